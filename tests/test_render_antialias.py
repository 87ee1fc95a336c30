"""Blending across silhouettes, in the readable stage and in the kernel."""

from __future__ import annotations

import pytest
import torch
from render_scene import ambient, at_pixels, bumpy_spheres, flat_camera

from render import render, render_by_stages
from render.antialias import (
    Meeting,
    Outline,
    blend,
    distances,
    edge_points,
    edges_of,
    find_crossings,
    inverse_depth,
    neighbours_of,
)
from render.rasterize import rasterize

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


def test_neighbours_lie_across_the_edge_opposite_each_corner():
    faces = torch.tensor([[0, 1, 2], [2, 3, 0]])
    assert neighbours_of(faces, edges_of(faces)).tolist() == [[-1, 1, -1], [-1, 0, -1]]


def test_a_surface_keeps_its_colour_up_to_the_crossing():
    # A ramp from black at the centre of column 4 to 1 at the edge, which lies 0.8 columns on; what is behind is 0.5.
    outline = Outline((0, 4), (0, 5), (0, 1), 0)
    row = torch.full((1, 8, 1), 0.5, dtype=torch.float64)
    row[0, 4] = 0
    blended = blend(row, torch.ones(1, 1, dtype=torch.float64), torch.tensor([0.8], dtype=torch.float64), [outline])
    # Integrals of x / 0.8 over [0, 0.5] and [0.5, 0.8]; the rest of column 5 is behind.
    assert blended[0, 4, 0].item() == pytest.approx(0.5**2 / 2 / 0.8, abs=1e-12)  # float64
    assert blended[0, 5, 0].item() == pytest.approx((0.8**2 - 0.5**2) / 2 / 0.8 + 0.7 * 0.5, abs=1e-12)


def crossed_planes() -> tuple[torch.Tensor, torch.Tensor]:
    """Two rectangles that pass through one another along an upright line at column 7.3 of a 12 x 16 picture.

    Their depths are 8 and 1 at column 4 and as much apart the other way at column 10.6.
    """
    left, right = [(4.0, -3), (4.0, 14)], [(10.6, 14), (10.6, -3)]
    first = torch.cat([at_pixels(left, 12, 16, 8.0), at_pixels(right, 12, 16)])
    second = torch.cat([at_pixels(left, 12, 16), at_pixels(right, 12, 16, 8.0)])
    return torch.cat([first, second])[None], torch.cat([SQUARE, SQUARE + 4])


def test_two_sheets_that_pass_through_one_another_are_blended_where_they_meet():
    vertices, faces = crossed_planes()
    # Inverse depths are linear in the picture: equal half way, at column 7.3.
    colors = torch.tensor([[1.0, 0.0, 0.0]] * 4 + [[0.0, 0.0, 1.0]] * 4, dtype=torch.float64)
    arguments = {"height": 12, "width": 16, "colors": colors}
    for made in (
        render(vertices, faces, flat_camera(12), ambient(), **arguments),
        render_by_stages(vertices, faces, flat_camera(12), ambient(), **arguments),
    ):
        red, _, blue = made["color"][0, :, 6, 7]
        # Column 7 is blue from 6.5 to 7.3, then red, in linear light.
        assert blue.item() == pytest.approx(1.055 * 0.8 ** (1 / 2.4) - 0.055, abs=1e-5)  # the kernel's sRGB: 6e-7
        assert red.item() == pytest.approx(1.055 * 0.2 ** (1 / 2.4) - 0.055, abs=1e-5)


def test_where_two_sheets_meet_moves_with_both():
    vertices, faces = crossed_planes()
    vertices = vertices.requires_grad_()
    attributes = torch.tensor([[0.0]] * 4 + [[1.0]] * 4, dtype=torch.float64)[None]
    made = render(
        vertices, faces, flat_camera(12), ambient(), height=12, width=16, attributes=attributes, buffers=("attributes",)
    )  # fmt: skip
    made["attributes"].sum().backward()
    # Inverse depths run from 1/8 to 1 and from 1 to 1/8 over 6.6 columns. A rise of the first by r at the left end is
    # one of r / 2 where they meet, half way, where their difference changes by 1.75 / 6.6 a column: that place moves by
    # 3.3 r / 1.75 columns to the left. A step of 1 m towards the eye at depth 8 is a rise of 1/64.
    nearer = torch.zeros_like(vertices)
    nearer[0, :2] = vertices[0, :2].detach() / -8  # along the ray: the picture of the corners stays
    moved = (vertices.grad * nearer).sum().item()
    assert moved == pytest.approx(-12 * 3.3 / 1.75 / 64, rel=1e-6)  # 12 rows


@pytest.mark.parametrize("stage", ["outlines", "meetings", "edge_points", "blend", "inverse_depth"])
def test_gradients_of_a_stage_match_finite_differences(stage):
    if stage == "meetings":
        vertices, faces = crossed_planes()
        camera, height, width = flat_camera(12), 12, 16
    else:
        scene = bumpy_spheres()
        vertices, faces, camera, height, width = scene["vertices"][:1], scene["faces"], scene["camera"], 14, 13
    clip = camera.project(vertices)
    crossings = find_crossings(rasterize(clip, faces, height, width), clip, faces, camera.focal * height / 2)[0]
    kind = Meeting if stage == "meetings" else Outline
    crossings = [crossing for crossing in crossings if isinstance(crossing, kind)][:12]
    assert len(crossings) == 12
    corners = clip[0].clone().requires_grad_()
    generator = torch.Generator().manual_seed(0)
    if stage in ("outlines", "meetings"):
        assert torch.autograd.gradcheck(lambda clip: distances(crossings, clip, faces, height, width), (corners,))
    elif stage == "edge_points":
        assert torch.autograd.gradcheck(lambda clip: edge_points(crossings, clip, faces, height, width)[1], (corners,))
    elif stage == "blend":
        picture = torch.rand(height, width, 2, dtype=torch.float64, generator=generator).requires_grad_()
        edges = torch.rand(12, 2, dtype=torch.float64, generator=generator).requires_grad_()
        places = distances(crossings, clip[0], faces, height, width).detach().requires_grad_()
        assert torch.autograd.gradcheck(lambda *values: blend(*values, crossings), (picture, edges, places))
    else:
        triangle = torch.tensor([[1.0, 1.0], [2.0, 6.0], [7.0, 3.0]], dtype=torch.float64, requires_grad=True)
        inverse = torch.tensor([0.5, 1.0, 0.7], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda *values: inverse_depth(*values, 3.2, 2.5), (triangle, inverse))


def test_at_most_one_crossing_lies_between_two_pixels():
    scene = bumpy_spheres(2)
    clip = scene["camera"].project(scene["vertices"])
    face_img = rasterize(clip, scene["faces"], 24, 20)
    for crossings in find_crossings(face_img, clip, scene["faces"], 12 * scene["camera"].focal):
        pairs = [frozenset([crossing.surface, crossing.behind]) for crossing in crossings]
        assert len(pairs) == len(set(pairs)) > 20
