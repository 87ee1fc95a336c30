"""The cyclic errors of Kim et al. 2021, Table 2, on characters that anyone can have.

    python figures/kim2021_table2.py [--results results/transfer.jsonl] [--config configs/demo.toml] [--seeds 3]

There and back between anny:man and five targets: held-out clips are retargeted, retargeted back by the same run's other
half, and renders of the recovered weights are compared with those of the original ones, at 128 pixels, in the
characters' own colours. Cells that the results file lacks are trained first, some minutes each.

The paper's rigs cannot be had, so its column says what its authors saw on theirs, not how ours compare on the same
faces. Skill (1 - MAE / MAE of a still face) and the error against the truth stand beside the cyclic numbers, because
those alone are good for anything that moves little. The last column is the skill of right weights both ways: a face
that cannot show an expression cannot give it back.

results/kim2021-table2.json    the table's numbers
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from reenact.atomic import write_atomically
from reenact.config import load_config
from reenact.rigs.files import load_rig
from reenact.suite import TARGETS, Trial, best_return, number, run_suite, versions

PAPER = {"Mery": (0.016, 0.895), "Polywink": (0.016, 0.892), "Man A": (0.016, 0.893), "Man B": (0.016, 0.894)}
PAPER |= {"Man C": (0.017, 0.886)}
"""MAE and SSIM of Victor to each and back."""
FRAMES = 600
"""Held out, of each cell."""
TRUTH = "cyclic.skill of the truth"
"""The last column, see `reenact.truth.true_return`."""
COLUMNS = ("cyclic.mae", "cyclic.ssim", "cyclic.skill", "cyclic.mae_masked", "cyclic.skill_masked", "ver")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results/transfer.jsonl"))
    parser.add_argument("--config", type=Path, default=Path("configs/demo.toml"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results"))
    options = parser.parse_args()
    cells = run_suite(
        [("anny:man", name) for name in TARGETS],
        (),
        FRAMES,
        seeds=tuple(range(options.seeds)),
        say=print,
        configs={options.config.stem: load_config(options.config)},
        results=options.results,
    )
    rows = {}
    print(f"\n| there and back | {' | '.join((*COLUMNS, TRUTH))} |")
    print("|---" * (2 + len(COLUMNS)) + "|")
    for target in TARGETS:
        mine = [cell for cell in cells if cell.target == target]
        values = {key: [number(cell, key) for cell in mine] for key in COLUMNS}
        trials = [Trial.of(load_rig(cell.source), load_rig(cell.target), FRAMES, cell.seed) for cell in mine]
        values[TRUTH] = [best_return(trial)["skill"] for trial in trials]
        rows[target] = {key: {"mean": float(np.mean(each)), "seeds": each} for key, each in values.items()}
        shown = [f"{np.mean(each):.4f} ± {np.std(each):.4f}" for each in values.values()]
        print(f"| {target} | {' | '.join(shown)} |")
    for name, (mae, ssim) in PAPER.items():
        print(f"| {name} (the paper's rig, published) | {mae} | {ssim} | - | - | - | - | - |")
    print(f"\n{versions(cells)}")
    write_atomically(options.out / "kim2021-table2.json", (json.dumps(rows, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
