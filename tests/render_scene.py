"""Small scenes for the tests of the renderer."""

from __future__ import annotations

import torch
import trimesh

from render import Camera, Light

GREY = (0.2, 0.5, 0.4)


def flat_camera(height: int) -> Camera:
    """At the origin; the plane z = -1 spans `height` metres in `height` rows, so that one pixel is one metre."""
    return Camera(torch.eye(3, 4, dtype=torch.float64), focal=2.0 / height)


def at_pixels(columns_rows: list, height: int, width: int, depth: float = 1.0) -> torch.Tensor:
    """World points (N, 3) that `flat_camera` puts at the given columns and rows; pixel centres are whole numbers."""
    points = torch.tensor(columns_rows, dtype=torch.float64)
    x, y = points[:, 0] - (width - 1) / 2, (height - 1) / 2 - points[:, 1]
    return torch.stack([x, y, -torch.ones_like(x)], -1) * depth


def ambient() -> Light:
    """Colours as they are: no light falls."""
    return Light(torch.tensor([0.0, 0.0, 1.0]), ambient=1.0, diffuse=0.0, specular=0.0)


def bumpy_spheres(subdivisions: int = 1, seed: int = 0) -> dict:
    """Two frames of a bumpy ball with a smaller one before it, which makes an inner silhouette; float64."""
    generator = torch.Generator().manual_seed(seed)
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.1)
    vertices, faces = torch.tensor(sphere.vertices), torch.tensor(sphere.faces).long()
    count = len(vertices)
    vertices = vertices * (1 + 0.1 * torch.rand(count, 1, dtype=torch.float64, generator=generator))
    small = 0.3 * vertices + torch.tensor([0.04, 0.02, 0.13], dtype=torch.float64)
    vertices = torch.cat([vertices, small])
    return {
        "vertices": torch.stack([vertices, 1.05 * vertices]),
        "faces": torch.cat([faces, faces + count]),
        # Off the axes of the icosphere: no vertex lies on a pixel centre, where the gradient jumps.
        "camera": Camera.look_at(
            torch.tensor([0.05, 0.02, 0.6], dtype=torch.float64),
            torch.tensor([0.003, 0.0017, 0.0], dtype=torch.float64),
            focal=4.5,
        ),
        "light": Light(torch.tensor([0.3, 0.4, 0.8], dtype=torch.float64), 0.2, 0.6, 0.2, 6.0),
        "colors": 0.2 + 0.6 * torch.rand(2 * count, 3, dtype=torch.float64, generator=generator),
        "uv": torch.rand(2 * count, 2, dtype=torch.float64, generator=generator),
        "texture": 0.2 + 0.6 * torch.rand(5, 4, 3, dtype=torch.float64, generator=generator),
    }
