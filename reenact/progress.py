"""Progress: how far the training of a run is, read from its folder while somebody else writes there."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reenact.checkpoint import newest_step
from reenact.holdout import NUMBER, OWN
from reenact.lock import is_training
from reenact.run import Run
from reenact.stages import planned_steps
from reenact.training import next_save, parsed_line

_POINTS = 300
"""Points of a curve at most; each is the mean of what lies around it."""
_RECENT, _LONG = 10, 100
"""Lines of metrics.jsonl that tell how fast steps are; and how long the rest takes, as some hold the rendering of new
expressions. So does the first, which tells of neither."""


@dataclass(frozen=True)
class Progress:
    """What there is to say of a training, at one moment."""

    state: str
    """"training", "finished" or "stopped"; also stopped before it ever began."""
    stage: str
    """The one at work, or the last one."""
    step: int
    """Steps of that stage that are done and logged, of `steps`."""
    steps: int
    done: int
    """Steps of all stages, of `total`."""
    total: int
    steps_per_second: float | None
    """Over the last two hundred steps, the rendering of new expressions left out; None before the first."""
    seconds_left: float | None
    """For all stages, should they go on like this; None unless it trains."""
    checkpoint: int | None
    """Steps, over all stages, of the newest one."""
    next_checkpoint: int
    """Steps, over all stages, at which the first or the following one is due."""
    previews: list[int]
    """Steps, over all stages, at which there is a picture."""
    losses: dict[str, list[tuple[float, float]]]
    """By kind, summed over rigs: steps over all stages, and the loss. "loss" is the sum of all kinds. "held out" is no
    loss but the number that checkpoints are compared by; see `reenact.holdout`."""


def read_progress(run: Run) -> Progress:
    """How far a run is.

    Raises:
        OSError: What it has logged cannot be read.
    """
    folder, plan = run.folder, planned_steps(run.config, run.keys)
    before = dict(zip(plan, np.cumsum([0, *plan.values()]).tolist()))
    total, lines = sum(plan.values()), _lines(folder / "metrics.jsonl", plan)
    stage, step = (lines[-1][0], lines[-1][1]) if lines else (next(iter(plan)), 0)
    done, saved = before[stage] + step, newest_step(folder)
    speeds = [numbers["steps_per_second"] for *_, numbers in lines if numbers.get("steps_per_second", 0) > 0]
    known = speeds[1:] or speeds
    pace = statistics.harmonic_mean(known[-_LONG:]) if known else None  # for each speaks of as many steps
    state = "finished" if saved == total else "training" if is_training(folder) else "stopped"
    due = before[stage] + next_save(run.config.training, step, plan[stage], before[stage])
    return Progress(
        state=state,
        stage=stage,
        step=step,
        steps=plan[stage],
        done=done,
        total=total,
        steps_per_second=statistics.median(known[-_RECENT:]) if known else None,
        seconds_left=(total - done) / pace if pace and state == "training" else None,
        checkpoint=saved,
        next_checkpoint=due,
        previews=sorted(int(path.stem) for path in (folder / "previews").glob("*.png") if path.stem.isdecimal()),
        losses=_curves([(float(before[name] + step), numbers) for name, step, numbers in lines]),
    )


def preview_file(run: Run, step: int) -> Path:
    """Where the picture of a step, over all stages, lies."""
    return run.folder / "previews" / f"{step:06d}.png"


def _lines(path: Path, plan: dict[str, int]) -> list[tuple[str, int, dict[str, float]]]:
    """Stage, step and numbers of each whole line; the last may be half written."""
    try:
        text = path.read_text("utf-8", errors="replace")
    except FileNotFoundError:
        return []
    found = []
    for line in filter(None, map(parsed_line, text.splitlines())):
        numbers = {name: value for name, value in line.items() if isinstance(value, float) and math.isfinite(value)}
        if line["stage"] in plan:
            found.append((line["stage"], line["step"], numbers))
    return found


def _curves(rows: list[tuple[float, dict[str, float]]]) -> dict[str, list[tuple[float, float]]]:
    curves: dict[str, list[tuple[float, float]]] = {}
    for step, numbers in rows:
        kinds: dict[str, float] = {}
        for name, value in numbers.items():
            kind = name.split(".")[0]
            if name == NUMBER:
                kinds["held out"] = value
            elif kind not in (NUMBER, OWN, "steps_per_second"):
                kinds[kind] = kinds.get(kind, 0.0) + value
        for kind, value in kinds.items():
            curves.setdefault(kind, []).append((step, value))
    return {kind: _thinned(points) for kind, points in curves.items()}


def _thinned(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    parts = np.array_split(np.array(points, dtype=float), min(len(points), _POINTS))
    return [tuple(part.mean(0).round(6).tolist()) for part in parts]
