"""What shapes do that move no place of a correspondence: tongues, teeth, and whatever else hides behind the skin.

Ours. Places lie on skin that both heads have, so that a tongue that comes out moves none of them, and no method that
looks at places can tell it from a face at rest. Inside, nothing says which point is which; but a tongue lies where the
other tongue lies, once both heads have the same proportions, and moves the same way. Motions become fields, smooth
enough to be compared without knowing points, at some points of both.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.rbf import CarriedShapes, ThinPlate
from reenact.rigs.rig import Rig

_SEEN = 0.01
"""Share of a shape's farthest motion that places see at least, where they tell it from others."""
_POINTS = 200
"""Of each head at which fields are compared, and that make a field."""


def hidden_motions(
    source: Rig, target: Rig, correspondence: Correspondence, carried: CarriedShapes, width: float
) -> tuple[Float[Tensor, "Ks D"], Float[Tensor, "Kt D"]]:
    """Motions of both rigs' hidden shapes, in the source's proportions, as rows to be compared; 0 for all others.

    Args:
        source: The actor.
        target: The rig.
        correspondence: Pairs of places.
        carried: What the shapes do at them.
        width: How far a field is smeared, in the source's units.

    Returns:
        Fields at the same D / 3 points; no columns where either rig hides nothing.
    """
    ours = hidden_shapes(source, carried.source_shapes)
    theirs = hidden_shapes(target, carried.shapes / carried.scale)
    if not len(ours) or not len(theirs):
        return torch.zeros(len(source.names), 0).double(), torch.zeros(len(target.names), 0).double()
    plate = ThinPlate(correspondence.target.of(target.neutral.double()), carried.source_neutral, stiffness=1.0)
    points, motions = _moving(source, ours)
    start, moved = _moving(target, theirs)
    placed = plate(start)
    probes = torch.cat([points, placed])

    def field(count: int, shapes: Tensor, at: Tensor, motions: Tensor) -> Tensor:
        near = torch.exp(-torch.cdist(probes, at).square() / (2 * width**2))
        smeared = torch.einsum("pv,kvi->kpi", near, motions).flatten(1)
        return smeared.new_zeros(count, smeared.shape[1]).index_copy(0, shapes, smeared)

    return (
        field(len(source.names), ours, points, motions),
        field(len(target.names), theirs, placed, plate(start + moved) - placed),
    )


def hidden_shapes(rig: Rig, at_places: Float[Tensor, "K N 3"]) -> Int[Tensor, "H"]:
    """Shapes that move vertices, but hardly a place; `at_places` is how they move those, in the rig's units."""
    moved, seen = (each.double().norm(dim=-1).amax(1) for each in (rig.deltas, at_places))  # the farthest, (K,)
    return ((moved > 1e-3 * moved.max()) & (seen < _SEEN * moved)).nonzero().flatten()


def _moving(rig: Rig, shapes: Int[Tensor, "H"]) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "H N 3"]]:
    """Some vertices that the shapes move, evenly spread, and how; float64."""
    strength = rig.deltas[shapes].square().sum(-1).amax(0)
    moving = (strength > 0.01 * strength.max()).nonzero().flatten()
    chosen = moving[farthest_points(rig.neutral[moving], min(_POINTS, len(moving)))]
    return rig.neutral[chosen].double(), rig.deltas[shapes][:, chosen].double()
