from dataclasses import replace

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.cross_mapping import CrossMapping, KernelCCA, expression_pairs
from reenact.rigs import arkit, motion
from reenact.rigs.clip import Clip

METHODS = {"rbf": CrossMapping, "kcca": KernelCCA}


@pytest.fixture(scope="module")
def relation(toy_pair):
    """Weights of the target as a smooth bent function of the source's, 0 at rest."""
    bend = torch.rand(7, 7, generator=torch.Generator().manual_seed(0)) / 7

    def relation(weights: torch.Tensor) -> torch.Tensor:
        return (weights @ bend + 0.2 * weights.square()).clamp(0, 1)

    return relation


def pairs_of(names, relation, count: int):
    inputs = torch.cat([torch.zeros(1, 7), motion.expressions(names, count - 1, seed=1)])
    return inputs, relation(inputs)


def test_every_pair_is_met_without_a_ridge(toy_pair, relation):
    pairs = pairs_of(toy_pair[0].names, relation, 25)
    made = CrossMapping(*toy_pair, pairs=pairs, ridge=0.0)(Clip(toy_pair[0].names, pairs[0], 30.0))
    torch.testing.assert_close(made.weights, pairs[1], rtol=0, atol=1e-5)  # condition of the Gaussians


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_the_neutral_goes_to_the_neutral(toy_pair, relation, method):  # G2
    still = Clip(toy_pair[0].names, torch.zeros(2, 7), 30.0)
    for pairs in (None, pairs_of(toy_pair[0].names, relation, 12)):
        assert float(method(*toy_pair, pairs=pairs)(still).weights.abs().max()) < 1e-6


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_more_pairs_give_less_error(toy_pair, relation, method):
    test = motion.expressions(toy_pair[0].names, 200, seed=9)
    errors = []
    for count in (4, 16, 64):
        made = method(*toy_pair, pairs=pairs_of(toy_pair[0].names, relation, count))
        errors.append(float((made(Clip(toy_pair[0].names, test, 30.0)).weights - relation(test)).abs().mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.3 * errors[0]


def test_far_from_all_pairs_the_trend_remains(toy_pair):
    inputs = torch.cat([torch.zeros(1, 7), 0.1 * motion.expressions(toy_pair[0].names, 40, seed=1)])
    far = Clip(toy_pair[0].names, 0.9 * torch.ones(1, 7), 30.0)
    made = CrossMapping(*toy_pair, pairs=(inputs, inputs / 2), width=0.02)(far)
    torch.testing.assert_close(made.weights, torch.full((1, 7), 0.45), rtol=0, atol=0.02)  # y = x / 2, with a ridge


def test_weights_stay_between_the_bounds(toy_pair, relation):
    wild = Clip(toy_pair[0].names, 5 * torch.randn(50, 7, generator=torch.Generator().manual_seed(0)), 30.0)
    for method in METHODS.values():
        weights = method(*toy_pair, pairs=pairs_of(toy_pair[0].names, relation, 12))(wild).weights
        assert bool(((weights >= 0) & (weights <= 1)).all())


def test_a_linear_kernel_finds_a_linear_relation(toy_pair):
    generator = torch.Generator().manual_seed(0)
    inputs = torch.rand(40, 7, generator=generator)
    outputs = inputs @ torch.linalg.qr(torch.randn(7, 7, generator=generator))[0]
    method = KernelCCA(*toy_pair, pairs=(inputs, outputs), kernel="linear", eta=1e-5)
    assert float(method.correlations[:7].min()) > 0.99
    assert float(method.correlations[7:].max()) < 0.01  # there are only seven directions


def test_the_order_of_pairs_does_not_matter(toy_pair, relation):
    inputs, outputs = pairs_of(toy_pair[0].names, relation, 20)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    clip = Clip(toy_pair[0].names, motion.expressions(toy_pair[0].names, 20, seed=9), 30.0)
    for method in METHODS.values():
        first = method(*toy_pair, pairs=(inputs, outputs))(clip).weights
        second = method(*toy_pair, pairs=(inputs[order], outputs[order]))(clip).weights
        torch.testing.assert_close(first, second, rtol=0, atol=1e-5)


def test_without_regularisation_unrelated_pairs_correlate_perfectly_and_predict_nothing(toy_pair):
    generator = torch.Generator().manual_seed(0)
    inputs, outputs = torch.rand(24, 7, generator=generator), torch.rand(24, 7, generator=generator)
    loose = KernelCCA(*toy_pair, pairs=(inputs, outputs), eta=1e-9)
    firm = KernelCCA(*toy_pair, pairs=(inputs, outputs), eta=1e-1)
    assert float(loose.correlations[:20].min()) > 0.999
    assert float(firm.correlations[0]) < 0.9

    def left_out(eta: float) -> float:
        errors = []
        for index in range(24):
            rest = torch.arange(24) != index
            method = KernelCCA(*toy_pair, pairs=(inputs[rest], outputs[rest]), eta=eta)
            # Unbounded, about the mean, so that only the regression is judged.
            guess = method._regress(inputs[index : index + 1].double()) + method._rest + outputs[rest].mean(0)
            errors.append(float((guess - outputs[index]).square().sum()))
        return float(np.mean(errors))

    assert left_out(1e-9) > 1.2 * left_out(1e-1)


def test_single_shapes_with_their_namesakes_are_the_pairs_where_none_are_given(toy_pair):
    inputs, outputs = expression_pairs(*toy_pair)
    assert not inputs[0].any()
    assert not outputs[0].any()
    assert bool((inputs[1:] == torch.eye(7)).all())
    assert bool((outputs == inputs).all())


def test_a_given_number_of_pairs_puts_left_and_right_together_the_largest_first(toy_pair):
    inputs, _ = expression_pairs(*toy_pair, count=4)
    names = [{toy_pair[0].names[k] for k in row.nonzero().flatten()} for row in inputs]
    assert names[0] == set()
    assert {"jawOpen"} in names
    assert {"mouthSmileLeft", "mouthSmileRight"} in names or {"mouthPucker"} in names
    assert all(("mouthSmileLeft" in n) == ("mouthSmileRight" in n) for n in names)
    strength = (inputs[1:] @ toy_pair[0].deltas.flatten(1)).norm(dim=1)
    assert bool((strength.diff() <= 0).all())


@pytest.mark.parametrize("count", [22, 31])
def test_the_published_numbers_of_pairs_exist_for_the_arkit_shapes(toy_pair, count):
    deltas = torch.randn(52, 642, 3, generator=torch.Generator().manual_seed(0))
    rig = replace(toy_pair[0], deltas=deltas, names=arkit.NAMES)
    inputs, outputs = expression_pairs(rig, rig, count=count)
    assert len(inputs) == len(outputs) == count
    assert len(torch.unique(inputs, dim=0)) == count


def test_a_correspondence_makes_the_pairs_where_no_name_is_shared(toy_pair):
    ball, egg = toy_pair
    other = replace(egg, names=tuple("abcdefg"))
    _, outputs = expression_pairs(ball, other, Correspondence.identity(ball, other)[torch.arange(0, 642, 5)])
    assert bool((outputs[1:].argmax(1) == torch.arange(7)).all())
    with pytest.raises(ReenactError, match="no shape has the same name"):
        expression_pairs(ball, other)


def test_results_repeat_bitwise(toy_pair):  # G10
    clip = Clip(toy_pair[0].names, motion.expressions(toy_pair[0].names, 20, seed=9), 30.0)
    for method in METHODS.values():
        assert bool((method(*toy_pair)(clip).weights == method(*toy_pair)(clip).weights).all())


def test_a_ramp_of_one_shape_makes_its_namesake_rise_all_the_way(toy_pair):  # G11
    ball, egg = toy_pair
    for method in METHODS.values():
        made = method(ball, egg)
        for index in range(7):
            ramp = torch.zeros(11, 7)
            ramp[:, index] = torch.linspace(0, 1, 11)
            answer = made(Clip(ball.names, ramp, 30.0)).weights[:, index]
            assert bool((answer.diff() > 0).all())


def test_unusable_pairs_are_named(toy_pair):
    with pytest.raises(ReenactError, match="expected at least two"):
        CrossMapping(*toy_pair, pairs=(torch.zeros(3, 7), torch.zeros(3, 5)))
    with pytest.raises(ReenactError, match="repetitions"):
        KernelCCA(*toy_pair, pairs=(torch.zeros(3, 7), torch.zeros(3, 7)))
    with pytest.raises(ReenactError, match="expected 2 to 6 pairs"):
        expression_pairs(*toy_pair, count=60)
