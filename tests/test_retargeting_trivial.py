from dataclasses import replace

import pytest
import torch

from reenact.errors import ReenactError
from reenact.retargeting.trivial import CopyNames, Neutral
from reenact.rigs import motion
from reenact.rigs.clip import Clip


def test_copying_is_the_identity_between_equal_rigs(toy_rig):  # SPEC 6.1
    clip = Clip(toy_rig.names, motion.expressions(toy_rig.names, 9, seed=0), fps=25.0)
    copied = CopyNames(toy_rig, toy_rig)(clip)
    assert bool((copied.weights == clip.weights).all())
    assert copied.fps == 25.0


def test_a_merged_shape_takes_the_mean_of_its_sides_and_each_side_the_whole(toy_rig):
    both = replace(toy_rig, deltas=toy_rig.deltas[:1], names=("eyeBlink",))
    sides = Clip(toy_rig.names, torch.tensor([[0.8, 0.2, 0, 0, 0, 0, 0]]), 30.0)
    with pytest.warns(UserWarning, match="left out"):
        merging = CopyNames(toy_rig, both)
    assert float(merging(sides).weights) == pytest.approx(0.5)
    with pytest.warns(UserWarning, match="stay at 0"):
        splitting = CopyNames(both, toy_rig)
    assert splitting(Clip(both.names, torch.tensor([[0.6]]), 30.0)).weights[0, :3].tolist() == pytest.approx(
        [0.6, 0.6, 0]
    )


def test_copies_stay_between_the_bounds(toy_rig):
    wild = Clip(toy_rig.names, torch.tensor([[-1.0, 2.0, 0, 0, 0, 0, 0]]), 30.0)
    assert CopyNames(toy_rig, toy_rig)(wild).weights[0, :2].tolist() == [0.0, 1.0]


def test_the_neutral_never_moves(toy_pair):
    ball, egg = toy_pair
    clip = Clip(ball.names, motion.expressions(ball.names, 9, seed=0), fps=25.0)
    still = Neutral(ball, replace(egg, deltas=egg.deltas[:2], names=("a", "b")))(clip)
    assert still.weights.shape == (9, 2)
    assert not still.weights.any()


def test_unusable_input_is_named(toy_rig):
    with pytest.raises(ReenactError, match="none of its 7 shapes"):
        CopyNames(toy_rig, replace(toy_rig, names=tuple("abcdefg")))
    for method in (CopyNames, Neutral):
        with pytest.raises(ReenactError, match="clip: expected the 7 shapes of ball"):
            method(toy_rig, toy_rig)(Clip(("x",), torch.zeros(1, 1), 30.0))
