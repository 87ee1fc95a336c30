"""Shapes that do the same are found by what they look like, and nothing that only one rig claims is believed."""

from dataclasses import replace

import pytest
import torch

from reenact.config import ImageConfig, LayoutConfig, PairsConfig
from reenact.data import Studio
from reenact.layout import find_layout
from reenact.pairs import Pairs, Teacher, _agreed, find_pairs, find_teacher
from reenact.retargeting.labels import Labels
from reenact.retargeting.shape_matching import Partners
from reenact.rigs import anny

SMALL = ImageConfig(resolution=32)


class HalfLabels(Labels):
    """Labels that say half of what the source does."""

    def __init__(self, partners):
        self.known = partners

    @property
    def partners(self):
        return self.known

    def weights(self, source_weights):
        return 0.5 * source_weights


def _renamed(rig, order):
    names = tuple(f"shape {k}" for k in range(len(order)))
    return replace(rig, names=names, deltas=rig.deltas[order])


def test_shapes_in_another_order_under_other_names_find_their_partners(toy_pair):
    ball, egg = toy_pair
    order = torch.randperm(len(egg.names), generator=torch.Generator().manual_seed(3))
    pairs = find_pairs(Studio(ball, SMALL), Studio(_renamed(egg, order), SMALL), PairsConfig())
    assert sorted(pairs.agreed) == sorted((int(k), j) for j, k in enumerate(order))
    torch.testing.assert_close(pairs.weights(torch.eye(len(order))), torch.eye(len(order))[:, order])


@pytest.mark.parametrize("name", ["anny:woman", "anny:toon"])
def test_every_shape_of_the_man_is_found_on_other_heads(name):
    """Names are taken away and the order is turned round, which tells the truth; a layout is found from pictures."""
    man, other = anny.build("anny:man"), anny.build(name)
    other = _renamed(other, torch.arange(len(other.names)).flip(0))
    layout = find_layout(man, other, 64, LayoutConfig(steps=60, samples=64))
    pairs = find_pairs(Studio(man, ImageConfig()), Studio(other, ImageConfig(), layout), PairsConfig())
    assert all(k + j == len(man.names) - 1 for k, j in pairs.agreed)  # nothing wrong is agreed on
    assert len(pairs.agreed) >= 50  # of 52; all of them with the default settings of the layout


def test_a_shape_that_two_share_is_a_mixture(toy_rig):
    nameless = _renamed(toy_rig, torch.arange(len(toy_rig.names)))  # so that both are framed by their motion
    eyes = toy_rig.deltas[:2].sum(0, keepdim=True)
    both = replace(nameless, names=nameless.names[1:], deltas=torch.cat([eyes, toy_rig.deltas[2:]]))
    split, merged = Studio(nameless, SMALL), Studio(both, SMALL)
    pairs = find_pairs(merged, split, PairsConfig())
    assert 0 not in dict(pairs.agreed)
    ratio = float(merged.contrast[-1] / split.contrast[-1])  # pictures are in units of each rig's own motion
    torch.testing.assert_close(pairs.matrix[0, :2], torch.full((2,), min(1 / ratio, 1.0)), rtol=0.02, atol=0)
    assert pairs.similarity[0] > 0.95
    back = find_pairs(split, merged, PairsConfig())
    assert not {0, 1} & dict(back.agreed).keys()  # neither eye alone is the pair of both


def test_only_clear_mutual_best_matches_are_agreed_on():
    correlation = torch.tensor([[0.9, 0.2, 0.1], [0.8, 0.7, 0.1], [0.1, 0.68, 0.2]])
    assert _agreed(correlation, PairsConfig(margin=0.05)) == ((0, 0),)  # 1 and 2 both want column 1
    assert _agreed(correlation, PairsConfig(margin=0.2)) == ()
    assert _agreed(correlation, PairsConfig(similarity=0.95)) == ()


def test_confidence_is_that_of_the_shapes_that_move():
    pairs = Pairs(torch.eye(2), torch.tensor([1.0, 0.5]), ((0, 0),), torch.tensor([3.0, 1.0]), torch.eye(2))
    confidence = pairs.confidence(torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [0.0, 0.0]]))
    torch.testing.assert_close(confidence, torch.tensor([1.0, 0.25, (3 + 0.25) / 4, 0.0]))


def test_a_corrected_expression_is_as_it_was_left_and_others_far_away_are_as_they_were(toy_pair):
    source, target = (Studio(rig, SMALL) for rig in toy_pair)
    plain = find_teacher(source, target, PairsConfig(method="pictures"))
    smile = torch.tensor([[0.0, 0, 0, 0, 0, 1, 1], [0.0, 0, 0, 0, 0, 1, 0.9]])  # two that lie close
    wanted = torch.tensor([[0.0, 0, 0, 0.3, 0, 0.5, 1], [0.0, 0, 0, 0.4, 0, 0.5, 1]])
    taught = find_teacher(source, target, PairsConfig(method="pictures"), corrected=(smile, wanted))
    torch.testing.assert_close(taught.weights(smile), wanted, rtol=0, atol=1e-3)
    blink = torch.tensor([[1.0, 1, 0, 0, 0, 0, 0], [0.0, 0, 0, 0, 0, 0, 0]])
    torch.testing.assert_close(taught.weights(blink), plain.weights(blink), rtol=0, atol=0.01)
    half = torch.tensor([[0.0, 0, 0, 0, 0, 0.9, 0.9]])
    assert 0.1 < float(taught.weights(half)[0, 3]) < 0.5
    assert float(taught.confidence(smile).min()) > 0.99


def test_a_face_at_rest_can_be_corrected(toy_pair):
    source, target = (Studio(rig, SMALL) for rig in toy_pair)
    wanted = torch.tensor([[0.0, 0, 0, 0.2, 0, 0, 0]])
    taught = find_teacher(source, target, PairsConfig(method="pictures"), corrected=(torch.zeros(1, 7), wanted))
    torch.testing.assert_close(taught.weights(torch.zeros(1, 7)), wanted, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("similarity", "say"), [(0.6, 0.0), (0.8, 0.35), (0.9, 0.5)])
def test_pictures_join_geometry_where_the_rigs_can_look_alike(similarity, say):
    pictures = Pairs(
        matrix=torch.eye(3),
        similarity=torch.full((3,), similarity),
        agreed=(),
        strength=torch.tensor([1.0, 2.0, 3.0]),
        likeness=torch.eye(3),
    )
    assert pictures.alike == pytest.approx(similarity**2)
    weights = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))
    expected = weights * (0.5 + say) / (1 + say)
    torch.testing.assert_close(Teacher(pictures, HalfLabels(Partners())).weights(weights), expected)
    paired = HalfLabels(Partners(single=((0, 0),)))
    torch.testing.assert_close(Teacher(pictures, paired).weights(weights), 0.5 * weights)
