"""What moves behind the skin, where no place of a correspondence lies: eyeballs, tongue, teeth.

Ours. Places are pairs of points on skin that both heads have. A gaze hardly moves them and a tongue not at all, so that
no method that looks at places can tell them from a face at rest. Which point of an eyeball is which, nothing says; but
an eyeball lies where the other's lies, once both heads have the same proportions, and turns by the same angle. Motions
of the pieces of mesh without places become fields, averaged over a small neighbourhood, at some points of both.

On `anny:merged`, whose gaze no place tells, eyeballs were wrong by 0.71 of their motion, and are by 0.18 so.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from reenact.geometry import connected_pieces, farthest_points
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.inverse_rig import nonnegative_least_squares
from reenact.retargeting.rbf import CarriedShapes
from reenact.rigs.rig import Rig

_REACH = 0.04
"""Width over which motion is averaged, as a share of the spread of the places: less than an eyeball, of which one side
goes where the other comes from."""
_POINTS = 300
"""Of each head at which fields are compared."""
_VERTICES = 1024
"""Compared with the skin at a time: bounds memory."""
_BESIDE = 8
"""Vertices of the skin that are beside another."""
_HIDDEN = 0.01
"""A shape that moves places less than this, where 1 is how far it moves anything inside, says nothing there."""
_CHIEFLY = 1.0
"""One that moves them less than this is better read inside."""
_SPARSITY = 0.01
"""Weight that a shape loses where it acts alone. Looking left and right at once shrinks an eyeball, which would explain
away how offsets cut the corners of turns; with it no shape acts for so little."""


@dataclass(frozen=True)
class Inside:
    """How the shapes of two rigs move what no place lies on, in the source's proportions; float64."""

    ours: Float[Tensor, "Ks D"]
    """Fields of the source's shapes."""
    theirs: Float[Tensor, "Kt D"]
    """Of the target's."""
    our_seen: Float[Tensor, "Ks"]
    """How far each shape moves any place, where 1 is how far it moves anything inside."""
    their_seen: Float[Tensor, "Kt"]

    @classmethod
    def of(cls, source: Rig, target: Rig, correspondence: Correspondence, carried: CarriedShapes) -> Inside:
        """
        Args:
            source: The actor.
            target: The rig.
            correspondence: Pairs of places.
            carried: The target in the source's proportions, by these pairs.
        """
        sides = (source, correspondence.source), (target, correspondence.target)
        inner = [_inner_vertices(rig, places) for rig, places in sides]
        seen = [_seen(rig, places, some) for (rig, places), some in zip(sides, inner)]
        if not len(inner[0]) or not len(inner[1]):
            return cls(*(torch.zeros(len(rig.names), 0).double() for rig, _ in sides), *seen)
        places = carried.source_neutral
        width = _REACH * float((places - places.mean(0)).square().sum(1).mean().sqrt())
        points, start = source.neutral[inner[0]].double(), target.neutral[inner[1]].double()
        placed = carried.carry(start)
        probes = torch.cat([each[farthest_points(each, min(_POINTS, len(each)))] for each in (points, placed)])
        return cls(
            _field(probes, points, source.deltas[:, inner[0]].double(), width),
            _field(probes, placed, carried.carry(start + target.deltas[:, inner[1]].double()) - placed, width),
            *seen,
        )

    def hidden(self) -> tuple[Float[Tensor, "Ks D"], Float[Tensor, "Kt D"]]:
        """The fields of shapes that move no place, as rows to be compared; 0 for all others."""
        return (
            self.ours * (self.our_seen < _HIDDEN)[:, None],
            self.theirs * (self.their_seen < _HIDDEN)[:, None],
        )

    @property
    def chiefly(self) -> Bool[Tensor, "Kt"]:
        """Shapes of the target that are better read inside than at places."""
        return (self.their_seen < _CHIEFLY) & self.theirs.any(1)

    def corrected(self, source_weights: Float[Tensor, "T Ks"], weights: Float[Tensor, "T Kt"]) -> Float[Tensor, "T Kt"]:
        """The target's weights, those of shapes that act chiefly inside read from what the others leave to move there.

        Args:
            source_weights: Of the source.
            weights: Of the target, in [0, 1], by any method that looks at places.
        """
        inner, outer = self.chiefly.nonzero().flatten(), (~self.chiefly).nonzero().flatten()
        if not len(inner):
            return weights
        left = source_weights.double() @ self.ours - weights[:, outer].double() @ self.theirs[outer]
        basis = self.theirs[inner]
        gram = basis @ basis.T
        found = nonnegative_least_squares(gram, left @ basis.T - _SPARSITY * gram.diagonal(), high=1.0)
        return weights.index_copy(1, inner, found.to(weights))


def _inner_vertices(rig: Rig, places: Places) -> Int[Tensor, "N"]:
    """Moving vertices of pieces of the mesh on which no place lies, and which some shape moves otherwise than the skin.

    Lashes and teeth go with what is beside them: of what a shape does to them the nearest skin tells all but a quarter.
    Of a gaze or a tongue that comes out it tells a quarter at most.
    """
    piece = torch.from_numpy(connected_pieces(rig.faces.numpy(), len(rig.neutral))).long()
    touched = torch.zeros(int(piece.max()) + 1, dtype=torch.bool)
    touched[piece[places.corners.flatten()]] = True
    strength = rig.deltas.norm(dim=-1).amax(0)
    skin = touched[piece].nonzero().flatten()
    moving = (~touched[piece] & (strength > 1e-3 * strength.max())).nonzero().flatten()
    tree = cKDTree(rig.neutral[skin].numpy())
    energy, left = (torch.zeros(len(rig.names), len(touched)).double() for _ in range(2))
    for some in moving.split(_VERTICES):
        beside = skin[tree.query(rig.neutral[some].numpy(), range(1, min(_BESIDE, len(skin)) + 1))[1]]
        moved, missed = rig.deltas[:, some].double(), torch.full((len(some),), torch.inf).double()
        told = torch.zeros(len(rig.names), len(some)).double()
        for near in beside.T:  # of these few, the one that goes most alike
            each = (moved - rig.deltas[:, near]).square().sum(-1)
            better = each.sum(0) < missed
            told, missed = torch.where(better, each, told), torch.where(better, each.sum(0), missed)
        energy.index_add_(1, piece[some], moved.square().sum(-1))
        left.index_add_(1, piece[some], told)
    counts = energy > 0.1 * energy.amax(0)  # what hardly moves a piece says nothing of it
    return moving[((left > 0.5 * energy) & counts).any(0)[piece[moving]]]


def _seen(rig: Rig, places: Places, inner: Int[Tensor, "N"]) -> Float[Tensor, "K"]:
    """How far each shape moves any place, where 1 is how far it moves any of the inner vertices."""
    if not len(inner):
        return torch.full((len(rig.names),), torch.inf).double()
    at_places, inside = (moved.double().norm(dim=-1) for moved in (places.of(rig.deltas), rig.deltas[:, inner]))
    return at_places.amax(1) / inside.amax(1).clamp_min(1e-300)


def _field(
    probes: Float[Tensor, "P 3"], points: Float[Tensor, "N 3"], motions: Float[Tensor, "K N 3"], width: float
) -> Float[Tensor, "K D"]:
    """Mean motion of the points around each probe; fades where there are none."""
    near = torch.exp(-torch.cdist(probes, points).square() / (2 * width**2))
    near = near / near.sum(1, keepdim=True).clamp_min(1e-3)
    return torch.einsum("pn,kni->kpi", near, motions).flatten(1)
