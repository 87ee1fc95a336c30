"""What a viewer can read of a training from its folder."""

import json
import os
import socket
from dataclasses import replace

import pytest

from reenact.checkpoint import save_checkpoint
from reenact.lock import RunLock, is_training
from reenact.progress import read_progress
from reenact.run import Run
from reenact.stages import planned_steps
from reenact.training import train


@pytest.fixture
def run(toy_config, tmp_path) -> Run:
    """Three stages of 12 steps, none of which is taken."""
    training = replace(toy_config.training, together=False)
    return Run.create(replace(toy_config, run=str(tmp_path / "run"), training=training))


def test_the_next_checkpoint_may_be_a_milestone_over_all_stages(toy_config, tmp_path):
    training = replace(toy_config.training, together=False, milestones=14)
    run = Run.create(replace(toy_config, run=str(tmp_path / "run"), training=training))
    log(run, {"stage": "bpnet.ball", "step": 1, "loss": 1.0})
    assert read_progress(run).next_checkpoint == 14


def log(run: Run, *lines: dict) -> None:
    with (run.folder / "metrics.jsonl").open("a") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)


def test_a_run_that_has_not_begun_stands_at_nothing(run):
    progress = read_progress(run)
    assert (progress.state, progress.stage, progress.step, progress.steps) == ("stopped", "reenactnet", 0, 12)
    assert (progress.done, progress.total, progress.checkpoint, progress.next_checkpoint) == (0, 36, None, 5)
    assert (progress.losses, progress.previews, progress.seconds_left) == ({}, [], None)


def test_steps_and_losses_are_counted_over_all_stages(run):
    log(
        run,
        {
            "stage": "reenactnet",
            "step": 12,
            "loss": 3.0,
            "reconstruction.ball": 1.0,
            "reconstruction.egg": 2.0,
            "steps_per_second": 0.1,  # with the rendering of the first expressions
        },
        {"stage": "bpnet.ball", "step": 6, "loss": 0.5, "weights": 0.5, "steps_per_second": 2.0},
        {"stage": "bpnet.ball", "step": 12, "loss": float("nan"), "weights": 0.25, "steps_per_second": 6.0},
    )
    with RunLock(run.folder):
        progress = read_progress(run)
    assert progress.losses == {
        "loss": [(12, 3.0), (18, 0.5)],
        "reconstruction": [(12, 3.0)],
        "weights": [(18, 0.5), (24, 0.25)],
    }
    assert (progress.state, progress.stage, progress.step, progress.done) == ("training", "bpnet.ball", 12, 24)
    assert progress.steps_per_second == pytest.approx(4.0)
    assert progress.seconds_left == pytest.approx(12 / 3)  # as many steps at 2 and at 6 a second: 1/2 s and 1/6 s each


def test_the_held_out_error_is_a_curve_of_its_own(run):
    log(run, {"stage": "reenactnet", "step": 3, "loss": 1.0, "held_out_own.egg": 0.3})
    numbers = {"held_out": 0.5, "held_out.ball": 0.4, "held_out.egg": 0.6, "held_out_own.egg": 0.2}
    log(run, {"stage": "reenactnet", "step": 6, "loss": 0.75, **numbers, "steps_per_second": 2.0})
    assert read_progress(run).losses == {"loss": [(3, 1.0), (6, 0.75)], "held out": [(6, 0.5)]}


def test_a_line_that_is_half_written_is_left_out(run):
    log(run, {"stage": "reenactnet", "step": 3, "loss": 1.0})
    with (run.folder / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "reenactnet", "step": 6, "lo')
    assert read_progress(run).done == 3


def test_long_curves_are_thinned_to_means(run):
    log(run, *({"stage": "reenactnet", "step": step, "loss": float(step)} for step in range(1, 901)))
    points = read_progress(run).losses["loss"]
    assert len(points) == 300
    assert points[:2] == [(2.0, 2.0), (5.0, 5.0)]  # of 1, 2, 3 and of 4, 5, 6


def test_pictures_and_checkpoints_are_found_and_a_finished_run_is_finished(run):
    (run.folder / "previews").mkdir()
    for name in ("000005.png", "000036.png", ".000036.png.1.tmp", "notes.png"):
        (run.folder / "previews" / name).touch()
    assert read_progress(run).previews == [5, 36]
    for step, state in ((5, "stopped"), (36, "finished")):
        save_checkpoint(run.folder, step, {}, {})
        assert (read_progress(run).checkpoint, read_progress(run).state) == (step, state)


def test_the_plan_is_what_a_training_does(toy_config, tmp_path):
    for together in (True, False):
        training = replace(toy_config.training, together=together)
        run = Run.open(train(replace(toy_config, run=str(tmp_path / str(together)), training=training)))
        progress = read_progress(run)
        assert progress.state == "finished"
        assert progress.done == progress.total == sum(planned_steps(run.config, run.keys).values())
        assert progress.previews[-1] == progress.total


def test_only_a_process_that_lives_trains(run):
    assert not is_training(run.folder)
    with RunLock(run.folder):
        assert is_training(run.folder)
    assert not is_training(run.folder)
    (run.folder / "lock").write_text(json.dumps({"pid": 2**22 + 1, "host": socket.gethostname()}))
    assert not is_training(run.folder)
    (run.folder / "lock").write_text(json.dumps({"pid": 1, "host": "elsewhere"}))
    assert is_training(run.folder)
    os.utime(run.folder / "lock", (0, 0))  # silent for long
    assert not is_training(run.folder)
