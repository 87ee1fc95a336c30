"""Bending as a penalty, and the solve of a frame under it, against dense twins and optimality conditions."""

import math

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.geometry import cotangent_laplacian
from reenact.retargeting.geometric_prior import FrameSolver, bending, sparsity_thresholds
from reenact.rigs.rig import Rig


def random_problem(count: int = 8, frames: int = 12, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Shapes (K, 20, 3) and frames in centimetres, and a prior."""
    generator = torch.Generator().manual_seed(seed)
    shapes = torch.randn(count, 20, 3, generator=generator).double()
    active = torch.rand(frames, count, generator=generator) > 0.6
    weights = torch.rand(frames, count, generator=generator).double() * active
    noise = 0.05 * torch.randn(frames, 20, 3, generator=generator).double()
    root = torch.randn(count, count, generator=generator).double()
    return shapes, torch.einsum("fk,kmi->fmi", weights, shapes) + noise, 0.1 * root @ root.T


def test_bending_agrees_with_the_dense_operator_on_all_coordinates(toy_rig):
    rig = toy_rig
    weights = torch.rand(7, generator=torch.Generator().manual_seed(0)).double()
    dense = np.kron(cotangent_laplacian(rig.neutral, rig.faces).toarray(), np.eye(3))  # (3 V, 3 V)
    moved = (weights @ rig.deltas.double().flatten(1)).numpy()
    expected = np.square(dense @ moved).sum() / len(rig.neutral)
    np.testing.assert_allclose(float(weights @ bending(rig) @ weights), expected, rtol=1e-10)


def test_bending_is_zero_at_the_neutral_quadratic_and_never_negative(toy_rig):
    matrix = bending(toy_rig)
    weights = torch.randn(50, 7, generator=torch.Generator().manual_seed(0)).double()

    def energy(w: torch.Tensor) -> torch.Tensor:
        return torch.einsum("nk,kl,nl->n", w, matrix, w)

    assert (energy(0 * weights) == 0).all()
    torch.testing.assert_close(energy(-3 * weights), 9 * energy(weights))
    assert (energy(weights) > 0).all()
    assert torch.linalg.eigvalsh(matrix)[0] > -1e-12 * matrix.trace()


def test_a_shape_that_moves_everything_alike_does_not_bend(toy_rig):
    shifted = torch.cat([toy_rig.deltas, torch.full_like(toy_rig.deltas[:1], 0.02)])
    rig = Rig("shifted", toy_rig.neutral, shifted, (*toy_rig.names, "shift"), toy_rig.faces)
    assert bending(rig)[-1, -1] < 1e-10 * bending(rig)[0, 0]


def test_a_frame_without_prior_and_sparsity_is_least_squares():
    shapes, frames, _ = random_problem()
    expected = np.linalg.lstsq(shapes.flatten(1).numpy().T, frames.flatten(1).numpy().T, rcond=None)[0].T
    signed = FrameSolver(shapes, low=-math.inf, high=math.inf)(frames)
    torch.testing.assert_close(signed, torch.from_numpy(expected), rtol=0, atol=1e-7)


def test_much_sparsity_leaves_no_weight():
    shapes, frames, _ = random_problem()
    thresholds = torch.full((8,), 1e3).double()
    for low, high in ((0.0, 1.0), (-math.inf, math.inf)):
        assert FrameSolver(shapes, thresholds=thresholds, low=low, high=high)(frames).abs().max() < 1e-6


def test_reweighting_never_raises_the_objective():
    shapes, frames, prior = random_problem(frames=1)
    thresholds = torch.full((8,), 0.3).double()
    solver = FrameSolver(shapes, prior, 0.3, thresholds, low=-math.inf, high=math.inf)
    projections = solver.project(frames)
    matrix, wanted = solver.system.numpy(), projections[0].numpy()
    weights, values = np.linalg.solve(matrix, wanted), []
    for _ in range(40):  # the rounds of the solver, written out
        values.append(float(solver.objective(torch.from_numpy(weights), projections[0])))
        weights = np.linalg.solve(matrix + np.diag(thresholds.numpy() / np.sqrt(weights**2 + 1e-8)), wanted)
    assert (np.diff(values) <= 1e-9 * abs(values[0])).all()
    found = solver.solve(projections)[0]
    assert float(solver.objective(found, projections[0])) <= values[-1] + 1e-3 * abs(values[0])
    np.testing.assert_allclose(found.numpy(), weights, atol=0.01)  # it stops when no weight moves by 1e-3


@pytest.mark.parametrize("mu", [0.0, 0.4])
def test_bounded_weights_meet_the_optimality_conditions(mu):
    shapes, frames, prior = random_problem()
    thresholds = sparsity_thresholds(shapes, 0.05)
    solver = FrameSolver(shapes, prior, mu, thresholds)
    weights = solver(frames)
    gradient = weights @ (solver.gram + mu * prior) - solver.project(frames) + thresholds
    free = (weights > 0) & (weights < 1)
    assert gradient[free].abs().max() < 1e-6
    assert gradient[weights == 0].min() > -1e-6
    assert (gradient[weights == 1] < 1e-6).all()
    assert free.any()
    assert (weights == 0).any()


def test_the_threshold_is_what_a_lone_shape_loses():
    shapes, _, _ = random_problem(count=1)
    for strength in (0.01, 0.2):
        solver = FrameSolver(shapes, thresholds=sparsity_thresholds(shapes, strength))
        torch.testing.assert_close(float(solver.step(0.7 * shapes[0])), 0.7 - strength, rtol=0, atol=1e-6)


def test_the_papers_sparsity_takes_a_third_of_a_shape_that_moves_few_markers():
    # A blink: 2 of 99 markers move by 1 cm, H = 2 / 99; it loses lambda / (2 K H) = 0.6 * 99 / (2 * 46 * 2) = 0.32.
    blink = torch.zeros(46, 99, 3).double()
    blink[:, 2:] = torch.randn(46, 97, 3, generator=torch.Generator().manual_seed(0)).double()
    blink[0] = 0
    blink[0, :2, 1] = 1.0
    paper = FrameSolver(blink, thresholds=torch.full((46,), 0.6 / 92).double(), low=-math.inf, high=math.inf)
    torch.testing.assert_close(float(paper.step(blink[0])[0]), 1 - 0.6 * 99 / (2 * 46 * 2), rtol=0, atol=0.01)
    ours = FrameSolver(blink, thresholds=sparsity_thresholds(blink, 0.01))
    torch.testing.assert_close(float(ours.step(blink[0])[0]), 0.99, rtol=0, atol=1e-6)


def test_a_pull_moves_the_centre_of_the_prior():
    shapes, frames, _ = random_problem()
    wanted = torch.linspace(0.1, 0.8, 8).double()
    solver = FrameSolver(shapes, torch.eye(8).double(), 1e6, pull=wanted)
    torch.testing.assert_close(solver(frames), wanted.expand(12, 8), rtol=0, atol=1e-4)


def test_more_prior_means_less_bending_and_a_worse_fit():
    shapes, frames, prior = random_problem()
    bent, misses = [], []
    for mu in (0.0, 0.1, 1.0, 10.0):
        weights = FrameSolver(shapes, prior, mu, low=-math.inf, high=math.inf)(frames)
        bent.append(float(torch.einsum("tk,kl,tl->", weights, prior, weights)))
        misses.append(float((frames - torch.einsum("tk,kmi->tmi", weights, shapes)).square().sum()))
    assert bent == sorted(bent, reverse=True)
    assert misses == sorted(misses)


def test_markers_that_do_not_count_change_nothing():
    shapes, frames, _ = random_problem()
    importance = torch.ones(20)
    importance[:5] = 0
    spoilt = frames.clone()
    spoilt[:, :5] += 3.0
    solver = FrameSolver(shapes, importance=importance)
    torch.testing.assert_close(solver(spoilt), solver(frames), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-math.inf, math.inf)])
def test_the_last_frame_hardly_changes_the_result(low, high):
    shapes, frames, prior = random_problem()
    solver = FrameSolver(shapes, prior, 0.1, sparsity_thresholds(shapes, 0.02), low=low, high=high)
    cold, warm = solver.step(frames[3]), solver.step(frames[3], solver.step(frames[4]))
    # Reweighting stops when a round moves no weight by 1e-3, which near a threshold is some way from where it ends.
    torch.testing.assert_close(warm, cold, rtol=0, atol=0.03 if high == math.inf else 1e-6)


def test_no_motion_has_no_weights():
    shapes, frames, prior = random_problem()
    for low, high in ((0.0, 1.0), (-math.inf, math.inf)):
        solver = FrameSolver(shapes, prior, 0.3, sparsity_thresholds(shapes, 0.1), low=low, high=high)
        assert (solver(0 * frames) == 0).all()


def test_bounds_that_cannot_be_solved_are_named():
    shapes, _, _ = random_problem()
    with pytest.raises(ReenactError, match="bounds from 0 up"):
        FrameSolver(shapes, low=-1.0, high=1.0)
