"""Blending across silhouettes: the gradient of coverage.

On a face rig triangles are smaller than pixels, so that the edge which separates two pixels rarely belongs to the
triangle that either shows. We therefore start from the edges, as none of the published rules for larger triangles does
(compare Laine et al. 2020, "Modular Primitives for High-Performance Differentiable Rendering",
doi:10.1145/3414685.3417861, section 3.5): an edge is a silhouette when exactly one of its faces is a front face; it
separates the two pixels between whose centres it passes if it lies in front of one and its own surface covers the
other; and of several edges between two centres the outermost counts.
"""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

DEPTH_MARGIN = 1e-4
"""An edge is in front of a pixel's surface if its inverse depth is larger by this share."""


def edges_of(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "E 4"]:
    """Each edge once: its two vertices, ascending, and its two faces, the second -1 where the mesh ends.

    Where more than two faces share an edge, the third and later ones each get the edge once more to themselves.
    """
    count = len(faces)
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values  # (3 F, 2)
    owners = torch.arange(count, device=faces.device).repeat(3)
    order = torch.argsort(ends[:, 0] * (int(faces.max()) + 1) + ends[:, 1], stable=True)
    ends, owners = ends[order], owners[order]
    starts = torch.ones(3 * count, dtype=torch.bool, device=faces.device)
    starts[1:] = (ends[1:] != ends[:-1]).any(1)
    positions = torch.arange(3 * count, device=faces.device)
    rank = positions - torch.where(starts, positions, 0).cummax(0).values  # 0, 1, 2, ... within the faces of an edge
    second = torch.full_like(owners, -1)
    second[:-1] = torch.where(rank[1:] == 1, owners[1:], -1)
    kept = rank != 1
    second[rank > 1] = -1
    return torch.cat([ends, owners[:, None], second[:, None]], 1)[kept]
