"""Which triangle covers each pixel. The readable stage and the compiled one are held to the same claims."""

from __future__ import annotations

import pytest
import torch
from render_scene import ambient, at_pixels, bumpy_spheres, flat_camera

from render import render
from render.rasterize import rasterize


def by_stage(vertices, faces, height, width):
    """Covered pixels (H, W) as the readable stage sees them."""
    return rasterize(flat_camera(height).project(vertices)[None], faces, height, width)[0] >= 0


def by_kernel(vertices, faces, height, width):
    """Covered pixels (H, W) as the kernel sees them."""
    made = render(
        vertices[None], faces, flat_camera(height), ambient(), height=height, width=width, buffers=("depth",)
    )  # fmt: skip
    return made["depth"][0, 0] > 0


both = pytest.mark.parametrize("covered", [by_stage, by_kernel])
TRIANGLE = torch.tensor([[0, 1, 2]])


@both
def test_a_triangle_covers_the_pixel_centres_inside_it(covered):
    # Counter-clockwise as seen; the hypotenuse runs from (0.5, 4.6) to (4.6, 0.5): columns + rows < 5.1.
    corners = at_pixels([(0.5, 0.5), (0.5, 4.6), (4.6, 0.5)], 6, 8)
    rows, columns = torch.meshgrid(torch.arange(6), torch.arange(8), indexing="ij")
    expected = (columns >= 1) & (rows >= 1) & (columns + rows <= 5)
    assert torch.equal(covered(corners, TRIANGLE, 6, 8), expected)


@both
def test_the_back_of_a_triangle_is_not_drawn(covered):
    corners = at_pixels([(0.5, 0.5), (4.6, 0.5), (0.5, 4.6)], 6, 8)
    assert not covered(corners, TRIANGLE, 6, 8).any()


@both
def test_two_triangles_share_a_border_through_pixel_centres_without_gap_or_overlap(covered):
    # A square whose border and diagonal run through pixel centres: each centre belongs to one triangle or to none.
    corners = at_pixels([(1, 1), (1, 5), (5, 5), (5, 1)], 7, 7)
    lower, upper = torch.tensor([[0, 1, 2]]), torch.tensor([[0, 2, 3]])
    one, other = covered(corners, lower, 7, 7), covered(corners, upper, 7, 7)
    assert not (one & other).any()
    assert int((one | other).sum()) == 16  # 4 x 4: of each two opposite borders one counts


@both
def test_triangles_that_have_no_area_or_lie_elsewhere_draw_nothing(covered):
    line = at_pixels([(1, 1), (3, 3), (5, 5)], 6, 8)
    point = at_pixels([(2, 2), (2, 2), (2, 2)], 6, 8)
    outside = at_pixels([(100, 100), (100, 140), (140, 100)], 6, 8)
    behind = at_pixels([(0.5, 0.5), (0.5, 4.6), (4.6, 0.5)], 6, 8, depth=-1.0)
    half_behind = at_pixels([(0.5, 0.5), (0.5, 4.6), (4.6, 0.5)], 6, 8)
    half_behind[2, 2] = 1.0
    at_the_eye = torch.zeros(3, 3, dtype=torch.float64)
    for corners in (line, point, outside, behind, half_behind, at_the_eye):
        assert not covered(corners, TRIANGLE, 6, 8).any()


@both
def test_a_triangle_far_larger_than_the_picture_covers_all_of_it(covered):
    corners = at_pixels([(-1e6, -1e6), (-1e6, 3e6), (3e6, -1e6)], 6, 8)
    assert covered(corners, TRIANGLE, 6, 8).all()


def test_kernel_and_stage_pick_the_same_faces():
    scene = bumpy_spheres(subdivisions=2)
    vertices, faces, camera = scene["vertices"], scene["faces"], scene["camera"]
    face_img = rasterize(camera.project(vertices), faces, 24, 20)
    labels = torch.arange(vertices.shape[1])
    made = render(
        vertices, faces, camera, ambient(), height=24, width=20, parts=labels, buffers=("parts", "depth")
    )  # fmt: skip
    corner = made["parts"][:, 0]  # a corner of the face that the kernel saw
    assert torch.equal(corner >= 0, face_img >= 0)
    seen = face_img >= 0
    assert (faces[face_img[seen]] == corner[seen][:, None]).any(-1).all()
