"""Skin that passes through skin: which vertices of lips and lids lie in each other, how deep, and the way out. Ours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from reenact.geometry import (
    boundary_edges,
    closest_points,
    mesh_edges,
    vertex_normals,
)
from reenact.retargeting.anatomy import Shell, unit_vectors
from reenact.retargeting.tetrahedra import first_hits
from reenact.rigs.rig import Rig

_DEEPEST = {"lips": 0.06, "lids_left": 0.03, "lids_right": 0.03}
"""Share of H beyond which a point is taken to lie behind the other side, not in it: what lips and lids are thick."""


def interpenetration(shell: Shell, vertices: Float[Tensor, "T V 3"]) -> dict[str, Float[Tensor, "T"]]:
    """How deep the two sides of each contact lie in each other, metres; 0 where they do not.

    A vertex of one side is inside the other where the closest point of that side's skin faces away from it, within 60
    degrees of straight, and is no border of it; and where an edge from it, or from those inside beside it, to the
    outside passes through that skin. Its depth is the distance to that point. Where sides already lie in each other at
    rest, as lips do in some sculpted neutrals, that depth counts too.
    """
    shell._check(vertices)
    depths = {}
    for name, contact in shell.contacts.items():
        sides = [Side.of(shell.rig, side) for side in (contact.upper.numpy(), contact.lower.numpy())]
        limit = _DEEPEST[name] * shell.height
        frames = []
        for mesh in vertices.double().numpy():
            found = [first.depths(mesh, second, limit) for first, second in (sides, sides[::-1])]
            frames.append(max(depth.max(initial=0.0) for depth in found))
        depths[name] = torch.tensor(frames)
    return depths


@dataclass(frozen=True)
class Side:
    """One side of a contact: its vertices and the faces around them."""

    vertices: ndarray
    number: ndarray
    """Vertices of the faces."""
    local: ndarray
    """Faces, as places in `number`."""
    place: ndarray
    """Of `vertices` in `number`."""
    edge: ndarray
    """Which of `number` are on the border of the faces."""
    ends: ndarray
    """(E, 2) edges that a vertex of the side is an end of, as places in `number`."""

    @classmethod
    def of(cls, rig: Rig, vertices: Int[ndarray, "U"]) -> Side:
        faces = rig.faces.numpy()
        member = np.zeros(len(rig.neutral), bool)
        member[vertices] = True
        near = faces[member[faces].any(1)]  # one ring more, so that no member is a border
        number, local = np.unique(near, return_inverse=True)
        local = local.reshape(-1, 3)
        edge = np.isin(np.arange(len(number)), boundary_edges(local))
        ends = mesh_edges(local)
        ends = ends[member[number][ends].any(1)]
        return cls(vertices, number, local, np.searchsorted(number, vertices), edge, ends)

    def depths(self, mesh: ndarray, other: Side, limit: float) -> Float[ndarray, "U"]:
        """How deep this side's vertices are inside the other."""
        inside, distance, _, _, _ = self.hits(mesh, other, limit)
        return np.where(inside, distance, 0.0)

    def hits(
        self, mesh: Float[ndarray, "V 3"], other: Side, limit: float, facing: bool = True
    ) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray]:
        """Which of this side's vertices are inside the other, how deep, and where they would come out.

        Args:
            mesh: Of the rig.
            other: Whose surface they may have passed.
            limit: Metres; what is farther behind the surface is not in it.
            facing: Only vertices whose own normal is opposed to that of the other surface.

        Returns:
            (U,) inside; (U,) distance to the closest point; (U, 3) its corners, vertices of the rig; (U, 3) its shares;
            (U, 3) its normal.
        """
        points, number, local = mesh[self.vertices], other.number, other.local
        surface = mesh[number]
        found, shares = closest_points(torch.from_numpy(points), torch.from_numpy(surface), torch.from_numpy(local))
        corners, shares = local[found.numpy()], shares.double().numpy()
        normals = vertex_normals(torch.from_numpy(surface), torch.from_numpy(local)).numpy()
        places = (surface[corners] * shares[..., None]).sum(1)
        normal = unit_vectors((normals[corners] * shares[..., None]).sum(1))
        away = points - places
        distance = np.linalg.norm(away, axis=1)
        # Beside the border of the other side nothing tells in from out; and skin that meets skin faces it. On a fold
        # rounding chose one of two faces: the corner across it does not count, nor does the normal of that face.
        holds = shares > 1e-6
        on_edge = (other.edge[corners] & holds).any(1) | (distance == 0)
        flat = np.cross(
            surface[corners[:, 1]] - surface[corners[:, 0]], surface[corners[:, 2]] - surface[corners[:, 0]]
        )
        # The way out of flesh runs along the normal; a way across it leads around an edge.
        behind = ((away * normal).sum(1) < -0.5 * distance) & (~holds.all(1) | ((away * flat).sum(1) < 0))
        inside = behind & ~on_edge & (distance < limit)
        if facing:
            own = vertex_normals(torch.from_numpy(mesh[self.number]), torch.from_numpy(self.local)).numpy()[self.place]
            inside &= (own * normal).sum(1) < 0
        if inside.any():
            inside &= self._crosses(mesh, surface[local], inside)
        return inside, distance, number[corners], shares, normal

    def _crosses(
        self, mesh: Float[ndarray, "V 3"], triangles: Float[ndarray, "F 3 3"], inside: ndarray
    ) -> Bool[ndarray, "U"]:
        """Vertices whose group of connected ones inside has an edge to the outside that passes through a triangle.

        Behind a surface is not yet in it: in a mouth wide open the inner side of one lip lies behind the other, and
        pushing it out of what it is not in drives it in.
        """
        within = np.zeros(len(self.number), bool)
        within[self.place] = inside
        ends = self.ends[within[self.ends].any(1)]
        both = within[ends].all(1)
        links = coo_array((np.ones(both.sum()), ends[both].T), shape=(len(within),) * 2)
        count, groups = connected_components(links, directed=False)
        out = np.where(within[ends[~both, :1]], ends[~both], ends[~both, ::-1])
        starts, leads = mesh[self.number[out[:, 0]]], mesh[self.number[out[:, 1]]] - mesh[self.number[out[:, 0]]]
        lengths = np.linalg.norm(leads, axis=1)
        nobody = np.full((len(triangles), 3), -1)
        reach = first_hits(starts, unit_vectors(leads), triangles, nobody, lengths.max(initial=0.0), False)
        crossing = np.zeros(count, bool)
        # In the corner both sides have vertices in common: an edge that ends in one touches, and does not cross.
        crossing[groups[out[reach < (1 - 1e-6) * lengths, 0]]] = True
        return crossing[groups[self.place]]
