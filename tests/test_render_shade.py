"""Light, vertex normals, texture lookup, colour per pixel."""

from __future__ import annotations

import pytest
import torch
import trimesh

from render.shade import (
    Light,
    level_of_detail,
    linear_from_srgb,
    mip_maps,
    sample_texture,
    shade,
    srgb_from_linear,
    unit,
    vertex_normals,
)


def test_srgb_and_linear_light_undo_each_other():
    srgb = torch.linspace(0, 1, 101, dtype=torch.float64)
    torch.testing.assert_close(srgb_from_linear(linear_from_srgb(srgb)), srgb, rtol=0, atol=1e-7)  # joint of the curve
    assert linear_from_srgb(torch.tensor(0.5)).item() == pytest.approx(0.2140411, abs=1e-6)  # IEC 61966-2-1


def test_normals_of_a_sphere_point_outward():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices = torch.tensor(sphere.vertices)[None]
    normals = vertex_normals(vertices, torch.tensor(sphere.faces).long())
    assert (normals * vertices).sum(-1).min() > 0.999  # faces of 8 degrees


def test_a_vertex_without_faces_has_no_normal_and_a_finite_gradient():
    vertices = torch.rand(1, 4, 3, dtype=torch.float64, requires_grad=True)
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2]]))
    assert not normals[0, 3].any()
    normals.sum().backward()
    assert torch.isfinite(vertices.grad).all()


FINEST = torch.tensor(0.0)


def test_the_texture_is_read_from_the_top_left_between_texel_centres():
    texture = torch.tensor([[[0.0], [1.0]], [[2.0], [3.0]]])
    uv = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.5, 0.5], [-1.0, 2.0]])
    assert sample_texture([texture], uv, FINEST.expand(5)).flatten().tolist() == [0.0, 1.0, 2.0, 1.5, 2.0]


def test_each_mip_map_is_the_mean_of_four_texels():
    texture = torch.tensor([[0.0, 2.0, 5.0], [4.0, 6.0, 7.0]])[..., None]
    halved, single = mip_maps(texture)[1:]
    assert halved[..., 0].tolist() == [[3.0, 6.0]]  # the odd last column counts twice
    assert single[..., 0].tolist() == [[4.5]]


def test_between_two_levels_the_texture_is_mixed():
    levels = [torch.zeros(2, 2, 1), torch.ones(1, 1, 1)]
    uv = torch.full((3, 2), 0.3)
    found = sample_texture(levels, uv, torch.tensor([0.0, 0.25, 1.0]))
    assert found.flatten().tolist() == [0.0, 0.25, 1.0]


def test_the_level_of_detail_counts_halvings_until_texels_are_as_large_as_pixels():
    # A square metre that faces the camera at 2 m, focal length 10 pixels: 5 x 5 pixels. Six times the volume of half of
    # it is 2 m^3, and half of it holds 40 x 40 / 2 texels: 8 x 8 texels in a pixel are 3 halvings.
    level = level_of_detail(torch.tensor(1600.0), torch.tensor(2.0), torch.tensor(2.0), 10.0, levels=7)
    assert level.item() == pytest.approx(3, abs=1e-6)  # float32
    coarse = level_of_detail(torch.tensor(16.0), torch.tensor(2.0), torch.tensor(2.0), 10.0, levels=7)
    assert coarse.item() == 0  # larger texels than pixels


@pytest.mark.parametrize("stage", ["shade", "vertex_normals", "sample_texture", "level_of_detail", "mip_maps"])
def test_gradients_of_a_stage_match_finite_differences(stage):
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(shape, dtype=torch.float64, generator=generator).requires_grad_()

    numbers = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.2, 0.6, 0.3, 7.5)]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [1, 4, 2]])
    checks = {
        # Points before the camera, normals towards it: both the light and the highlight are seen.
        "shade": (
            lambda albedo, normals, points, position, *coefficients: shade(
                albedo, unit(normals + torch.tensor([0, 0, 2.0])), points - torch.tensor([0.5, 0.5, 2]), position,
                Light(position, *coefficients),
            ),
            (random(6, 3), random(6, 3), random(6, 3), random(3), *numbers),
        ),
        "vertex_normals": (lambda vertices: vertex_normals(vertices, faces), (random(2, 5, 3),)),
        "sample_texture": (
            lambda a, b, uv, level: sample_texture([a, b], uv, level), (random(4, 6, 2), random(2, 3, 2), random(9, 2),
                                                                         random(9)),
        ),
        "level_of_detail": (
            lambda volumes, depths, focal: level_of_detail(torch.tensor([900.0, 400.0]), volumes, depths + 1, focal + 5,
                                                           9),
            (random(2), random(2), random()),
        ),
        "mip_maps": (lambda texture: tuple(mip_maps(texture)), (random(3, 5, 2),)),
    }  # fmt: skip
    function, inputs = checks[stage]
    assert torch.autograd.gradcheck(function, inputs)


def test_light_from_the_eye_onto_a_facing_surface_adds_all_three_terms():
    light = Light(torch.zeros(3), ambient=0.1, diffuse=0.5, specular=0.25, shininess=8.0)
    point, normal = torch.tensor([0.0, 0.0, -2.0]), torch.tensor([0.0, 0.0, 1.0])
    color = shade(torch.full((3,), 0.5), normal, point, torch.zeros(3), light)
    torch.testing.assert_close(color, torch.full((3,), 0.5 * (0.1 + 0.5) + 0.25))


def test_light_from_the_side_follows_the_cosine_and_the_mirrored_ray():
    light = Light(torch.zeros(3), ambient=0.0, diffuse=1.0, specular=1.0, shininess=2.0)
    point, normal = torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, 0.0, 1.0])
    color = shade(torch.full((3,), 0.5), normal, point, torch.tensor([3**0.5, 0.0, 0.0]), light)
    # 60 degrees off the normal and off the eye's mirror direction: cosine 1 / 2 in both terms.
    torch.testing.assert_close(color, torch.full((3,), 0.5 * 0.5 + 0.5**2))


def test_a_light_behind_the_surface_leaves_the_ambient_term():
    light = Light(torch.zeros(3), ambient=0.3, diffuse=1.0, specular=1.0)
    point, normal = torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, 0.0, 1.0])
    color = shade(torch.ones(3), normal, point, torch.tensor([0.0, 0.0, -5.0]), light)
    torch.testing.assert_close(color, torch.full((3,), 0.3))


@pytest.mark.parametrize("name", ["ambient", "diffuse", "specular", "shininess"])
def test_a_negative_coefficient_is_refused_by_name(name):
    with pytest.raises(ValueError, match=name):
        Light(torch.zeros(3), **{name: -0.1})
