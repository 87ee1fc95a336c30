"""Training goes on where it stopped, bit for bit, and learns."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from reenact.checkpoint import load_checkpoint
from reenact.config import save_config
from reenact.errors import ReenactError
from reenact.inference import ImageRetargeter
from reenact.rigs.clip import Clip
from reenact.run import Run, networks_state
from reenact.training import learning_rate, train


def _trained(config, folder, **training):
    config = replace(config, run=str(folder), training=replace(config.training, **training))
    return train(config)


@pytest.fixture(scope="module")
def finished(toy_config, tmp_path_factory) -> Path:
    return _trained(toy_config, tmp_path_factory.mktemp("runs") / "whole")


def _weights(folder: Path) -> dict[str, torch.Tensor]:
    return networks_state(load_checkpoint(folder).tensors)


def _losses(folder: Path) -> list[dict]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key != "steps_per_second"} for line in lines]


def test_a_run_killed_at_any_moment_resumes_to_the_same_weights(toy_config, finished, tmp_path):
    folder = tmp_path / "killed"
    config_file = tmp_path / "config.toml"
    save_config(replace(toy_config, run=str(folder)), config_file)
    command = [sys.executable, "-m", "reenact.cli", "train", "--config", str(config_file)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=os.environ)
    deadline = time.monotonic() + 120
    while not list(folder.glob("checkpoints/*.safetensors")) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    train(replace(toy_config, run=str(folder)), resume=True)
    expected, actual = _weights(finished), _weights(folder)
    assert expected.keys() == actual.keys()
    assert all(torch.equal(expected[name], actual[name]) for name in expected)
    assert [line["step"] for line in _losses(folder)][-1] == [line["step"] for line in _losses(finished)][-1]


def test_a_run_never_overwrites_another(toy_config, finished):
    with pytest.raises(ReenactError, match="never overwrites"):
        train(replace(toy_config, run=str(finished)))


def test_resuming_a_finished_run_changes_nothing(toy_config, finished):
    before = _weights(finished)
    train(replace(toy_config, run=str(finished)), resume=True)
    after = _weights(finished)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_the_same_seed_gives_the_same_weights_and_another_seed_does_not(toy_config, finished, tmp_path):
    again = _weights(_trained(toy_config, tmp_path / "again"))
    other = _weights(_trained(toy_config, tmp_path / "other", seed=1))
    expected = _weights(finished)
    assert all(torch.equal(expected[name], again[name]) for name in expected)
    assert any(not torch.equal(expected[name], other[name]) for name in expected)


def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_checkpoint(toy_config, tmp_path):
    with pytest.raises(ReenactError, match="lower the learning rate"):
        _trained(toy_config, tmp_path / "nan", learning_rate=float("inf"), schedule="constant")


def test_the_one_cycle_rises_to_its_peak_and_ends_near_nothing():
    rates = [learning_rate(step, 100, 2.0, "one-cycle") for step in range(100)]
    assert max(rates) == rates[15] == 2.0
    assert rates[0] == pytest.approx(0.08)
    assert rates[99] < 0.01
    assert learning_rate(50, 100, 2.0, "constant") == 2.0


def test_a_frame_alone_gives_the_weights_that_it_has_in_a_clip(finished):
    retargeter = ImageRetargeter.load(finished)
    weights = torch.rand(70, len(retargeter.source.names), generator=torch.Generator().manual_seed(0))
    moved = retargeter(Clip(retargeter.source.names, weights, 30.0))
    assert moved.names == retargeter.target.names
    single = torch.stack([retargeter.step(frame) for frame in weights[60:]])
    torch.testing.assert_close(single, moved.weights[60:], rtol=0, atol=1e-5)  # float32, other batch size


def test_a_clip_with_other_names_is_refused(finished):
    retargeter = ImageRetargeter.load(finished)
    with pytest.raises(ReenactError, match="names"):
        retargeter(Clip(("a",), torch.zeros(1, 1), 30.0))


def test_reverse_swaps_the_rigs(finished):
    forward, reverse = ImageRetargeter.load(finished), ImageRetargeter.load(finished, reverse=True)
    assert (reverse.source.name, reverse.target.name) == (forward.target.name, forward.source.name)


def test_the_run_folder_holds_what_is_needed_to_repeat_it(finished):
    run = Run.open(finished)
    assert [rig.name for rig in run.rigs.values()] == ["ball", "egg"]
    assert list(finished.glob("previews/*.png"))
    assert {line["stage"] for line in _losses(finished)} == {"reenactnet", "bpnet.ball", "bpnet.egg"}
    with pytest.raises(FileNotFoundError, match="run folder"):
        Run.open(finished / "nothing")
