"""A studio shows networks what moves, and draws what it was told to."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from reenact.config import ImageConfig
from reenact.data import Studio, identity_grid
from reenact.errors import ReenactError
from reenact.portrait import BACKGROUND
from reenact.rigs.clip import Clip

SMALL = ImageConfig(resolution=16)


@pytest.fixture(scope="module")
def studio(toy_rig):
    return Studio(toy_rig, SMALL)


def test_the_neutral_shows_as_nothing_and_typical_expressions_have_unit_size(studio):
    assert not studio.show(studio.neutral[None]).any()
    for buffer in studio.show(studio.survey(256)).split(3, dim=1):
        assert buffer.square().mean().sqrt() == pytest.approx(1, abs=0.15)  # another draw than the one of the unit


def test_a_picture_comes_back_from_what_is_shown(studio):
    pictures = studio.survey(3)
    assert pictures.shape == (3, 6, 16, 16)
    torch.testing.assert_close(studio.picture(studio.show(pictures)), pictures, rtol=0, atol=1e-6)  # float32


def test_a_glance_is_the_motion_pass_of_the_whole_picture(studio):
    weights = torch.eye(len(studio.rig.names))
    whole = studio.show(studio.photograph(weights))
    torch.testing.assert_close(studio.glance(weights), whole[:, 3:], rtol=0, atol=1e-6)  # float32


def test_without_residuals_the_pictures_themselves_are_shown(toy_rig):
    studio = Studio(toy_rig, replace(SMALL, motion=False, residual=False))
    pictures = studio.survey(3)
    assert pictures.shape == (3, 3, 16, 16)
    assert torch.equal(studio.show(pictures), pictures)
    assert torch.equal(studio.picture(pictures), pictures)


def test_the_same_random_numbers_draw_the_same_expressions(studio):
    draws = [studio.draw(5, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_a_clip_is_what_is_drawn_from(toy_rig):
    weights = torch.rand(4, len(toy_rig.names), generator=torch.Generator().manual_seed(0))
    studio = Studio(toy_rig, SMALL, clip=Clip(toy_rig.names, weights, 30.0))
    drawn = studio.draw(50, np.random.default_rng(0))
    assert {tuple(row) for row in drawn.tolist()} == {tuple(row) for row in weights.tolist()}


def test_a_layout_of_any_resolution_moves_the_pictures(toy_rig, studio):
    weights = torch.zeros(1, len(toy_rig.names))
    still = Studio(toy_rig, SMALL, layout=identity_grid(10)).photograph(weights)
    torch.testing.assert_close(still, studio.photograph(weights), rtol=0, atol=1e-5)  # float32 interpolation
    step = torch.tensor([2 / 16, 0.0])  # one pixel to the right in the rig's own picture
    moved = Studio(toy_rig, SMALL, layout=identity_grid(32) + step).photograph(weights)
    torch.testing.assert_close(moved[..., :-1], still[..., 1:], rtol=0, atol=1e-5)


def test_beyond_the_picture_lies_background(toy_rig):
    far = identity_grid(16) + torch.tensor([1.0, 0.0])  # the right half looks past the border
    pictures = Studio(toy_rig, SMALL, layout=far).photograph(torch.ones(1, len(toy_rig.names)))
    colors, motion = pictures[0, :3, :, 9:], pictures[0, 3:, :, 9:]
    torch.testing.assert_close(colors, torch.tensor(BACKGROUND)[:, None, None].expand_as(colors))
    assert not motion.any()


def test_buffers_are_stacked_and_weights_have_a_gradient(studio):
    weights = torch.full((2, len(studio.rig.names)), 0.5, requires_grad=True)
    pictures = studio.photograph(weights, ("color", "mask"))
    assert pictures.shape == (2, 4, 16, 16)
    pictures[:, :3].square().sum().backward()
    assert bool((weights.grad != 0).all())


def test_a_rig_whose_pictures_do_not_change_is_named(toy_rig):
    still = Clip(toy_rig.names, torch.zeros(3, len(toy_rig.names)), 30.0)
    with pytest.raises(ReenactError, match="ball: expected expressions that change its picture"):
        Studio(toy_rig, SMALL, clip=still)
