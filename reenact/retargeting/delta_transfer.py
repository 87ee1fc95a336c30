"""Delta transfer: every vertex of the target moves by its partner's offset, scaled and turned.

Noh & Neumann 2001, "Expression Cloning", doi:10.1145/383259.383290, reduced to its plainest form, with one scale for
the whole head unless asked otherwise. The baseline of mesh methods: fast, and blind to how the surface stretches.

Symbol     Code          Shape
S_i - S    deltas        (Ks, Vs, 3)
c(v)       vertex_pairs  (Vt, Vs)
sigma      size          () or (Vt,)
J_v        turns         (Vt, 3, 3)

x_t^v = T^v + sigma J_v (S_i - S)^c(v) is linear in the source's offsets, so transferring its shapes once is exact.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from reenact.geometry import connected_pieces, similarity_fit, vertex_normals
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import (
    Explanation,
    apply_sparse,
    densify,
    vertex_pairs,
)
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


class DeltaTransfer:
    """Carries the offsets of the source's shapes to the target's vertices."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        scale: Literal["head", "local"] = "head",
        turn: bool = True,
        reach: float = 0.05,
    ) -> None:
        """
        Args:
            source: Where motion comes from.
            target: Where it goes to.
            correspondence: Pairs; see `densify`.
            training: Not used.
            scale: `head` takes the ratio of sizes of the whole heads, `local` that of the surface around each vertex.
            turn: Turn each offset by the smallest rotation that takes the source's normal to the target's.
            reach: See `DeformationTransfer`.

        Raises:
            ReenactError: There is no correspondence, or it belongs to other rigs.

        Source: the sum of Noh & Neumann's steps 1 and 2. Where they turn by local frames made of the normal and the
        surface's own edges, which needs a common topology, we turn by the normal alone.
        """
        self.source, self.target = source, target
        correspondence = densify(source, target, correspondence)
        followed = vertex_pairs(source, target, correspondence, reach)
        if scale == "head":
            places = correspondence.source.of(source.neutral), correspondence.target.of(target.neutral)
            size, _, _ = similarity_fit(*places, correspondence.confidence)
        else:
            size = _local_size(source, target, followed)[:, None]
        offsets = apply_sparse(followed, source.deltas.double()) * size.double()
        if turn:
            normals = vertex_normals(source.neutral, source.faces).double()
            partner_normals = apply_sparse(followed, normals[None])[0]
            turns = smallest_rotations(partner_normals, vertex_normals(target.neutral, target.faces).double())
            offsets = torch.einsum("vij,kvj->kvi", turns, offsets)
        pieces = connected_pieces(target.faces.numpy(), len(target.neutral))
        self._explanation = Explanation(target, pieces, followed.sum(1))
        self._projection = self._explanation.projections(offsets)  # (Ks, Kt)
        offsets = self._explanation.complete(offsets)
        name = f"{source.name} on {target.name}"
        self.shapes = Rig(name, target.neutral, offsets.float(), source.names, target.faces)
        """The source's shapes on the target's mesh."""

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target: bounded least squares of `vertices(clip)`, weights in [0, 1]."""
        check_names(clip, self.source)
        weights = self._explanation.weights(clip.weights.double() @ self._projection)
        return replace(clip, names=self.target.names, weights=weights.float())

    def vertices(self, clip: Clip) -> Float[Tensor, "T V 3"]:
        """Target vertices in metres, outside the span of the target's own shapes."""
        check_names(clip, self.source)
        return self.shapes.vertices(clip.weights)


def smallest_rotations(start: Float[Tensor, "N 3"], end: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Rotations that take each direction to another the shortest way; the identity where they are opposite or 0.

    Source: Rodrigues' formula, R = I + [v]x + [v]x^2 / (1 + c), with v the cross and c the dot product.
    """
    start, end = torch.nn.functional.normalize(start, dim=1), torch.nn.functional.normalize(end, dim=1)
    cosine = (start * end).sum(1)
    x, y, z = torch.linalg.cross(start, end).unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).unflatten(1, (3, 3))
    unit = torch.eye(3, dtype=start.dtype, device=start.device)
    known = (cosine > -0.999) & (start.norm(dim=1) > 0.5) & (end.norm(dim=1) > 0.5)
    rotations = unit + cross + cross @ cross / (1 + cosine).clamp_min(1e-3)[:, None, None]
    return torch.where(known[:, None, None], rotations, unit)


def _local_size(source: Rig, target: Rig, followed: csr_array) -> Float[Tensor, "V"]:
    """How much longer the target's edges around each vertex are than the way between the partners of their ends.

    Both lengths are summed over the edges of three rings of neighbours; a vertex without partners has 1.
    """
    count = len(target.neutral)
    coverage = followed.sum(1)
    partners = (followed @ source.neutral.double().numpy()) / np.maximum(coverage, 1e-12)[:, None]
    edges = target.faces.numpy()[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[(coverage[edges] > 0).all(1)]
    around = coo_array((np.ones(2 * len(edges)), (edges.ravel(), edges[:, ::-1].ravel())), shape=(count, count)).tocsr()
    sums = []
    for points in (target.neutral.double().numpy(), partners):
        lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        total = np.bincount(edges.ravel(), np.repeat(lengths, 2), minlength=count)
        sums.append(around @ (around @ total))
    return torch.from_numpy(np.where(sums[1] > 0, sums[0] / np.maximum(sums[1], 1e-12), 1.0))
