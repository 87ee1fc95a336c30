"""Facts about rigs, and what is called wrong: each fault is built into a rig and must be named, and nothing else."""

from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig
from PIL import Image

from reenact.errors import ReenactError
from reenact.inspection import inspect, save_sheet
from reenact.rigs.formats.pieces import Contents
from reenact.rigs.rig import Rig

NOTHING = Contents("made", ())


def problems(rig: Rig) -> list[str]:
    facts = inspect(rig, NOTHING)
    return [*facts.problems, *(f"{shape.name} {text}" for shape in facts.shapes for text in shape.problems)]


def with_shape(rig: Rig, name: str, deltas: torch.Tensor) -> Rig:
    return replace(rig, names=(*rig.names, name), deltas=torch.cat([rig.deltas, deltas[None]]))


def test_a_sound_rig_has_no_problems_and_its_shapes_their_places(toy_rig):
    assert problems(toy_rig) == []
    places = {shape.name: (shape.region, shape.side) for shape in inspect(toy_rig, NOTHING).shapes}
    assert places["eyeBlinkLeft"] == ("eyes", "left")
    assert places["eyeBlinkRight"] == ("eyes", "right")
    assert places["browInnerUp"] == ("brows", "both")
    assert places["mouthPucker"] == ("mouth", "both")
    assert places["jawOpen"] == ("jaw", "both")


def test_strength_is_in_parts_of_the_face_and_does_not_change_with_size(toy_rig):
    larger = replace(toy_rig, neutral=2 * toy_rig.neutral, deltas=2 * toy_rig.deltas)
    ours, theirs = inspect(toy_rig, NOTHING), inspect(larger, NOTHING)
    assert [a.strength for a in ours.shapes] == pytest.approx([b.strength for b in theirs.shapes])
    assert theirs.face == pytest.approx(2 * ours.face)


FAULTS = {
    "a dead shape": (lambda rig: with_shape(rig, "wink", torch.zeros_like(rig.neutral)), "wink moves nothing"),
    "a twin": (lambda rig: with_shape(rig, "open", rig.deltas[3]), "open is the same as jawOpen"),
    "a missing partner": (
        lambda rig: with_shape(rig, "cheekLeft", rig.deltas[5].flip(0) * 0 + 0.5 * rig.deltas[5]),
        "cheekLeft has no partner on the other side",
    ),
    "a weak partner": (
        lambda rig: replace(rig, deltas=torch.cat([rig.deltas[:1], 0.5 * rig.deltas[1:2], rig.deltas[2:]])),
        "eyeBlinkLeft moves 2.00 times as far as eyeBlinkRight",
    ),
    "sides that are swapped": (
        lambda rig: replace(rig, deltas=rig.deltas[[1, 0, 2, 3, 4, 5, 6]]),
        "eyeBlinkLeft is called left and moves the person's right",
    ),
    "two spellings": (
        lambda rig: with_shape(rig, "JawOpen", 0.7 * rig.deltas[3] + 0.001),
        "several names spell one shape: jawOpen, JawOpen",
    ),
    "centimetres": (
        lambda rig: replace(rig, neutral=100 * rig.neutral, deltas=100 * rig.deltas),
        "it may be in centimetres",
    ),
    "a back to the camera": (
        lambda rig: replace(rig, faces=rig.faces.flip(1)),
        "what moves looks along -Z",
    ),
    "a flat face": (lambda rig: replace(rig, faces=torch.cat([rig.faces, rig.faces[:1, [0, 0, 1]]])), "no area"),
    "a loose vertex": (
        lambda rig: replace(
            rig,
            neutral=torch.cat([rig.neutral, rig.neutral[:1]]),
            colors=None,
            deltas=torch.cat([rig.deltas, rig.deltas[:, :1]], dim=1),
        ),
        "1 of 643 vertices belong to no face",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(fault, toy_rig):
    damage, sentence = FAULTS[fault]
    assert any(sentence in text for text in problems(damage(toy_rig)))


def test_an_edge_of_three_faces_is_named(toy_rig):
    edge = toy_rig.faces[0, :2].tolist()
    other = next(v for v in range(600) if v not in toy_rig.faces[(toy_rig.faces == edge[0]).any(1)])
    fin = replace(toy_rig, faces=torch.cat([toy_rig.faces, torch.tensor([[*edge, other]])]))
    assert any("shared by more than two faces" in text for text in problems(fin))


def test_a_shape_that_moves_the_whole_body_is_named(toy_rig):
    body = torch.cat([toy_rig.neutral, toy_rig.neutral * 5 - torch.tensor([0.0, 0.7, 0.0])])
    deltas = torch.cat([toy_rig.deltas, torch.zeros_like(toy_rig.deltas)], dim=1)
    rig = Rig("body", body, deltas, toy_rig.names, torch.cat([toy_rig.faces, toy_rig.faces + 642]))
    fatter = with_shape(rig, "fat", 0.1 * body)
    assert "fat moves the whole body, not the face" in problems(fatter)
    assert inspect(fatter, NOTHING).face == pytest.approx(inspect(toy_rig, NOTHING).face, rel=0.01)


def test_the_sheet_has_a_picture_for_the_neutral_and_each_shape(toy_rig, tmp_path):
    save_sheet(toy_rig, inspect(toy_rig, NOTHING), tmp_path / "x.png", size=32)
    with Image.open(tmp_path / "x.png") as sheet:
        assert sheet.size == (4 * 32, 2 * (32 + 16))


def test_a_rig_without_eyes_or_mouth_is_said_so_and_not_drawn(tmp_path):
    ball = make_toy_rig("ball")
    bump = replace(ball, names=("bump",), deltas=ball.deltas[2:3])
    facts = inspect(bump, NOTHING)
    assert facts.face is None
    assert any("expected blendshapes that move eyes and mouth" in text for text in facts.problems)
    with pytest.raises(ReenactError, match="eyes and mouth"):
        save_sheet(bump, facts, tmp_path / "x.png")
