"""Trainings that are ended from outside, again and again: `python lives.py FOLDER SEED KILLS KILLS_IN_SAVES` and
`python lives.py FOLDER SEED SIGNAL COUNT WHERE` print as JSON what became of them.

Everything is imported and compiled once; each life is a fork of this process: half a second instead of five.
"""

import ctypes
import json
import os
import random
import shutil
import signal
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from make_fixture_run import ball

from reenact import checkpoint
from reenact.checkpoint import best_checkpoint, load_checkpoint
from reenact.cli import main as reenact
from reenact.config import (
    BPNetConfig,
    Config,
    ImageConfig,
    LayoutConfig,
    PairsConfig,
    ReenactNetConfig,
    TrainingConfig,
    save_config,
)
from reenact.inference import ImageRetargeter
from reenact.rigs.clip import Clip
from reenact.rigs.files import save_rig
from reenact.rigs.motion import expressions
from reenact.run import networks_state


def settings(folder: Path, seed: int, **training: int) -> Config:
    """Settings of a small run whose rigs lie in the folder."""
    for rig in (ball("ball", 1.0), ball("egg", 1.25)):
        if not (folder / f"{rig.name}.npz").exists():
            save_rig(rig, folder / f"{rig.name}.npz")
    common = {"steps": 36, "batch_size": 4, "save_every": 3, "threads": 1, "frames": 16, "refresh": 7, "keep": 2}
    return Config(
        source=str(folder / "ball.npz"),
        target=str(folder / "egg.npz"),
        images=ImageConfig(resolution=16),
        layout=LayoutConfig(steps=5, samples=16, grid=5),
        pairs=PairsConfig(markers=50),
        reenactnet=ReenactNetConfig(code=4, components=4, color_components=3, width=8),
        bpnet=BPNetConfig(hidden=8, batch_size=4),
        training=TrainingConfig(**{**common, "seed": seed, **training}),
    )


def live(run: Path, config: Config) -> int:
    """Begin the run, or go on with it, as a user would; the exit status."""
    if (run / "config.toml").exists():
        return reenact(["train", "--run", str(run), "--resume"])
    save_config(replace(config, run=str(run)), run.with_suffix(".toml"))
    return reenact(["train", "--config", str(run.with_suffix(".toml"))])


def born(run: Path, config: Config, before=lambda: None) -> int:
    """A child that lives; its process."""
    child = os.fork()
    if child == 0:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
        status = 99
        for number in (signal.SIGINT, signal.SIGHUP):  # a shell or nohup may have told us to ignore them
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        with suppress(AttributeError):  # none may outlive this process: PR_SET_PDEATHSIG, where there is one
            ctypes.CDLL(None).prctl(1, signal.SIGKILL)
        try:
            before()
            status = live(run, config)
        except SystemExit as end:
            status = end.code
        except KeyboardInterrupt:  # a second one, after the command had said its last word: Python ends with 130
            status = 130
        finally:
            os._exit(status)
    return child


def die_inside_a_save(number: int):
    """Make this process kill itself at some call of the system in a save, counted from now on."""
    left, real_save = [number], checkpoint.save_checkpoint

    def mortal(call):
        def wrapped(*arguments, **keywords):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*arguments, **keywords)

        return wrapped

    def save(*arguments, **keywords):
        calls = {name: getattr(os, name) for name in ("fsync", "replace", "open", "unlink")}
        for name, call in calls.items():
            setattr(os, name, mortal(call))
        try:
            return real_save(*arguments, **keywords)
        finally:
            for name, call in calls.items():
                setattr(os, name, call)

    def begin():
        from reenact import training

        training.save_checkpoint = save

    return begin


def outcome(run: Path) -> dict:
    """All that has to be equal: weights, optimizer, metrics, the best checkpoint, and what a clip becomes."""
    saved = load_checkpoint(run)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    retargeter = ImageRetargeter.load(run)
    names = retargeter.source.names
    moved = retargeter(Clip(names, expressions(names, 20, 5), 30.0)).weights
    return {
        "step": saved.step,
        "tensors": saved.tensors,
        "weights": networks_state(saved.tensors),
        "metrics": [{key: value for key, value in line.items() if key != "steps_per_second"} for line in lines],
        "moved": moved,
        "best": (best_checkpoint(run), (run / "checkpoints" / "best").read_text()),
    }


def differs(one: dict, other: dict, words: tuple[str, ...]) -> list[str]:
    def same(a, b):
        if isinstance(a, dict) and any(isinstance(value, torch.Tensor) for value in a.values()):
            return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)
        return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b

    return [word for word in words if not same(one[word], other[word])]


def kills(folder: Path, seed: int, count: int, in_saves: int) -> dict:
    """Runs that are killed up to five times each, until all kills are spent; then compared with an unbroken one."""
    config, rng = settings(folder, seed), random.Random(seed)
    assert live(folder / "unbroken", config) == 0
    start = time.perf_counter()
    assert live(folder / "warm", config) == 0
    whole, expected = time.perf_counter() - start, outcome(folder / "unbroken")
    inside = [True] * in_saves + [False] * (count - in_saves)
    rng.shuffle(inside)
    found = {"kills": 0, "in_saves": 0, "before_the_first_save": 0, "runs": 0, "wrong": []}
    while found["kills"] < count:
        run = folder / f"run-{found['runs']}"
        found["runs"] += 1
        for _ in range(5):
            if found["kills"] == count:
                break
            if inside[found["kills"]]:
                child = born(run, config, die_inside_a_save(rng.randint(1, 40)))
            else:
                child = born(run, config)
                time.sleep(rng.random() * whole)
                with suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            if not os.WIFSIGNALED(status):
                break  # it came to its end before
            found["in_saves"] += inside[found["kills"]]
            found["kills"] += 1
            found["before_the_first_save"] += not list(run.glob("checkpoints/step-*"))
        status = live(run, config)
        if status:
            found["wrong"].append(f"{run.name}: exit {status}")
            continue
        found["wrong"] += [f"{run.name}: {word}" for word in differs(expected, outcome(run), tuple(expected))]
        found["wrong"] += [f"left behind: {path.name}" for path in run.rglob(".*")]
        # A kill at the very end, between the last save and the removal of what it replaces, leaves one too many.
        if len(list(run.glob("checkpoints/step-*"))) > config.training.keep + 1 + 1:  # and the best
            found["wrong"].append(f"{run.name}: old checkpoints stayed")
        shutil.rmtree(run)
    found["wrong"] += [f"left behind: {path.name}" for path in folder.glob(".*")]
    return found


def signals(folder: Path, seed: int, name: str, count: int, where: str) -> dict:
    """Runs that are asked to end: at a step, while pictures are rendered, first or again, or before training; twice for
    `SIGINT+`."""
    long = {"steps": 3000, "save_every": 10_000, "refresh": 0}
    if where == "rendering":
        long |= {"frames": 20_000}
    if where == "again":
        long |= {"frames": 2000, "refresh": 25}
    config, rng = settings(folder, seed, **long), random.Random(seed)
    assert live(folder / "warm", settings(folder, seed)) == 0
    number = getattr(signal, name.removesuffix("+"))
    found = {"seconds": [], "statuses": [], "wrong": []}
    for index in range(count):
        run = folder / f"{where}-{index}"
        child = born(run, config)
        deadline = time.monotonic() + 120
        log = run / "metrics.jsonl"
        signs = {"steps": log, "again": log, "rendering": run / "pairs.json"}
        while not (signs[where].exists() if where in signs else any(folder.glob(f".{run.name}-*"))):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        wait = {"steps": (0, 0.5), "again": (1, 3), "rendering": (1, 2), "before": (0, 0.2)}[where]
        time.sleep(rng.uniform(*wait))
        start = time.perf_counter()
        os.kill(child, number)
        if name.endswith("+"):
            time.sleep(0.001)
            with suppress(ProcessLookupError):
                os.kill(child, number)
        _, status = os.waitpid(child, 0)
        found["seconds"].append(time.perf_counter() - start)
        found["statuses"].append(os.waitstatus_to_exitcode(status))
        saved = sorted(path.name for path in run.glob("checkpoints/step-*"))
        if where in ("steps", "again") and not saved and not name.endswith("+"):
            found["wrong"].append(f"{run.name}: nothing was saved")
        if where == "before":  # twice may cut short the clearing up, which the next run of that name does then
            found["wrong"] += [] if name.endswith("+") else [f"left behind: {path.name}" for path in folder.glob(".*")]
        elif not saved:
            continue
        else:  # it goes on from there, and is asked to end once more
            child = born(run, config)
            while str(child) not in (run / "lock").read_text():
                time.sleep(0.01)
            time.sleep(1.0)
            os.kill(child, signal.SIGTERM)
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            if status != 143 or load_checkpoint(run).step < int(saved[-1][5:13]):
                found["wrong"].append(f"{run.name}: resumed with exit {status} from {saved}")
    return found


def naps(folder: Path, seed: int, count: int) -> dict:
    """Runs whose process is stopped and continued, as when a laptop sleeps, and which lose their terminal."""
    config, rng = settings(folder, seed), random.Random(seed)
    assert live(folder / "unbroken", config) == 0
    expected, found = outcome(folder / "unbroken"), {"naps": 0, "wrong": []}
    for index in range(count):
        run = folder / f"nap-{index}"
        child = born(run, config)
        for _ in range(3):
            time.sleep(rng.random() * 0.2)
            os.kill(child, signal.SIGSTOP)
            time.sleep(0.2)
            os.kill(child, signal.SIGCONT)
            found["naps"] += 1
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        found["wrong"] += [f"exit {status}"] if status else differs(expected, outcome(run), tuple(expected))
    return found


if __name__ == "__main__":
    place, first_seed, *rest = sys.argv[1:]
    sys.stdout, answer = open(os.devnull, "w"), sys.stdout  # noqa: SIM115 - for the whole life of the process
    torch.set_num_threads(1)
    if rest[0].startswith("SIG"):
        result = signals(Path(place), int(first_seed), rest[0], int(rest[1]), rest[2])
    elif rest[0] == "nap":
        result = naps(Path(place), int(first_seed), int(rest[1]))
    else:
        result = kills(Path(place), int(first_seed), int(rest[0]), int(rest[1]))
    print(json.dumps(result), file=answer)
