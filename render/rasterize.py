"""Which triangle covers each pixel: integers, so no gradient starts here."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from render.camera import to_pixels

NEAR = 1e-3
"""Metres. A face with a corner nearer than this, or behind the camera, is not drawn."""


def front_faces(
    vertices_clip: Float[Tensor, "B V 4"], faces: Int[Tensor, "F 3"], height: int, width: int
) -> Bool[Tensor, "B F"]:
    """Faces that turn their counter-clockwise side to the camera and lie wholly in front of it."""
    pixels = to_pixels(vertices_clip, height, width)
    first, second, third = pixels[:, faces].unbind(2)
    area = _cross(second - first, third - first)  # rows point down, so counter-clockwise is negative
    return (area < 0) & (vertices_clip[:, faces, 3] > NEAR).all(-1)


@torch.no_grad()
def rasterize(
    vertices_clip: Float[Tensor, "B V 4"], faces: Int[Tensor, "F 3"], height: int, width: int
) -> Int[Tensor, "B H W"]:
    """Index of the nearest front face at each pixel centre, -1 where there is none.

    A centre on the edge between two faces belongs to exactly one of them, in any order of the faces.
    """
    batch = len(vertices_clip)
    face_img = torch.full((batch, height, width), -1)
    inverse_img = torch.zeros(batch, height, width).to(vertices_clip)  # 1 / depth: linear in the picture
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centres = torch.stack([columns, rows], -1).to(vertices_clip)  # (H, W, 2)
    pixels = to_pixels(vertices_clip, height, width)
    front = front_faces(vertices_clip, faces, height, width)
    for frame, face in front.nonzero().tolist():
        corners = pixels[frame, faces[face].flip(0)]  # (3, 2), clockwise: areas inside are positive
        areas = []
        inside = torch.ones(height, width, dtype=torch.bool)
        for start, end in ((1, 2), (2, 0), (0, 1)):  # the edge opposite each corner
            area = _cross(corners[start] - centres, corners[end] - centres)  # (H, W)
            along_x, along_y = (corners[end] - corners[start]).tolist()
            owns_edge = along_y > 0 or (along_y == 0 and along_x < 0)
            inside &= (area >= 0) if owns_edge else (area > 0)
            areas.append(area)
        areas = torch.stack(areas, -1)
        inverse = (areas / areas.sum(-1, keepdim=True) / vertices_clip[frame, faces[face].flip(0), 3]).sum(-1)
        nearest = inside & (inverse > inverse_img[frame])
        face_img[frame][nearest] = face
        inverse_img[frame][nearest] = inverse[nearest]
    return face_img


def _cross(a: Float[Tensor, "*batch 2"], b: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch"]:
    return a[..., 0] * b[..., 1] - b[..., 0] * a[..., 1]
