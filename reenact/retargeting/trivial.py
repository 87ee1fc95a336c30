"""What every method must beat, or may hope to reach: a face that does not move, and weights copied by name."""

from __future__ import annotations

from dataclasses import replace

import torch

from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.files import conform
from reenact.rigs.rig import Rig


class Neutral:
    """Leaves the target at rest. The floor: what scores no better has learned nothing."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
    ) -> None:
        self.source, self.target = source, target

    def __call__(self, clip: Clip) -> Clip:
        """As many frames of rest."""
        check_names(clip, self.source)
        return replace(clip, names=self.target.names, weights=torch.zeros(len(clip), len(self.target.names)))


class CopyNames:
    """Copies the weight of each shape to the shape of the same name.

    Where two rigs mean the same by their names and have the same range of motion, nothing can be better; where they do
    not, it is wrong without a sign of it. The spellings of ARKit's names count as the same, and merged or split sides
    are averaged or doubled; see `conform`, whose warnings name what is lost.
    """

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
    ) -> None:
        """
        Raises:
            ReenactError: No shape of the target has a namesake.
        """
        self.source, self.target = source, target
        each = Clip(source.names, torch.eye(len(source.names)), fps=30.0)
        self.matrix = conform(each, target, where=source.name).weights  # (Ks, Kt)

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        return replace(clip, names=self.target.names, weights=(clip.weights.float() @ self.matrix).clamp(0, 1))
