"""Partners where two rigs are built to one scheme, and what three methods agree on where they are not.

Ours. `shape_matching` is nearly exact where the shapes of two rigs pair off one to one, and helpless where they do not.
Then nothing is left but how far things move, and each method reads that in its own way: offsets turned with the surface
(`delta_transfer`), triangles (`deformation_transfer`), a thin-plate map between faces (`rbf`). Their mistakes have
little in common, so that the mean of their weights is closer to the truth than the best of them; a blink that two of
them leave half open closes in the mean.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer, densify
from reenact.retargeting.delta_transfer import DeltaTransfer
from reenact.retargeting.rbf import ProportionMatching
from reenact.retargeting.retargeter import Retargeter, check_names
from reenact.retargeting.shape_matching import ShapeMatching
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


class Consensus:
    """`ShapeMatching` where shapes pair off, else the mean of delta transfer, deformation transfer and `rbf`."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        likeness: Float[Tensor, "Ks Kt"] | None = None,
    ) -> None:
        """
        Args:
            source: Its motion is explained.
            target: Explains it.
            correspondence: Pairs of places; a few hundred tell small shapes apart.
            training: Not used.
            likeness: See `ShapeMatching`.

        Raises:
            ReenactError: There is no correspondence, or it belongs to other rigs.
        """
        self.source, self.target = source, target
        self.matching = ShapeMatching(source, target, correspondence, likeness=likeness)
        """Its `partners` are empty where the rigs are not built to one scheme."""
        self.methods: tuple[Retargeter, ...] = (self.matching,)
        if not self.matching.partners:
            dense = densify(source, target, correspondence)
            self.methods = (
                DeltaTransfer(source, target, dense),
                DeformationTransfer(source, target, dense),
                ProportionMatching(source, target, correspondence),
            )

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        answers = torch.stack([method(clip).weights for method in self.methods])
        weights = answers.mean(0)
        if not self.matching.partners:
            weights = self.matching.inside.corrected(clip.weights, weights)
        return replace(clip, names=self.target.names, weights=weights)
