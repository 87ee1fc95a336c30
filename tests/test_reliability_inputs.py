"""Damaged settings, checkpoints and run folders; rigs that nobody would want; no network. docs/reliability.md.

Damaged rigs and clips are in tests/test_formats_mutants.py, hostile ones in the tests of each format.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_toy_rig
from lives import settings
from mutate import mutant
from ugly import LARGE, UGLY, make

from reenact.checkpoint import load_checkpoint
from reenact.config import Config, load_config
from reenact.data import Studio
from reenact.errors import ReenactError
from reenact.folder import load_run_config
from reenact.inspection import inspect
from reenact.retargeting import METHODS
from reenact.retargeting.correspondence import find_correspondence
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_rig, read_rig, save_rig
from reenact.rigs.formats.pieces import Choice
from reenact.rigs.motion import expressions
from reenact.run import Run
from reenact.training import train

HERE = Path(__file__).parent
STORED = HERE / "fixtures" / "run-1" / "run"


def damaged(path: Path, count: int, load, seed: int = 0) -> dict[str, int]:
    """How many mutants of a file load, and how many are refused; no other error, no hang, little memory."""
    data, rng, found = path.read_bytes(), np.random.default_rng(seed), {"loaded": 0, "refused": 0}
    before, longest, nameless = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 0.0, 0
    for _ in range(count):
        changed = data
        while changed == data:
            changed = mutant(data, rng)
        path.write_bytes(changed)
        start = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                load()
            found["loaded"] += 1
        except ReenactError as error:
            found["refused"] += 1
            nameless += not any(str(place) in str(error) for place in (path, *path.parents[:2]))
        longest = max(longest, time.perf_counter() - start)
    path.write_bytes(data)
    assert (longest < 10, nameless) == (True, 0)
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**10 < 2048  # MiB
    return found


COUNTS = [2000, pytest.param(50_000, marks=pytest.mark.nightly)]


@pytest.mark.parametrize("count", COUNTS)
def test_damaged_settings_load_or_are_refused(count, tmp_path):
    """R1, TOML."""
    shutil.copy(STORED / "config.toml", tmp_path)
    found = damaged(tmp_path / "config.toml", count, lambda: load_config(tmp_path / "config.toml"))
    assert found["refused"] > count / 2


@pytest.mark.parametrize("count", [600, pytest.param(50_000, marks=pytest.mark.nightly)])
def test_a_damaged_checkpoint_is_never_loaded(count, tmp_path):
    """R1, safetensors and the JSON in its header."""
    shutil.copytree(STORED, tmp_path / "run")
    (path,) = (tmp_path / "run" / "checkpoints").glob("step-*")
    assert damaged(path, count, lambda: load_checkpoint(tmp_path / "run")) == {"loaded": 0, "refused": count}


FILES = {
    "format.json": 200,
    "layouts.safetensors": 60,
    "rigs/1-egg.npz": 60,
    "correspondences/0-1.npz": 60,
    "checkpoints/latest": 60,
}
"""Of a run folder, with how often each is damaged in every run."""


@pytest.mark.parametrize("times", [1, pytest.param(30, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", FILES)
def test_a_run_with_a_damaged_file_opens_or_is_refused(name, times, tmp_path):
    """R1, the rest of a run folder."""
    shutil.copytree(STORED, tmp_path / "run")
    found = damaged(tmp_path / "run" / name, times * FILES[name], lambda: Run.open(tmp_path / "run").trained_networks())
    assert sum(found.values()) == times * FILES[name]
    assert (found["refused"] > 0) == (name != "checkpoints/latest")  # a lost pointer loses nothing


@pytest.mark.parametrize("count", [5, pytest.param(500, marks=pytest.mark.nightly)])
def test_a_stopped_run_with_damaged_metrics_goes_on(count, tmp_path):
    """Metrics are for people: no line of them stops a training."""
    shutil.copytree(STORED, tmp_path / "run")
    rng, metrics = np.random.default_rng(0), (STORED / "metrics.jsonl").read_bytes()
    config = replace(load_run_config(tmp_path / "run"), run=str(tmp_path / "run"))
    for _ in range(count):
        shutil.rmtree(tmp_path / "run")
        shutil.copytree(STORED, tmp_path / "run")
        (tmp_path / "run" / "metrics.jsonl").write_bytes(mutant(metrics + b"\n" + metrics, rng) + b'{"stage": "x"}\n[')
        train(config, resume=True)
        assert load_checkpoint(tmp_path / "run").step == 12


# ---- R10: ugly rigs ----


def tried(name: str, folder: Path) -> dict[str, str]:
    """What becomes of a rig: `ok`, or the sentence of the refusal, by what was done with it."""
    ball, found = make_toy_rig("ball"), {}
    rig = make(name)
    for each, file in ((ball, "nice.npz"), (rig, "ugly.npz")):
        save_rig(each, folder / file)
    small = name not in LARGE
    config = settings(folder, 0, steps=2, save_every=2)
    rigs = {"source": str(folder / "nice.npz"), "target": str(folder / "ugly.npz")}
    config = replace(config, **rigs, run=str(folder / "run"))
    if not small:
        config = replace(config, pairs=replace(config.pairs, method="none"))

    def looked_at() -> None:
        inspect(*read_rig(str(folder / "ugly.npz"), Choice((), ())))

    def exported() -> None:
        save_rig(rig, folder / "ugly.glb")
        assert len(load_rig(str(folder / "ugly.glb")).names) == len(rig.names)

    def retargeted() -> None:
        clip = Clip(ball.names, expressions(ball.names, 12, 3), 30.0)
        moved = METHODS["shape-matching"](ball, rig, find_correspondence(ball, rig, 50), None)(clip)
        assert torch.isfinite(moved.weights).all()

    for do in (looked_at, exported, lambda: train(config), *([retargeted] if small else [])):
        word = do.__name__ if do.__name__ != "<lambda>" else "trained"
        try:
            do()
            found[word] = "ok"
        except ReenactError as error:
            found[word] = str(error)
    return found


REFUSED = {
    "one_shape": "at least four shapes",
    "only_empty_shapes": "expected shapes that move",
    "z_up": "expressions that change its picture",
    "backwards": "that face the camera",
    "flat": "in one plane",
    "flipped": "cannot be registered",
    "one_triangle": "connected vertices",
    "one_point": "",
}
"""What training says of rigs that it cannot take; it takes the others."""
QUICK = ("doubled", "degenerate", "flipped", "one_shape", "one_triangle", "one_point", "times 0.001", "times 1000")


def test_as_many_ugly_rigs_as_were_promised():
    assert len(UGLY | LARGE) >= 20
    assert (REFUSED.keys() | set(QUICK)) <= UGLY.keys()


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(n, marks=pytest.mark.nightly) for n in UGLY | LARGE)])
def test_an_ugly_rig_works_or_is_refused_by_name(name, tmp_path):
    """R10."""
    found = tried(name, tmp_path)
    assert found["looked_at"] == found["exported"] == "ok"
    if name in REFUSED:
        assert REFUSED[name] in found["trained"]
    else:
        assert set(found.values()) == {"ok"}


def test_a_rig_that_is_inside_out_is_told_by_inspect(tmp_path):
    for name, told in (("flipped", True), ("holes", False), ("half_flipped", False), ("times 1000", False)):
        save_rig(make(name), tmp_path / "x.npz")
        facts = inspect(*read_rig(str(tmp_path / "x.npz"), Choice((), ())))
        assert any("inside out" in problem for problem in facts.problems) == told


@pytest.mark.parametrize("factor", [1e-3, 1e3, *(pytest.param(f, marks=pytest.mark.nightly) for f in (0.01, 0.1, 7.0))])
def test_a_result_does_not_change_with_the_scale_of_a_rig(factor, tmp_path):
    """R10: weights that geometry finds, and the pictures that networks see."""
    ball, egg = make_toy_rig("ball"), make_toy_rig("egg", stretch=1.25, hue=2.0)
    other = replace(egg, neutral=factor * egg.neutral, deltas=factor * egg.deltas)
    clip = Clip(ball.names, expressions(ball.names, 12, 3), 30.0)
    images = replace(Config().images, resolution=32)
    moved, shown = [], []
    for rig in (egg, other):
        moved.append(METHODS["shape-matching"](ball, rig, find_correspondence(ball, rig, 50), None)(clip).weights)
        shown.append(Studio(rig, images).glance(clip.weights))
    torch.testing.assert_close(moved[0], moved[1], rtol=0, atol=1e-4)
    torch.testing.assert_close(shown[0], shown[1], rtol=0, atol=1e-3)  # residuals of unit size: of 1 in 1,000


# ---- R17: no network ----


@pytest.mark.nightly
def test_the_whole_path_passes_without_a_network(tmp_path):
    """R17, with the settings of configs/smoke.toml instead of the demo's, whose training takes a quarter of an hour."""
    alone = ["unshare", "--user", "--map-root-user", "--net"]
    if shutil.which("unshare") is None or subprocess.run([*alone, "true"], check=False).returncode:
        pytest.skip("needs unshare, and the right to use it")
    environment = {**os.environ, "PYTHONPATH": str(HERE.parent), "REENACT_CACHE": str(tmp_path / "cache")}
    run = tmp_path / "run"
    for arguments in (
        ["train", "--config", HERE.parent / "configs" / "smoke.toml", "--run", run],
        ["infer", run, "synthetic:2026:2", "--out", tmp_path / "x.glb"],
        ["evaluate", run, "--frames", "40"],
        ["doctor"],
    ):
        command = [*alone, sys.executable, "-m", "reenact.cli", *map(str, arguments)]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=900, check=False, env=environment, cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr[-3000:]
    assert json.loads((run / "evaluation" / "metrics.json").read_text())
