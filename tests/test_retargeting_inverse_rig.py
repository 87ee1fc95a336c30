import math
import time

import numpy as np
import pytest
import torch
from conftest import make_random_rig
from scipy.optimize import lsq_linear

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Places
from reenact.retargeting.inverse_rig import InverseRig, fit_weights, nonnegative_least_squares
from reenact.rigs import motion


def random_problem(seed: int, unknowns: int, rows: int, frames: int):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, unknowns)) @ (np.eye(unknowns) + 0.3 * rng.normal(size=(unknowns, unknowns)))
    sides = rng.normal(size=(frames, rows))
    return matrix, sides, torch.tensor(matrix.T @ matrix), torch.tensor(sides @ matrix)


def test_one_unknown_is_clipped():
    gram, sides = torch.tensor([[2.0]]), torch.tensor([[-1.0], [1.0], [3.0]])
    weights = nonnegative_least_squares(gram, sides, high=1.0)
    torch.testing.assert_close(weights, torch.tensor([[0.0], [0.5], [1.0]], dtype=torch.float64))


def test_a_bound_weight_lets_the_other_one_make_up_for_it():
    # |w1 - 2|^2 + |w1 + w2 - 2|^2 with w1 <= 1: w1 = 1, and then w2 = 1.
    gram, sides = torch.tensor([[2.0, 1.0], [1.0, 1.0]]), torch.tensor([[4.0, 2.0]])
    torch.testing.assert_close(nonnegative_least_squares(gram, sides, high=1.0), torch.ones(1, 2).double())


@pytest.mark.parametrize(("unknowns", "rows", "high"), [(1, 4, 1.0), (6, 9, math.inf), (20, 40, 0.3), (52, 90, 1.0)])
def test_weights_equal_those_of_scipy(unknowns, rows, high):
    matrix, sides, gram, projections = random_problem(unknowns, unknowns, rows, 12)
    weights = nonnegative_least_squares(gram, projections, 0.0, high).numpy()
    for frame, side in enumerate(sides):
        slow = lsq_linear(matrix, side, bounds=(0, high), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(weights[frame], slow, atol=1e-8)  # the ridge, 1e-8 of the diagonal


@pytest.mark.parametrize("rank", [3, 10, 52])
def test_the_optimality_conditions_hold_even_where_shapes_depend_on_each_other(rank):  # A1
    matrix = np.random.default_rng(rank).normal(size=(rank, 52))
    sides = torch.tensor(np.random.default_rng(9).normal(size=(40, rank)) @ matrix)
    gram = torch.tensor(matrix.T @ matrix)
    weights = nonnegative_least_squares(gram, sides, high=1.0)
    gradient, tolerance = weights @ gram - sides, 1e-6 * sides.norm(dim=1, keepdim=True)
    assert bool(((weights >= 0) & (weights <= 1)).all())
    settled = gradient.abs() <= tolerance
    held = ((weights == 0) & (gradient >= -tolerance)) | ((weights == 1) & (gradient <= tolerance))
    assert bool((settled | held).all())


def test_the_start_changes_nothing():
    _, _, gram, projections = random_problem(5, 30, 50, 20)
    start = torch.rand(20, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    cold, warm = (nonnegative_least_squares(gram, projections, 0.0, 1.0, begin) for begin in (None, start))
    torch.testing.assert_close(cold, warm, rtol=0, atol=1e-8)  # tolerance of the active set


def test_without_bounds_the_result_is_least_squares():
    matrix, sides, gram, projections = random_problem(6, 12, 30, 4)
    weights = nonnegative_least_squares(gram, projections, -math.inf, math.inf)
    np.testing.assert_allclose(weights.numpy(), np.linalg.lstsq(matrix, sides.T, rcond=None)[0].T, atol=1e-9)


def test_smoothness_is_a_joint_optimum_over_the_clip():
    matrix, sides, gram, projections = random_problem(7, 4, 8, 6)
    weights = nonnegative_least_squares(gram, projections, 0.0, 1.0, smoothness=2.0).numpy()
    # Slow twin: all frames in one system, with rows sqrt(2) (w_f+1 - w_f).
    difference = np.sqrt(2.0) * np.kron(np.diff(np.eye(6), axis=0), np.eye(4))
    whole = np.concatenate([np.kron(np.eye(6), matrix), difference])
    slow = lsq_linear(whole, np.concatenate([sides.ravel(), np.zeros(20)]), bounds=(0, 1), method="bvls", tol=1e-14)
    np.testing.assert_allclose(weights.ravel(), slow.x, atol=1e-6)  # sweeps end at a change of 1e-9


def test_weights_of_meshes_in_the_span_come_back(toy_rig):  # SPEC 6.1
    weights = motion.expressions(toy_rig.names, 50, seed=3)
    rig = toy_rig
    vertices = rig.neutral.double() + torch.einsum("tk,kvc->tvc", weights.double(), rig.deltas.double())
    torch.testing.assert_close(fit_weights(rig, vertices), weights, rtol=0, atol=1e-6)
    places = Places.at(torch.arange(0, len(rig.neutral), 3))
    torch.testing.assert_close(fit_weights(rig, vertices, places), weights, rtol=0, atol=1e-6)


def test_a_shape_that_moves_nothing_stays_at_rest():
    rig = make_random_rig(1)  # its third shape is still
    vertices = rig.vertices(torch.tensor([[0.5, 0.25, 0.0]]))
    torch.testing.assert_close(
        fit_weights(rig, vertices), torch.tensor([[0.5, 0.25, 0.0]]), rtol=0, atol=1e-5
    )  # float32 vertices


def test_the_neutral_has_weights_of_exactly_zero(toy_rig):
    assert not fit_weights(toy_rig, toy_rig.neutral[None].expand(3, -1, -1)).any()


def test_places_that_do_not_matter_do_not_matter(toy_rig):
    weights = torch.tensor([[0.0, 0.3, 0.0, 0.8, 0.0, 0.0, 0.1]])
    vertices = toy_rig.vertices(weights)
    vertices[:, :100] += 0.01
    importance = torch.ones(len(toy_rig.neutral))
    importance[:100] = 0
    fitted = InverseRig(toy_rig, importance=importance)(vertices)
    torch.testing.assert_close(fitted, weights, rtol=0, atol=1e-4)  # float32 vertices


def test_condition_tells_how_well_shapes_can_be_told_apart(toy_rig):
    from dataclasses import replace

    assert 1 <= InverseRig(toy_rig).condition < 1e3
    deltas = torch.cat([toy_rig.deltas, toy_rig.deltas[:1] + toy_rig.deltas[1:2]])
    assert InverseRig(replace(toy_rig, deltas=deltas, names=(*toy_rig.names, "both"))).condition > 1e6


def test_an_empty_clip_has_no_weights(toy_rig):
    assert fit_weights(toy_rig, torch.zeros(0, len(toy_rig.neutral), 3)).shape == (0, 7)


def test_any_number_of_threads_finds_the_same_bits():
    rows = torch.randn(60, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = torch.randn(1500, 20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(nonnegative_least_squares(rows.T @ rows, wanted, high=1.0))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])
    alone = torch.cat([nonnegative_least_squares(rows.T @ rows, row[None], high=1.0) for row in wanted[250:260]])
    torch.testing.assert_close(found[1][250:260], alone, rtol=0, atol=1e-9)  # across the border of two blocks


def test_frames_are_solved_fast_enough_for_real_time():
    _, _, gram, projections = random_problem(8, 52, 300, 500)
    nonnegative_least_squares(gram, projections[:2], 0.0, 1.0)  # compiles
    times = []
    for _ in range(3):
        start = time.thread_time()
        nonnegative_least_squares(gram, projections, 0.0, 1.0)
        times.append(time.thread_time() - start)
    assert 500 / min(times) > 1000  # 30,000 on an idle core; loose, for machines that are busy


def test_unusable_input_is_named(toy_rig):
    with pytest.raises(ReenactError, match="low < high"):
        nonnegative_least_squares(torch.eye(2), torch.ones(1, 2), low=1.0, high=0.0)
    with pytest.raises(ReenactError, match="NaN"):
        nonnegative_least_squares(torch.eye(2), torch.full((1, 2), torch.nan))
    with pytest.raises(ReenactError, match="expected 642 vertices"):
        fit_weights(toy_rig, torch.zeros(1, 5, 3))
    with pytest.raises(ReenactError, match="importances"):
        InverseRig(toy_rig, importance=torch.ones(3))
