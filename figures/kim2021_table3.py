"""BPNet's losses, Table 3 of Kim et al. 2021: weights (L_w), pixels (L_r), or both?

    python figures/kim2021_table3.py [--rig anny:toon] [--steps 800] [--seeds 3]

BPNet alone learns to read a rig's own renders, with each loss and all else equal, and is judged on held-out clips of
that rig: PSNR and SSIM of renders of the weights that it reads, at 128 pixels, and the vertex error that no picture
shows. ReenactNet takes no part (one step, nothing it draws is read), and the vertex loss, which is ours, is off.

The paper finds both above L_w alone above L_r alone.

results/kim2021-table3.json    the numbers of each seed
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
from reenact.config import BPNetConfig, Config, PairsConfig, TrainingConfig
from reenact.inference import ImageRetargeter
from reenact.suite import own_numbers
from reenact.training import train

LOSSES = {"L_r": (0.0, 1.0), "L_w": (1.0, 0.0), "L_w + L_r": (1.0, 1.0)}
PAPER = {"L_r": (34.409, 0.966), "L_w": (37.661, 0.973), "L_w + L_r": (38.650, 0.977)}
"""PSNR and SSIM on the paper's Man B."""


def measured(rig: str, steps: int, seed: int, weight_loss: float, image_loss: float) -> dict[str, float]:
    """What a BPNet so trained reads."""
    with tempfile.TemporaryDirectory() as spare:
        config = Config(
            source=rig,
            target=rig,
            run=f"{spare}/run",
            pairs=PairsConfig(method="none"),
            training=TrainingConfig(steps=1, together=False, refresh=0, seed=seed),
            bpnet=BPNetConfig(
                steps=steps,
                weight_loss=weight_loss,
                image_loss=image_loss,
                image_from=0.0,
                vertex_loss=0.0,
                decoded_fraction=0.0,
            ),
        )
        return own_numbers(ImageRetargeter.load(train(replace(config))), seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", default="anny:toon")
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results"))
    options = parser.parse_args()
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in LOSSES}
    for seed in range(options.seeds):
        for name, factors in LOSSES.items():
            rows[name].append(measured(options.rig, options.steps, seed, *factors))
            print(f"{name}, seed {seed}: {rows[name][-1]}", flush=True)
    print("\n| loss | PSNR | SSIM | VER | paper, other rig: PSNR | SSIM |\n|---|---|---|---|---|---|")
    for name, numbers in rows.items():
        spread = [[each[key] for each in numbers] for key in ("psnr", "ssim", "ver")]
        shown = [f"{np.mean(each):.3f} ± {np.std(each):.3f}" for each in spread]
        print(f"| {name} | {' | '.join(shown)} | {' | '.join(map(str, PAPER[name]))} |")
    psnr = {name: float(np.mean([each["psnr"] for each in numbers])) for name, numbers in rows.items()}
    print(
        f"\nThe paper's order {'holds' if psnr['L_w + L_r'] > psnr['L_w'] > psnr['L_r'] else 'does not hold'} in PSNR."
    )
    result = {"rig": options.rig, "steps": options.steps, "seeds": rows}
    write_atomically(options.out / "kim2021-table3.json", (json.dumps(result, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
