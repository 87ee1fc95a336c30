"""Camera: world -> camera -> clip space -> pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole that looks along -Z of its own space, +Y up, with square pixels.

    Raises:
        ValueError: The focal length is not a positive number.
    """

    world_to_camera: Float[Tensor, "3 4"]
    """Rotation and translation (metres) that take a world point to camera space."""
    focal: float | Float[Tensor, ""]
    """Focal length in units of half the image height: 1 / tan(half the vertical field of view)."""

    def __post_init__(self) -> None:
        if not 0 < self.focal < float("inf"):
            raise ValueError(f"camera: expected a positive focal length, got {self.focal}")

    @staticmethod
    def look_at(eye: Float[Tensor, "3"], target: Float[Tensor, "3"], focal: float | Float[Tensor, ""]) -> Camera:
        """The camera at `eye` that has `target` in the middle of its picture and +Y upright."""
        backward = torch.nn.functional.normalize(eye - target, dim=0)
        up = torch.tensor([0.0, 1.0, 0.0], dtype=eye.dtype, device=eye.device)
        right = torch.nn.functional.normalize(torch.linalg.cross(up, backward), dim=0)
        rotation = torch.stack([right, torch.linalg.cross(backward, right), backward])  # rows: axes of the camera
        return Camera(torch.cat([rotation, -(rotation @ eye)[:, None]], dim=1), focal)

    def to_camera(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World points in camera space, metres."""
        matrix = self.world_to_camera.to(points)
        return points @ matrix[:, :3].T + matrix[:, 3]

    def project(self, vertices: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
        """World points in clip space (x, y, z, w): x / w and y / w count half image heights, w is the depth in metres.

        The picture's width is not needed: pixels are square, so it only decides where the sides are cut off.
        """
        x, y, z = self.to_camera(vertices).unbind(-1)
        return torch.stack([self.focal * x, self.focal * y, z, -z], dim=-1)


def to_pixels(vertices_clip: Float[Tensor, "*batch 4"], height: int, width: int) -> Float[Tensor, "*batch 2"]:
    """Column and row of clip-space points; the centre of the top left pixel is (0, 0)."""
    x, y, _, w = vertices_clip.unbind(-1)
    return torch.stack([(width - 1) / 2 + x / w * (height / 2), (height - 1) / 2 - y / w * (height / 2)], dim=-1)
