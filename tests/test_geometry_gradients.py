"""Faces, their frames and how they deform: numbers worked out by hand, then laws."""

import pytest
import torch

from reenact.geometry import deformation_gradients, face_areas, face_frames, sound_faces

TRIANGLE = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
FACE = torch.tensor([[0, 1, 2]])


def rotation(seed: int) -> torch.Tensor:
    matrix, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.manual_seed(seed)))
    return matrix * torch.linalg.det(matrix)


def test_a_right_triangle_of_4_by_1_has_area_2_and_a_normal_of_length_2():
    assert face_areas(TRIANGLE, FACE).tolist() == [2.0]
    # The cross product is (0, 0, 4); over the root of its length it becomes (0, 0, 2). Columns are e1, e2, n.
    expected = torch.tensor([[4.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]], dtype=torch.float64)
    torch.testing.assert_close(face_frames(TRIANGLE, FACE)[0], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", [0.01, 3.0])
def test_a_frame_scales_and_turns_as_one_piece(scale):
    turned = scale * TRIANGLE @ rotation(0).T
    expected = scale * rotation(0) @ face_frames(TRIANGLE, FACE)[0]
    torch.testing.assert_close(face_frames(turned, FACE)[0], expected, rtol=1e-12, atol=1e-12)


def test_stretching_along_x_by_2_is_read_off_a_face_with_a_thickness_of_root_2():
    deformed = TRIANGLE * torch.tensor([2.0, 1.0, 1.0], dtype=torch.float64)
    # Cross product (0, 0, 8) has the scaled normal (0, 0, sqrt 8); the neutral's is (0, 0, 2): sqrt 8 / 2 = sqrt 2.
    expected = torch.diag(torch.tensor([2.0, 1.0, 2.0**0.5], dtype=torch.float64))
    torch.testing.assert_close(deformation_gradients(TRIANGLE, deformed, FACE)[0], expected, rtol=0, atol=1e-12)


def test_an_affine_map_is_found_in_the_plane_of_every_face(toy_rig):
    matrix = torch.eye(3, dtype=torch.float64) + 0.3 * torch.randn(
        3, 3, dtype=torch.float64, generator=torch.manual_seed(1)
    )
    neutral = toy_rig.neutral.double()
    gradients = deformation_gradients(neutral, neutral @ matrix.T + 5.0, toy_rig.faces)
    edges = face_frames(neutral, toy_rig.faces)[..., :2]
    torch.testing.assert_close(gradients @ edges, matrix @ edges, rtol=0, atol=1e-9)  # 5 m away from the origin


def test_a_similarity_is_found_whole(toy_rig):
    matrix = 1.7 * rotation(2)
    neutral = toy_rig.neutral.double()
    gradients = deformation_gradients(neutral, neutral @ matrix.T - 1.0, toy_rig.faces)
    torch.testing.assert_close(gradients, matrix.expand_as(gradients), rtol=0, atol=1e-9)


def test_many_expressions_give_what_each_gives_alone(toy_rig):
    expressions = toy_rig.vertices(torch.eye(len(toy_rig.names)))
    together = deformation_gradients(toy_rig.neutral, expressions, toy_rig.faces)
    for k, expression in enumerate(expressions):
        alone = deformation_gradients(toy_rig.neutral, expression, toy_rig.faces)
        torch.testing.assert_close(together[k], alone, rtol=0, atol=1e-5)  # float32 inverses


def test_faces_without_area_are_unsound_and_have_the_identity_for_a_gradient():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 0, 3], [0, 1, 3]])
    assert sound_faces(points, faces).tolist() == [False, False, True]
    gradients = deformation_gradients(points, 2 * points, faces)
    torch.testing.assert_close(gradients, torch.stack([torch.eye(3), torch.eye(3), 2 * torch.eye(3)]))
    assert bool(torch.isfinite(face_frames(points, faces)).all())


def test_soundness_does_not_depend_on_size():
    tiny = TRIANGLE * 1e-6
    assert sound_faces(tiny, FACE).tolist() == [True]
    torch.testing.assert_close(deformation_gradients(tiny, 2 * tiny, FACE)[0], 2 * torch.eye(3, dtype=torch.float64))
