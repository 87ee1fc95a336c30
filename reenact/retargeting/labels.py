"""Weights of one rig for another's motion, with how far to believe each frame: labels for networks without pairs."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.retargeting.correspondence import Correspondence, find_correspondence
from reenact.retargeting.geometric_prior import bending
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.shape_matching import ShapeMatching
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

MARKERS = 300
"""Pairs of places that labels are made from."""


def labels(
    source: Rig, target: Rig, clip: Clip, correspondence: Correspondence | None = None
) -> tuple[Float[Tensor, "T Kt"], Float[Tensor, "T"]]:
    """Weights of the target for each frame of the source's clip, and the confidence in them.

    The confidence is exp(-E_Fit / E_0) exp(-E_Prior / P_0), 1 at rest: how much of the frame the weights leave
    unexplained at the markers, with E_0 a tenth of how much the frame moves them, and how much they bend the target,
    with P_0 what it rarely bends in expressions of its own.

    Args:
        source: Performs the clip.
        target: Is to perform it.
        clip: With the source's names, in its order.
        correspondence: Pairs of places; found where None.

    Raises:
        ReenactError: The clip is not the source's, or no correspondence is found.

    Source: ours, from the energies of RB17, Eq. 2 and 15. Medians of the clip for E_0 and P_0, the obvious choice,
    doubt half of any clip, and everything in a clip whose usual frame is exact.
    """
    pairs = find_correspondence(source, target, MARKERS) if correspondence is None else correspondence
    method = ShapeMatching(source, target, pairs)
    weights = method(clip).weights
    carried = carry_shapes(source, target, pairs, stiffness=0.1)
    personal = carried.guess.clone()
    for ours, theirs in method.partners:
        personal[theirs] = carried.source_shapes[ours]
    moved = carried.displacements(clip.weights)
    missed = moved - torch.einsum("tk,kni->tni", weights.double(), personal)
    unexplained, motion_energy = ((each.square().sum(-1) * carried.confidence).mean(1) for each in (missed, moved))
    quadratic = bending(target).double()
    own = motion.expressions(target.names, 200, seed=0).double()
    often = _bent(own, quadratic).quantile(0.95).clamp_min(1e-300)
    share = unexplained / motion_energy.clamp_min(1e-12 * float(motion_energy.max().clamp_min(1e-300)))
    return weights, torch.exp(-share / 0.1 - _bent(weights.double(), quadratic) / often).float()


def _bent(weights: Float[Tensor, "T K"], quadratic: Float[Tensor, "K K"]) -> Float[Tensor, "T"]:
    """E_Prior of expressions."""
    return torch.einsum("tk,kl,tl->t", weights, quadratic, weights)
