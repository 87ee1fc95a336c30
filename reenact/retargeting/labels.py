"""Weights of one rig for another's motion, with how far to believe each frame: labels for networks without pairs."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.retargeting.consensus import Consensus
from reenact.retargeting.correspondence import Correspondence, find_correspondence
from reenact.retargeting.geometric_prior import bending
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.retargeter import check_names
from reenact.retargeting.shape_matching import Partners
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

MARKERS = 300
"""Pairs of places that labels are made from."""


class Labels:
    """Weights of the target for expressions of the source, by `Consensus`, and the confidence in them."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        likeness: Float[Tensor, "Ks Kt"] | None = None,
    ) -> None:
        """
        Args:
            source: Performs.
            target: Is to perform the same.
            correspondence: Pairs of places; `MARKERS` of them are found where None.
            likeness: See `ShapeMatching`.

        Raises:
            ReenactError: No correspondence is found.
        """
        self.source, self.target = source, target
        pairs = find_correspondence(source, target, MARKERS) if correspondence is None else correspondence
        self._method = Consensus(source, target, pairs, likeness=likeness)
        self._carried = carry_shapes(source, target, pairs, stiffness=0.1)
        self._personal = self.partners.personal(self._carried.source_shapes, self._carried.guess)
        self._bending = bending(target).double()
        own = motion.expressions(target.names, 200, seed=0).double()
        self._often = self._bent(own).quantile(0.95).clamp_min(1e-300)

    @property
    def partners(self) -> Partners:
        """Shapes that mean each other; none where the rigs are not built to one scheme."""
        return self._method.matching.partners

    def weights(self, source_weights: Float[Tensor, "T Ks"]) -> Float[Tensor, "T Kt"]:
        """Weights of the target in [0, 1]."""
        return self._method(Clip(self.source.names, source_weights, 30.0)).weights  # frame by frame: no rate matters

    def confidence(
        self, source_weights: Float[Tensor, "T Ks"], weights: Float[Tensor, "T Kt"] | None = None
    ) -> Float[Tensor, "T"]:
        """How far to believe each frame: exp(-E_Fit / E_0) exp(-E_Prior / P_0), in [0, 1], 1 at rest.

        How much of the frame the weights leave unexplained at the markers, with E_0 a tenth of how much the frame moves
        them, and how much they bend the target, with P_0 what it rarely bends in expressions of its own.

        Args:
            source_weights: Expressions of the source.
            weights: Of the target, from `weights`, where they are at hand.

        Source: ours, from the energies of RB17, Eq. 2 and 15. Medians of the clip for E_0 and P_0, the obvious choice,
        doubt half of any clip, and everything in a clip whose usual frame is exact.
        """
        weights = self.weights(source_weights) if weights is None else weights
        moved = self._carried.displacements(source_weights)
        missed = moved - torch.einsum("tk,kni->tni", weights.double(), self._personal)
        unexplained, energy = ((each.square().sum(-1) * self._carried.confidence).mean(1) for each in (missed, moved))
        share = unexplained / energy.clamp_min(1e-12 * float(energy.max().clamp_min(1e-300)))
        return torch.exp(-share / 0.1 - self._bent(weights.double()) / self._often).float()

    def _bent(self, weights: Float[Tensor, "T K"]) -> Float[Tensor, "T"]:
        """E_Prior of expressions."""
        return torch.einsum("tk,kl,tl->t", weights, self._bending, weights)


def labels(
    source: Rig, target: Rig, clip: Clip, correspondence: Correspondence | None = None
) -> tuple[Float[Tensor, "T Kt"], Float[Tensor, "T"]]:
    """Weights of the target for each frame of the source's clip, and the confidence in them; see `Labels`.

    Raises:
        ReenactError: The clip is not the source's, or no correspondence is found.
    """
    check_names(clip, source)
    made = Labels(source, target, correspondence)
    weights = made.weights(clip.weights)
    return weights, made.confidence(clip.weights, weights)
