"""Damaged files of every format load or are refused: no crash, no hang, no large allocation, one class of error."""

import base64
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from conftest import make_random_rig

from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.files import save_clip, save_rig

HERE = Path(__file__).parent
FIXTURES = HERE / "fixtures"


def rig_file(folder: Path, name: str) -> Path:
    save_rig(make_random_rig(1), folder / name)
    return folder / name


def clip_file(folder: Path, name: str) -> Path:
    names = arkit.NAMES if name == "take.csv" else ("jawOpen", "smirk", "ü")
    save_clip(Clip(names, torch.rand(12, len(names), generator=torch.Generator().manual_seed(0)), 30.0), folder / name)
    return folder / name


def embedded(folder: Path) -> Path:
    """A .gltf with everything inside."""
    root = json.loads((FIXTURES / "blender.gltf").read_text())
    for owner in (*root["buffers"], *root["images"]):
        kind = "image/png" if owner["uri"].endswith(".png") else "application/octet-stream"
        data = base64.b64encode((FIXTURES / owner["uri"]).read_bytes()).decode()
        owner["uri"] = f"data:{kind};base64,{data}"
    (folder / "x.gltf").write_text(json.dumps(root))
    return folder / "x.gltf"


CASES = {
    "glb": ("rig", lambda _: FIXTURES / "blender.glb"),
    "glb of ours": ("rig", lambda folder: rig_file(folder, "x.glb")),
    "gltf": ("rig", lambda folder: embedded(folder)),
    "glb with Draco": ("rig", lambda _: FIXTURES / "transform_draco.glb"),
    "glb with meshopt": ("rig", lambda _: FIXTURES / "transform_meshopt.glb"),
    "glb quantised, WebP": ("rig", lambda _: FIXTURES / "transform_webp.glb"),
    "glb animation": ("clip", lambda _: FIXTURES / "blender.glb"),
    "npz rig": ("rig", lambda folder: rig_file(folder, "x.npz")),
    "npz clip": ("clip", lambda folder: clip_file(folder, "c.npz")),
    "csv of Live Link Face": ("clip", lambda folder: clip_file(folder, "take.csv")),
    "csv table": ("clip", lambda folder: clip_file(folder, "c.table.csv")),
    "json table": ("clip", lambda folder: clip_file(folder, "c.json")),
    "json of Audio2Face": ("clip", lambda folder: clip_file(folder, "c.a2f.json")),
    "fbx": ("rig", lambda _: FIXTURES / "blender.fbx"),
}

SLOW = {
    "usdc": ("rig", lambda folder: rig_file(folder, "x.usdc")),
    "usda": ("rig", lambda folder: rig_file(folder, "x.usda")),
    "usdz": ("rig", lambda folder: rig_file(folder, "x.usdz")),
}
"""A minute or two each; test_formats_usd tries a few of each in every run."""


def run(case: str, count: int, folder: Path) -> dict:
    noun, make = (CASES | SLOW)[case]
    command = [sys.executable, HERE / "mutate.py", noun, make(folder), str(count), "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=count * 0.2 + 120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def check(found: dict, count: int) -> None:
    assert found["loaded"] + found["refused"] == count
    assert found["refused"] > count / 10  # else the mutants are too mild to test anything
    assert found["longest"] < 12  # a reader of its own process has ten seconds
    assert found["grown"] < 2048


@pytest.mark.parametrize("case", CASES)
def test_2000_damaged_files_load_or_are_refused(case, tmp_path):
    check(run(case, 2000, tmp_path), 2000)


@pytest.mark.nightly
@pytest.mark.parametrize("case", SLOW)
def test_2000_damaged_usd_files_load_or_are_refused(case, tmp_path):
    check(run(case, 2000, tmp_path), 2000)


@pytest.mark.nightly
@pytest.mark.parametrize("case", CASES)
def test_50000_damaged_files_load_or_are_refused(case, tmp_path):
    check(run(case, 50_000, tmp_path), 50_000)
