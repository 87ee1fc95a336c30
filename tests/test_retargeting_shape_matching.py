from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.rbf import ProportionMatching
from reenact.retargeting.shape_matching import Partners, ShapeMatching, ShapeMatchingConfig, find_partners
from reenact.rigs import motion
from reenact.rigs.clip import Clip

RHO = torch.tensor([0.5, 0.7, 1.0, 1.3, 1.6, 2.0, 0.8])


def markers(source, target, count: int = 120) -> Correspondence:
    return Correspondence.identity(source, target)[farthest_points(source.neutral, count)]


@pytest.fixture(scope="module")
def shuffled():
    """An egg whose shapes stand in another order, without names, each with a range of its own."""
    egg = make_toy_rig("egg", stretch=1.25)
    order = torch.tensor([3, 0, 6, 5, 1, 2, 4])
    deltas = (RHO[:, None, None] * egg.deltas)[order]
    return replace(egg, deltas=deltas, names=tuple("abcdefg")), order


SURE = ShapeMatchingConfig(similarity=0.6)


def test_partners_are_found_in_any_order(toy_rig, shuffled):
    egg, order = shuffled
    method = ShapeMatching(toy_rig, egg, markers(toy_rig, egg))
    assert sorted(method.partners.single, key=lambda pair: pair[1]) == [(int(j), k) for k, j in enumerate(order)]


def test_shapes_are_compared_alike_few_places_at_a_time(toy_rig, shuffled, monkeypatch):
    method = ShapeMatching(toy_rig, shuffled[0], markers(toy_rig, shuffled[0]))
    at_once = method._compared(SURE)
    monkeypatch.setattr("reenact.retargeting.shape_matching._PLACES", 7)
    for few, all_places in zip(method._compared(SURE), at_once):
        torch.testing.assert_close(few, all_places, rtol=0, atol=1e-9)


def test_full_strength_means_full_strength_whatever_the_range(toy_rig, shuffled):
    egg, order = shuffled
    clip = Clip(toy_rig.names, motion.expressions(toy_rig.names, 40, seed=1), 30.0)
    truth = clip.weights[:, order]
    found = ShapeMatching(toy_rig, egg, markers(toy_rig, egg))(clip)
    torch.testing.assert_close(found.weights, truth, rtol=0, atol=1e-6)
    plain = ProportionMatching(toy_rig, egg, markers(toy_rig, egg))(clip)
    assert float((plain.weights - truth).abs().mean()) > 0.02


def test_pairs_that_are_a_little_off_still_find_the_partners(toy_rig, shuffled):
    egg, order = shuffled
    chosen = farthest_points(toy_rig.neutral, 120)
    noisy = egg.neutral[chosen] + 0.005 * torch.randn(120, 3, generator=torch.Generator().manual_seed(0))
    near = torch.cdist(noisy, egg.neutral).argmin(1)
    pairs = Correspondence(Places.at(chosen), Places.at(near), torch.ones(120))
    method = ShapeMatching(toy_rig, egg, pairs)
    assert len(method.partners) >= 6
    assert all(j == int(order[k]) for j, k in method.partners.single)


def test_a_sum_of_two_is_the_partner_of_both():
    left, right, other = torch.eye(3, dtype=torch.float64)
    parts, whole = torch.stack([left, right, other]), torch.stack([left + right, other])
    assert find_partners(parts, whole, SURE) == Partners(((2, 1),), merged=((0, 1, 0),))
    assert find_partners(whole, parts, SURE) == Partners(((1, 2),), split=((0, 0, 1),))


def test_what_looks_like_a_sum_of_shapes_with_better_homes_is_none():
    up, wide, other = torch.eye(3, dtype=torch.float64)
    ours, theirs = torch.stack([up, wide, other]), torch.stack([up + 0.8 * wide, wide, other])
    assert find_partners(ours, theirs, SURE) == Partners(((0, 0), (1, 1), (2, 2)))


def test_likeness_decides_where_motion_does_not():
    ours = torch.tensor([[1.0, 0.1], [1.0, 0.12]], dtype=torch.float64)
    likeness = torch.tensor([[0.2, 0.8], [0.8, 0.2]])
    assert find_partners(ours, ours, SURE).single == ((0, 0), (1, 1))
    assert find_partners(ours, ours, SURE, likeness).single == ((0, 1), (1, 0))


def test_each_shape_has_one_partner_at_most_and_only_one_that_is_alike():
    generator = torch.Generator().manual_seed(0)
    ours, theirs = (torch.randn(12, 40, dtype=torch.float64, generator=generator) for _ in range(2))
    theirs[:5] = ours[:5] + 0.3 * theirs[:5]
    theirs[5] = ours[4] + 0.5 * theirs[5]  # a second claim
    pairs = find_partners(ours, theirs, SURE)
    assert pairs == Partners(tuple((k, k) for k in range(5)))


def test_a_rig_with_left_and_right_in_one_has_its_range_too(toy_rig):
    egg = make_toy_rig("egg", stretch=1.25)
    blink = egg.deltas[0] + egg.deltas[1]
    deltas = torch.stack([blink, 2 * egg.deltas[2], 0.5 * egg.deltas[3], *egg.deltas[4:]])
    merged = replace(egg, deltas=deltas, names=("blink", "brow", "jaw", "pucker", "left", "right"))
    method = ShapeMatching(toy_rig, merged, markers(toy_rig, merged))
    assert method.partners == Partners(((2, 1), (3, 2), (4, 3), (5, 4), (6, 5)), merged=((0, 1, 0),))
    assert method.partners.ours == set(range(7))
    shown = torch.tensor([[0.6, 0.6, 0.3, 0.9, 0, 0.8, 0.8]])
    found = method(Clip(toy_rig.names, shown, 30.0)).weights
    torch.testing.assert_close(found, torch.tensor([[0.6, 0.3, 0.9, 0, 0.8, 0.8]]), rtol=0, atol=0.02)
    back = ShapeMatching(merged, toy_rig, markers(merged, toy_rig))(Clip(merged.names, found, 30.0)).weights
    torch.testing.assert_close(back, shown, rtol=0, atol=0.02)


def test_rigs_of_different_schemes_are_matched_by_proportion_only(toy_rig):
    egg = make_toy_rig("egg", stretch=1.25)
    mixed = torch.stack([egg.deltas[:2].sum(0), egg.deltas[2] + egg.deltas[3], egg.deltas[5:].sum(0)])
    other = replace(egg, deltas=mixed, names=("blink", "surprise", "smile"))
    pairs = markers(toy_rig, other)
    method = ShapeMatching(toy_rig, other, pairs, config=ShapeMatchingConfig(stiffness=1e-8))
    assert len(method.partners) == 0
    clip = Clip(toy_rig.names, motion.expressions(toy_rig.names, 20, seed=1), 30.0)
    torch.testing.assert_close(method(clip).weights, ProportionMatching(toy_rig, other, pairs)(clip).weights)


def test_the_neutral_goes_to_the_neutral_and_results_repeat_bitwise(toy_rig, shuffled):  # G2, G10
    egg, _ = shuffled
    method, again = (ShapeMatching(toy_rig, egg, markers(toy_rig, egg)) for _ in range(2))
    assert not method(Clip(toy_rig.names, torch.zeros(2, 7), 30.0)).weights.any()
    clip = Clip(toy_rig.names, motion.expressions(toy_rig.names, 20, seed=1), 30.0)
    assert bool((method(clip).weights == again(clip).weights).all())


def test_a_rig_of_one_shape_works(toy_rig):
    one = replace(toy_rig, deltas=toy_rig.deltas[3:4], names=("jaw",))
    half = Clip(toy_rig.names, 0.5 * torch.eye(7)[3:4], 30.0)
    assert float(ShapeMatching(toy_rig, one, markers(toy_rig, one))(half).weights) == pytest.approx(0.5, abs=1e-5)


def test_a_correspondence_is_needed(toy_pair):
    with pytest.raises(ReenactError, match="needs a correspondence"):
        ShapeMatching(*toy_pair)
