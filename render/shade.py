"""Light, vertex normals, texture lookup, and the colour of each pixel.

Phong 1975, "Illumination for Computer Generated Pictures", doi:10.1145/360825.360839. Light is added and blended in
linear units; colours that come from or go to people are sRGB (IEC 61966-2-1).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Light:
    """A white point light and how the surface answers to it; no falloff with distance.

    Raises:
        ValueError: A coefficient is negative.
    """

    position: Float[Tensor, "3"]
    """World space, metres."""
    ambient: float | Float[Tensor, ""] = 0.25
    """Share of the albedo that is seen without light."""
    diffuse: float | Float[Tensor, ""] = 0.75
    """Share of the albedo that is seen where the light falls straight onto the surface."""
    specular: float | Float[Tensor, ""] = 0.05
    """Linear intensity in the middle of the highlight."""
    shininess: float | Float[Tensor, ""] = 16.0
    """Exponent of the highlight; larger is smaller and sharper."""

    def __post_init__(self) -> None:
        for name in ("ambient", "diffuse", "specular", "shininess"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"light: expected {name} of 0 or more, got {getattr(self, name)}")

    @property
    def coefficients(self) -> Float[Tensor, "4"]:
        """Ambient, diffuse, specular, shininess; a gradient reaches those that are tensors."""
        numbers = (self.ambient, self.diffuse, self.specular, self.shininess)
        return torch.stack(
            [torch.as_tensor(n, dtype=self.position.dtype, device=self.position.device) for n in numbers]
        )


def linear_from_srgb(srgb: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Linear light of sRGB values."""
    # The clamp keeps the branch that is not taken from putting NaN into the gradient.
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """sRGB values of linear light, clamped to [0, 1]."""
    linear = linear.clamp(0, 1)
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def vertex_normals(vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B V 3"]:
    """Unit sums of the adjoining faces' area-weighted normals; 0 where a vertex has no area around it."""
    first, second, third = vertices[:, faces].unbind(2)
    face_normals = torch.linalg.cross(second - first, third - first)  # (B, F, 3), twice the area long
    sums = torch.zeros_like(vertices)
    for corner in range(3):
        sums = sums.index_add(1, faces[:, corner], face_normals)
    return unit(sums)


def mip_maps(texture: Float[Tensor, "Ht Wt C"]) -> list[Float[Tensor, "_rows _columns C"]]:
    """The texture and copies of it, each with half as many rows and columns, down to one texel.

    An odd last row or column counts twice.

    Williams 1983, "Pyramidal Parametrics", doi:10.1145/964967.801126. Mean values: give it linear light.
    """
    levels = [texture]
    while max(levels[-1].shape[:2]) > 1:
        smaller = levels[-1]
        for axis, size in enumerate(smaller.shape[:2]):
            if size > 1:
                pairs = smaller if size % 2 == 0 else torch.cat([smaller, smaller.narrow(axis, size - 1, 1)], axis)
                smaller = pairs.unflatten(axis, (-1, 2)).mean(axis + 1)
        levels.append(smaller)
    return levels


def texel_areas(uv: Float[Tensor, "U 2"], uv_faces: Int[Tensor, "F 3"], rows: int, columns: int) -> Float[Tensor, "F"]:
    """Twice the area of each face in the texture, in texels."""
    first, second, third = (uv * torch.tensor([columns, rows]).to(uv))[uv_faces].unbind(1)
    a, b = second - first, third - first
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs()


def level_of_detail(
    texel_areas: Float[Tensor, "*batch"],
    volumes: Float[Tensor, "*batch"],
    depths: Float[Tensor, "*batch"],
    focal: float | Float[Tensor, ""],
    levels: int,
) -> Float[Tensor, "*batch"]:
    """How often a texture is to be halved until a texel is as large as a pixel, in area; 0 where it is larger already.

    A pixel shows depth^3 / (volume focal^2) of a face, with the focal length in pixels and six times the volume between
    the face and the eye. Hardware looks at the longer side of what a pixel shows (Williams 1983); area blurs less and
    is smooth, so that its gradient can be followed (ours).

    Args:
        texel_areas: Twice the area of the sample's face in the texture, in texels.
        volumes: Six times the volume between the face and the eye, cubic metres.
        depths: Of the sample, metres.
        focal: Pixels.
        levels: Of the texture.
    """
    texels = texel_areas * depths**3 / (volumes.clamp(min=1e-30) * focal**2)
    return (0.5 * texels.clamp(min=1.0).log2()).clamp(max=levels - 1)


def sample_texture(
    levels: list[Float[Tensor, "_rows _columns C"]],
    uv_img: Float[Tensor, "*batch 2"],
    level_of_detail: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch C"]:
    """Lookup between four texels of each of the two levels next to `level_of_detail`.

    (0, 0) is the top left corner, texel centres lie half a texel inside, borders are repeated.
    """
    finer = level_of_detail.long()
    between = (level_of_detail - finer)[..., None]
    total = torch.zeros_like(uv_img[..., :1])
    for number, texture in enumerate(levels):
        share = torch.where((finer == number)[..., None], 1 - between, 0.0)
        share = torch.where((finer == number - 1)[..., None], between, share)
        total = total + share * _sample_level(texture, uv_img)
    return total


def _sample_level(texture: Float[Tensor, "Ht Wt C"], uv_img: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch C"]:
    rows, columns = texture.shape[:2]
    x = (uv_img[..., 0] * columns - 0.5).clamp(0, columns - 1)
    y = (uv_img[..., 1] * rows - 0.5).clamp(0, rows - 1)
    left, top = x.long(), y.long()
    right, bottom = (left + 1).clamp(max=columns - 1), (top + 1).clamp(max=rows - 1)
    s, t = (x - left)[..., None], (y - top)[..., None]
    upper = (1 - s) * texture[top, left] + s * texture[top, right]
    lower = (1 - s) * texture[bottom, left] + s * texture[bottom, right]
    return (1 - t) * upper + t * lower


def shade(
    albedo: Float[Tensor, "*batch 3"],
    normals: Float[Tensor, "*batch 3"],
    points: Float[Tensor, "*batch 3"],
    light_position: Float[Tensor, "3"],
    light: Light,
) -> Float[Tensor, "*batch 3"]:
    """Linear colour of surface points in camera space, seen from the origin.

    Args:
        albedo: Linear reflectance.
        normals: Unit length.
        points: Camera space, metres.
        light_position: The light in camera space, metres.
        light: Its coefficients.

    Source: Phong 1975, with the albedo in the ambient and diffuse terms and a white highlight.
    """
    to_light, to_eye = unit(light_position - points), unit(-points)
    n_l, n_v = (normals * to_light).sum(-1, keepdim=True), (normals * to_eye).sum(-1, keepdim=True)
    # The light vector mirrored at the normal, against the direction to the eye.
    r_v = 2 * n_l * n_v - (to_light * to_eye).sum(-1, keepdim=True)
    highlight = torch.where((n_l > 0) & (r_v > 0), r_v.clamp(min=1e-12) ** light.shininess, 0.0)
    return albedo * (light.ambient + light.diffuse * n_l.clamp(min=0)) + light.specular * highlight


def unit(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Vectors of length 1; a zero vector stays zero and passes no gradient on."""
    squared = (vectors**2).sum(-1, keepdim=True)
    return vectors * torch.where(squared > 0, squared, 1.0).rsqrt() * (squared > 0)
