"""The pictures of docs/how-it-works.md, from a trained run.

    python figures/how_it_works.py RUN [--out docs/images]

how-layout.png      neutrals as framed, and the target in the layout of the source
how-pipeline.png    an expression on its way: picture, motion pass, ReenactNet's drawing, weights, the target
how-weights.png     the weights that BPNet read from one drawing, beside the right ones where names tell them
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
from torch import Tensor

from reenact.inference import ImageRetargeter
from reenact.portrait import Portrait
from reenact.rigs import arkit
from reenact.rigs.rig import Rig
from reenact.truth import true_weights

POSES = (
    {"jawOpen": 0.6, "mouthSmileLeft": 0.7, "mouthSmileRight": 0.7, "browInnerUp": 0.7},
    {"eyeBlinkLeft": 1.0, "mouthPucker": 0.8, "browDownRight": 0.6},
    {"noseSneerLeft": 0.8, "noseSneerRight": 0.8, "browDownLeft": 0.9, "browDownRight": 0.9, "mouthStretchLeft": 0.7},
)


def weights(rig: Rig) -> Tensor:
    """(3, K) the poses, by ARKit's names."""
    names = [arkit.canonical(name) or name for name in rig.names]
    return torch.tensor([[pose.get(name, 0.0) for name in names] for pose in POSES])


def colors(pictures: Tensor) -> Tensor:
    """(N, H, W, 3) of pictures whose first three channels are colours."""
    return pictures[:, :3].clamp(0, 1).movedim(1, -1)


def motion(pictures: Tensor, scale: float) -> Tensor:
    """(N, H, W, 3) of the motion pass: grey does not move, red to the side, green up, blue forward."""
    return (0.5 + pictures[:, 3:6] / (2 * scale)).clamp(0, 1).movedim(1, -1)


def portraits(rig: Rig, poses: Tensor, size: int = 160) -> Tensor:
    return colors(Portrait.of(rig).render(rig.vertices(poses), size)["color"])


@torch.no_grad()
def layout(retargeter: ImageRetargeter) -> plt.Figure:
    """Source, target as framed, target in the source's layout, and the last over the first."""
    source, target = retargeter.source, retargeter.target
    still = torch.zeros(1, len(source.names)), torch.zeros(1, len(target.names))
    laid = [colors(retargeter.source_pictures(still[0]))[0], colors(retargeter.target_pictures(still[1]))[0]]
    shown = {
        f"{source.name}, in paint": laid[0],
        f"{target.name}, as framed": portraits(target, still[1])[0],
        "in the shared layout": laid[1],
        "both": (laid[0] + laid[1]) / 2,
    }
    figure, axes = plt.subplots(1, len(shown), figsize=(11, 3.1))
    for axis, (title, picture) in zip(axes, shown.items()):
        axis.imshow(picture)
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    figure.tight_layout()
    return figure


@torch.no_grad()
def pipeline(retargeter: ImageRetargeter) -> plt.Figure:
    """A row per pose, a column per step."""
    source, target = retargeter.source, retargeter.target
    poses = weights(source)
    pictures = retargeter.source_pictures(poses)
    drawn = retargeter.reenact(pictures)
    read = torch.stack([retargeter.step(pose) for pose in poses])
    scale = float(pictures[:, 3:6].abs().max())
    columns = {
        f"{source.name}": portraits(source, poses),
        "1  its motion pass": motion(pictures, scale),
        f"4  ReenactNet: the pass\nof {target.name}": motion(drawn, scale),
        "   and its colours,\nto look at": colors(drawn),
        f"5  BPNet: {target.name}\nwith the weights it reads": portraits(target, read),
    }
    known, truth, covered = true_weights(source, target, poses)
    if covered and torch.equal(known, poses):
        columns["the truth"] = portraits(target, truth)
    figure, axes = plt.subplots(len(POSES), len(columns), figsize=(2.1 * len(columns), 6.9))
    for column, (title, rows) in enumerate(columns.items()):
        axes[0, column].set_title(title, fontsize=10)
        for axis, picture in zip(axes[:, column], rows):
            axis.imshow(picture)
            axis.set_axis_off()
    figure.tight_layout(h_pad=0.3, w_pad=0.3)
    return figure


@torch.no_grad()
def read_weights(retargeter: ImageRetargeter) -> plt.Figure:
    """Bars of the first pose."""
    pose = weights(retargeter.source)[:1]
    read = retargeter.step(pose[0])
    _, truth, covered = true_weights(retargeter.source, retargeter.target, pose)
    shown = (torch.maximum(read, truth[0]) > 0.02).nonzero().flatten().tolist()
    figure, axis = plt.subplots(figsize=(8, 0.28 * len(shown) + 0.9))
    axis.barh(range(len(shown)), read[shown], 0.7, color="#c2410c", label="read")
    if covered:
        axis.plot(truth[0, shown], range(len(shown)), "|", color="#2563a8", markersize=13, mew=2.5, label="right")
    axis.set_yticks(range(len(shown)), [retargeter.target.names[k] for k in shown])
    axis.set(xlim=(0, 1), xlabel="weight")
    axis.invert_yaxis()
    axis.legend(loc="lower right")
    figure.tight_layout()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "images")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    retargeter = ImageRetargeter.load(arguments.run)
    for name, draw in {"layout": layout, "pipeline": pipeline, "weights": read_weights}.items():
        path = arguments.out / f"how-{name}.png"
        draw(retargeter).savefig(path, dpi=90)
        print(path)


if __name__ == "__main__":
    main()
