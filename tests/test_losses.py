"""Distances are what their formulas say."""

import pytest
import torch

from reenact.losses import VertexDistance, code_distance, weight_distance


def test_weight_distance_is_the_mean_over_entries():
    assert weight_distance(torch.tensor([[0.0, 1.0]]), torch.tensor([[0.5, 1.0]])) == pytest.approx(0.25)


def test_vertex_distance_is_the_distance_of_the_vertices(toy_rig):
    generator = torch.Generator().manual_seed(0)
    a, b, typical = (torch.rand(5, 7, generator=generator) for _ in range(3))
    moved = (toy_rig.vertices(a) - toy_rig.vertices(b)).flatten(1).norm(dim=1)
    unit = (toy_rig.vertices(typical) - toy_rig.neutral).flatten(1).square().sum(1).mean().sqrt()
    torch.testing.assert_close(VertexDistance(toy_rig, typical)(a, b), moved / unit, rtol=1e-4, atol=0)  # float32


def test_vertex_distance_has_a_gradient_where_shapes_are_alike():
    from conftest import make_toy_rig

    rig = make_toy_rig("twins")
    rig.deltas[1] = rig.deltas[0]  # two equal shapes: the quadratic form is singular
    weights = torch.zeros(1, 7, requires_grad=True)
    VertexDistance(rig, torch.rand(4, 7))(weights, torch.eye(7)[:1]).backward()
    assert bool(torch.isfinite(weights.grad).all())


def test_codes_of_one_distribution_are_close_and_the_unit_does_not_matter():
    random = torch.Generator().manual_seed(0)
    a, b = torch.randn(4000, 5, generator=random), torch.randn(4000, 5, generator=random)
    near = code_distance(a, b)
    assert near < 0.01
    torch.testing.assert_close(code_distance(100 * a, 100 * b), near)
    assert code_distance(a, b + 1) > 0.5
    mixed = b @ torch.tensor(
        [[1.0, 0.9, 0, 0, 0], [0, 0.45, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]
    )
    assert code_distance(a, mixed) > 0.03  # equal means, correlated
    a.requires_grad_()
    code_distance(a, b + 1).backward()
    assert (a.grad.mean(0) < 0).all()  # drawn towards the other
