"""Rig: a neutral face and its blendshapes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from reenact.errors import ReenactError

PARTS = ("skin", "lips", "brows", "eyes", "lashes", "teeth", "tongue", "mouth")
"""Names of the values of `Rig.parts`; `eyes` are the eyeballs, `mouth` is the lining of the mouth."""


@dataclass(frozen=True)
class Rig:
    """A neutral mesh, named offsets from it, and how its surface looks.

    Metres, +Y up, the face looks along +Z. Colours are sRGB in [0, 1].

    Raises:
        ReenactError: Sizes disagree, a number is not finite, a name is doubled, a face names a missing vertex.
    """

    name: str
    neutral: Float[Tensor, "V 3"]
    """Resting vertices."""
    deltas: Float[Tensor, "K V 3"]
    """Offsets from the neutral that each blendshape adds at weight 1."""
    names: tuple[str, ...]
    """K blendshape names, all different."""
    faces: Int[Tensor, "F 3"]
    """Triangles, counter-clockwise from outside."""
    colors: Float[Tensor, "V 3"] | None = None
    """Vertex colours; a texture, where there is one, multiplies them."""
    parts: Int[Tensor, "V"] | None = None
    """Index into `PARTS` for each vertex, where known."""
    uv: Float[Tensor, "U 2"] | None = None
    """Texture coordinates, (0, 0) top left. U may exceed V: seams split uv, never geometry."""
    uv_faces: Int[Tensor, "F 3"] | None = None
    """Triangles that index `uv`; None where they equal `faces`."""
    texture: Float[Tensor, "Ht Wt 3"] | None = None
    """Base colour picture."""

    def __post_init__(self) -> None:
        vertex_count, shape_count = len(self.neutral), len(self.names)
        if self.deltas.shape != (shape_count, vertex_count, 3):
            raise ReenactError(
                f"{self.name}: expected deltas ({shape_count}, {vertex_count}, 3) for {shape_count} names and "
                f"{vertex_count} vertices, got {tuple(self.deltas.shape)}"
            )
        if vertex_count == 0 or shape_count == 0 or len(self.faces) == 0:
            raise ReenactError(
                f"{self.name}: expected vertices, faces and at least one blendshape, got {vertex_count} vertices, "
                f"{len(self.faces)} faces, {shape_count} blendshapes; export the mesh with its shape keys"
            )
        if len(set(self.names)) != shape_count:
            doubled = sorted({name for name in self.names if self.names.count(name) > 1})
            raise ReenactError(f"{self.name}: blendshape names must differ, doubled: {', '.join(doubled)}")
        if int(self.faces.min()) < 0 or int(self.faces.max()) >= vertex_count:
            raise ReenactError(f"{self.name}: a face names a vertex outside 0..{vertex_count - 1}")
        for field in ("neutral", "deltas", "colors", "uv", "texture"):
            value = getattr(self, field)
            if value is not None and not bool(torch.isfinite(value).all()):
                raise ReenactError(f"{self.name}: {field} holds NaN or infinity; re-export the mesh")
        for field, expected in (("colors", vertex_count), ("parts", vertex_count)):
            value = getattr(self, field)
            if value is not None and len(value) != expected:
                raise ReenactError(f"{self.name}: expected {expected} {field}, one per vertex, got {len(value)}")
        if self.texture is not None and self.uv is None:
            raise ReenactError(f"{self.name}: has a texture but no uv coordinates; export the mesh with its uv map")
        if self.uv is not None:
            uv_faces = self.faces if self.uv_faces is None else self.uv_faces
            if uv_faces.shape != self.faces.shape or int(uv_faces.max()) >= len(self.uv) or int(uv_faces.min()) < 0:
                raise ReenactError(
                    f"{self.name}: uv faces do not match the {len(self.faces)} faces and {len(self.uv)} uv; "
                    "export the mesh with its uv map again"
                )

    def vertices(self, weights: Float[Tensor, "*batch K"]) -> Float[Tensor, "*batch V 3"]:
        """The expression that the weights make: neutral + sum of weighted deltas. Source: KI21, Eq. 1."""
        if weights.shape[-1] != len(self.names):
            raise ReenactError(f"{self.name}: expected weights (..., {len(self.names)}), got {tuple(weights.shape)}")
        flat = weights @ self.deltas.flatten(1)  # (..., 3 V): one matrix product
        return self.neutral + flat.unflatten(-1, self.neutral.shape)

    def to(self, device: torch.device | str) -> Rig:
        """The same rig with its tensors on a device."""
        moved = {key: value.to(device) for key, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **moved)

    def part(self, *names: str) -> Int[Tensor, "N"]:
        """Indices of the vertices whose part is one of the names; empty where parts are unknown."""
        if self.parts is None:
            return torch.zeros(0, dtype=torch.int64)
        wanted = torch.tensor([PARTS.index(name) for name in names])
        return torch.isin(self.parts, wanted.to(self.parts.device)).nonzero().flatten()
