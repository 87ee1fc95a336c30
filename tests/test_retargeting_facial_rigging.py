"""Example-based facial rigging: what exact examples give back, its limits, and its laws."""

from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer
from reenact.retargeting.facial_rigging import FacialRigging, Rigging, RiggingConfig, choose_examples
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

SCALES = torch.tensor([0.5, 0.7, 1.0, 1.3, 1.6, 2.0, 0.8])


def scaled(rig: Rig) -> Rig:
    """The rig with another range of motion."""
    return replace(rig, name="actor", deltas=rig.deltas * SCALES[:, None, None])


def ratios(found: torch.Tensor, shapes: torch.Tensor) -> torch.Tensor:
    """How long each shape is along another."""
    return (found * shapes).sum((1, 2)) / shapes.square().sum((1, 2))


def frozen(beta: float, iterations: int = 1, gamma: float = 1e6) -> RiggingConfig:
    return RiggingConfig(iterations=iterations, beta=(beta, beta), gamma=(gamma, gamma))


def test_exact_examples_with_exact_weights_give_back_the_scale_of_each_shape():
    rig = make_toy_rig("generic")
    actor = scaled(rig)
    weights = torch.cat([torch.eye(7), motion.expressions(rig.names, 8, seed=1)])
    method = FacialRigging(
        actor,
        rig,
        Correspondence.identity(actor, rig),
        config=frozen(1e-9),
        examples=actor.vertices(weights),
        weights=weights,
    )
    found = ratios(method.personalised.deltas, rig.deltas)
    torch.testing.assert_close(found, SCALES, rtol=1e-3, atol=0)  # beta is not quite 0
    clip = Clip(actor.names, 0.5 * torch.eye(7), 30.0)
    torch.testing.assert_close(method(clip).weights, clip.weights, rtol=0, atol=2e-3)


def test_at_the_default_settings_the_scales_are_approached_and_ranked():
    rig = make_toy_rig("generic")
    actor = scaled(rig)
    weights = torch.eye(7)
    pairs = Correspondence.identity(actor, rig)
    method = FacialRigging(actor, rig, pairs, examples=actor.vertices(weights), weights=weights)
    found = ratios(method.personalised.deltas, rig.deltas)
    assert torch.equal(found.argsort(), SCALES.argsort())
    # Between the generic rig's 1 and the truth: one example of a shape weighs little against beta and omega.
    assert bool(((found - 1) * (SCALES - found) >= -1e-4).all())


def test_a_strong_pull_gives_deformation_transfer(toy_pair):
    actor, rig = toy_pair
    weights = torch.eye(7)
    pairs = Correspondence.identity(actor, rig)
    method = FacialRigging(actor, rig, pairs, config=frozen(1e9), examples=actor.vertices(weights), weights=weights)
    expected = DeformationTransfer(rig, actor, pairs.reversed()).shapes.deltas
    torch.testing.assert_close(method.personalised.deltas, expected, rtol=0, atol=1e-6)


def test_the_shape_step_solves_the_normal_equations_of_each_face(toy_pair):
    actor, rig = toy_pair
    weights = motion.expressions(rig.names, 5, seed=2).double()
    carried = DeformationTransfer(rig, actor, Correspondence.identity(rig, actor))
    rigging = Rigging(carried, actor.vertices(weights.float()).double(), weights, RiggingConfig(iterations=0))
    rigging.fit_shapes(0.3)
    for face in (0, 200, 500):
        # K x K, as printed: (alpha^T alpha + beta diag(omega)) M = alpha^T (M^S - M_0) + beta omega M*
        system = weights.T @ weights + 0.3 * torch.diag(rigging.trust[face])
        side = weights.T @ rigging._wanted[face] + 0.3 * rigging.trust[face][:, None] * rigging.generic[face]
        torch.testing.assert_close(rigging.edges[face], torch.linalg.solve(system, side), rtol=0, atol=1e-12)


def test_faces_that_a_shape_does_not_move_are_trusted_a_hundredfold(toy_pair):
    actor, rig = toy_pair
    carried = DeformationTransfer(rig, actor, Correspondence.identity(rig, actor))
    rigging = Rigging(
        carried, actor.vertices(torch.eye(7)).double(), torch.eye(7).double(), RiggingConfig(iterations=0)
    )
    # omega(0) = (1 / 0.1)^2 = 100, and it falls towards 1 as the motion grows.
    assert float(rigging.trust.max()) == pytest.approx(100, rel=1e-3)
    assert 1 < float(rigging.trust.min()) < 50


def test_each_step_lowers_its_energy_at_fixed_settings(toy_pair):
    actor, rig = toy_pair
    carried = DeformationTransfer(rig, actor, Correspondence.identity(rig, actor))
    weights = motion.expressions(rig.names, 15, seed=3)
    guess = (0.6 * weights + 0.1).double()
    config = RiggingConfig(iterations=6, beta=(0.3, 0.3), gamma=(0.5, 0.5))
    energies = Rigging(carried, actor.vertices(weights).double(), guess, config).energies
    assert len(energies) == 6
    for shapes_before, shapes_after, weights_before, weights_after in energies:
        assert shapes_after <= shapes_before * (1 + 1e-9)
        assert weights_after <= weights_before * (1 + 1e-9)
    # The steps have different energies, edges and vertices, so that none need fall over the rounds; this one does.
    assert energies[-1][1] < energies[0][1]


def test_a_strong_pull_holds_the_weights_and_a_weak_one_lets_them_fit_within_bounds(toy_pair):
    actor, rig = toy_pair
    carried = DeformationTransfer(rig, actor, Correspondence.identity(rig, actor))
    guess = torch.full((3, 7), 0.5, dtype=torch.float64)
    examples = actor.vertices(torch.zeros(3, 7)).double()
    held, free = (
        Rigging(carried, examples, guess, RiggingConfig(iterations=1, beta=(1e9, 1e9), gamma=(gamma, gamma))).weights
        for gamma in (1e9, 1e-9)
    )
    torch.testing.assert_close(held, guess, rtol=0, atol=1e-6)
    assert float(free.abs().max()) < 1e-6  # the examples are neutral


def test_examples_are_the_frames_nearest_to_the_clusters():
    rig = make_toy_rig("ball")
    poses = torch.zeros(3, 7)
    poses[0, 3], poses[1, 0], poses[2, 5] = 1.0, 1.0, 1.0
    noise = 0.01 * torch.rand(60, 7, generator=torch.manual_seed(0))
    weights = (poses.repeat(20, 1) + noise).clamp(0, 1)
    chosen = choose_examples(rig, Clip(rig.names, weights, 30.0), RiggingConfig(examples=3))
    assert sorted((chosen % 3).tolist()) == [0, 1, 2]
    still = Clip(rig.names, torch.zeros(9, 7), 30.0)
    assert len(choose_examples(rig, still, RiggingConfig())) == 1  # one expression, however many are asked for


def test_equal_rigs_nearly_return_the_weights():
    rig = make_toy_rig("ball")
    training = Clip(rig.names, motion.expressions(rig.names, 200, seed=5), 30.0)
    method = FacialRigging(rig, rig, Correspondence.identity(rig, rig), training)
    clip = Clip(rig.names, motion.expressions(rig.names, 30, seed=6), 30.0)
    torch.testing.assert_close(method(clip).weights, clip.weights, rtol=0, atol=0.02)  # the guess rests on 100 places


def test_laws_of_scale_neutral_order_and_repetition(toy_pair):
    actor, rig = toy_pair
    pairs = Correspondence.identity(actor, rig)
    training, short = Clip(actor.names, motion.expressions(actor.names, 100, seed=7), 30.0), RiggingConfig(iterations=3)
    clip = Clip(actor.names, motion.expressions(actor.names, 10, seed=8), 24.0)
    first, second = (FacialRigging(actor, rig, pairs, training, config=short)(clip) for _ in range(2))
    assert torch.equal(first.weights, second.weights)
    assert (first.fps, first.names) == (24.0, rig.names)
    assert float(first.weights.min()) >= 0
    assert float(first.weights.max()) <= 1
    large = replace(rig, neutral=rig.neutral * 5, deltas=rig.deltas * 5)
    torch.testing.assert_close(
        FacialRigging(actor, large, pairs, training, config=short)(clip).weights, first.weights, rtol=0, atol=1e-3
    )
    method = FacialRigging(actor, rig, pairs, config=short)  # without a clip, a minute of synthetic motion serves
    still = method(Clip(actor.names, torch.zeros(2, 7), 30.0))
    assert float(still.weights.abs().max()) < 1e-6
    for k in range(7):
        ramp = torch.zeros(11, 7)
        ramp[:, k] = torch.linspace(0, 0.8, 11)
        assert bool((method(Clip(actor.names, ramp, 30.0)).weights[:, k].diff() > 0).all())


def test_unusable_input_is_named(toy_pair):
    actor, rig = toy_pair
    pairs = Correspondence.identity(actor, rig)
    with pytest.raises(ReenactError, match="expected a correspondence, got none"):
        FacialRigging(actor, rig)
    with pytest.raises(ReenactError, match="expected the 7 shapes of ball"):
        FacialRigging(actor, rig, pairs, Clip(("jawOpen",), torch.zeros(3, 1), 30.0))
    with pytest.raises(ReenactError, match="ball: expected examples of 642 vertices, got 5"):
        FacialRigging(actor, rig, pairs, examples=torch.zeros(2, 5, 3))
    with pytest.raises(ReenactError, match=r"egg: expected weights \(2, 7\) for 2 examples"):
        FacialRigging(actor, rig, pairs, examples=actor.neutral.repeat(2, 1, 1), weights=torch.zeros(3, 7))
    method = FacialRigging(actor, rig, pairs, examples=actor.vertices(torch.eye(7)))
    with pytest.raises(ReenactError, match="expected the 7 shapes of ball"):
        method(Clip(("jawOpen",), torch.zeros(1, 1), 30.0))
