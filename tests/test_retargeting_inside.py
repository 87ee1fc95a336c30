"""What no place tells, an eye that turns and a tongue that comes out, is read inside."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from conftest import make_toy_rig

from reenact.geometry import farthest_points
from reenact.retargeting.consensus import Consensus
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.inside import Inside
from reenact.retargeting.labels import Labels
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.shape_matching import ShapeMatching
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

_EYE = torch.tensor([0.03, 0.02, 0.05])
_TONGUE = torch.tensor([0.0, -0.04, 0.04])


def joined(rig: Rig, piece: trimesh.Trimesh, place: torch.Tensor, deltas: dict[str, torch.Tensor]) -> Rig:
    """A rig with one more piece of mesh, and shapes that move nothing but it."""
    points = torch.tensor(np.asarray(piece.vertices), dtype=torch.float32) + place
    count = len(rig.neutral)
    old = torch.cat([rig.deltas, torch.zeros(len(rig.names), len(points), 3)], 1)
    new = torch.stack([torch.cat([torch.zeros(count, 3), each]) for each in deltas.values()])
    faces = torch.tensor(np.asarray(piece.faces), dtype=torch.int64) + count
    return Rig(
        rig.name,
        torch.cat([rig.neutral, points]),
        torch.cat([old, new]),
        (*rig.names, *deltas),
        torch.cat([rig.faces, faces]),
    )


def with_eye_and_tongue(rig: Rig, stretch: float = 1.0, degrees: float = 20.0, level: int = 2) -> Rig:
    """A ball of 2 cm behind the skin that looks left and right, and a pill that comes out."""
    tall = torch.tensor([1.0, stretch, 1.0])
    eye = trimesh.creation.icosphere(subdivisions=level, radius=0.02)
    points = torch.tensor(np.asarray(eye.vertices), dtype=torch.float32)
    angle = np.radians(degrees)
    turn = torch.tensor([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]).float()
    looks = {"left": points @ turn.T - points, "right": points @ turn - points}
    rig = joined(rig, eye, _EYE * tall, looks)
    tongue = trimesh.creation.capsule(height=0.02, radius=0.008, count=[8, 8])
    out = torch.tensor([0.0, 0.0, 0.03]).expand(len(tongue.vertices), 3)
    return joined(rig, tongue, _TONGUE * tall, {"tongue": out})


def pairs_on_skin(source: Rig, target: Rig) -> Correspondence:
    chosen = farthest_points(make_toy_rig("ball").neutral, 120)
    return Correspondence(Places.at(chosen), Places.at(chosen), torch.ones(120))


def inside(source: Rig, target: Rig) -> Inside:
    pairs = pairs_on_skin(source, target)
    return Inside.of(source, target, pairs, carry_shapes(source, target, pairs, stiffness=1.0))


@pytest.fixture(scope="module")
def heads():
    source = with_eye_and_tongue(make_toy_rig("ball"))
    return source, with_eye_and_tongue(make_toy_rig("egg", stretch=1.25), 1.25)


def test_a_tongue_finds_its_partner_and_follows_it(heads):
    source, target = heads
    order = torch.tensor([4, 9, 0, 8, 6, 5, 1, 2, 3, 7])
    target = replace(target, deltas=target.deltas[order], names=tuple("abcdefghij"))
    method = ShapeMatching(source, target, pairs_on_skin(*heads))
    assert sorted(method.partners.single, key=lambda pair: pair[1]) == [(int(j), k) for k, j in enumerate(order)]
    weights = torch.rand(20, 10, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(method(Clip(source.names, weights, 30.0)).weights, weights[:, order], rtol=0, atol=1e-5)


def test_what_labels_say_of_a_tongue_is_not_that_it_rests(heads):
    source = heads[0]
    out = torch.eye(len(source.names))[source.names.index("tongue")][None]
    labels = Labels(*heads, pairs_on_skin(*heads))
    torch.testing.assert_close(labels.weights(out), out, rtol=0, atol=1e-5)


def test_a_gaze_is_read_where_shapes_do_not_pair_off(heads):
    """The target's eye turns by 10 degrees where the source's turns by 20, so half a glance asks for all of it."""
    source = heads[0]
    egg = make_toy_rig("egg", stretch=1.25)
    threes = [(0, 2, 3), (1, 3, 4), (2, 4, 5), (3, 5, 6), (4, 6, 0), (5, 0, 1)]
    mixed = torch.stack([egg.deltas[list(some)].sum(0) for some in threes])
    other = replace(egg, deltas=mixed, names=tuple("abcdef"))
    target = with_eye_and_tongue(other, 1.25, degrees=10.0, level=3)  # other points than the source's eye
    method = Consensus(source, target, pairs_on_skin(source, target))
    assert not method.matching.partners
    glance, names = torch.zeros(3, len(source.names)), target.names
    glance[0, source.names.index("left")] = 0.25
    glance[1, source.names.index("right")] = 0.5
    glance[2, source.names.index("tongue")] = 0.7
    found = method(Clip(source.names, glance, 30.0)).weights
    assert float(found[0, names.index("left")]) == pytest.approx(0.5, abs=0.05)
    assert float(found[1, names.index("right")]) == pytest.approx(1.0, abs=0.05)
    assert float(found[2, names.index("tongue")]) == pytest.approx(0.7, abs=0.05)
    assert float(found[0, names.index("right")]) == pytest.approx(0.0, abs=0.01)
    blind = torch.stack([each(Clip(source.names, glance, 30.0)).weights for each in method.methods]).mean(0)
    assert float(blind[0, names.index("left")]) < 0.1  # no place moved


def test_the_jaw_that_carries_a_tongue_does_not_put_it_out(heads):
    source = heads[0]
    jaw = source.names.index("jawOpen")
    tongue = slice(
        len(source.neutral) - len(trimesh.creation.capsule(height=0.02, radius=0.008, count=[8, 8]).vertices), None
    )
    carried = []
    for rig in heads:
        deltas = rig.deltas.clone()
        deltas[jaw, tongue] = torch.tensor([0.0, -0.01, 0.0])
        carried.append(replace(rig, deltas=deltas))
    made = inside(*carried)
    weights = torch.zeros(1, len(source.names))
    weights[0, jaw] = 1.0
    torch.testing.assert_close(made.corrected(weights, weights), weights, rtol=0, atol=0.02)


def test_lashes_go_with_the_skin_and_are_not_inside(heads):
    """A piece without places that each shape moves as it moves the skin there."""
    rigs = []
    for rig in heads:
        piece = trimesh.creation.icosphere(subdivisions=1, radius=0.004)
        place = rig.neutral[int(rig.neutral[:, 2].argmax())]
        points = torch.tensor(np.asarray(piece.vertices), dtype=torch.float32) + place
        near = torch.cdist(points, rig.neutral[:642]).argmin(1)
        longer = joined(rig, piece, place, {"none": torch.zeros(len(points), 3)})
        deltas = longer.deltas.clone()
        deltas[: len(rig.names), -len(points) :] = rig.deltas[:, near]
        rigs.append(replace(longer, deltas=deltas))
    plain, lashed = inside(*heads), inside(*rigs)
    torch.testing.assert_close(lashed.ours[: len(heads[0].names)], plain.ours)
    assert not lashed.ours[-1].any()


def test_heads_without_anything_inside_are_left_alone(toy_pair):
    made = inside(*toy_pair)
    weights = torch.rand(3, len(toy_pair[1].names))
    assert made.ours.shape == (len(toy_pair[0].names), 0)
    assert made.corrected(weights, weights) is weights
