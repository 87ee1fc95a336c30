"""Blendshapes of one head, made to fit another of the same topology.

Sumner & Popović 2004, "Deformation Transfer for Triangle Meshes", doi:10.1145/1015706.1015736; in the gradient form of
Botsch et al. 2006, "Deformation Transfer for Detail-Preserving Surface Editing": the unknown is the offset u of each
vertex, and every target edge e should change by (Q - I) e, where Q is how the source deformed the same triangle.

Paper   Code         Shape
Q       gradients    (F, 3, 3) one per triangle
u       offsets      (V, 3)

Transfer alone keeps proportions, not contacts: afterwards `close_pairs` moves the vertices that should touch, and what
surrounds them, until they do.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation


class Transfer:
    """Carries offsets from one neutral to another; what the source leaves in place stays in place on the target."""

    def __init__(
        self,
        source: Float[np.ndarray, "V 3"],
        target: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        fixed: Int[np.ndarray, "R"],
    ):
        """Args: fixed: Vertices that never move; every connected piece of the mesh needs one."""
        self.source, self.faces, self.fixed = source, faces, fixed
        self.source_frames = np.linalg.inv(_frames(source, faces))
        start, end = faces, np.roll(faces, -1, axis=1)  # (F, 3) edges a->b, b->c, c->a
        self.target_edges = target[end] - target[start]  # (F, 3, 3)
        incidence = _incidence(start.ravel(), end.ravel(), len(source))
        self.divergence = (incidence.T @ sparse.diags(_cotangents(target, faces).ravel())).tocsr()
        self.laplacian = (self.divergence @ incidence).tocsr()

    def __call__(self, offsets: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """The same motion on the target."""
        gradients = _frames(self.source + offsets, self.faces) @ self.source_frames
        wanted = (self.target_edges @ (gradients - np.eye(3)).transpose(0, 2, 1)).reshape(-1, 3)
        free = np.setdiff1d(np.flatnonzero((offsets != 0).any(1)), self.fixed)
        result = np.zeros_like(offsets)
        if len(free):
            system = self.laplacian[free][:, free].tocsc()
            result[free] = splu(system).solve(self.divergence[free] @ wanted)
        return result


class LocalField:
    """Smooth vector fields (thin plate) that take given values at some vertices and vanish far from them."""

    def __init__(
        self,
        points: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        handles: Int[np.ndarray, "N"],
        reach: float,
    ):
        """Args: reach: Distance from the handles in metres at which the field is zero."""
        distance = np.min(np.linalg.norm(points[:, None] - points[None, handles], axis=2), axis=1)
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        incidence = _incidence(start, end, len(points))
        laplacian = incidence.T @ sparse.diags(_cotangents(points, faces).ravel()) @ incidence
        bending = (laplacian @ laplacian + 1e-9 * sparse.eye(len(points))).tocsc()
        self.handles = handles
        self.inner = np.setdiff1d(np.flatnonzero(distance < reach), handles)
        self.coupling = bending[self.inner][:, handles]
        self.solve = splu(bending[self.inner][:, self.inner].tocsc()).solve
        self.count = len(points)

    def __call__(self, values: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "V 3"]:
        """The field with these values at the handles."""
        field = np.zeros((self.count, 3))
        field[self.handles] = values
        field[self.inner] = -self.solve(self.coupling @ values)
        return field


def close_pairs(
    posed: Float[np.ndarray, "V 3"],
    pairs: Int[np.ndarray, "N 2"],
    gaps: Float[np.ndarray, "N 3"],
    upper_share: float,
    field: LocalField,
) -> Float[np.ndarray, "V 3"]:
    """Offsets that bring vertex pairs to wanted gaps.

    Args:
        posed: Vertices as they are.
        pairs: (upper, lower).
        gaps: Wanted upper - lower, metres.
        upper_share: Part of the way that the upper vertices go; the lower ones go the rest.
        field: Spreads the correction; its handles are the upper vertices followed by the lower ones.
    """
    excess = posed[pairs[:, 0]] - posed[pairs[:, 1]] - gaps
    return field(np.concatenate([-upper_share * excess, (1 - upper_share) * excess]))


def rigid_rotation(points: Float[np.ndarray, "N 3"], moved: Float[np.ndarray, "N 3"]) -> Rotation:
    """The rotation about the centre of the points that comes nearest to a motion."""
    return Rotation.align_vectors(moved - moved.mean(0), points - points.mean(0))[0]


def affine_map(source: Float[np.ndarray, "N 3"], target: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3 3"]:
    """Linear part A of the map target = A source + b that fits two states of one point set best."""
    solution = np.linalg.lstsq(source - source.mean(0), target - target.mean(0), rcond=None)[0]
    return solution.T


def _frames(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Two edges and the scaled normal of each face, as columns. Source: Sumner & Popović 2004, Eq. 1."""
    first, second, third = points[faces].transpose(1, 0, 2)
    normal = np.cross(second - first, third - first)
    # Over the root of its length the normal grows like an edge; flat slivers keep a tiny one instead of none.
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.stack([second - first, third - first, normal / np.sqrt(length)], axis=2) + 1e-9 * np.eye(3)


def _cotangents(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) half cotangent opposite the edges a->b, b->c, c->a, kept positive so that the matrix stays definite."""
    result = []
    for apex in (2, 0, 1):
        tip, left, right = (points[faces[:, (apex + turn) % 3]] for turn in range(3))
        to_left, to_right = left - tip, right - tip
        cross = np.linalg.norm(np.cross(to_left, to_right), axis=1)
        result.append((to_left * to_right).sum(1) / np.maximum(cross, 1e-12) / 2)
    return np.clip(np.stack(result, axis=1), 0.05, 5.0)


def _incidence(start: np.ndarray, end: np.ndarray, count: int) -> sparse.csr_matrix:
    """(E, V): takes vertex values to differences end - start."""
    rows = np.arange(len(start))
    values = np.concatenate([np.ones(len(end)), -np.ones(len(start))])
    return sparse.csr_matrix((values, (np.r_[rows, rows], np.r_[end, start])), (len(start), count))
