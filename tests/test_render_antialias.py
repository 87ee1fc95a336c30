"""Blending across silhouettes, in the readable stage and in the kernel."""

from __future__ import annotations

import pytest
import torch
from render_scene import ambient, at_pixels, bumpy_spheres, flat_camera

from render import render, render_by_stages
from render.antialias import edges_of

SQUARE = torch.tensor([[0, 1, 2], [0, 2, 3]])


def square(left: float, top: float, right: float, bottom: float, depth: float = 1.0) -> torch.Tensor:
    """Corners (1, 4, 3) of a rectangle that faces the camera, in columns and rows of a 12 x 16 picture."""
    return at_pixels([(left, top), (left, bottom), (right, bottom), (right, top)], 12, 16, depth)[None]


def mask_by_kernel(vertices, faces):
    return render(vertices, faces, flat_camera(12), ambient(), height=12, width=16, buffers=("mask",))["mask"]


def mask_by_stages(vertices, faces):
    white = torch.ones(vertices.shape[1], 3, dtype=vertices.dtype)
    return render_by_stages(vertices, faces, flat_camera(12), ambient(), height=12, width=16, colors=white)["mask"]


both = pytest.mark.parametrize("mask_of", [mask_by_kernel, mask_by_stages])


@both
@pytest.mark.parametrize("shift", [0.0, 0.15, 0.4, 0.6, 0.85])
def test_the_mask_of_an_upright_edge_is_the_covered_share_of_its_pixels(mask_of, shift):
    mask = mask_of(square(2.7 + shift, 3.2, 9.1 + shift, 8.6), SQUARE)
    # Pixel column c reaches from c - 0.5 to c + 0.5.
    columns = torch.arange(16, dtype=torch.float64)
    inside = (columns + 0.5).clamp(max=9.1 + shift) - (columns - 0.5).clamp(min=2.7 + shift)
    expected = inside.clamp(0, 1)
    torch.testing.assert_close(mask[0, 0, 6], expected, rtol=0, atol=1e-9)  # float64


@both
def test_a_picture_of_coverage_moves_at_the_speed_of_the_edge(mask_of):
    corners = square(2.7, 3.2, 9.1, 8.6).requires_grad_()
    mask_of(corners, SQUARE).sum().backward()
    # The right edge is 8.6 - 3.2 high and is met by the 5 rows 4 to 8; one metre is one pixel at depth 1.
    assert corners.grad[0, 2:, 0].sum().item() == pytest.approx(5, abs=1e-9)  # float64
    assert corners.grad[0, :2, 0].sum().item() == pytest.approx(-5, abs=1e-9)
    # The lower edge is met by the columns 3 to 9; +Y is up.
    assert corners.grad[0, 1:3, 1].sum().item() == pytest.approx(-7, abs=1e-9)


@both
def test_shared_edges_inside_a_surface_are_not_blended(mask_of):
    mask = mask_of(square(2.7, 3.2, 9.1, 8.6), SQUARE)
    assert (mask[0, 0, 4:8, 4:9] == 1).all()


def test_the_silhouette_of_a_near_surface_is_blended_with_the_one_behind_it():
    corners = torch.cat([square(-3, -3, 20, 20, depth=2.0), square(2.7, 3.2, 9.3, 8.6)], 1)
    faces = torch.cat([SQUARE, SQUARE + 4])
    colors = torch.tensor([[1.0, 0.0, 0.0]] * 4 + [[0.0, 0.0, 1.0]] * 4, dtype=torch.float64)
    made = render(
        corners, faces, flat_camera(12), ambient(), height=12, width=16, colors=colors, buffers=("color", "mask")
    )  # fmt: skip
    assert (made["mask"] == 1).all()
    red, green, blue = made["color"][0, :, 6, 9]
    # Column 9 is blue from 8.5 to 9.3, in linear light.
    assert blue.item() == pytest.approx(1.055 * 0.8 ** (1 / 2.4) - 0.055, abs=1e-5)  # the kernel's sRGB: 6e-7
    assert red.item() == pytest.approx(1.055 * 0.2 ** (1 / 2.4) - 0.055, abs=1e-5)
    assert green.item() == pytest.approx(0, abs=1e-5)


def test_the_silhouette_of_a_hidden_surface_changes_nothing():
    front = square(1.2, 1.2, 13.3, 10.3)
    hidden = square(4.7, 3.2, 9.1, 8.6, depth=2.0)
    alone = mask_by_kernel(front, SQUARE)
    assert torch.equal(mask_by_kernel(torch.cat([front, hidden], 1), torch.cat([SQUARE, SQUARE + 4])), alone)


def test_each_edge_is_listed_once_with_its_faces():
    # Two triangles on edge (0, 2), and a third one on the same edge: a fin.
    edges = edges_of(torch.tensor([[0, 1, 2], [0, 2, 3], [2, 0, 4]])).tolist()
    assert sorted(edges) == [
        [0, 1, 0, -1], [0, 2, 0, 1], [0, 2, 2, -1], [0, 3, 1, -1], [0, 4, 2, -1], [1, 2, 0, -1], [2, 3, 1, -1],
        [2, 4, 2, -1],
    ]  # fmt: skip


def test_edges_of_a_closed_surface_have_two_faces_each():
    faces = bumpy_spheres()["faces"]
    edges = edges_of(faces)
    assert len(edges) == len(faces) * 3 // 2
    assert (edges[:, 3] >= 0).all()
