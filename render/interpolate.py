"""Barycentric coordinates and vertex attributes per pixel: the gradient inside triangles."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def barycentrics(
    vertices_clip: Float[Tensor, "B V 4"], faces: Int[Tensor, "F 3"], face_img: Int[Tensor, "B H W"]
) -> Float[Tensor, "B H W 3"]:
    """Perspective-correct barycentric coordinates of each pixel's ray in its face; 0 on the background.

    Shearing a triangle until the ray is the viewing axis leaves areas in two dimensions, and no division by a depth.
    """
    batch, height, width = face_img.shape
    corners = vertices_clip[torch.arange(batch)[:, None, None, None], faces[face_img.clamp(min=0)]]  # (B, H, W, 3, 4)
    x = (torch.arange(width).to(vertices_clip) - (width - 1) / 2) * (2 / height)
    y = ((height - 1) / 2 - torch.arange(height).to(vertices_clip)) * (2 / height)
    sheared_x = corners[..., 0] - x[None, None, :, None] * corners[..., 3]  # (B, H, W, 3)
    sheared_y = corners[..., 1] - y[None, :, None, None] * corners[..., 3]
    areas = sheared_x.roll(-1, -1) * sheared_y.roll(-2, -1) - sheared_x.roll(-2, -1) * sheared_y.roll(-1, -1)
    covered = (face_img >= 0)[..., None]
    return torch.where(covered, areas / torch.where(covered, areas.sum(-1, keepdim=True), 1.0), 0.0)


def interpolate(
    attributes: Float[Tensor, "B V C"],
    faces: Int[Tensor, "F 3"],
    face_img: Int[Tensor, "B H W"],
    bary_img: Float[Tensor, "B H W 3"],
) -> Float[Tensor, "B H W C"]:
    """Vertex attributes at each pixel; 0 on the background."""
    batch = torch.arange(len(attributes))[:, None, None, None]
    corners = attributes[batch, faces[face_img.clamp(min=0)]]  # (B, H, W, 3, C)
    return (bary_img[..., None] * corners).sum(-2)
