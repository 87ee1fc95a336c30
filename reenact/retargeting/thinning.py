"""Thinned rigs, for work whose cost grows faster than the number of vertices. Ours.

Vertices that lie far from each other are chosen, more of them where shapes move the surface. Every other vertex goes to
the nearest of them along the edges, and a triangle of the mesh that joins three such neighbourhoods becomes a triangle
between the three chosen vertices. These stay where they were and move as they did.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from reenact.geometry import edge_graph, farthest_points, mesh_edges, nearest_along
from reenact.rigs.rig import Rig

_STILL = 0.2
"""Weight of a vertex that nothing moves, beside 1 for the one that moves most: how sparsely it may be thinned."""


def thinned(rig: Rig, count: int) -> tuple[Rig, Int[Tensor, "N"]]:
    """A rig of at most `count` vertices, without texture, and which vertices of the rig they are.

    A rig that has no more is returned as it is. Vertices without a triangle left are dropped.
    """
    if len(rig.neutral) <= count:
        return rig, torch.arange(len(rig.neutral))
    motion = rig.deltas.norm(dim=-1).amax(0)
    chosen = farthest_points(rig.neutral, count, _STILL + motion / motion.max().clamp_min(1e-30))
    faces = _joined(rig, chosen.numpy())
    kept, numbered = np.unique(faces, return_inverse=True)
    vertices = chosen[torch.from_numpy(kept)]
    smaller = replace(
        rig,
        neutral=rig.neutral[vertices],
        deltas=rig.deltas[:, vertices],
        faces=torch.from_numpy(numbered.reshape(-1, 3)),
        colors=None if rig.colors is None else rig.colors[vertices],
        parts=None if rig.parts is None else rig.parts[vertices],
        uv=None,
        uv_faces=None,
        texture=None,
    )
    return smaller, vertices


def _joined(rig: Rig, chosen: Int[np.ndarray, "N"]) -> Int[np.ndarray, "F 3"]:
    """Triangles between neighbourhoods of the chosen vertices, as indices of these; each once."""
    faces = rig.faces.numpy()
    graph = edge_graph(rig.neutral.double().numpy(), mesh_edges(faces))
    corners = nearest_along(graph, chosen)[0][faces]  # pieces without a chosen vertex have none
    a, b, c = corners.T
    corners = corners[(corners >= 0).all(1) & (a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    return corners[np.sort(first)]
