"""Several processes train as one does, and go down together when one of them dies."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import team_worker
import torch
from conftest import make_toy_rig
from torch.distributed.run import get_args_parser

from reenact import training
from reenact.checkpoint import load_checkpoint
from reenact.config import save_config
from reenact.errors import ReenactError
from reenact.rigs.files import save_rig
from reenact.run import networks_state
from reenact.team import Team
from reenact.training import train

WORKER = Path(__file__).with_name("team_worker.py")


@pytest.fixture(scope="module")
def cast_config(toy_config, tmp_path_factory):
    """All terms from the first step on, of three rigs; batches of 5, which two processes cannot halve."""
    folder = tmp_path_factory.mktemp("cast")
    save_rig(make_toy_rig("bean", stretch=0.9, hue=1.0), folder / "bean.npz")
    return replace(
        toy_config,
        cast=(toy_config.source, toy_config.target, f"{folder / 'bean.npz'}"),
        bpnet=replace(toy_config.bpnet, image_from=0.0),
        training=replace(toy_config.training, batch_size=5, frames=80, elastic=0.02, cycle_loss=0.5),
    )


@pytest.fixture(scope="module")
def alone(cast_config, tmp_path_factory):
    """The run of one process, and the gradients of its first step."""
    folder = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "_not_finite", training._not_finite)  # put back what the next line changes
        kept = team_worker.keep_gradients(folder / "gradients.safetensors")
        train(replace(cast_config, run=str(folder / "run")))
    return folder / "run", kept


def _start(size, config, folder, *others):
    """What torchrun ends with, and after how many seconds."""
    save_config(config, folder / "config.toml")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", f"{size}", WORKER]
    started = time.monotonic()
    done = subprocess.run(
        [*command, folder / "config.toml", folder / "gradients.safetensors", *others],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([f"{WORKER.parents[1]}", os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    return done, time.monotonic() - started


def _weights(folder):
    return networks_state(load_checkpoint(folder).tensors)


def _agree(size, cast_config, alone, tmp_path):
    config = replace(cast_config, run=str(tmp_path / "run"))
    done, _ = _start(size, config, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("rendering 80 fresh expressions") == 2  # one process speaks
    folder, kept = alone
    found = safetensors.torch.load_file(tmp_path / "gradients.safetensors")
    assert found.keys() == kept.keys()
    for name, value in kept.items():
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-6)  # float32, sums in another order
    logs = [(each / "metrics.jsonl").read_text().splitlines() for each in (folder, tmp_path / "run")]
    assert len(logs[0]) == len(logs[1])
    for lines in zip(*logs):
        one, many = map(json.loads, lines)
        assert one.keys() == many.keys()
        assert many["loss"] == pytest.approx(one["loss"], rel=1e-4)


def test_two_processes_take_the_steps_of_one(cast_config, alone, tmp_path):
    _agree(2, cast_config, alone, tmp_path)


@pytest.mark.nightly
def test_four_processes_take_the_steps_of_one(cast_config, alone, tmp_path):
    _agree(4, cast_config, alone, tmp_path)


@pytest.mark.parametrize("rank", [pytest.param(0, marks=pytest.mark.nightly), 1])
def test_a_killed_process_ends_the_others_and_the_run_goes_on_with_fewer(rank, cast_config, alone, tmp_path):
    config = replace(cast_config, run=str(tmp_path / "run"))
    done, seconds = _start(2, config, tmp_path, "--kill", str(rank), "8")
    assert done.returncode != 0
    assert seconds < 120  # most of it is the start
    assert "processes: expected all that train together to live, got one that ended" in done.stderr
    assert "the last checkpoint is intact, go on with --resume" in done.stderr
    saved = load_checkpoint(tmp_path / "run").step
    assert saved == (5 if rank == 0 else 8)  # who leads and lives keeps what was learnt since
    train(config, resume=True)
    expected, actual = _weights(alone[0]), _weights(tmp_path / "run")
    assert load_checkpoint(tmp_path / "run").step == 12
    for name, value in expected.items():
        if name.startswith("bpnets."):
            torch.testing.assert_close(actual[name], value, rtol=0, atol=2e-3)  # of rates of 2e-3, a step or less


def test_what_processes_cannot_share_is_refused(cast_config, toy_config):
    with pytest.raises(ReenactError, match="expected at most one for each of 4 pictures of a batch, got 5"):
        training._check_team(toy_config, Team(0, 5))
    compared = replace(toy_config, training=replace(toy_config.training, align_loss=0.1))
    with pytest.raises(ReenactError, match=r"for training.align_loss compares whole batches, got 2"):
        training._check_team(compared, Team(0, 2))
    training._check_team(compared, Team())


def test_every_item_is_the_share_of_one_process():
    shares = [Team(rank, 3).share(8).tolist() for rank in range(3)]
    assert sorted(item for share in shares for item in share) == list(range(8))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert Team(3, 4).share(2).tolist() == []


def test_a_failure_of_pytorch_becomes_a_sentence():
    from reenact.team import TeamError, _told

    with pytest.raises(TeamError, match=r"got one that ended \(Connection closed by peer\); the last"), _told():
        raise RuntimeError("[gloo/pair.cc:553] Connection closed by peer [127.0.0.1]:9093. This is\nand a page")


def test_torchrun_understands_the_commands_of_the_page():
    """Without `--` it takes `--run` for an option of its own, cut short."""
    page = (Path(__file__).parents[1] / "docs" / "scale.md").read_text().replace("\\\n", " ")
    commands = re.findall(r"^(?:srun )?torchrun (.*?)(?: *#.*)?$", page, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        understood = get_args_parser().parse_args(shlex.split(command.replace("$SLURM_NNODES", "4")))
        script = [understood.training_script, *understood.training_script_args]
        assert next(word for word in script if word != "--") in ("train.py", "reenact.cli")
        assert ("--run" in script) != ("batch" in script)
