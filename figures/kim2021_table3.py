"""BPNet's losses, Table 3 of Kim et al. 2021: weights (L_w), pixels (L_r), or both?

    python figures/kim2021_table3.py [--network convolutional|components] [--rig anny:toon] [--steps 2500] [--seeds 3]

BPNet alone learns to read a rig's own renders, with each loss and all else equal, and is judged on held-out clips of
that rig: PSNR and SSIM of renders of the weights that it reads, at 128 pixels, and the vertex error that no picture
shows. ReenactNet takes no part (one step, nothing it draws is read), and the vertex loss, which is ours, is off. The
rig is source and target, so each training makes two BPNets, from other weights and pictures: both are measured.

`convolutional` is the published kind of network and of loss, mean absolute differences of colours and of weights, with
factors of 1, from configs/paper-kim2021.toml; smaller and shorter than there, so that all nine trainings take an hour
of a core. `components` is ours, whose pixel loss is in units of a rig's typical motion: the same factor asks for
far more there.

The paper finds both above L_w alone above L_r alone.

results/kim2021-table3.json    the numbers of each BPNet, two for each seed
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

from reenact.atomic import write_atomically
from reenact.config import BPNetConfig, Config, PairsConfig, TrainingConfig, load_config
from reenact.inference import ImageRetargeter
from reenact.suite import own_numbers
from reenact.training import train

ROOT = Path(__file__).parents[1]
LOSSES = {"L_r": (0.0, 1.0), "L_w": (1.0, 0.0), "L_w + L_r": (1.0, 1.0)}
PAPER = {"L_r": (34.409, 0.966), "L_w": (37.661, 0.973), "L_w + L_r": (38.650, 0.977)}
"""PSNR and SSIM on the paper's Man B."""


def convolutional(steps: int) -> Config:
    """The published settings at 64 pixels, with a quarter of the channels and a schedule that ends in less time."""
    paper = load_config(ROOT / "configs" / "paper-kim2021.toml")
    small = replace(paper.reenactnet, encoder_channels=8, seed_channels=16, decoder_channels=8)  # it is not used
    return replace(
        paper,
        images=replace(paper.images, resolution=64),
        reenactnet=small,
        training=replace(paper.training, epochs=None, steps=1, schedule="one-cycle"),
        bpnet=replace(paper.bpnet, epochs=None, steps=steps, batch_size=16, channels=16, learning_rate=1e-3),
    )


def components(steps: int) -> Config:
    """BPNet as it is by default, but for the vertex loss and the pictures that ReenactNet draws."""
    return Config(
        pairs=PairsConfig(method="none"),
        training=TrainingConfig(steps=1, together=False, refresh=0),
        bpnet=BPNetConfig(steps=steps, image_from=0.0, vertex_loss=0.0, decoded_fraction=0.0),
    )


NETWORKS = {"convolutional": convolutional, "components": components}


def measured(config: Config, rig: str, seed: int, weight_loss: float, image_loss: float) -> list[dict[str, float]]:
    """What each of two BPNets so trained reads."""
    with tempfile.TemporaryDirectory() as spare:
        config = replace(
            config,
            source=rig,
            target=rig,
            run=f"{spare}/run",
            training=replace(config.training, seed=seed),
            bpnet=replace(config.bpnet, weight_loss=weight_loss, image_loss=image_loss),
        )
        run = train(config)
        return [own_numbers(ImageRetargeter.load(run, reverse=reverse), seed) for reverse in (False, True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", choices=NETWORKS, default="convolutional")
    parser.add_argument("--rig", default="anny:toon")
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--losses", nargs="+", choices=LOSSES, default=list(LOSSES))
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    options = parser.parse_args()
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in options.losses}
    for seed in range(options.seeds):
        for name in rows:
            rows[name] += measured(NETWORKS[options.network](options.steps), options.rig, seed, *LOSSES[name])
            print(f"{name}, seed {seed}: {rows[name][-2:]}", flush=True)
    print("\n| loss | PSNR | SSIM | VER | paper, other rig: PSNR | SSIM |\n|---|---|---|---|---|---|")
    for name, numbers in rows.items():
        spread = [[each[key] for each in numbers] for key in ("psnr", "ssim", "ver")]
        shown = [f"{np.mean(each):.3f} ± {np.std(each):.3f}" for each in spread]
        print(f"| {name} | {' | '.join(shown)} | {' | '.join(map(str, PAPER[name]))} |")
    if set(rows) == set(LOSSES):
        psnr = {name: float(np.mean([each["psnr"] for each in numbers])) for name, numbers in rows.items()}
        ordered = psnr["L_w + L_r"] > psnr["L_w"] > psnr["L_r"]
        print(f"\nThe paper's order {'holds' if ordered else 'does not hold'} in PSNR.")
    path = options.out / "kim2021-table3.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    results[options.network] = {"rig": options.rig, "steps": options.steps, "losses": rows}
    write_atomically(path, (json.dumps(results, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
