"""Trainings that are killed, interrupted, stopped, doubled, or fed with what is no number; docs/reliability.md."""

import ctypes
import json
import os
import pickletools
import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from reenact import run as run_module
from reenact import stages
from reenact.checkpoint import load_checkpoint, load_tensors
from reenact.cli import main
from reenact.errors import ReenactError
from reenact.folder import load_run_config
from reenact.rigs.clip import Clip
from reenact.rigs.files import save_clip
from reenact.run import Run
from reenact.training import train

HERE = Path(__file__).parent
STORED = HERE / "fixtures" / "run-1" / "run"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs fork and signals")


def lives(folder, *arguments, timeout=600):
    """What tests/lives.py found."""
    command = [sys.executable, HERE / "lives.py", folder, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout)
    assert found["wrong"] == []
    return found


def test_a_run_that_is_killed_at_random_ends_as_the_unbroken_one(tmp_path):
    """R3."""
    found = lives(tmp_path, 0, 4, 2)
    assert (found["kills"], found["in_saves"]) == (4, 2)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_run_that_is_killed_25_times_ends_as_the_unbroken_one(seed, tmp_path):
    """R3, the full count."""
    found = lives(tmp_path, seed, 25, 10, timeout=3000)
    assert (found["kills"], found["in_saves"]) == (25, 10)


STATUS = {"SIGTERM": 143, "SIGINT": 130, "SIGINT+": 130, "SIGHUP": 129}


def asked(folder, name, count, where):
    found = lives(folder, 0, name, count, where, timeout=120 + 60 * count)
    assert found["statuses"] == [STATUS[name]] * count
    assert max(found["seconds"]) < 10


@pytest.mark.parametrize(("name", "where"), [("SIGTERM", "again")])
def test_a_run_that_is_asked_to_end_does_so_within_ten_seconds(name, where, tmp_path):
    """R7."""
    asked(tmp_path, name, 1, where)


@pytest.mark.nightly
@pytest.mark.parametrize("where", ["steps", "again", "rendering", "before"])
@pytest.mark.parametrize("name", STATUS)
def test_a_run_that_is_asked_to_end_5_times_does_so_within_ten_seconds(name, where, tmp_path):
    """R7, the full count: five each."""
    asked(tmp_path, name, 5, where)


@pytest.mark.nightly
def test_a_run_that_sleeps_ends_as_the_one_that_was_awake(tmp_path):
    assert lives(tmp_path, 0, "nap", 5)["naps"] == 15


# ---- R6: where a run is to lie ----


def _bound():
    """Let permissions bind root as well: a process that this one starts will lack the right to overrule them."""
    for right in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        assert ctypes.CDLL(None).prctl(24, right, 0, 0, 0) == 0  # PR_CAPBSET_DROP


TRAIN = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
import reenact.training
from reenact.cli import main
for arguments in json.loads(sys.argv[2]):
    start = time.process_time()  # not the clock on the wall: others may be at work on this machine
    status = main(["train", *arguments])
    print(status, time.process_time() - start)
"""


def refused(*commands):
    """The sentences of train commands that end before any training; each takes less than two seconds."""
    arguments = json.dumps([[str(each) for each in command] for command in commands])
    done = subprocess.run(
        [sys.executable, "-c", TRAIN, HERE.parent, arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
        preexec_fn=None if os.getuid() else _bound,
    )
    answers = [line.split() for line in done.stdout.splitlines()]
    assert [status for status, _ in answers] == ["2"] * len(commands)
    assert max(float(seconds) for _, seconds in answers) < 2
    assert "Traceback" not in done.stderr
    sentences = done.stderr.splitlines()
    assert len(sentences) == len(commands)
    return sentences


def test_a_folder_in_which_nobody_may_write_is_refused_before_any_work(tmp_path):
    (tmp_path / "locked").mkdir()
    shutil.copytree(STORED, tmp_path / "run")
    for name in ("locked", "run"):
        (tmp_path / name).chmod(0o555)
    sentences = refused(
        ["--run", tmp_path / "locked" / "run"],
        ["--run", tmp_path / "locked"],
        ["--resume", "--run", tmp_path / "run"],
    )
    assert all("Permission denied" in sentence for sentence in sentences)


def test_names_at_which_no_folder_can_be_are_refused_before_any_work(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    sentences = refused(
        ["--run", tmp_path / "file"],
        ["--run", tmp_path / "file" / "run"],
        ["--run", tmp_path / ("x" * 256)],
        ["--run", tmp_path / "circle" / "run"],
        ["--resume", "--run", tmp_path / "missing"],
    )
    words = ["already holds something", "Not a directory", "too long", "circle", "expected a run folder"]
    assert all(word in sentence for word, sentence in zip(words, sentences, strict=True))
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("name", ["my runs/[b] ünïcode 日本", "/".join(["long" * 20] * 8), "link"])
def test_runs_of_odd_names_train_and_resume(name, toy_config, tmp_path):
    folder = tmp_path / name
    if name == "link":
        (tmp_path / "elsewhere").mkdir()
        folder.symlink_to(tmp_path / "elsewhere")
    config = replace(toy_config, run=str(folder), training=replace(toy_config.training, steps=4, save_every=2))
    config = replace(config, pairs=replace(config.pairs, method="none"))
    assert train(config) == folder
    assert train(config, resume=True) == folder
    assert load_checkpoint(folder).step == 4


# ---- R8: two processes on one folder; tests/test_checkpoint.py has the locks ----


def test_a_second_training_of_a_run_is_refused_and_names_the_first(tmp_path, capsys):
    shutil.copytree(STORED, tmp_path / "run")
    code = "import sys, time\nfrom pathlib import Path\nfrom reenact.lock import RunLock\n"
    code += "with RunLock(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"
    first = subprocess.Popen(
        [sys.executable, "-c", code, tmp_path / "run"], stdout=subprocess.PIPE, text=True, cwd=HERE.parent
    )
    try:
        assert first.stdout.readline() == "held\n"
        before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
        assert main(["train", "--run", f"{tmp_path / 'run'}", "--resume"]) == 2
        sentence = capsys.readouterr().err
        assert f"got process {first.pid}" in sentence
        assert f"on {socket.gethostname()}; wait for it" in sentence
        assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == before
    finally:
        first.kill()
        first.wait()
    assert main(["train", "--run", f"{tmp_path / 'run'}", "--resume"]) == 0


def test_a_training_that_was_taken_for_dead_saves_nothing_more(tmp_path, monkeypatch):
    """As on a cluster, where a machine that hung wakes up again."""
    shutil.copytree(STORED, tmp_path / "run")
    config, render = load_run_config(tmp_path / "run"), stages._render

    def takeover(*arguments, **keywords):
        (tmp_path / "run" / "lock").write_text('{"pid": 7, "host": "elsewhere", "user": "ana"}')
        return render(*arguments, **keywords)

    monkeypatch.setattr(stages, "_render", takeover)
    with pytest.raises(ReenactError, match="got process 7 of ana on elsewhere"):
        train(config, resume=True)
    assert load_checkpoint(tmp_path / "run").step == 6
    assert "elsewhere" in (tmp_path / "run" / "lock").read_text()


def test_two_who_begin_a_run_of_one_name_get_one_run_and_one_refusal(toy_config, tmp_path, monkeypatch):
    config = replace(toy_config, run=str(tmp_path / "run"), pairs=replace(toy_config.pairs, method="none"))
    config = replace(config, layout=replace(config.layout, method="none"))
    real = run_module._find_layouts

    def slower(*arguments):  # the other one finishes while this one works
        monkeypatch.setattr(run_module, "_find_layouts", real)
        Run.create(config)
        return real(*arguments)

    monkeypatch.setattr(run_module, "_find_layouts", slower)
    with pytest.raises(ReenactError, match="never overwrites"):
        Run.create(config)
    assert Run.open(tmp_path / "run").keys == ["ball", "egg"]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_two_who_begin_runs_without_a_name_get_two(toy_config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = replace(toy_config, run=None, pairs=replace(toy_config.pairs, method="none"))
    config = replace(config, layout=replace(config.layout, method="none"))
    real, made = run_module._find_layouts, []

    def slower(*arguments):
        monkeypatch.setattr(run_module, "_find_layouts", real)
        made.append(Run.create(config))
        return real(*arguments)

    monkeypatch.setattr(run_module, "_find_layouts", slower)
    made.append(Run.create(config))
    assert [run.folder.as_posix() for run in made] == ["runs/ball-to-egg-1", "runs/ball-to-egg-2"]
    assert all(Run.open(run.folder).config.run == run.folder.as_posix() for run in made)


def test_what_a_killed_process_left_of_a_run_is_swept_by_the_next_and_nobody_elses(toy_config, tmp_path):
    machine = "".join(each for each in socket.gethostname() if each.isalnum())[:30]
    names = {
        f".run-{machine}-{2**22 + 1}-abc": False,  # 2^22 is the most that Linux counts to: no such process
        f".run-{machine}-{os.getpid()}-abc": True,
        f".run-elsewhere-{2**22 + 1}-abc": True,
        f".run2-{machine}-{2**22 + 1}-abc": True,
    }
    for name in names:
        (tmp_path / name / "run" / "rigs").mkdir(parents=True)
    config = replace(toy_config, run=str(tmp_path / "run"), pairs=replace(toy_config.pairs, method="none"))
    Run.create(replace(config, layout=replace(config.layout, method="none")))
    assert {name: (tmp_path / name).exists() for name in names} == names


# ---- R9: what is no number ----


def _going_on(tmp_path):
    shutil.copytree(STORED, tmp_path / "run")
    return load_run_config(tmp_path / "run")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_no_number_stops_at_that_step_and_keeps_the_batch(value, tmp_path, monkeypatch):
    config, losses, steps = _going_on(tmp_path), stages._joint_losses, []

    def wrong(shop, pools, rows, done):
        steps.append(done)
        found = losses(shop, pools, rows, done)
        return {**found, "weights.egg": found["weights.egg"] * value} if len(steps) == 3 else found

    monkeypatch.setattr(stages, "_joint_losses", wrong)
    with pytest.raises(ReenactError, match=r"run: the loss of networks became .* at step 8; the batch is in .*failed"):
        train(config, resume=True)
    assert len(steps) == 3
    assert load_checkpoint(tmp_path / "run").step == 6
    kept = load_tensors(tmp_path / "run" / "failed" / "step-00000008.safetensors")
    assert not torch.isfinite(kept["loss.weights.egg"])
    for key in ("ball", "egg"):
        assert len(kept[f"{key}.weights"]) == len(kept[f"{key}.described"]) == len(kept[f"{key}.seen"]) == 4


def test_a_gradient_that_is_no_number_stops_before_it_reaches_the_networks(tmp_path, monkeypatch):
    config, losses = _going_on(tmp_path), stages._joint_losses

    def wrong(shop, *arguments):
        bias = next(iter(shop.networks.parameters()))
        return {**losses(shop, *arguments), "root": (bias - bias.detach()).abs().sum().sqrt()}  # 0, but 1 / 0 its slope

    monkeypatch.setattr(stages, "_joint_losses", wrong)
    with pytest.raises(ReenactError, match=r"the gradient of networks became .* at step 6"):
        train(config, resume=True)
    assert load_checkpoint(tmp_path / "run").step == 6


def test_networks_that_are_no_numbers_are_not_saved(tmp_path, monkeypatch):
    config, real = _going_on(tmp_path), torch.optim.AdamW.step

    def step(optimizer, *arguments):
        real(optimizer, *arguments)
        state = next(iter(optimizer.state.values()))
        if int(state["step"]) == 12:  # the last: no loss would show it
            state["exp_avg_sq"].fill_(float("inf"))

    monkeypatch.setattr(torch.optim.AdamW, "step", step)
    with pytest.raises(ReenactError, match=r"optimizer\.\d+\.exp_avg_sq became infinite or no number by step 12"):
        train(config, resume=True)
    assert load_checkpoint(tmp_path / "run").step == 6


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("part", ["neutral", "deltas"])
def test_rigs_with_what_is_no_number_are_refused_before_any_training(part, value, toy_config, tmp_path):
    with np.load(toy_config.target) as file:
        arrays = dict(file)
    spoilt = arrays[part].copy()
    spoilt.flat[5] = value
    np.savez(tmp_path / "bad.npz", **{**arrays, part: spoilt})
    with pytest.raises(ReenactError, match=rf"bad\.npz: {part} holds NaN or infinity"):
        train(replace(toy_config, target=str(tmp_path / "bad.npz"), run=str(tmp_path / "run")))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("text", ["nan", "inf", "1e999"])
def test_clips_with_what_is_no_number_are_refused_before_any_training(text, toy_config, toy_rig, tmp_path):
    save_clip(Clip(toy_rig.names, torch.zeros(3, len(toy_rig.names)), 30.0), tmp_path / "c.table.csv")
    lines = (tmp_path / "c.table.csv").read_text().splitlines()
    lines[2] = ",".join([*lines[2].split(",")[:-1], text])
    (tmp_path / "c.table.csv").write_text("\n".join(lines))
    with pytest.raises(ReenactError, match=r"c\.table\.csv"):
        train(replace(toy_config, source_clip=str(tmp_path / "c.table.csv"), run=str(tmp_path / "run")))
    assert not (tmp_path / "run").exists()


# ---- R12: seeds and threads; R13: memory; R15: pickle ----


def _ended(config, folder):
    train(replace(config, run=str(folder)))
    return load_checkpoint(folder).tensors


def test_two_threads_come_to_what_one_comes_to(toy_config, tmp_path):
    """R12; the same seed twice is in tests/test_training.py. Sums in another order: the last bits may differ."""
    config = replace(toy_config, training=replace(toy_config.training, steps=6))
    one = _ended(config, tmp_path / "one")
    two = _ended(replace(config, training=replace(config.training, threads=2)), tmp_path / "two")
    for name in one:
        torch.testing.assert_close(one[name], two[name], rtol=1e-3, atol=1e-5, msg=lambda text, name=name: name + text)


@pytest.mark.parametrize("steps", [240, pytest.param(20_000, marks=pytest.mark.nightly)])
def test_memory_stays_flat_over_many_steps(steps, tmp_path):
    """R13: under 5 % more after the first tenth, in a process of its own."""
    code = """
import json, resource, sys
from dataclasses import replace
from pathlib import Path
from lives import live, settings
from reenact import training
steps, seen, add = int(sys.argv[1]), [], training._Log.add
def counted(log, step, losses, **others):
    if step in (max(120, steps // 10), steps - 1):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        seen.append(pages * resource.getpagesize())
    add(log, step, losses, **others)
training._Log.add = counted
config = settings(Path(sys.argv[2]), 0, steps=steps, save_every=steps // 40, refresh=steps // 40)
config = replace(config, bpnet=replace(config.bpnet, image_from=0.0))  # all kinds of work from the beginning
assert live(Path(sys.argv[2]) / "run", config) == 0
print(json.dumps(seen))
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
    command = [sys.executable, "-c", code, str(steps), tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120 + steps, check=True, env=environment)
    early, late = json.loads(done.stdout.splitlines()[-1])
    assert late < 1.05 * early, f"{early / 2**20:.0f} MiB became {late / 2**20:.0f}"


def opcodes(data: bytes) -> list[str]:
    """Names of pickle's instructions, as far as the data is one."""
    found = []
    try:
        for operation, _, _ in pickletools.genops(data):
            found.append(operation.name)
            if operation.name == "STOP":
                return found
    except Exception:
        return []
    return []


def test_nothing_in_a_run_folder_is_pickle_or_makes_objects(toy_config, tmp_path):
    """R15; arrays inside .npz are looked at one by one."""
    import pickle
    import zipfile

    assert opcodes(pickle.dumps({"a": [1]}))  # else the search finds nothing ever
    config = replace(toy_config, run=str(tmp_path / "run"))
    train(replace(config, training=replace(config.training, steps=5)))
    looked = 0
    for path in (tmp_path / "run").rglob("*"):
        if not path.is_file():
            continue
        pieces = [path.read_bytes()]
        if path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                pieces += [archive.read(name) for name in archive.namelist()]
        for data in pieces:
            looked += 1
            assert not opcodes(data), path
            for tag in (b"!!python", b"numpy.core.multiarray", b"numpy._core.multiarray", b"torch._utils", b"|O'"):
                assert tag not in data, path
    assert looked > 20
