import numpy as np
import pytest
import torch
import trimesh

from reenact.errors import ReenactError
from reenact.geometry import (
    closest_points,
    closest_points_around,
    farthest_points,
    outward_faces,
    rigid_fit,
    similarity_fit,
    vertex_normals,
)

TETRAHEDRON = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
OUTSIDE = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def random_rotation(seed):
    matrix = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))[0]
    return matrix * torch.linalg.det(matrix)


def random_points(count, seed):
    return torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_only_surfaces_that_enclose_something_and_are_wound_outwards_hide_their_backs():
    ball = trimesh.creation.icosphere(subdivisions=3)  # 1,280 faces
    head = ball.faces[ball.triangles_center[:, 1] > -0.98]  # open at the neck
    dish = ball.faces[ball.triangles_center[:, 1] > 0.9]
    surfaces = [ball.faces, head, ball.faces[:, ::-1], dish, OUTSIDE.numpy()]
    points = [ball.vertices] * 4 + [TETRAHEDRON.numpy()]
    places = np.cumsum([0, *map(len, points)])
    faces = np.concatenate([surface + place for surface, place in zip(surfaces, places)])
    hidden = outward_faces(np.concatenate(points), faces)
    parts = np.split(hidden, np.cumsum([len(surface) for surface in surfaces])[:-1])
    assert 0 < len(ball.faces) - len(head) < 30
    assert [set(part.tolist()) for part in parts] == [{True}, {True}, {False}, {False}, {True}]


def test_normals_of_a_corner_of_a_cube_are_its_diagonal():
    normals = vertex_normals(TETRAHEDRON, OUTSIDE[:3])
    torch.testing.assert_close(normals[0], -torch.ones(3, dtype=torch.float64) / 3**0.5)


def test_a_larger_face_bends_the_normal_more():
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 1]])
    floor, wall = [0, 1, 2], [0, 3, 1]  # areas 2 and 1, normals +z and +y
    normals = vertex_normals(vertices, torch.tensor([floor, wall]))
    torch.testing.assert_close(normals[0], torch.tensor([0.0, 1.0, 2.0]) / 5**0.5)


def test_a_vertex_without_faces_has_no_normal():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    assert vertex_normals(vertices, torch.tensor([[0, 1, 2]]))[3].tolist() == [0, 0, 0]


def test_farthest_points_of_a_line_are_its_ends_then_its_middle():
    line = torch.stack([torch.arange(9.0), torch.zeros(9), torch.zeros(9)], dim=1)
    assert farthest_points(line, 5, first=0).tolist() == [0, 8, 4, 2, 6]


def test_where_weights_double_points_stand_half_as_far_apart():
    square = torch.tensor(np.random.default_rng(0).uniform(0, 1, (20000, 3)) * [1, 1, 0])
    heavy = square[:, 0] < 0.5
    chosen = farthest_points(square, 400, torch.where(heavy, 2.0, 1.0))
    dense = int(heavy[chosen].sum())
    assert dense / (400 - dense) == pytest.approx(4, rel=0.15)  # half as far apart: four times as many to an area


def test_points_without_weight_are_never_chosen_and_coinciding_ones_once_each():
    points = torch.zeros(4, 3)
    assert sorted(farthest_points(points, 3, torch.tensor([1.0, 0, 2, 1])).tolist()) == [0, 2, 3]


def test_more_points_than_have_weight_cannot_be_chosen():
    with pytest.raises(ReenactError, match="1 to 2"):
        farthest_points(torch.zeros(3, 3), 3, torch.tensor([1.0, 1, 0]))


def test_a_rigid_motion_is_found_exactly():
    points, rotation, shift = random_points(7, 0), random_rotation(1), torch.tensor([0.3, -2.0, 5.0]).double()
    found, moved = rigid_fit(points, points @ rotation.T + shift)
    torch.testing.assert_close(found, rotation, rtol=0, atol=1e-12)
    torch.testing.assert_close(moved, shift, rtol=0, atol=1e-12)


def test_a_mirror_image_is_fitted_by_a_rotation():
    points = random_points(9, 2)
    rotation, _ = rigid_fit(points, points * torch.tensor([-1.0, 1, 1]))
    assert torch.linalg.det(rotation) == pytest.approx(1)


def test_a_similarity_is_found_exactly_and_in_the_dtype_given():
    points, rotation = random_points(5, 3).float(), random_rotation(4).float()
    scale, found, shift = similarity_fit(points, 2.5 * points @ rotation.T - 1)
    assert scale.dtype == found.dtype == shift.dtype == torch.float32
    assert float(scale) == pytest.approx(2.5, rel=1e-5)
    torch.testing.assert_close(found, rotation, rtol=0, atol=1e-5)  # float32
    torch.testing.assert_close(shift, -torch.ones(3), rtol=0, atol=1e-5)


def test_points_without_weight_do_not_pull_a_fit():
    points, rotation = random_points(6, 5), random_rotation(6)
    wanted = points @ rotation.T
    wanted[5] += 100
    found, _ = rigid_fit(points, wanted, torch.tensor([1.0, 2, 3, 4, 5, 0], dtype=torch.float64))
    torch.testing.assert_close(found, rotation, rtol=0, atol=1e-12)


def test_a_fit_needs_three_pairs_and_weights_that_weigh():
    with pytest.raises(ReenactError, match="3 or more"):
        rigid_fit(torch.zeros(2, 3), torch.zeros(2, 3))
    with pytest.raises(ReenactError, match="not all 0"):
        rigid_fit(torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(4))


@pytest.mark.parametrize(
    ("point", "face", "shares"),
    [
        ([0.2, 0.2, -1.0], 0, {0: 0.6, 1: 0.2, 2: 0.2}),  # below the floor: straight up
        ([0.5, -1.0, -1.0], None, {0: 0.5, 1: 0.5}),  # nearest to an edge
        ([-1.0, -1.0, -1.0], None, {0: 1.0}),  # nearest to a corner
        ([1.0, 1.0, 1.0], 3, {1: 1 / 3, 2: 1 / 3, 3: 1 / 3}),  # before the slope
    ],
)
def test_the_closest_point_of_a_tetrahedron(point, face, shares):
    found, weights = closest_points(torch.tensor([point], dtype=torch.float64), TETRAHEDRON, OUTSIDE)
    assert face is None or int(found[0]) == face
    given = {int(corner): float(share) for corner, share in zip(OUTSIDE[found[0]], weights[0]) if share > 1e-12}
    assert given == pytest.approx(shares)


def test_closest_points_agree_with_trying_every_face():
    ball = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(0)
    vertices = torch.tensor(ball.vertices * rng.uniform(0.7, 1.3, (len(ball.vertices), 1)))  # not convex
    faces, points = torch.tensor(np.asarray(ball.faces)), torch.tensor(rng.normal(0, 1, (200, 3)))
    found, shares = closest_points(points, vertices, faces)
    on_surface = torch.einsum("nc,nci->ni", shares, vertices[faces[found]])
    # The slow twin: project onto every face by dense samples of its barycentric grid.
    steps = torch.tensor([(i, j, 40 - i - j) for i in range(41) for j in range(41 - i)], dtype=torch.float64) / 40
    samples = torch.einsum("sc,fci->fsi", steps, vertices[faces]).reshape(-1, 3)
    slow = torch.cdist(points, samples).amin(1)
    fast = (on_surface - points).norm(dim=1)
    assert bool((fast <= slow + 1e-12).all())
    assert float((slow - fast).max()) < 0.01  # spacing of the samples
    torch.testing.assert_close(shares.sum(1), torch.ones(200, dtype=torch.float64))
    assert bool((shares >= -1e-12).all())


def test_among_the_faces_around_all_vertices_the_closest_point_is_the_closest_of_all():
    points = random_points(50, 7)
    every = torch.arange(4).expand(50, 4)
    found, shares = closest_points_around(points, TETRAHEDRON, OUTSIDE, every)
    face, expected = closest_points(points, TETRAHEDRON, OUTSIDE)
    places = [torch.einsum("nc,nci->ni", s, TETRAHEDRON[OUTSIDE[f]]) for f, s in ((found, shares), (face, expected))]
    torch.testing.assert_close(places[0], places[1])


def test_the_closest_point_of_a_triangle_in_five_dimensions():
    corners = torch.zeros(3, 5, dtype=torch.float64)
    corners[1, 3] = corners[2, 4] = 1
    point = torch.tensor([[7.0, -2, 0, 0.25, 0.5]], dtype=torch.float64)
    _, shares = closest_points_around(point, corners, torch.tensor([[0, 1, 2]]), torch.tensor([[0]]))
    torch.testing.assert_close(shares[0], torch.tensor([0.25, 0.25, 0.5], dtype=torch.float64))
