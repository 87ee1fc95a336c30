"""Clip: blendshape weights over time."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError


@dataclass(frozen=True)
class Clip:
    """Weights of named blendshapes at a constant frame rate.

    Raises:
        ReenactError: Sizes disagree, a weight is not finite, a name is doubled, the rate is not positive.
    """

    names: tuple[str, ...]
    """K blendshape names, all different."""
    weights: Float[Tensor, "T K"]
    """Coefficients, 0 at rest and 1 at the full shape."""
    fps: float
    """Frames per second."""
    rotations: Float[Tensor, "frames 9"] | None = None
    """Yaw, pitch and roll of the head, the left and the right eye in radians, as Live Link Face records them. They pass
    through retargeting untouched."""

    def __post_init__(self) -> None:
        if self.weights.shape[1] != len(self.names):
            raise ReenactError(f"clip: expected {len(self.names)} weights a frame, got {self.weights.shape[1]}")
        if len(set(self.names)) != len(self.names):
            doubled = sorted({name for name in self.names if self.names.count(name) > 1})
            raise ReenactError(f"clip: names must differ, doubled: {', '.join(doubled)}")
        if self.rotations is not None and self.rotations.shape != (len(self.weights), 9):
            raise ReenactError(
                f"clip: expected rotations ({len(self.weights)}, 9), a row per frame, got {tuple(self.rotations.shape)}"
            )
        if self.rotations is not None and not bool(torch.isfinite(self.rotations).all()):
            raise ReenactError("clip: rotations must be finite, one is NaN or infinity")
        if not bool(torch.isfinite(self.weights).all()):
            frame = int((~torch.isfinite(self.weights)).any(1).nonzero()[0])
            raise ReenactError(f"clip: weights must be finite, frame {frame} holds NaN or infinity")
        if not self.fps > 0 or self.fps == float("inf"):
            raise ReenactError(f"clip: expected a positive frame rate, got {self.fps}")

    def __len__(self) -> int:
        """Frames."""
        return len(self.weights)

    @property
    def duration(self) -> float:
        """Seconds."""
        return len(self) / self.fps
