"""Which places of two rigs belong together: given, by shared landmarks, or found."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from reenact.errors import ReenactError
from reenact.rigs.rig import Rig


@dataclass(frozen=True)
class Places:
    """Points on the surface of a rig: each a weighted mean of three vertices."""

    corners: Int[Tensor, "N 3"]
    """Vertices of the face that a point lies on."""
    shares: Float[Tensor, "N 3"]
    """Barycentric coordinates, summing to 1."""

    @classmethod
    def at(cls, vertices: Int[Tensor, "N"]) -> Places:
        """The places of whole vertices."""
        corners = vertices[:, None].expand(-1, 3).contiguous()
        return cls(corners, torch.tensor([1.0, 0.0, 0.0]).expand(len(vertices), 3).contiguous())

    def __len__(self) -> int:
        return len(self.corners)

    def of(self, vertices: Float[Tensor, "*batch V 3"]) -> Float[Tensor, "*batch N 3"]:
        """Positions, or offsets, at the places."""
        shares = self.shares.to(vertices.dtype)
        return torch.einsum("...nci,nc->...ni", vertices[..., self.corners, :], shares)

    def __getitem__(self, chosen: Int[Tensor, "M"]) -> Places:
        return Places(self.corners[chosen], self.shares[chosen])


@dataclass(frozen=True)
class Correspondence:
    """N pairs of places, the n-th of the source with the n-th of the target.

    Raises:
        ReenactError: The sizes disagree, or there are fewer than four pairs.
    """

    source: Places
    target: Places
    confidence: Float[Tensor, "N"]
    """How sure each pair is, in [0, 1]; 1 where a person or the topology gave it."""

    def __post_init__(self) -> None:
        if not len(self.source) == len(self.target) == len(self.confidence):
            raise ReenactError(
                f"correspondence: expected as many source as target places and confidences, got {len(self.source)}, "
                f"{len(self.target)} and {len(self.confidence)}"
            )
        if len(self.source) < 4:
            raise ReenactError(f"correspondence: expected at least 4 pairs, got {len(self.source)}")

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, chosen: Int[Tensor, "M"]) -> Correspondence:
        return Correspondence(self.source[chosen], self.target[chosen], self.confidence[chosen])

    def reversed(self) -> Correspondence:
        """The same pairs from the target to the source."""
        return Correspondence(self.target, self.source, self.confidence)

    @classmethod
    def identity(cls, source: Rig, target: Rig) -> Correspondence:
        """Each vertex with the vertex of the same number, for rigs that share their topology.

        Raises:
            ReenactError: The rigs differ in their number of vertices.
        """
        if len(source.neutral) != len(target.neutral):
            raise ReenactError(
                f"correspondence: expected rigs with as many vertices, got {len(source.neutral)} of {source.name} and "
                f"{len(target.neutral)} of {target.name}; let the correspondence be found"
            )
        places = Places.at(torch.arange(len(source.neutral)))
        return cls(places, places, torch.ones(len(places)))
