"""Proportion matching with a penalty on weights: the peers that Ribera 2017 compares its geometric prior with.

Ribera et al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment", doi:10.1145/3072959.3073674, Sec.
6.2: the thin-plate guess as personal shapes, and in Eq. 16 another norm in the place of E_Prior.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.priors import elastic_net, pca_prior
from reenact.retargeting.rbf import ProportionMatching
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

PRIORS = ("l2", "elastic-net", "pca")


class PenalisedMatching:
    """Bounded least squares in the carried shapes, with squares, magnitudes or unlikeness to the rig's shapes added."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        prior: str = "l2",
        strength: float = 0.001,
        sparsity: float = 0.002,
    ) -> None:
        """
        Args:
            source: The actor.
            target: The rig.
            correspondence: Pairs of places.
            training: Not used.
            prior: One of `PRIORS`.
            strength: Of the quadratic part, with the trace of the data's matrix made equal to its own.
            sparsity: Of the elastic net: what a shape of usual size that acts alone loses of its weight.

        Raises:
            ReenactError: No correspondence, an unknown prior, or a negative strength.

        Source: RB17, Eq. 16. The bounds, the units of the strengths, and that the PCA prior is centred on the neutral,
        so that a still face stays still, are ours.
        """
        if prior not in PRIORS:
            raise ReenactError(f"penalised matching: expected a prior among {', '.join(PRIORS)}, got {prior}")
        if strength < 0 or sparsity < 0:
            raise ReenactError(f"penalised matching: expected strengths of at least 0, got {strength} and {sparsity}")
        self.source, self.target = source, target
        matching = ProportionMatching(source, target, correspondence)
        self._projection = matching.source_projection
        size = matching.gram.diagonal().mean()
        quadratic = torch.eye(len(target.names), dtype=torch.float64)
        if prior == "pca":
            quadratic = pca_prior(target)[0]
        self.gram = matching.gram + strength * size / quadratic.diagonal().mean() * quadratic
        self._magnitudes = 2 * len(target.names) * sparsity * float(size) if prior == "elastic-net" else 0.0

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        projections = clip.weights.to(torch.float64) @ self._projection
        weights = elastic_net(self.gram, projections, magnitudes=self._magnitudes, high=1.0)
        return replace(clip, names=self.target.names, weights=weights.float())
