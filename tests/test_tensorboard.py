"""TensorBoard: what a training tells it, and what it says where it is missing."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from reenact import tensorboard
from reenact.errors import ReenactError
from reenact.training import train


def test_without_it_training_says_what_to_install_before_any_work(toy_config, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    config = replace(toy_config, run=str(tmp_path / "run"), training=replace(toy_config.training, tensorboard=True))
    with pytest.raises(ReenactError, match=r"pip install 'reenact\[tensorboard\]'"):
        train(config)
    assert not (tmp_path / "run").exists()


def test_unless_it_is_wanted_nothing_is_written(tmp_path):
    with tensorboard.Board(tmp_path, wanted=False) as board:
        board.scalars("networks", 0, 1, {"loss": 1.0})
        board.picture(tmp_path / "none.png", 1)
    assert list(tmp_path.iterdir()) == []


def read(folder):
    """Scalars by tag as {step: value}, and the steps of the pictures."""
    event_accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="needs the extra tensorboard"
    )
    events = event_accumulator.EventAccumulator(str(folder)).Reload()
    scalars = {tag: {each.step: each.value for each in events.Scalars(tag)} for tag in events.Tags()["scalars"]}
    pictures = [each.step for tag in events.Tags()["images"] for each in events.Images(tag)]
    return scalars, pictures


def test_steps_count_over_all_stages_and_a_resumed_run_replaces_what_was_beyond(tmp_path):
    pytest.importorskip("tensorboard", reason="needs the extra tensorboard")
    Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(tmp_path / "preview.png")
    with tensorboard.Board(tmp_path, wanted=True) as board:
        board.scalars("reenactnet", 0, 20, {"loss": 0.5})
        board.scalars("bpnet.a", 20, 20, {"loss": 0.25})
        board.picture(tmp_path / "preview.png", 20)
        board.scalars("bpnet.a", 20, 40, {"loss": 9.0})
    with tensorboard.Board(tmp_path, wanted=True, step=40) as board:
        board.scalars("bpnet.a", 20, 40, {"loss": 0.125})
    scalars, pictures = read(tmp_path / "tensorboard")
    assert scalars == {"reenactnet/loss": {20: 0.5}, "bpnet.a/loss": {40: 0.25, 60: 0.125}}
    assert pictures == [20]


def test_a_training_writes_its_losses_and_previews(toy_config, tmp_path):
    pytest.importorskip("tensorboard", reason="needs the extra tensorboard")
    training = replace(toy_config.training, tensorboard=True, steps=4, save_every=2, frames=8)
    folder = train(replace(toy_config, run=str(tmp_path / "run"), training=training))
    scalars, pictures = read(folder / "tensorboard")
    assert pictures == [2, 4]
    assert list(scalars["networks/loss"]) == [2, 4]
    assert {"networks/reconstruction.ball", "networks/weights.egg"} <= scalars.keys()
