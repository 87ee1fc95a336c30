"""What every method answers to."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


@runtime_checkable
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


def check_names(clip: Clip, source: Rig) -> None:
    """
    Raises:
        ReenactError: The clip's names are not the rig's, in its order.
    """
    if clip.names != source.names:
        raise ReenactError(
            f"clip: expected the {len(source.names)} shapes of {source.name} in its order ({source.names[0]}, ...), "
            f"got {len(clip.names)} ({', '.join(clip.names[:1])}, ...); use `reenact.rigs.files.conform`"
        )
