"""Makes a small stopped run and what it answers: `python tests/make_fixture_run.py FOLDER`.

tests/fixtures/run-0 was made so by the code of November 2026, before run folders had a format. A fixture of a format is
made once, when the format is new, and never again: later code has to open what older code wrote.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from conftest import _BUMPS

from reenact import training
from reenact.config import BPNetConfig, Config, ImageConfig, LayoutConfig, PairsConfig, ReenactNetConfig, TrainingConfig
from reenact.inference import ImageRetargeter
from reenact.rigs.clip import Clip
from reenact.rigs.files import save_clip, save_rig
from reenact.rigs.rig import Rig


def ball(name: str, stretch: float) -> Rig:
    """A ball of 162 vertices with four bumps for shapes."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    points, names = np.asarray(mesh.vertices), ("eyeBlinkLeft", "eyeBlinkRight", "jawOpen", "mouthPucker")
    deltas = [
        np.exp(-np.square(points - place).sum(1, keepdims=True) / 0.1) * direction
        for place, direction in (_BUMPS[each] for each in names)
    ]
    size = np.array([0.1, 0.1 * stretch, 0.1])
    tensors = [torch.tensor(each, dtype=torch.float32) for each in (points * size, np.stack(deltas) * size)]
    return Rig(name, tensors[0], tensors[1], names, torch.tensor(np.asarray(mesh.faces), dtype=torch.int64))


def main(folder: Path) -> None:
    rigs = folder / "originals"
    rigs.mkdir(parents=True)
    for rig in (ball("ball", 1.0), ball("egg", 1.25)):
        save_rig(rig, rigs / f"{rig.name}.npz")
    config = Config(
        source=str(rigs / "ball.npz"),
        target=str(rigs / "egg.npz"),
        run=str(folder / "run"),
        images=ImageConfig(resolution=16),
        layout=LayoutConfig(steps=5, samples=16, grid=5),
        pairs=PairsConfig(markers=50),
        reenactnet=ReenactNetConfig(code=4, components=4, color_components=3, width=8),
        bpnet=BPNetConfig(hidden=8, steps=12, batch_size=4),
        training=TrainingConfig(steps=12, batch_size=4, save_every=6, threads=1, frames=16, refresh=7, keep=1),
    )
    preview, save = training._preview, training._save

    class Stopped(Exception):
        pass

    def stop(*arguments):
        save(*arguments)
        raise Stopped

    training._preview, training._save = lambda *_: None, stop
    try:
        training.train(config)
    except Stopped:
        pass
    finally:
        training._preview, training._save = preview, save
    retargeter = ImageRetargeter.load(folder / "run")
    names = retargeter.source.names
    clip = Clip(names, torch.linspace(0, 1, 5)[:, None] * torch.linspace(0.2, 1, len(names)), 30.0)
    save_clip(replace(clip, fps=30.0), folder / "clip.npz")
    save_clip(retargeter(clip), folder / "moved.npz")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
