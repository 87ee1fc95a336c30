import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.inverse_rig import InverseRig
from reenact.retargeting.penalised_matching import PRIORS, PenalisedMatching
from reenact.retargeting.priors import elastic_net, pca_prior, ridge_weights
from reenact.retargeting.rbf import ProportionMatching
from reenact.rigs import motion
from reenact.rigs.clip import Clip


@pytest.fixture(scope="module")
def problem(toy_rig):
    weights = motion.expressions(toy_rig.names, 20, seed=1)
    gram = InverseRig(toy_rig).gram
    return gram, weights.double() @ gram, weights.double()


def energy(rig, weights: torch.Tensor, keep: float) -> float:
    """Slow twin: |diag(1/sigma) U^T (v(w) - m)|^2 from a full decomposition of the shapes."""
    shapes = rig.deltas.double().flatten(1)
    mean = shapes.mean(0)
    _, strengths, directions = torch.linalg.svd(shapes - mean, full_matrices=False)
    variances = strengths.square() / len(shapes)
    kept = int((variances.cumsum(0) / variances.sum() < keep).sum()) + 1
    score = directions[:kept] @ (weights.double() @ shapes - mean)
    return float((score.square() / variances[:kept]).sum())


@pytest.mark.parametrize("keep", [0.5, 0.9, 0.98])
def test_the_quadratic_form_is_the_pca_energy(toy_rig, keep):
    quadratic, linear = pca_prior(toy_rig, keep)
    rest = energy(toy_rig, torch.zeros(7), keep)
    for weights in motion.expressions(toy_rig.names, 5, seed=2):
        w = weights.double()
        assert float(w @ quadratic @ w - 2 * linear @ w) + rest == pytest.approx(
            energy(toy_rig, weights, keep), rel=1e-6
        )


def test_the_energy_is_zero_at_the_mean_of_the_shapes_and_grows_along_every_line_from_it(toy_rig):
    quadratic, linear = pca_prior(toy_rig)
    mean = torch.full((7,), 1 / 7, dtype=torch.float64)
    torch.testing.assert_close(quadratic @ mean, linear, rtol=0, atol=1e-9)
    assert energy(toy_rig, mean.float(), 0.98) < 1e-10
    assert float(torch.linalg.eigvalsh(quadratic).min()) > -1e-9


def test_a_stronger_pca_prior_pulls_more_to_the_mean_shape(toy_rig, problem):
    gram, projections, _ = problem
    quadratic, linear = pca_prior(toy_rig)
    unit = gram.trace() / quadratic.trace()
    energies = []
    for strength in (0.0, 0.01, 0.1, 1.0, 10.0):
        pulled = torch.linalg.solve(gram + strength * unit * quadratic, (projections + strength * unit * linear).T).T
        energies.append(sum(energy(toy_rig, row.float(), 0.98) for row in pulled))
    assert energies == sorted(energies, reverse=True)


def test_ridge_is_least_squares_at_zero_and_shrinks_with_strength(problem):
    gram, projections, weights = problem
    torch.testing.assert_close(ridge_weights(gram, projections, 0.0), weights, rtol=0, atol=1e-9)
    sizes = [float(ridge_weights(gram, projections, mu).norm()) for mu in (0.0, 1e-5, 1e-3, 1e-1)]
    assert sizes == sorted(sizes, reverse=True)


def test_the_elastic_net_is_a_soft_threshold_where_shapes_do_not_overlap():
    gram, sides = 2 * torch.eye(3), torch.tensor([[1.0, -1.0, 0.1]])
    # min 2 w^2 - 2 b w + (1.2 / 3) |w|: w = (b -+ 0.2) / 2
    both = elastic_net(gram, sides, magnitudes=1.2, low=-math.inf)
    torch.testing.assert_close(both, torch.tensor([[0.4, -0.4, 0.0]]).double(), rtol=0, atol=1e-7)
    above = elastic_net(gram, sides, magnitudes=1.2)
    torch.testing.assert_close(above, torch.tensor([[0.4, 0.0, 0.0]]).double(), rtol=0, atol=1e-7)
    squares = elastic_net(gram, sides, squares=2.0, low=-math.inf)
    torch.testing.assert_close(squares, sides.double() / 4, rtol=0, atol=1e-7)


def test_the_elastic_net_with_signs_meets_its_optimality_conditions(problem):
    gram, projections, _ = problem
    noise = 0.2 * projections.std() * torch.randn(projections.shape, generator=torch.Generator().manual_seed(0))
    wanted, strength = projections + noise, float(0.4 * projections.std())
    weights = elastic_net(gram, wanted, magnitudes=strength, low=-math.inf)
    slope = 2 * (weights @ gram - wanted)
    bound = strength / len(gram)
    active = weights.abs() > 1e-9
    assert 0.1 < float(active.double().mean()) < 0.95
    tolerance = 1e-6 * float(wanted.abs().max())
    np.testing.assert_allclose(slope[active], -bound * weights[active].sign(), atol=tolerance)
    assert float(slope[~active].abs().max()) <= bound + tolerance


def test_unusable_input_is_named(toy_rig):
    with pytest.raises(ReenactError, match="share of variance"):
        pca_prior(toy_rig, keep=1.5)
    with pytest.raises(ReenactError, match="shapes that differ"):
        pca_prior(replace(toy_rig, deltas=toy_rig.deltas[:1].expand(7, -1, -1).clone()))
    with pytest.raises(ReenactError, match="at least 0"):
        elastic_net(torch.eye(2), torch.ones(1, 2), squares=-1.0)
    with pytest.raises(ReenactError, match="mirror each other"):
        elastic_net(torch.eye(2), torch.ones(1, 2), low=-2.0, high=1.0)


@pytest.mark.parametrize("prior", PRIORS)
def test_more_penalty_never_moves_the_face_more(prior):
    ball, egg = make_toy_rig("ball"), make_toy_rig("egg", stretch=1.25)
    pairs = Correspondence.identity(ball, egg)
    clip = Clip(ball.names, motion.expressions(ball.names, 50, seed=1), 30.0)
    moved = []
    for factor in (0.0, 0.1, 1.0, 10.0):
        method = PenalisedMatching(ball, egg, pairs, prior=prior, strength=0.1 * factor, sparsity=0.05 * factor)
        weights = method(clip).weights
        moved.append(float((egg.vertices(weights) - egg.neutral).norm()))
    assert all(later <= earlier * (1 + 1e-6) for earlier, later in pairwise(moved))
    assert moved[3] < 0.8 * moved[0]


def test_no_penalty_is_proportion_matching():
    ball, egg = make_toy_rig("ball"), make_toy_rig("egg", stretch=1.25)
    pairs = Correspondence.identity(ball, egg)
    clip = Clip(ball.names, motion.expressions(ball.names, 20, seed=1), 30.0)
    plain = ProportionMatching(ball, egg, pairs)(clip).weights
    for prior in PRIORS:
        same = PenalisedMatching(ball, egg, pairs, prior=prior, strength=0.0, sparsity=0.0)(clip).weights
        torch.testing.assert_close(same, plain, rtol=0, atol=1e-5)  # float32 of an exact solve


@pytest.mark.parametrize("settings", [{"prior": "magic"}, {"strength": -1.0}, {"sparsity": -1.0}])
def test_penalties_that_cannot_be_are_refused(settings):
    ball = make_toy_rig("ball")
    with pytest.raises(ReenactError, match="penalised matching: expected"):
        PenalisedMatching(ball, ball, Correspondence.identity(ball, ball), **settings)
