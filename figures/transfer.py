"""The tables of networks in README.md and docs/experiments.md, drawn from the finished cells of the suite.

    python figures/transfer.py [--results results/transfer.jsonl] [--method demo] [--short]

Prints Markdown: a column per pair, mean and standard deviation over the seeds that there are. It trains nothing; the
cells are made by `reenact evaluate --suite transfer --configs configs/demo.toml --results results/transfer.jsonl`.

The row of the truth says what comes back where weights are right both ways: a head that cannot show an expression
cannot give it back, so that row, not 1, is what the cyclic skill above it can reach. It is made here, which takes some
seconds per column.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from reenact.errors import ReenactError
from reenact.rigs.files import load_rig
from reenact.suite import TARGETS, Cell, Trial, best_return, load_cells, number, versions

ROWS = {
    "**VER**": ("**ver:.3f**",),
    "the labels that taught, without networks": ("taught:.3f",),
    "VER of mouth / eyes / brows": ("ver_mouth:.2f", "ver_eyes:.2f", "ver_brows:.2f"),
    "weight error, correlation, gain": ("wmae:.3f", "correlation:.2f", "gain:.2f"),
    "lip contact, blinks: F1": ("lips.contact_f1:.2f", "lids.blink_f1:.2f"),
    "single shapes whose strongest answer is right": ("single.right:.2f",),
    "jitter (1 is the truth's)": ("jitter:.2f",),
    "recorded take: VER, jitter": ("take.ver:.3f", "take.jitter:.1f"),
    "cyclic at 128 pixels: MAE, SSIM": ("cyclic.mae:.4f", "cyclic.ssim:.3f"),
    "cyclic skill": ("cyclic.skill:.2f",),
    "BPNet on its own rig: VER": ("own.ver:.3f",),
    "the same: PSNR, SSIM at 128 pixels": ("own.psnr:.1f", "own.ssim:.3f"),
    "seconds of a core to train": ("seconds:.0f",),
}
"""Title and numbers, each the dotted name of `suite.measure` and its format; in stars where it is bold."""

SHORT = (
    "**VER**",
    "the labels that taught, without networks",
    "lip contact, blinks: F1",
    "recorded take: VER, jitter",
    "cyclic at 128 pixels: MAE, SSIM",
    "cyclic skill",
)
"""The rows that README.md has of these; that of delta transfer is from results/geometric.jsonl, see docs/methods.md."""


def shown(cells: Sequence[Cell], kind: str, alone: bool) -> str:
    """Mean of one number over seeds; with its standard deviation where it stands alone and there are several.

    Args:
        cells: One for each seed.
        kind: Name and format, as in `ROWS`.
        alone: Whether the row has no other numbers.
    """
    stars = "**" if kind.startswith("**") else ""
    name, _, how = kind.strip("*").partition(":")
    values = [cell.seconds if name == "seconds" else number(cell, name) for cell in cells]
    values = [value for value in values if value is not None]
    if not values:
        return "-"
    spread = f" ± {np.std(values):{how}}" if alone and len(values) > 1 else ""
    return f"{stars}{np.mean(values):{how}}{spread}{stars}"


def ceiling(cells: Sequence[Cell], frames: int, files: dict[str, str]) -> str:
    """The truth's cyclic skill on the clips of these cells; the names of the rigs must be known."""
    try:
        source, target = (load_rig(files.get(name, name)) for name in (cells[0].source, cells[0].target))
    except ReenactError:
        return "-"
    skills = [best_return(Trial.of(source, target, frames, cell.seed))["skill"] for cell in cells]
    return f"{np.mean(skills):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results/transfer.jsonl"))
    parser.add_argument("--method", default="demo", help="the name of a configuration")
    parser.add_argument("--frames", type=int, default=600, help="held-out frames of the cells")
    parser.add_argument("--rigs", nargs="*", default=[], help="files of rigs that are not built in")
    parser.add_argument("--short", action="store_true", help="only the rows of README.md")
    options = parser.parse_args()
    files = {Path(path).stem: path for path in options.rigs}
    cells = sorted(
        (cell for cell in load_cells(options.results) if cell.method == options.method and not cell.failed),
        key=lambda cell: cell.seed,
    )
    columns: dict[tuple[str, str], list[Cell]] = {("anny:man", name): [] for name in TARGETS}
    for cell in cells:
        columns.setdefault((cell.source, cell.target), []).append(cell)
    columns = {pair: each for pair, each in columns.items() if each}
    print(f"| | {' | '.join(' to '.join(name.removeprefix('anny:') for name in pair) for pair in columns)} |")
    print("|---" * (1 + len(columns)) + "|")
    print(f"| seeds | {' | '.join(', '.join(str(cell.seed) for cell in each) for each in columns.values())} |")
    for title, kinds in ROWS.items():
        if options.short and title not in SHORT:
            continue
        row = [", ".join(shown(each, kind, len(kinds) == 1) for kind in kinds) for each in columns.values()]
        print(f"| {title} | {' | '.join(row)} |")
        if title == "cyclic skill":
            row = [ceiling(each, options.frames, files) for each in columns.values()]
            print(f"| cyclic skill of the truth | {' | '.join(row)} |", flush=True)
    print(f"\n{versions(cells)}")


if __name__ == "__main__":
    main()
