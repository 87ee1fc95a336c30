"""Examples: the most telling ones come first, and unpaired ones find their place among what the source does."""

from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer
from reenact.retargeting.examples import choose, embed
from reenact.retargeting.plbs import Patches
from reenact.rigs import motion


def miss(found, truth, neutral) -> float:
    return float((found - truth).norm(dim=-1).sum() / (truth - neutral).norm(dim=-1).sum())


def test_an_expression_that_tells_of_several_patches_comes_first(toy_rig):
    single = torch.eye(7)
    both = single[0] + single[3]  # a blink and the jaw, far from each other
    chosen = choose(toy_rig, 2, torch.stack([single[0], single[3], both, 0.5 * both]))
    torch.testing.assert_close(chosen[0], both)


def test_one_patch_chooses_like_pivoted_gram_schmidt(toy_rig):
    candidates = motion.expressions(toy_rig.names, 30, seed=1)
    whole = Patches.of(toy_rig, 1)
    chosen = choose(toy_rig, 4, candidates, whole)
    moved = (candidates @ toy_rig.deltas.flatten(1)).double()
    left, expected = moved.clone(), []
    for _ in range(4):  # slow and obvious: try each, and see what stays
        stays = []
        for row in left:
            unit = row / row.norm().clamp_min(1e-12)
            stays.append(float((left - torch.outer(left @ unit, unit)).square().sum()))
        best = int(torch.tensor(stays).argmin())
        expected.append(best)
        unit = left[best] / left[best].norm()
        left = left - torch.outer(left @ unit, unit)
    torch.testing.assert_close(chosen, candidates[expected])


def test_no_more_are_chosen_than_explain_everything(toy_rig):
    assert len(choose(toy_rig, 50, torch.eye(7))) == 7
    assert len(choose(toy_rig, 50, torch.eye(7)[:2].repeat(4, 1))) == 2
    assert len(choose(toy_rig, 5)) == 5


def test_nothing_to_choose_from_is_named(toy_rig):
    with pytest.raises(ReenactError, match="expected at least 1, got 0"):
        choose(toy_rig, 0)
    with pytest.raises(ReenactError, match="expected candidates that move the face"):
        choose(toy_rig, 2, torch.zeros(3, 7))
    with pytest.raises(ReenactError, match=r"expected weights \(N, 7\), got \(3, 2\)"):
        choose(toy_rig, 2, torch.zeros(3, 2))


@pytest.fixture(scope="module")
def seen(toy_pair):
    return toy_pair[0].vertices(motion.expressions(toy_pair[0].names, 200, seed=5))


def test_what_the_source_was_seen_doing_is_found_again(seen):
    rig = make_toy_rig("ball")
    pairs = Correspondence.identity(rig, rig)
    found = embed(rig, rig, seen[40:44], pairs, seen)
    assert miss(found, seen[40:44], rig.neutral) < 1e-3


def test_embedded_examples_come_closer_than_carried_ones(toy_pair, seen):
    source, target = toy_pair
    sideways = torch.tensor([1.3, 0.8, 1.1])  # the target has its own way of moving
    target = replace(target, deltas=target.deltas * sideways)
    weights = motion.expressions(target.names, 5, seed=6)
    pairs, truth = Correspondence.identity(source, target), source.vertices(weights)
    found = embed(source, target, target.vertices(weights), pairs, seen)
    carried = DeformationTransfer(target, source, pairs.reversed()).transfer(target.vertices(weights))
    assert miss(found, truth, source.neutral) < 0.8 * miss(carried, truth, source.neutral)


def test_a_neutral_example_stays_neutral(toy_pair, seen):
    source, target = toy_pair
    pairs = Correspondence.identity(source, target)
    found = embed(source, target, target.neutral[None], pairs, seen)
    torch.testing.assert_close(found[0], source.neutral, rtol=0, atol=1e-6)  # float32


def test_still_frames_are_named(toy_pair):
    source, target = toy_pair
    with pytest.raises(ReenactError, match="expected frames that move, got 3"):
        embed(
            source,
            target,
            target.vertices(torch.eye(7)),
            Correspondence.identity(source, target),
            source.neutral.expand(3, -1, 3),
        )
