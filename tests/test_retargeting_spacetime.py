import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.rbf import ProportionMatching
from reenact.retargeting.spacetime import VelocityMatching, match_velocities
from reenact.rigs import motion
from reenact.rigs.clip import Clip


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(0)
    basis = torch.tensor(rng.normal(size=(4, 30)))
    weights = torch.tensor(np.cumsum(0.1 * rng.normal(size=(25, 4)), axis=0))
    return basis @ basis.T, weights @ basis @ basis.T, weights


def markers(source, target) -> Correspondence:
    return Correspondence.identity(source, target)[farthest_points(source.neutral, 80)]


def test_the_block_solve_equals_the_assembled_system(problem):
    gram, projections, _ = problem
    prior = torch.diag(torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))
    keys = {0: torch.zeros(4).double(), 9: torch.ones(4).double()}
    found = match_velocities(gram, projections, keys, 5.0, prior).numpy()
    # Slow twin: P (w_f+1 - w_f) in the metric of the root of H, all frames in one dense least squares.
    root = np.linalg.cholesky(gram.numpy()).T
    step = np.diff(np.eye(25), axis=0)
    wanted = np.linalg.solve(root.T, np.diff(projections.numpy(), axis=0).T).T
    held = np.zeros((2, 25))
    held[[0, 1], list(keys)] = np.sqrt(5.0)
    rows = [np.kron(step, root), np.kron(held, np.eye(4)), np.kron(np.eye(25), np.sqrt(prior.numpy()))]
    sides = [wanted.ravel(), np.sqrt(5.0) * np.stack([key.numpy() for key in keys.values()]).ravel(), np.zeros(100)]
    slow = np.linalg.lstsq(np.concatenate(rows), np.concatenate(sides), rcond=None)[0]
    np.testing.assert_allclose(found.ravel(), slow, atol=1e-8)


def test_with_every_frame_held_the_keys_come_back(problem):
    gram, projections, _ = problem
    wanted = torch.rand(25, 4, generator=torch.Generator().manual_seed(0)).double()
    found = match_velocities(gram, projections, dict(enumerate(wanted)), 1e9)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)  # H over the strength of the hold


@pytest.mark.parametrize("frame", [0, 7, 24])
def test_one_held_frame_integrates_consistent_velocities_exactly(problem, frame):
    gram, projections, weights = problem
    found = match_velocities(gram, projections, {frame: weights[frame]}, 1.0)
    torch.testing.assert_close(found, weights, rtol=0, atol=1e-6)  # what keeps still shapes solvable, 1e-10


def test_markers_that_all_sit_off_change_nothing(problem):
    gram, projections, weights = problem
    keys = {0: weights[0], 24: weights[24]}
    shifted = projections + torch.tensor([3.0, -2.0, 1.0, 5.0])
    torch.testing.assert_close(
        match_velocities(gram, shifted, keys, 1.0), match_velocities(gram, projections, keys, 1.0), rtol=0, atol=1e-8
    )


def test_an_edit_fades_steadily_towards_its_neighbours(problem):
    gram, projections, weights = problem
    ends = {0: weights[0], 24: weights[24]}
    plain = match_velocities(gram, projections, ends, 1e6)
    edited = match_velocities(gram, projections, {**ends, 10: weights[10] + 1.0}, 1e6)
    change = edited - plain
    torch.testing.assert_close(change[10], torch.ones(4).double(), rtol=0, atol=1e-4)  # the strength of the hold
    ramp = torch.cat([torch.arange(11) / 10, torch.arange(13, -1, -1) / 14]).double()
    torch.testing.assert_close(change, ramp[:, None].expand(-1, 4), rtol=0, atol=1e-3)


def test_identical_rigs_keep_their_weights(toy_rig):  # G1
    clip = motion.synthesize(toy_rig.names, 3.0, seed=5, kind="expressions")
    found = VelocityMatching(toy_rig, toy_rig, markers(toy_rig, toy_rig), prior=0.0)(clip)
    torch.testing.assert_close(found.weights, clip.weights, rtol=0, atol=1e-5)


def test_the_neutral_goes_to_the_neutral(toy_pair):  # G2
    still = Clip(toy_pair[0].names, torch.zeros(5, 7), 30.0)
    assert not VelocityMatching(*toy_pair, markers(*toy_pair), prior=0.1)(still).weights.any()


def test_a_key_of_the_animator_is_met_and_only_bends_the_clip(toy_pair):
    clip = motion.synthesize(toy_pair[0].names, 3.0, seed=5, kind="expressions")
    method = VelocityMatching(*toy_pair, markers(*toy_pair), prior=0.0)
    plain, key = method(clip).weights, torch.full((7,), 0.5)
    edited = method(clip, keys={40: key}).weights
    torch.testing.assert_close(edited[40], key, rtol=0, atol=0.01)  # held by 1000 times the fit
    torch.testing.assert_close(edited[0], plain[0], rtol=0, atol=0.01)
    torch.testing.assert_close(edited[-1], plain[-1], rtol=0, atol=0.01)


def test_it_jitters_no_more_than_frame_by_frame(toy_pair):
    ball, egg = toy_pair
    noise = 0.03 * torch.randn(90, 7, generator=torch.Generator().manual_seed(0))
    weights = (motion.synthesize(ball.names, 3.0, seed=5, kind="expressions").weights + noise).clamp_min(0)
    clip, pairs = Clip(ball.names, weights, 30.0), markers(ball, egg)

    def jitter(weights: torch.Tensor) -> float:
        return float(weights.diff(n=2, dim=0).abs().mean())

    frames = jitter(ProportionMatching(ball, egg, pairs)(clip).weights)
    assert jitter(VelocityMatching(ball, egg, pairs)(clip).weights) <= 1.01 * frames


def test_clips_of_one_frame_and_of_none_work_and_results_repeat_bitwise(toy_pair):  # G10
    clip = motion.synthesize(toy_pair[0].names, 1.0, seed=5, kind="expressions")
    method, again = (VelocityMatching(*toy_pair, markers(*toy_pair)) for _ in range(2))
    assert bool((method(clip).weights == again(clip).weights).all())
    for frames in (0, 1):
        assert method(Clip(clip.names, clip.weights[:frames], 30.0)).weights.shape == (frames, 7)


def test_unusable_input_is_named(toy_pair):
    with pytest.raises(ReenactError, match="needs a correspondence"):
        VelocityMatching(*toy_pair)
    with pytest.raises(ReenactError, match="holding > 0"):
        VelocityMatching(*toy_pair, markers(*toy_pair), holding=0.0)
    with pytest.raises(ReenactError, match="at least one key"):
        match_velocities(torch.eye(2), torch.zeros(3, 2), {}, 1.0)
    clip = Clip(toy_pair[0].names, torch.zeros(3, 7), 30.0)
    for keys in ({5: torch.zeros(7)}, {0: torch.zeros(2)}):
        with pytest.raises(ReenactError, match="key: expected 7 weights at a frame from 0 to 2"):
            VelocityMatching(*toy_pair, markers(*toy_pair))(clip, keys)
