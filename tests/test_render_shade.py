"""Light, vertex normals, texture lookup, colour per pixel."""

from __future__ import annotations

import pytest
import torch
import trimesh

from render.shade import Light, linear_from_srgb, sample_texture, shade, srgb_from_linear, vertex_normals


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


def test_the_texture_is_read_from_the_top_left_between_texel_centres():
    texture = torch.tensor([[[0.0], [1.0]], [[2.0], [3.0]]])
    uv = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.5, 0.5], [-1.0, 2.0]])
    assert sample_texture(texture, uv).flatten().tolist() == [0.0, 1.0, 2.0, 1.5, 2.0]


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
