"""What every method answers to."""

from __future__ import annotations

from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


class Retargeter(Protocol):
    """Moves motion from `source` to `target`; everything slow happened in the constructor."""

    source: Rig
    target: Rig

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target: the target's shapes, as many frames, the same rate."""
        ...


class MeshRetargeter(Retargeter, Protocol):
    """A retargeter that makes the target's vertices first, and weights of them."""

    def vertices(self, clip: Clip) -> Float[Tensor, "T V 3"]:
        """Target vertices in metres, in the target's own frame; they need not lie in the span of its shapes."""
        ...
