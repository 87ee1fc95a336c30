"""The pictures of docs/anacondar.md: patches, what each part adds, gravity, and softer or stiffer cheeks.

    python figures/anacondar.py [--target anny:toon] [--out docs/images]

anacondar-patches.png      80 patches of the source, and the same ones on the target
anacondar-components.png   frames of a clip: source, parts of the method, result, truth, with the distance from truth
anacondar-gravity.png      one expression without weight, and in a centrifuge
anacondar-stiffness.png    the same under gravity with soft, usual and stiff cheeks
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

from reenact.portrait import Portrait
from reenact.retargeting.anacondar import Anacondar, AnacondarConfig
from reenact.retargeting.anatomy import Shell
from reenact.retargeting.correspondence import find_correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer
from reenact.retargeting.examples import choose
from reenact.retargeting.physics import PhysicsConfig
from reenact.retargeting.plbs import PatchConfig, Patches, PatchwiseBlendshapes
from reenact.rigs.files import load_rig
from reenact.rigs.rig import Rig

SIZE = 420
POSES = (
    {"jawOpen": 0.7, "mouthSmileLeft": 0.6, "mouthSmileRight": 0.6, "browInnerUp": 0.8},
    {"mouthPucker": 0.8, "eyeBlinkLeft": 1.0, "browDownRight": 0.9, "cheekPuff": 0.5},
    {"mouthShrugLower": 0.8, "mouthLeft": 0.8, "eyeWideLeft": 0.7, "eyeWideRight": 0.7, "noseSneerLeft": 0.7},
)
"""By ARKit's names, which both rigs have: what is asked of the source, and the truth on the target."""


def weights(rig: Rig) -> Tensor:
    """(poses, K)."""
    return torch.tensor([[pose.get(name, 0.0) for name in rig.names] for pose in POSES])


def picture(rig: Rig, vertices: Tensor, colors: Tensor | None = None) -> np.ndarray:
    """A portrait of one mesh, with other colours for its vertices where given."""
    portrait = Portrait.of(rig)
    if colors is not None:
        portrait = replace(portrait, rig=replace(rig, colors=colors, texture=None))
    return portrait.render(vertices[None].float(), SIZE)["color"][0].movedim(0, -1).clamp(0, 1).numpy()


def heat(rig: Rig, distance: Tensor, full: float) -> Tensor:
    """Colours of distances, from grey at 0 to red at `full` metres."""
    share = (distance / full).clamp(0, 1)[:, None].numpy()
    shown = plt.get_cmap("inferno")(0.1 + 0.85 * share[:, 0])[:, :3]
    return torch.from_numpy(np.where(share > 0.02, shown, 0.55)).float().clamp(0, 1).contiguous()


def show(rows: list[list[tuple[np.ndarray, str]]], path: Path) -> None:
    columns = max(map(len, rows))
    figure, axes = plt.subplots(len(rows), columns, figsize=(2.3 * columns, 2.55 * len(rows)), squeeze=False)
    for axis in axes.ravel():
        axis.set_axis_off()
    for line, row in zip(axes, rows):
        for axis, (pixels, title) in zip(line, row):
            axis.imshow(pixels)
            axis.set_title(title, fontsize=12)
    figure.tight_layout(pad=0.4)
    figure.savefig(path, dpi=80, pil_kwargs={"optimize": True})
    plt.close(figure)
    print(path)


def draw_patches(blendshapes: PatchwiseBlendshapes, path: Path) -> None:
    palette = plt.get_cmap("tab20")(np.linspace(0, 1, 20))[:, :3]
    order = np.random.default_rng(3).permutation(len(blendshapes.patches))

    def painted(rig: Rig, patches: Patches) -> np.ndarray:
        shares = patches.shares.toarray()
        return picture(rig, rig.neutral, torch.from_numpy(shares @ palette[order % 20]).float().clamp(0, 1))

    source, target = blendshapes.source, blendshapes.target
    pair = [
        (painted(source, blendshapes.patches), source.name),
        (painted(target, blendshapes.target_patches), target.name),
    ]
    show([pair], path)


def draw_components(method: Anacondar, transfer: DeformationTransfer, plain: PatchwiseBlendshapes, path: Path) -> None:
    source, target = method.source, method.target
    frames, truth = source.vertices(weights(source)), target.vertices(weights(target))
    stages = method.stages(frames)
    columns = {
        "blendshapes": plain(frames).float(),
        "patchwise": stages.shown,
        "surface transfer": transfer.transfer(frames),
        "both parts": stages.combined,
        "AnaConDaR": stages.vertices,
        "truth": truth,
    }
    rows = []
    for frame, mesh in enumerate(frames):
        faces, errors = [(picture(source, mesh), source.name)], [(np.ones((SIZE, SIZE, 3)), "")]
        for title, found in columns.items():
            faces.append((picture(target, found[frame]), title))
            distance = (found[frame] - truth[frame]).norm(dim=-1)
            ratio = float(distance.sum() / (truth[frame] - target.neutral).norm(dim=-1).sum())
            errors.append((picture(target, found[frame], heat(target, distance, 0.006)), f"misses {ratio:.2f}"))
        rows += [faces, errors[:-1]]
    show(rows, path)


def draw_forces(source: Rig, target: Rig, settings: dict, folder: Path) -> None:
    """Soft tissue whose skin holds on little, in a centrifuge: a cheek that holds on to its bone sags little at 1 g."""
    frame = source.vertices(weights(source))[:1]
    soft = PhysicsConfig(skin=1.0, elasticity=0.3, muscle=0.3, iterations=60)
    config = AnacondarConfig(physics=soft, doubt=0.0)  # else where pairs are unsure it would fall further
    method = Anacondar(source, target, config=config, **settings)
    rest = method.stages(frame).vertices[0]
    row, heats = [(picture(target, rest), "no weight")], [(np.ones((SIZE, SIZE, 3)), "")]
    for title, force in (
        ("20 g down", (0.0, -20.0, 0.0)),
        ("20 g up: head down", (0.0, 20.0, 0.0)),
        ("20 g sideways", (20.0, 0.0, 0.0)),
    ):
        moved = method.stages(frame, force=torch.tensor(force)).vertices[0]
        fall = (moved - rest).norm(dim=-1)
        row.append((picture(target, moved), title))
        heats.append(
            (picture(target, moved, heat(target, fall, 0.008)), f"moved up to {1000 * float(fall.max()):.1f} mm")
        )
    show([row, heats], folder / "anacondar-gravity.png")

    cheeks = cheek_field(method.shell)
    row, heats = [], []
    for title, factor in (("soft cheeks, 1/10", 0.1), ("as built", 1.0), ("stiff cheeks, 30", 30.0)):
        edited = Anacondar(
            source, target, config=config, stiffness=1 + (factor - 1) * cheeks, shell=method.shell, **settings
        )
        still = edited.stages(frame).vertices[0]
        moved = edited.stages(frame, force=torch.tensor([0.0, -20.0, 0.0])).vertices[0]
        fall = (moved - still).norm(dim=-1)
        row.append((picture(target, moved), f"{title}, 20 g"))
        mean = 1000 * float((fall * cheeks).sum() / cheeks.sum())
        heats.append((picture(target, moved, heat(target, fall, 0.008)), f"cheeks fall by {mean:.2f} mm"))
    row.append((picture(target, target.neutral, heat(target, 0.006 * cheeks, 0.006)), "what was edited"))
    show([row, heats], folder / "anacondar-stiffness.png")


def cheek_field(shell: Shell) -> Tensor:
    """(V,) 1 in the lower middle of both cheeks, fading to 0."""
    rig, marks = shell.rig, shell.landmarks
    field = torch.zeros(len(rig.neutral))
    for eye in marks.eyes:
        middle = torch.from_numpy(0.1 * eye + 0.9 * marks.mouth).float()
        middle[0] = 1.15 * float(eye[0])
        flat = (rig.neutral - middle)[:, :2].norm(dim=-1) / (0.22 * shell.height)
        field = torch.maximum(
            field, torch.exp(-flat.square()) * (rig.neutral[:, 2] > marks.mouth[2] - 0.5 * shell.height)
        )
    return field


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", default="anny:man")
    parser.add_argument("--target", default="anny:toon")
    parser.add_argument("--examples", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "images")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    source, target = load_rig(arguments.source), load_rig(arguments.target)
    pairs = find_correspondence(source, target, 300)
    examples = choose(target, arguments.examples)
    settings = {"correspondence": pairs, "examples": examples, "counterparts": examples}
    method = Anacondar(source, target, **settings)
    draw_patches(method.blendshapes, arguments.out / "anacondar-patches.png")
    plain = PatchwiseBlendshapes(
        source, target, source.vertices(examples), target.vertices(examples), pairs, PatchConfig(patches=1, ridge=1e-2)
    )
    draw_components(
        method, DeformationTransfer(source, target, pairs), plain, arguments.out / "anacondar-components.png"
    )
    draw_forces(source, target, settings, arguments.out)


if __name__ == "__main__":
    main()
