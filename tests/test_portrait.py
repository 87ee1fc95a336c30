"""Every rig is photographed with its eyes and mouth on the same rows."""

from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.portrait import EYE_HEIGHT, MAKEUP, MOUTH_HEIGHT, Portrait, face_lines, fit_weights, made_up
from reenact.rigs import anny, motion
from reenact.rigs.rig import Rig


@pytest.mark.parametrize("name", sorted(anny.BUILT_IN))
def test_eye_and_mouth_rows_of_every_character_agree(name):
    portrait = Portrait.of(anny.build(name))
    lines = portrait.project(torch.stack(face_lines(portrait.rig)), 64)  # (2, 2) pixels
    expected = torch.tensor([(1 - EYE_HEIGHT) * 32, (1 - MOUTH_HEIGHT) * 32])
    torch.testing.assert_close(lines[:, 1], expected, rtol=0, atol=1.5)  # the two lie at different depths
    torch.testing.assert_close(lines[:, 0], torch.full((2,), 32.0), rtol=0, atol=0.75)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_the_picture_does_not_depend_on_the_unit_of_the_rig(toy_rig, size):
    scaled = replace(toy_rig, neutral=toy_rig.neutral * size, deltas=toy_rig.deltas * size)
    weights = torch.eye(len(toy_rig.names))
    expected = Portrait.of(toy_rig).render(toy_rig.vertices(weights), 48)["color"]
    actual = Portrait.of(scaled).render(scaled.vertices(weights), 48)["color"]
    # A vertex may round to the other side of a pixel's middle, never many.
    assert (actual - expected).abs().mean() < 1e-4


def test_lines_are_found_without_parts_and_without_known_names(toy_rig):
    unnamed = replace(toy_rig, names=tuple(f"shape {k}" for k in range(len(toy_rig.names))))
    eyes, mouth = face_lines(unnamed)
    assert eyes[1] > 0.02 > -0.02 > mouth[1]


def test_nineteen_numbers_describe_a_portrait(toy_rig):
    portrait = Portrait.of(toy_rig)
    assert portrait.parameters.shape == (19,)
    assert portrait.parameters[15] == pytest.approx(portrait.scale)


def test_projection_agrees_with_the_render(toy_rig):
    portrait = Portrait.of(toy_rig)
    mask = portrait.render(toy_rig.neutral[None], 64, ("mask",))["mask"][0, 0]
    rows, columns = (mask > 0.5).nonzero().T
    projected = portrait.project(toy_rig.neutral, 64)
    low, high = projected.amin(0), projected.amax(0)
    assert float(columns.min()) == pytest.approx(float(low[0].clamp_min(0)), abs=1)
    assert float(columns.max()) + 1 == pytest.approx(float(high[0].clamp_max(64)), abs=1)
    assert float(rows.min()) == pytest.approx(float(low[1].clamp_min(0)), abs=1)


def test_a_face_upside_down_is_named(toy_rig):
    flip = torch.tensor([-1.0, -1.0, 1.0])
    with pytest.raises(ReenactError, match="eyes above the mouth"):
        Portrait.of(replace(toy_rig, neutral=toy_rig.neutral * flip, deltas=toy_rig.deltas * flip))


def test_a_rig_that_does_not_move_is_named():
    still = make_toy_rig("still")
    still = replace(still, deltas=torch.zeros_like(still.deltas), names=tuple(f"s{k}" for k in range(len(still.names))))
    with pytest.raises(ReenactError, match="move"):
        Portrait.of(still)


def test_lid_and_mouth_shapes_that_move_nothing_are_not_asked(toy_rig):
    deltas = toy_rig.deltas.clone()
    deltas[:2] = 0  # both blinks: the lines come from what the others move
    eyes, mouth = face_lines(replace(toy_rig, deltas=deltas))
    assert eyes[1] > 0.02 > -0.02 > mouth[1]


def test_makeup_paints_every_rig_alike_but_for_the_eyes():
    dark, pale = made_up(anny.build("anny:woman")), made_up(anny.build("anny:man"))
    for part, color in MAKEUP.items():
        assert torch.equal(dark.colors[dark.part(part)], torch.tensor(color).expand(len(dark.part(part)), 3))
    eyes = pale.part("eyes")
    assert torch.equal(pale.colors[eyes], anny.build("anny:man").colors[eyes])
    assert not torch.equal(pale.colors[eyes], dark.colors[eyes])


def test_a_rig_that_does_not_tell_its_lips_keeps_its_colours(toy_rig):
    assert made_up(toy_rig) is toy_rig


def test_the_motion_pass_says_how_far_visible_points_moved(toy_rig):
    portrait = Portrait.of(toy_rig)
    step = torch.tensor([0.002, -0.001, 0.003])
    motion = portrait.render((toy_rig.neutral + step)[None], 32, ("mask", "motion"))
    inside = motion["mask"][0, 0] == 1
    seen = motion["motion"][0][:, inside]
    torch.testing.assert_close(seen, (portrait.scale * step)[:, None].expand_as(seen), rtol=1e-4, atol=0)  # float32
    assert not portrait.render(toy_rig.neutral[None], 32, ("motion",))["motion"].any()


@pytest.mark.parametrize("seed", [1, 2])
def test_weights_are_found_from_a_picture_alone(seed):
    rig = anny.build("anny:man")
    portrait = Portrait.of(rig)
    goal = rig.vertices(motion.expressions(rig.names, 1, seed))
    fitted = rig.vertices(fit_weights(portrait, portrait.render(goal, 128)["color"]))
    error = (fitted - goal).norm() / (goal - rig.neutral).norm()
    assert error < 0.02  # 0.001 and 0.0002 measured


@pytest.mark.parametrize(
    "names",
    [
        # VRoid, MMD, VRM 1.0 and VRChat: nothing of ARKit, and a shape first that moves everything.
        ("fat", "Fcl_EYE_Close_L", "Fcl_EYE_Close_R", "Fcl_BRW_Angry", "Fcl_MTH_A", "Fcl_MTH_U", "Fcl_MTH_Fun", "x"),
        ("fat", "まばたき", "ウィンク", "困る", "あ", "う", "い", "口角上げ"),
        ("fat", "blinkLeft", "blinkRight", "surprised", "aa", "ou", "ih", "oh"),
        ("fat", "vrc.blink", "wink right", "angry", "vrc.v_aa", "vrc.v_ou", "vrc.v_ih", "vrc.v_oh"),
    ],
)
def test_avatars_of_other_naming_on_a_body_are_framed_by_their_faces(names):
    ball = make_toy_rig("ball")
    body = torch.cat([ball.neutral, ball.neutral * 6 - torch.tensor([0.0, 0.8, 0.0])])
    deltas = torch.cat([ball.deltas, torch.zeros_like(ball.deltas)], dim=1)
    rig = Rig("avatar", body, torch.cat([0.2 * body[None], deltas]), names, torch.cat([ball.faces, ball.faces + 642]))
    eyes, mouth = face_lines(rig)
    expected_eyes, expected_mouth = face_lines(ball)
    # Names tell the same lids; of the mouth they may mean other shapes than ARKit's, within a quarter of the face.
    torch.testing.assert_close(eyes, expected_eyes, rtol=0, atol=0.003)
    assert (mouth - expected_mouth).norm() < 0.25 * (expected_eyes - expected_mouth).norm()
