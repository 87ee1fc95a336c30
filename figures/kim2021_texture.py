"""A target whose texture is inverted: the failure that Kim et al. 2021 show, and what is left of it.

    python figures/kim2021_texture.py [--target anny:woman] [--steps 1500] [--seeds 3]

The paper's networks see colours: on a face painted in the negative, dark brows on pale skin become pale brows on dark
skin, and what lifts a dark band there lowers a pale one here. Networks are trained without pairs from anny:man to a
target and to the same target in the negative, once on colours (residuals against the neutral, no makeup, because on
plain colours nothing transfers at this size), and once on how far each point moves. What counts is how the brows
follow: the correlation of the brow shapes with the truth over held-out clips, and the vertex error around the brows.

results/kim2021-texture.json           the numbers
docs/images/kim2021-texture.png        brows up, as each draws and reads it
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from torch import Tensor

from reenact.atomic import write_atomically
from reenact.config import Config, ImageConfig, LayoutConfig, PairsConfig, TrainingConfig
from reenact.inference import ImageRetargeter
from reenact.metrics import per_shape
from reenact.preview import save_contact_sheet
from reenact.rigs.files import load_rig, save_rig
from reenact.suite import Trial, measure
from reenact.training import train

SEEN = {
    "colours": ImageConfig(motion=False, makeup=False),
    "motion": ImageConfig(makeup=False),
}


def measured(
    target: str, images: ImageConfig, steps: int, seed: int, folder: Path
) -> tuple[dict[str, float], list[Tensor]]:
    """Numbers of networks so trained, and pictures of raised brows: source, drawn, read."""
    config = Config(
        source="anny:man",
        target=target,
        run=str(folder),
        images=images,
        layout=LayoutConfig(method="pictures"),
        pairs=PairsConfig(method="none"),
        training=TrainingConfig(steps=steps, elastic=0.025, refresh=0, seed=seed),
    )
    forward = ImageRetargeter.load(train(config))
    trial = Trial.of(forward.source, forward.target, 600, seed)
    numbers = measure(forward, None, trial)
    answers = torch.cat([forward(clip).weights for clip in trial.clips.values()])
    shapes = per_shape(answers, trial.truth)
    brows = [row["correlation"] for name, row in zip(forward.target.names, shapes) if name.startswith("brow")]
    up = torch.zeros(1, len(forward.source.names))
    up[0, [k for k, name in enumerate(forward.source.names) if name in ("browInnerUp", *_OUTER)]] = 1.0
    shown = forward.source_pictures(up)
    pictures = [
        shown[:, :3],
        forward.reenact(shown)[:, :3],
        forward.target_pictures(forward._retarget(up))[:, :3],
        forward.target_pictures(up)[:, :3],
    ]
    return {"brows": float(np.mean(brows)), "ver_brows": numbers["ver_brows"], "ver": numbers["ver"]}, pictures


_OUTER = ("browOuterUpLeft", "browOuterUpRight")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", default="anny:woman")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument("--images", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    rows: dict[str, list[dict[str, float]]] = {}
    sheet: list[list[Tensor]] = []
    with tempfile.TemporaryDirectory() as spare:
        rig = load_rig(options.target)
        negative = Path(spare) / "negative.npz"
        save_rig(replace(rig, colors=1 - rig.colors), negative)
        for seed in range(options.seeds):
            for seen, images in SEEN.items():
                for paint, target in (("as it is", options.target), ("negative", str(negative))):
                    folder = Path(spare) / f"{seen}-{paint}-{seed}".replace(" ", "-")
                    numbers, pictures = measured(target, images, options.steps, seed, folder)
                    rows.setdefault(f"{seen}, {paint}", []).append(numbers)
                    print(f"{seen}, {paint}, seed {seed}: {numbers}", flush=True)
                    if seed == 0:
                        sheet.append(pictures)
    print("\n| networks see, target painted | brow correlation | VER around the brows | VER |\n|---|---|---|---|")
    for name, numbers in rows.items():
        spread = [[each[key] for each in numbers] for key in ("brows", "ver_brows", "ver")]
        print(f"| {name} | {' | '.join(f'{np.mean(each):.3f} ± {np.std(each):.3f}' for each in spread)} |")
    write_atomically(options.out / "kim2021-texture.json", (json.dumps(rows, indent=1) + "\n").encode())
    columns = [torch.cat(column) for column in zip(*sheet)]
    save_contact_sheet(options.images / "kim2021-texture.png", columns)


if __name__ == "__main__":
    main()
