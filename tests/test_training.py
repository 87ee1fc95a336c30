"""Training goes on where it stopped, bit for bit, and learns."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console

from reenact.checkpoint import load_checkpoint
from reenact.config import BPNetConfig, PairsConfig, load_config, save_config
from reenact.errors import ReenactError
from reenact.inference import ImageRetargeter
from reenact.metrics import vertex_error_ratio
from reenact.nudges import Nudge, Nudges, save_nudges
from reenact.pairs import Pairs, Teacher
from reenact.rigs.clip import Clip
from reenact.rigs.motion import expressions
from reenact.run import Run, networks_state
from reenact.stages import _step_count
from reenact.tensorboard import Board
from reenact.training import _Log, _preview, _say_next, learning_rate, train


def _trained(config, folder, **training):
    config = replace(config, run=str(folder), training=replace(config.training, **training))
    return train(config)


@pytest.fixture(scope="module")
def staged_config(toy_config):
    """One stage after the other, as published."""
    return replace(toy_config, training=replace(toy_config.training, together=False))


@pytest.fixture(scope="module")
def finished(toy_config, tmp_path_factory) -> Path:
    return _trained(toy_config, tmp_path_factory.mktemp("runs") / "whole")


def _weights(folder: Path) -> dict[str, torch.Tensor]:
    return networks_state(load_checkpoint(folder).tensors)


def _losses(folder: Path) -> list[dict]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key != "steps_per_second"} for line in lines]


@pytest.mark.parametrize("saved", [5, 10])  # before and after fresh expressions
def test_a_run_killed_at_any_moment_resumes_to_the_same_weights(saved, toy_config, finished, tmp_path):
    _kill_and_resume(toy_config, saved, finished, tmp_path)


def test_a_run_killed_in_a_later_stage_resumes_to_the_same_weights(staged_config, tmp_path):
    _kill_and_resume(staged_config, 22, _trained(staged_config, tmp_path / "whole"), tmp_path)


def _kill_and_resume(config, saved, finished, tmp_path):
    folder = tmp_path / "killed"
    config_file = tmp_path / "config.toml"
    save_config(replace(config, run=str(folder)), config_file)
    command = [sys.executable, "-m", "reenact.cli", "train", "--config", str(config_file)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=os.environ)
    deadline = time.monotonic() + 120
    while not any(f"{saved:06d}" in path.name for path in folder.glob("checkpoints/*")) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    train(replace(config, run=str(folder)), resume=True)
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


def test_the_run_folder_holds_what_is_needed_to_repeat_it(finished):
    run = Run.open(finished)
    assert [rig.name for rig in run.rigs.values()] == ["ball", "egg"]
    assert list(finished.glob("previews/*.png"))
    assert {line["stage"] for line in _losses(finished)} == {"networks"}
    with pytest.raises(FileNotFoundError, match="run folder"):
        Run.open(finished / "nothing")


def test_resuming_networks_of_other_settings_is_refused(toy_config, toy_run, tmp_path):
    folder = tmp_path / "edited"
    shutil.copytree(toy_run.folder, folder)
    edited = replace(toy_config, bpnet=replace(toy_config.bpnet, hidden=16))
    save_config(edited, folder / "config.toml")
    with pytest.raises(ReenactError, match=r"edited: expected networks as config.toml describes them, got others"):
        train(replace(edited, run=str(folder)), resume=True)


def test_resuming_where_nothing_is_says_how_to_begin(toy_config, tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a run folder"):
        train(replace(toy_config, run=str(tmp_path / "none")), resume=True)


def test_a_log_drops_the_lines_of_steps_that_are_taken_again(tmp_path):
    path = tmp_path / "metrics.jsonl"
    lines = [{"stage": "a", "step": 20}, {"stage": "b", "step": 20}, {"stage": "b", "step": 40}]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"stage": "b", "st')  # torn by a power cut
    log = _Log(path, "b", 30)
    log.add(30, {"x": torch.tensor(2.0)})
    log.add(31, {"x": torch.tensor(4.0)})
    log.flush()
    *kept, added = [json.loads(line) for line in path.read_text().splitlines()]
    assert kept == lines[:2]
    assert (added["stage"], added["step"], added["x"], added["loss"]) == ("b", 32, 3.0, 3.0)


def test_what_a_killed_process_left_half_written_goes_when_the_run_goes_on_but_for_what_others_write(toy_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(toy_run.folder, folder)
    names = [".metrics.jsonl.42.tmp", ".pairs.json.42.tmp", ".nudges.json.42.tmp"]
    for name in names:
        (folder / name).write_text("half")
    config = replace(toy_run.config, run=str(folder))
    with pytest.raises(KeyError):  # the checkpoint is of no training
        train(config, resume=True)
    assert [name for name in names if (folder / name).exists()] == [".nudges.json.42.tmp"]


def test_epochs_over_a_fixed_set_become_steps():
    assert _step_count(7, None, 10, 4) == 7
    assert _step_count(7, 2.0, 10, 4) == 5
    assert _step_count(7, 1.0, 10, 4) == 3


@pytest.mark.parametrize("network", ["components", "convolutional"])
@pytest.mark.parametrize("pairs", ["geometry", "pictures", "none"])
@pytest.mark.parametrize("together", [True, False])
def test_every_kind_of_network_trains_with_every_teacher_and_without(network, pairs, together, toy_config, tmp_path):
    config = replace(
        toy_config,
        run=str(tmp_path / "run"),
        pairs=PairsConfig(method=pairs),
        reenactnet=replace(toy_config.reenactnet, network=network),
        training=replace(toy_config.training, elastic=0.02, together=together),
    )
    train(config)
    stages = {line["stage"]: line for line in _losses(tmp_path / "run")}
    drawn = stages["networks" if together else "reenactnet"]
    assert {f"pairs.{key}" in drawn for key in ("ball", "egg")} == {pairs != "none"}
    assert (tmp_path / "run" / "pairs.json").exists() == (pairs != "none")
    assert (tmp_path / "run" / "correspondences" / "0-1.npz").exists() == (pairs == "geometry")
    if together:
        words = ("reconstruction", "weights", "read", "image")
        assert {f"{word}.{key}" for word in words for key in ("ball", "egg")} <= drawn.keys()
    else:
        assert {"weights", "vertices", "image"} <= stages["bpnet.egg"].keys()


@pytest.mark.parametrize("network", ["components", "convolutional"])
def test_losses_between_the_rigs_train_where_asked(network, toy_config, tmp_path):
    config = replace(
        toy_config,
        run=str(tmp_path / "run"),
        reenactnet=replace(toy_config.reenactnet, network=network),
        bpnet=replace(toy_config.bpnet, hidden=0),
        training=replace(toy_config.training, align_loss=0.1, cycle_loss=0.5),
    )
    train(config)
    terms = _losses(tmp_path / "run")[-1]
    assert {"align", "cycle.ball", "cycle.egg"} <= terms.keys()
    assert terms["align"] > 0
    assert terms["cycle.ball"] > 0


def test_errors_of_reading_reach_what_draws_only_where_asked(toy_config, tmp_path):
    """Without any other loss on it, a decoder moves by what is read from its drawings, or not at all."""
    moved = {}
    for read_loss in (0.0, 1.0):
        folder = tmp_path / str(read_loss)
        alone = replace(toy_config.training, read_loss=read_loss, pair_loss=0.0, steps=2, weight_decay=0.0)
        train(replace(toy_config, run=str(folder), training=alone, pairs=PairsConfig(method="pictures")))
        moved[read_loss] = _weights(folder)["reenactnet.decoders.egg.weight"]
    assert not torch.equal(moved[0.0], moved[1.0])


def test_the_loss_through_the_renderer_is_left_out_where_no_picture_of_its_own_is_left(staged_config, tmp_path):
    bpnet = replace(staged_config.bpnet, decoded_fraction=1.0)  # all drawn from the other rig's expressions
    train(replace(staged_config, run=str(tmp_path / "run"), bpnet=bpnet))
    assert not any("image" in line for line in _losses(tmp_path / "run"))


def test_rigs_with_nothing_in_common_still_train(toy_config, tmp_path, monkeypatch):
    nothing = Teacher(Pairs(torch.zeros(7, 7), torch.zeros(7), (), torch.ones(7), torch.zeros(7, 7)), None)
    monkeypatch.setattr(Run, "teacher", lambda *_: nothing)
    train(replace(toy_config, run=str(tmp_path / "run")))
    assert all(torch.isfinite(value).all() for value in _weights(tmp_path / "run").values())


def test_the_published_settings_train(toy_config, tmp_path):
    paper = load_config(Path(__file__).parents[1] / "configs" / "paper-kim2021.toml")
    small = replace(
        paper,
        source=toy_config.source,
        target=toy_config.target,
        run=str(tmp_path / "run"),
        images=replace(paper.images, resolution=32),
        reenactnet=replace(paper.reenactnet, encoder_channels=8, seed_channels=8, decoder_channels=8, code=16),
        bpnet=replace(paper.bpnet, channels=8, epochs=1.0),
        training=replace(paper.training, frames=16, epochs=1.0, batch_size=8),
    )
    train(small)
    assert {line["step"] for line in _losses(tmp_path / "run")} == {2, 4}  # 16 / 8, 16 / 5 rounded up


@pytest.mark.parametrize("pairs", ["geometry", "pictures", "none"])
def test_what_is_learnt_moves_the_other_rig_without_being_told_how(pairs, toy_config, tmp_path):
    """The toys carry the same shapes, so copied weights are the truth; training never sees names."""
    config = replace(
        toy_config,
        run=str(tmp_path / "run"),
        pairs=PairsConfig(method=pairs),
        bpnet=BPNetConfig(hidden=64, steps=400, batch_size=32, image_from=0.99),
        training=replace(toy_config.training, steps=400, batch_size=32, frames=512, refresh=0, save_every=1000),
    )
    folder = train(config)
    retargeter = ImageRetargeter.load(folder)
    weights = expressions(retargeter.source.names, 64, 12345)
    moved = retargeter(Clip(retargeter.source.names, weights, 30.0)).weights
    assert vertex_error_ratio(retargeter.target, moved, weights) < 0.25  # 1 is a face that stays still


def test_networks_learn_what_a_person_corrected(toy_config, tmp_path):
    """The label is one of this rig's shape at a frame where the source shows another."""
    settings = replace(toy_config.training, steps=400, batch_size=32, frames=512, refresh=0, save_every=1000)
    plain = replace(toy_config, training=settings)
    runs = {"plain": train(replace(plain, run=str(tmp_path / "plain")))}
    rigs = Run.open(runs["plain"]).rigs
    (source, performer), (target, _) = rigs.items()
    jaw, brow = performer.names.index("jawOpen"), performer.names.index("browInnerUp")
    shown, wanted = torch.zeros(1, 7), torch.zeros(1, 7)
    shown[0, jaw], wanted[0, jaw], wanted[0, brow] = 1.0, 1.0, 0.8
    nudge = Nudge(
        "clip",
        30.0,
        3,
        8,
        source,
        target,
        "networks",
        {"browInnerUp": 0.8},
        (*wanted[0].tolist(),),
        (*shown[0].tolist(),),
    )
    save_nudges(Nudges({key: rig.names for key, rig in rigs.items()}, (nudge,)), tmp_path / "nudges.json")
    taught = replace(plain, pairs=replace(plain.pairs, nudges=str(tmp_path / "nudges.json")))
    runs["taught"] = train(replace(taught, run=str(tmp_path / "taught")))
    blink = torch.zeros(1, 7)
    blink[0, performer.names.index("eyeBlinkLeft")] = 1.0
    moved = {}
    for name, folder in runs.items():
        retargeter = ImageRetargeter.load(folder)
        moved[name] = retargeter(Clip(performer.names, torch.cat([shown, blink]), 30.0)).weights
    assert moved["plain"][0, brow] < 0.2 < 0.5 < moved["taught"][0, brow]
    assert moved["taught"][1, brow] < 0.2
    (tmp_path / "nudges.json").unlink()
    assert Run.open(runs["taught"]).config.pairs.nudges  # the run has a copy of its own
    train(replace(taught, run=str(tmp_path / "taught")), resume=True)


def test_nudges_of_other_rigs_are_refused(toy_config, tmp_path):
    save_nudges(Nudges({"cat": ("meow",)}), tmp_path / "nudges.json")
    strange = replace(toy_config.pairs, nudges=str(tmp_path / "nudges.json"))
    with pytest.raises(ReenactError, match=r"nudges.json: expected corrected frames of ball or egg .*, got 0 of cat"):
        train(replace(toy_config, run=str(tmp_path / "run"), pairs=strange))
    assert not (tmp_path / "run").exists()


def test_a_preview_that_fails_does_not_stop_the_training(toy_run, tmp_path):
    said = io.StringIO()
    board = Board(tmp_path, wanted=False)
    _preview(toy_run, toy_run.networks(), {}, 0, 1, Console(file=said), board)  # no studio to photograph
    assert said.getvalue().startswith("preview skipped: ")


def test_the_commands_to_go_on_with_can_be_pasted(toy_run):
    said = io.StringIO()
    _say_next(Console(file=said, markup=False), replace(toy_run, folder=Path("my runs/[b]")))
    for command in ("evaluate", "view"):
        assert f"  reenact {command} 'my runs/[b]'\n" in said.getvalue()
    cast = replace(toy_run.config, cast=tuple(toy_run.keys))
    _say_next(Console(file=said, markup=False), replace(toy_run, config=cast, folder=Path("cast")))
    assert f"  reenact evaluate cast --from {toy_run.keys[0]} --to {toy_run.keys[-1]}\n" in said.getvalue()
