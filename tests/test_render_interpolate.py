"""Barycentric coordinates and vertex attributes per pixel."""

from __future__ import annotations

import pytest
import torch
from render_scene import at_pixels, bumpy_spheres, flat_camera

from render import Camera
from render.camera import to_pixels
from render.interpolate import barycentrics, interpolate
from render.rasterize import rasterize


def test_barycentric_coordinates_sum_to_one_and_find_their_own_pixel():
    scene = bumpy_spheres()
    camera, faces = scene["camera"], scene["faces"]
    clip = camera.project(scene["vertices"])
    face_img = rasterize(clip, faces, 16, 14)
    bary_img = barycentrics(clip, faces, face_img)
    covered = face_img >= 0
    sums = bary_img.sum(-1)
    torch.testing.assert_close(sums[covered], torch.ones_like(sums[covered]), rtol=0, atol=1e-12)  # float64
    assert not bary_img[~covered].any()
    x, y, _, w = interpolate(clip, faces, face_img, bary_img).unbind(-1)
    rows, columns = torch.meshgrid(torch.arange(16.0), torch.arange(14.0), indexing="ij")
    columns_found, rows_found = 6.5 + x / w * 8, 7.5 - y / w * 8
    assert (columns_found - columns)[covered].abs().max() < 1e-9  # float64, 16 pixels
    assert (rows_found - rows)[covered].abs().max() < 1e-9


def test_interpolation_is_perspective_correct():
    # From depth 1 on the left to depth 3 on the right. Half way between in the picture, 1 / depth is the mean of 1 and
    # 1 / 3, so the depth is 1.5, a quarter of the way along the surface.
    corners = at_pixels([(0, 0), (0, 8), (8, 0), (8, 8)], 9, 9)
    corners[2:] *= 3
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    clip = flat_camera(9).project(corners)[None]
    face_img = rasterize(clip, faces, 9, 9)
    along = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64)[None, :, None]
    found = interpolate(along, faces, face_img, barycentrics(clip, faces, face_img))
    assert found[0, 3, 4, 0].item() == pytest.approx(0.25, abs=1e-12)  # float64


@pytest.mark.parametrize("stage", ["barycentrics", "interpolate", "project", "to_pixels"])
def test_gradients_of_a_stage_match_finite_differences(stage):
    scene = bumpy_spheres()
    faces, camera = scene["faces"], scene["camera"]
    clip = camera.project(scene["vertices"][:1])
    face_img = rasterize(clip, faces, 9, 8)
    generator = torch.Generator().manual_seed(0)
    if stage == "barycentrics":
        function, inputs = (lambda clip: barycentrics(clip, faces, face_img)), (clip,)
    elif stage == "interpolate":
        attributes = torch.rand(1, clip.shape[1], 2, dtype=torch.float64, generator=generator)
        coordinates = barycentrics(clip, faces, face_img)
        function = lambda values, img: interpolate(values, faces, face_img, img)  # noqa: E731
        inputs = (attributes, coordinates)
    elif stage == "project":
        function = lambda vertices, matrix, focal: Camera(matrix, focal).project(vertices)  # noqa: E731
        inputs = (scene["vertices"][0, :5], camera.world_to_camera, torch.tensor(4.5, dtype=torch.float64))
    else:
        function, inputs = (lambda clip: to_pixels(clip, 9, 8)), (clip,)
    leaves = tuple(value.detach().clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(function, leaves)
