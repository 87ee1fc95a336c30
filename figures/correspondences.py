"""The pictures of docs/correspondence.md: which place of one face was found to be which of another.

    python figures/correspondences.py [--source anny:man] [--targets anny:toon FACE.glb] [--out docs/images]

correspondences.png     sampled pairs and the pairs at known places, a dot of one colour on each face
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
import numpy as np
import torch
from torch import Tensor

from reenact.geometry import vertex_normals
from reenact.portrait import Portrait
from reenact.retargeting.correspondence import MARKERS, Correspondence, find_correspondence
from reenact.rigs import arkit
from reenact.rigs.files import load_rig
from reenact.rigs.rig import Rig

SIZE = 900


def posed(rig: Rig, *shapes: str) -> Tensor:
    """(1, V, 3) with the ARKit shapes at full weight, by name."""
    weights = torch.zeros(1, len(rig.names))
    for index, name in enumerate(rig.names):
        if set(arkit.meaning(name)) & set(shapes):
            weights[0, index] = 1.0
    return rig.vertices(weights)


def colors(points: Tensor) -> np.ndarray:
    """A colour for each place of the source: hue goes round the face, neighbours alternate in lightness."""
    middle = points.mean(0)
    turn = torch.atan2(points[:, 1] - middle[1], points[:, 0] - middle[0]) / (2 * torch.pi) + 0.5
    palette = plt.get_cmap("hsv")(turn.numpy() * 0.97)[:, :3]
    order = np.argsort(turn.numpy())
    shade = np.ones(len(points))
    shade[order[::3]], shade[order[1::3]] = 0.55, 0.8
    return palette * shade[:, None]


def draw(axis, rig: Rig, vertices: Tensor, places, dots: np.ndarray, box: tuple[float, ...] | None) -> None:
    """The face with its dots; those that look away from the camera are left out."""
    portrait = Portrait.of(rig)
    picture = portrait.render(vertices, SIZE)["color"][0].movedim(0, -1)
    points = places.of(vertices[0])
    normals = places.of(vertex_normals(vertices[0], rig.faces))
    seen = normals[:, 2] > 0.05
    pixels = portrait.project(points, SIZE)
    axis.imshow(picture.clamp(0, 1))
    size = 26 if box is None else 40
    axis.scatter(pixels[seen, 0], pixels[seen, 1], s=size, c=dots[seen.numpy()], edgecolors="black", linewidths=0.6)
    left, right, bottom, top = (0, SIZE, SIZE, 0) if box is None else (share * SIZE for share in box)
    axis.set_xlim(left, right)
    axis.set_ylim(bottom, top)
    axis.set_axis_off()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", default="anny:man")
    parser.add_argument("--targets", nargs="+", default=["anny:toon"])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "images")
    parser.add_argument("--motion-only", action="store_true", help="do not read the names of shapes")
    arguments = parser.parse_args()
    source = load_rig(arguments.source)
    targets = [load_rig(name) for name in arguments.targets]
    eye, nose, mouth = (0.52, 0.82, 0.45, 0.2), (0.3, 0.7, 0.76, 0.44), (0.25, 0.75, 0.95, 0.55)
    brow = (0.2, 0.8, 0.42, 0.08)
    rows: list[tuple[str, tuple[str, ...], tuple[float, ...] | None, int]] = [
        ("markers", (), None, MARKERS),
        ("brows, of 600 pairs", (), brow, 600),
        ("an eye", (), eye, 600),
        ("shut", ("eyeBlinkLeft", "eyeBlinkRight"), eye, 600),
        ("nose and lips", (), nose, 600),
        ("jaw open", ("jawOpen",), mouth, 600),
    ]
    figure, axes = plt.subplots(len(rows), 2 * len(targets), figsize=(9 * len(targets), 4.4 * len(rows)), squeeze=False)
    for column, target in enumerate(targets):
        dense = find_correspondence(source, target, None, use_names=not arguments.motion_only)
        for line, (title, shapes, box, count) in enumerate(rows):
            pairs: Correspondence = dense.sample(source, count)
            dots = colors(pairs.source.of(source.neutral))
            for side, (rig, places) in enumerate(((source, pairs.source), (target, pairs.target))):
                axis = axes[line, 2 * column + side]
                draw(axis, rig, posed(rig, *shapes), places, dots, box)
                axis.set_title(f"{rig.name}: {title}", fontsize=11)
    figure.tight_layout()
    arguments.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out / "correspondences.png", dpi=80)
    print(arguments.out / "correspondences.png")


if __name__ == "__main__":
    main()
