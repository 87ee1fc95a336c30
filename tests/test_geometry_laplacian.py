"""The cotangent Laplacian, on meshes whose angles are known."""

import numpy as np
import torch

from reenact.geometry import cotangent_laplacian

SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO_TRIANGLES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def grid(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A flat 6 x 6 grid whose inner vertices are jittered."""
    place = torch.arange(36)
    points = torch.stack([place % 6, place // 6, torch.zeros(36)], 1).double()
    inner = ((points[:, :2] > 0) & (points[:, :2] < 5)).all(1)
    jitter = torch.rand(36, 2, generator=torch.Generator().manual_seed(seed)).double() - 0.5
    points[inner, :2] += 0.4 * jitter[inner]
    corner = torch.tensor([6 * row + column for row in range(5) for column in range(5)])
    faces = torch.cat(
        [torch.stack([corner, corner + 1, corner + 7], 1), torch.stack([corner, corner + 7, corner + 6], 1)]
    )
    return points, faces


def test_a_square_has_sides_of_one_half_and_a_diagonal_of_zero():
    operator = cotangent_laplacian(SQUARE, TWO_TRIANGLES).toarray()
    expected = np.array([[1, -0.5, 0, -0.5], [-0.5, 1, -0.5, 0], [0, -0.5, 1, -0.5], [-0.5, 0, -0.5, 1]])
    np.testing.assert_allclose(operator, expected, atol=1e-12)  # the diagonal faces two right angles, cotangent 0


def test_a_border_edge_counts_its_one_angle():
    triangle = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 3**0.5 / 2, 0]])
    operator = cotangent_laplacian(triangle, torch.tensor([[0, 1, 2]])).toarray()
    np.testing.assert_allclose(operator[0, 1], -1 / (2 * 3**0.5), atol=1e-7)  # float32 corners


def test_rows_sum_to_zero_and_the_operator_is_symmetric():
    points, faces = grid(0)
    points[:, 2] = torch.rand(36, generator=torch.Generator().manual_seed(1)).double()
    operator = cotangent_laplacian(points, faces).toarray()
    np.testing.assert_allclose(operator.sum(1), 0, atol=1e-12)
    np.testing.assert_array_equal(operator, operator.T)


def test_inside_a_flat_mesh_linear_functions_vanish():
    points, faces = grid(2)
    linear = (points @ torch.tensor([[1.0], [-2.0], [0.0]]).double() + 3).numpy()
    inner = ((points[:, :2] > 0) & (points[:, :2] < 5)).all(1).numpy()
    np.testing.assert_allclose((cotangent_laplacian(points, faces, low=-1e9, high=1e9) @ linear)[inner], 0, atol=1e-12)


def test_positive_bounds_keep_the_operator_positive_semidefinite():
    # Two apex angles of 170 degrees face one edge: half of cot 170 each, -5.7 in all.
    fan = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [0, 0.0875, 0], [0, -0.0875, 0]])
    faces = torch.tensor([[0, 1, 2], [1, 0, 3]])
    wide = cotangent_laplacian(fan, faces, low=-1e9, high=1e9).toarray()
    np.testing.assert_allclose(wide[0, 1], 5.67, atol=0.01)
    clamped = cotangent_laplacian(fan, faces, low=0.01).toarray()
    np.testing.assert_allclose(clamped[0, 1], -0.01)
    assert np.linalg.eigvalsh(clamped)[0] > -1e-12


def test_slivers_weigh_no_more_than_the_upper_bound():
    sliver = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1e-7, 0], [1, 0, 0]])
    operator = cotangent_laplacian(sliver, torch.tensor([[0, 1, 2], [0, 1, 3]])).toarray()
    assert np.isfinite(operator).all()
    assert np.abs(operator - np.diag(np.diag(operator))).max() <= 5


def test_size_does_not_matter_and_turning_neither():
    points, faces = grid(3)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)).double())[0]
    moved = 7 * points @ turn.T + 2
    np.testing.assert_allclose(
        cotangent_laplacian(moved, faces).toarray(), cotangent_laplacian(points, faces).toarray(), atol=1e-9
    )
