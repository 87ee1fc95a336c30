"""The face of a rig: the one connected sheet that its shapes move, skin and lips, and the rims of its openings. Ours.

Some heads end at the lid's margin, and others have skin in the socket behind it. What lies there has no partner on a
head without; the margin has one on both. What is out of sight is told by the renderer, the only use that geometric
methods make of it: any mesh that it draws has insides, closed or not, and its depth is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from reenact.errors import ReenactError
from reenact.geometry import (
    boundary_edges,
    connected_pieces,
    edge_graph,
    mesh_edges,
    nearest_along,
    vertex_areas,
    vertex_normals,
)
from reenact.rigs.rig import Rig
from render.camera import Camera, to_pixels
from render.pipeline import render
from render.shade import Light

MOVING = 0.1
"""A vertex belongs to the moving face where shapes move it by more than this share of how far they move anything,
summed over shapes by squares."""

STILL = 0.02
"""A shape that moves the face by less than this share of the farthest moving one says nothing about it."""

_SURFACE_PARTS = ("skin", "lips", "brows")
_MARGIN = 0.2
"""Still skin around what moves that belongs to a face, in face heights: the other rig may move more."""
_DEEP = 0.15
"""Skin out of sight belongs to a socket where it reaches so many face heights away from what is seen: inner lips and
folds reach 0.03 to 0.09 on the heads we have, sockets 0.24 to 0.52."""
_RIM = 0.03
"""Face heights in which the nearness of a rim falls by e."""
_SIDES = [(yaw, pitch) for yaw in (-70, -35, 0, 35, 70) for pitch in (-40, 0, 40)]
"""Degrees from the front from which a face is looked at, to see what can be seen of it."""
_PIXELS = 512
"""Height and width of what is seen, about two faces."""
_SLACK = 0.004
"""Face heights that a vertex may lie behind what is seen at its pixel; a pixel is as wide."""


@dataclass(frozen=True)
class Face:
    """The connected sheet of a rig that its shapes move, without eyes, teeth, tongue and lashes."""

    vertices: Int[np.ndarray, "N"]
    """Numbers in the rig."""
    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    areas: Float[np.ndarray, "N"]
    """A third of the area around each vertex."""
    faces: Int[np.ndarray, "M 3"]
    """Of the sheet's own vertices."""
    deltas: Float[np.ndarray, "K N 3"]
    strength: Float[np.ndarray, "N"]
    """Root of the summed squares of how far shapes move a vertex, each as a share of its farthest motion."""
    hollow: Bool[np.ndarray, "N"]
    """Skin deep out of sight, in the sockets behind the lids."""
    rim: Float[np.ndarray, "N"]
    """Nearness of the margin of lids and lips: 1 where the moving skin ends or a hollow begins, 0 far from there."""
    height: float
    """Of the moving face, brows to chin, metres."""

    @classmethod
    def of(cls, rig: Rig) -> Face:
        """The face of a rig.

        Raises:
            ReenactError: Nothing moves.
        """
        points, faces = rig.neutral.double().cpu().numpy(), rig.faces.cpu().numpy()
        deltas = rig.deltas.double().cpu().numpy()
        motion = np.linalg.norm(deltas, axis=-1)  # (K, V)
        farthest = motion.max(1, keepdims=True)
        if farthest.max() <= 1e-9:
            raise ReenactError(f"{rig.name}: expected shapes that move the face, got none; did the export keep them?")
        live = farthest[:, 0] > STILL * farthest.max()
        strength = np.sqrt(np.square(motion[live] / farthest[live]).sum(0))
        sheet = _sheet(rig, points, faces, strength)
        moving = sheet & (strength > MOVING)
        if moving.sum() < 20:
            raise ReenactError(
                f"{rig.name}: expected a face that its shapes move, got {int(moving.sum())} connected vertices "
                "that move; check the parts and the deltas"
            )
        low, high = (np.quantile(points[moving, 1], share) for share in (0.02, 0.98))
        height = float(high - low)
        near = cKDTree(points[moving]).query(points, distance_upper_bound=max(_MARGIN * height, 1e-9))[0] < np.inf
        kept = faces[(sheet & near)[faces].all(1)]
        vertices, own = np.unique(kept, return_inverse=True)
        own, shown = own.reshape(kept.shape), points[vertices]
        seen = seen_from_outside(rig, np.median(points[moving], axis=0), height)[vertices]
        hollow = _hollow(shown, own, seen, height)
        return cls(
            vertices,
            shown,
            surface_normals(shown, own),
            vertex_areas(shown, own),
            own,
            np.ascontiguousarray(deltas[:, vertices]),
            strength[vertices],
            hollow,
            _rim(shown, own, hollow, strength[vertices], height),
            height,
        )

    def without_hollows(self) -> Face:
        """The same face, ending at the lid's margin."""
        kept, own = np.unique(self.faces[~self.hollow[self.faces].any(1)], return_inverse=True)
        own, shown = own.reshape(-1, 3), self.points[kept]
        return replace(
            self,
            vertices=self.vertices[kept],
            points=shown,
            normals=surface_normals(shown, own),
            areas=vertex_areas(shown, own),
            faces=own,
            deltas=np.ascontiguousarray(self.deltas[:, kept]),
            strength=self.strength[kept],
            hollow=self.hollow[kept],
            rim=self.rim[kept],
        )


def _sheet(rig: Rig, points: np.ndarray, faces: np.ndarray, strength: np.ndarray) -> np.ndarray:
    """Marks the connected sheet with the largest moved area; vertices at one place count as connected."""
    marked = np.ones(len(points), bool)
    if len(rig.part(*_SURFACE_PARTS)):
        marked = np.zeros(len(points), bool)
        marked[rig.part(*_SURFACE_PARTS).cpu().numpy()] = True
    kept = faces[marked[faces].all(1)]
    _, place = np.unique(points.round(7), axis=0, return_inverse=True)
    ends = place[kept[:, [0, 1, 2]]].ravel(), place[kept[:, [1, 2, 0]]].ravel()
    count = int(place.max()) + 1
    _, piece = connected_components(coo_array((np.ones(len(ends[0])), ends), shape=(count, count)), directed=False)
    piece = piece[place]
    moved_area = np.bincount(piece, weights=vertex_areas(points, kept) * strength)
    return marked & (piece == moved_area.argmax())


def seen_from_outside(rig: Rig, middle: Float[np.ndarray, "3"], height: float) -> Bool[np.ndarray, "V"]:
    """Whether each vertex, at rest, is seen from any side in front of the face. All parts hide what is behind them.

    Args:
        rig: Any rig that faces +Z.
        middle: Of the face, metres.
        height: Of the face, metres.
    """
    scale = max(height, 1e-12)
    points = ((rig.neutral.double().cpu() - torch.from_numpy(middle)) / scale).float()
    faces = rig.faces.cpu()
    normals = vertex_normals(points.double(), faces).float()
    seen = torch.zeros(len(points), dtype=torch.bool)
    for yaw, pitch in np.radians(_SIDES).tolist():
        way = torch.tensor([math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)])
        camera = Camera.look_at(8 * way, torch.zeros(3), focal=8.0)
        picture = render(points[None], faces, camera, Light(8 * way), height=_PIXELS, width=_PIXELS, buffers=("depth",))
        clip = camera.project(points)
        column, row = to_pixels(clip, _PIXELS, _PIXELS).round().clamp(-1, _PIXELS).long().unbind(-1)
        inside = (column >= 0) & (column < _PIXELS) & (row >= 0) & (row < _PIXELS)
        nearest = picture["depth"][0, 0][row.clamp(0, _PIXELS - 1), column.clamp(0, _PIXELS - 1)]
        unhidden = (nearest == 0) | (clip[:, 3] <= nearest + _SLACK)
        seen |= inside & unhidden & (normals @ way > 0)
    return seen.numpy()


def _hollow(points: np.ndarray, faces: np.ndarray, seen: np.ndarray, height: float) -> Bool[np.ndarray, "N"]:
    """Connected skin out of sight that reaches deep."""
    if not seen.any():  # a head that looks away, or in a box
        return np.zeros(len(points), bool)
    depth = nearest_along(edge_graph(points, mesh_edges(faces)), np.flatnonzero(seen))[1]
    count = len(points)
    pieces = connected_pieces(faces[~seen[faces].any(1)], count)
    deepest = np.zeros(count)
    np.maximum.at(deepest, pieces, np.where(seen | np.isinf(depth), 0, depth))
    return ~seen & (deepest[pieces] > _DEEP * height)


def _rim(
    points: np.ndarray, faces: np.ndarray, hollow: np.ndarray, strength: np.ndarray, height: float
) -> Float[np.ndarray, "N"]:
    """Nearness of borders that move: not of the neck, or where the still head behind the face begins."""
    border = np.unique(boundary_edges(faces[~hollow[faces].any(1)]))
    border = border[strength[border] > MOVING]
    if len(border) == 0:
        return np.zeros(len(points))
    distance = nearest_along(edge_graph(points, mesh_edges(faces)), border)[1]
    return np.exp(-distance / max(_RIM * height, 1e-12))


def surface_normals(points: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "M 3"]) -> Float[np.ndarray, "N 3"]:
    """`vertex_normals` of arrays: unit length."""
    return vertex_normals(torch.from_numpy(points), torch.from_numpy(faces)).numpy()
