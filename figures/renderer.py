"""The pictures of docs/renderer.md.

    python figures/renderer.py [--out docs/images]

renderer-stages.png     what the stages make of a face
renderer-gradient.png   where the gradient of a picture for one weight comes from, beside differences of a fine picture
renderer-fitting.png    weights of a face found from one picture by gradient descent
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

from reenact.portrait import Portrait, fit_weights
from reenact.rigs import anny, motion
from render.rasterize import rasterize
from render.shade import linear_from_srgb, srgb_from_linear

SIZE = 96


def expression(rig, **weights: float) -> Tensor:
    """(1, K) weights from names."""
    numbers = torch.zeros(1, len(rig.names))
    for name, weight in weights.items():
        numbers[0, rig.names.index(name)] = weight
    return numbers


def stages(portrait: Portrait) -> plt.Figure:
    """Visibility, buffers, colour without and with blending."""
    rig = portrait.rig
    vertices = rig.vertices(expression(rig, jawOpen=0.6, mouthSmileLeft=0.8, mouthSmileRight=0.8, eyeBlinkLeft=0.6))
    made = portrait.render(vertices, SIZE, ("color", "mask", "normals", "depth", "parts"))
    face_img = rasterize(portrait.camera.project(portrait.scale * vertices + portrait.position), rig.faces, SIZE, SIZE)[
        0
    ]
    confetti = torch.rand(len(rig.faces) + 1, 3, generator=torch.Generator().manual_seed(0))
    confetti[-1] = 1
    hard = portrait.render(vertices, 8 * SIZE)["color"][..., 4::8, 4::8]
    depth = made["depth"][0, 0].masked_fill(made["depth"][0, 0] == 0, torch.nan)
    pictures = {
        "faces: which triangle is seen\nin the middle of each pixel": confetti[face_img],
        "depth, metres": depth,
        "normals, in camera space": (made["normals"][0].movedim(0, -1) + 1) / 2,
        "parts: labels of vertices": made["parts"][0, 0].float().masked_fill(made["parts"][0, 0] < 0, torch.nan),
        "colour in the middle of each pixel": hard[0].movedim(0, -1),
        "blended across silhouettes": made["color"][0].movedim(0, -1),
        "mask: share that is covered": made["mask"][0, 0],
    }
    figure, axes = plt.subplots(2, 4, figsize=(12, 7))
    for axis, (title, picture) in zip(axes.flat, pictures.items()):
        axis.imshow(picture, cmap="viridis" if "mask" not in title else "gray", interpolation="nearest")
        axis.set_title(title, fontsize=10)
    corner = axes.flat[7]
    left, right = (image[0, :, 60:84, 34:58].movedim(0, -1) for image in (hard, made["color"]))
    corner.imshow(torch.cat([left, torch.ones(24, 1, 3), right], 1), interpolation="nearest")
    corner.set_title("the mouth, before and after", fontsize=10)
    return _finish(figure)


def gradient(portrait: Portrait, shape: str = "jawOpen") -> plt.Figure:
    """How each pixel changes with one weight: through shading, through coverage, and by differences."""
    rig = portrait.rig
    weights = expression(rig, jawOpen=0.35, mouthSmileLeft=0.4, mouthSmileRight=0.4)
    direction = rig.deltas[rig.names.index(shape)]
    size, batch = 64, 64
    vertices = rig.vertices(weights).expand(batch, -1, -1)
    changes = torch.zeros(size * size)
    for start in range(0, size * size, batch):
        leaf = vertices.clone().requires_grad_()
        light = linear_from_srgb(portrait.render(leaf, size)["color"]).mean(1).flatten(1)  # (batch, pixels)
        pixels = torch.arange(start, start + batch)
        (found,) = torch.autograd.grad(light[torch.arange(batch), pixels].sum(), leaf)
        changes[pixels] = (found * direction).sum((1, 2))

    def fine(weights: Tensor) -> Tensor:
        linear = linear_from_srgb(portrait.render(rig.vertices(weights), 16 * size)["color"])
        return torch.nn.functional.avg_pool2d(linear, 16)[0].mean(0)

    step = expression(rig, **{shape: 0.01})
    numeric = (fine(weights + step) - fine(weights - step)) / 0.02
    picture = srgb_from_linear(linear_from_srgb(portrait.render(rig.vertices(weights), 8 * size)["color"]))
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.6))
    axes[0].imshow(picture[0].movedim(0, -1))
    axes[0].set_title("the face", fontsize=10)
    scale = numeric.abs().max().item() / 2
    analytic = changes.view(size, size)
    for axis, values, title in (
        (axes[1], analytic, f"gradient for {shape}, by `render`"),
        (axes[2], numeric, "differences of 16 x 16 samples a pixel"),
        (axes[3], analytic - numeric, "their difference"),
    ):
        axis.imshow(values, cmap="RdBu", vmin=-scale, vmax=scale, interpolation="nearest")
        axis.set_title(title, fontsize=10)
    return _finish(figure)


def fitting(portrait: Portrait, seed: int = 0) -> plt.Figure:
    """Weights from one picture."""
    rig = portrait.rig
    goal = motion.expressions(rig.names, 1, seed)
    target = portrait.render(rig.vertices(goal), 128)["color"]
    snapshots, errors = {}, []
    still = rig.neutral[None]

    def watch(step: int, weights: Tensor) -> None:
        vertices = rig.vertices(weights)
        errors.append(((vertices - rig.vertices(goal)).norm() / (rig.vertices(goal) - still).norm()).item())
        if step in (0, 30, 100):
            snapshots[step] = portrait.render(vertices, 128)["color"][0].movedim(0, -1)

    fitted = fit_weights(portrait, target, watch=watch)
    snapshots["the end"] = portrait.render(rig.vertices(fitted), 128)["color"][0].movedim(0, -1)
    figure, axes = plt.subplots(1, 6, figsize=(16, 3.1))
    for axis, (title, picture) in zip(axes, {"the picture": target[0].movedim(0, -1), **snapshots}.items()):
        axis.imshow(picture)
        axis.set_title(title if isinstance(title, str) else f"step {title}", fontsize=10)
    _finish(figure)
    axes[5].set_axis_on()
    axes[5].semilogy(errors)
    axes[5].set_title("vertex error, share of the motion", fontsize=10)
    axes[5].set_xlabel("step")
    figure.tight_layout()
    return figure


def _finish(figure: plt.Figure) -> plt.Figure:
    for axis in figure.axes:
        axis.set_axis_off()
    figure.tight_layout(h_pad=2)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "images")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    portrait = Portrait.of(anny.build("anny:man"))
    for draw in (stages, gradient, fitting):
        draw(portrait).savefig(arguments.out / f"renderer-{draw.__name__}.png", dpi=80)
        print(arguments.out / f"renderer-{draw.__name__}.png")


if __name__ == "__main__":
    main()
