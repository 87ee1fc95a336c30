"""Laws that every geometric method keeps, on toys and on the labels and captures made with them."""

from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.metrics import vertex_error_ratio
from reenact.retargeting import METHODS
from reenact.retargeting.capture import drive, load_places
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.labels import labels
from reenact.retargeting.markers import Markers
from reenact.rigs import motion
from reenact.rigs.clip import Clip

BY_NAME = ("copy", "neutral", "cross-mapping", "kernel-cca", "key-shapes")
"""Methods that can do with names alone, or with nothing."""


@pytest.fixture(scope="module")
def toys():
    return make_toy_rig("ball"), make_toy_rig("egg", stretch=1.25)


@pytest.fixture(scope="module")
def made(toys):
    """Every method from the ball to the egg."""
    pairs = Correspondence.identity(*toys)
    return {name: method(*toys, pairs) for name, method in METHODS.items()}


def clip_of(rig, frames=40, seed=3) -> Clip:
    return Clip(rig.names, motion.expressions(rig.names, frames, seed), 30.0)


@pytest.mark.parametrize("name", METHODS)
def test_a_still_face_stays_still(name, made, toys):
    still = made[name](Clip(toys[0].names, torch.zeros(3, 7), 30.0))
    assert still.names == toys[1].names
    assert still.weights.abs().max() < 1e-4  # float32 results of solves in float64


@pytest.mark.parametrize("name", METHODS)
def test_frames_rate_and_range_are_kept(name, made, toys):
    moved = made[name](replace(clip_of(toys[0]), fps=24.0))
    assert moved.weights.shape == (40, 7)
    assert moved.fps == 24.0
    if name != "ribera-paper":  # its weights have any sign and size, as published
        assert float(moved.weights.min()) >= 0
        assert float(moved.weights.max()) <= 1


@pytest.mark.parametrize("name", [name for name in METHODS if name not in ("neutral", "ribera-paper")])
def test_every_method_is_better_than_a_still_face(name, made, toys):
    clip = clip_of(toys[0])
    error = vertex_error_ratio(toys[1], made[name](clip).weights.clamp(0, 1), clip.weights)
    assert error < (0.9 if name == "key-shapes" else 0.5)


@pytest.mark.parametrize("name", METHODS)
def test_the_same_input_gives_the_same_weights(name, made, toys):
    again = METHODS[name](*toys, Correspondence.identity(*toys))
    clip = clip_of(toys[0])
    assert torch.equal(again(clip).weights, made[name](clip).weights)


@pytest.mark.parametrize("name", [name for name in METHODS if name not in BY_NAME])
def test_methods_that_need_pairs_say_so(name, toys):
    with pytest.raises(ReenactError, match="correspondence"):
        METHODS[name](*toys)


@pytest.mark.parametrize("name", METHODS)
def test_a_clip_of_another_rig_is_refused(name, made):
    with pytest.raises(ReenactError, match="expected"):
        made[name](Clip(("wink",), torch.zeros(1, 1), 30.0))


def test_labels_are_right_where_they_are_sure(toys):
    clip = clip_of(toys[0], 200)
    weights, confidence = labels(*toys, clip, Correspondence.identity(*toys))
    assert vertex_error_ratio(toys[1], weights, clip.weights) < 0.1
    assert float(confidence.min()) >= 0
    assert float(confidence.max()) <= 1
    assert labels(*toys, Clip(toys[0].names, torch.zeros(1, 7), 30.0), Correspondence.identity(*toys))[1] == 1


def test_labels_doubt_what_the_target_cannot_do(toys):
    ball, egg = toys
    numb = replace(egg, names=egg.names[:3], deltas=egg.deltas[:3])  # no mouth
    weights = torch.zeros(20, 7)
    weights[:10, 0] = torch.linspace(0.2, 1, 10)  # blinks
    weights[10:, 3] = torch.linspace(0.2, 1, 10)  # the jaw
    confidence = labels(ball, numb, Clip(ball.names, weights, 30.0), Correspondence.identity(ball, egg))[1]
    assert confidence[10:].max() < confidence[:10].min()


def test_markers_drive_a_rig_whatever_the_head_does(toys):
    ball, egg = toys
    moving = (ball.deltas.norm(dim=-1).amax(0) > 1e-3).nonzero().flatten()
    still = (ball.deltas.norm(dim=-1).amax(0) < 1e-7).nonzero().flatten()[::20]
    chosen = torch.cat([moving[farthest_points(ball.neutral[moving], 40, None, None)], still])
    clip = clip_of(ball, 300)
    take = Markers.from_rig(ball, Places.at(chosen), clip.weights, 30.0)
    angle = 0.4 * torch.sin(torch.arange(300) / 20)
    zero, one = torch.zeros(300), torch.ones(300)
    rows = [[angle.cos(), zero, angle.sin()], [zero, one, zero], [-angle.sin(), zero, angle.cos()]]
    turn = torch.stack([torch.stack(row, -1) for row in rows], -2)  # (T, 3, 3)
    nodding = replace(take, positions=torch.einsum("tij,tmj->tmi", turn, take.positions) + 1.5)
    held, moved = (drive(egg, each, take.names, chosen).weights for each in (take, nodding))
    torch.testing.assert_close(moved, held, rtol=0, atol=0.02)  # what the found head motion leaves of itself
    assert vertex_error_ratio(egg, moved, clip.weights) < 0.5


def test_places_of_markers_are_read_strictly(tmp_path, toys):
    path = tmp_path / "places.csv"
    path.write_text("vertex,marker\n3,lip\n7,brow\n")
    names, vertices = load_places(path, toys[0])
    assert (names, vertices.tolist()) == (("lip", "brow"), [3, 7])
    for text, message in (
        ("a,b\n1,2\n", "expected columns marker and vertex"),
        ("marker,vertex\nlip,3.5\n", "a vertex of ball below 642 in row 1, got 3.5"),
        ("marker,vertex\nlip,642\n", "in row 1, got 642"),
        ("marker,vertex\nlip,1\nlip,2\n", "doubled: lip"),
    ):
        path.write_text(text)
        with pytest.raises(ReenactError, match=message):
            load_places(path, toys[0])


def test_a_capture_that_cannot_drive_is_refused(toys):
    take = Markers.from_rig(toys[0], Places.at(torch.arange(5)), torch.zeros(2, 7), 30.0)
    with pytest.raises(ReenactError, match="at least 4 with a vertex each, got 3 and 3"):
        drive(toys[1], take, take.names[:3], torch.arange(3))
    with pytest.raises(ReenactError, match=r"vertices of egg in 0..641"):
        drive(toys[1], take, take.names, torch.tensor([0, 1, 2, 3, 642]))
