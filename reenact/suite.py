"""Every method on every pair of rigs, in one table: what a method is worth is what it is worth on faces not its own.

Held-out clips of six kinds, truth from names or, where a rig has other shapes than ARKit's, from the same head with
ARKit's. Cyclic numbers have no place here: they are small for anything that moves little.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from reenact.errors import ReenactError
from reenact.evaluation import contacts_of, held_out_clips, moving_vertices, true_numbers, true_weights
from reenact.retargeting import METHODS
from reenact.retargeting.correspondence import find_correspondence
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_rig
from reenact.rigs.rig import Rig

TARGETS = ("anny:woman", "anny:child", "anny:toon", "anny:merged", "anny:units")
"""Whom `anny:man` is retargeted to."""

REGIONS = {
    "mouth": ("jaw", "mouth", "tongue"),
    "eyes": ("eyelids", "gaze"),
    "brows": ("brows",),
}
"""Regions of `arkit.REGIONS` that numbers are given for."""


@dataclass(frozen=True)
class Row:
    """One method on one pair with one seed."""

    source: str
    target: str
    method: str
    seed: int
    set_up: float
    """Seconds, without finding the correspondence."""
    numbers: dict[str, Any]
    """Of `true_numbers`, and `ver_mouth`, `ver_eyes`, `ver_brows`; empty where the method cannot work on this pair."""
    failed: str = ""
    """Why not."""


def run_suite(
    pairs: Sequence[tuple[str, str]],
    methods: Sequence[str] = tuple(METHODS),
    frames: int = 600,
    seeds: Sequence[int] = (0,),
    markers: int = 300,
    say: Callable[[str], None] = lambda _: None,
) -> list[Row]:
    """Numbers of each method on each pair, with correspondences that are found.

    Args:
        pairs: Names or files of source and target.
        methods: Of `METHODS`.
        frames: Held-out frames in all.
        seeds: Of the clips.
        markers: Places that are found; methods that need a dense correspondence complete it.
        say: Told what is being done.

    Raises:
        ReenactError: An unknown method, or a rig that cannot be loaded.
    """
    for method in methods:
        if method not in METHODS:
            raise ReenactError(f"suite: expected methods among {', '.join(METHODS)}, got {method}")
    rows = []
    for source_name, target_name in pairs:
        source, target = load_rig(source_name), load_rig(target_name)
        say(f"{source.name} -> {target.name}: finding the correspondence")
        correspondence = find_correspondence(source, target, markers)
        trials = {seed: _trial(source, target, frames, seed) for seed in seeds}
        for method in methods:
            say(f"{source.name} -> {target.name}: {method}")
            rows += _measured(source, target, method, correspondence, trials)
    return rows


@dataclass(frozen=True)
class _Trial:
    clips: dict[str, Clip]
    known: Tensor
    truth: Tensor
    shared: list[int]


def _trial(source: Rig, target: Rig, frames: int, seed: int) -> _Trial:
    clips = held_out_clips(source.names, frames, seed)
    known, truth, shared = true_weights(source, target, torch.cat([clip.weights for clip in clips.values()]))
    if not shared:
        raise ReenactError(f"{source.name} to {target.name}: no shape has the same meaning by name, so nothing is true")
    return _Trial(clips, known, truth, shared)


def _measured(source: Rig, target: Rig, method: str, correspondence: Any, trials: dict[int, _Trial]) -> list[Row]:
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # shapes without a namesake are counted in the numbers
            retargeter = METHODS[method](source, target, correspondence)
    except ReenactError as error:
        return [Row(source.name, target.name, method, seed, 0.0, {}, str(error)) for seed in trials]
    set_up = time.perf_counter() - start
    rows = []
    for seed, trial in trials.items():
        spans, parts, at = [], [], 0
        for clip in trial.clips.values():  # clip by clip: some methods look at neighbours in time
            known = trial.known[at : at + len(clip)]
            parts.append(retargeter(Clip(source.names, known, clip.fps)).weights)
            spans.append(slice(at, at + len(clip)))
            at += len(clip)
        predicted = torch.cat(parts)
        numbers = true_numbers(target, predicted, trial.truth, trial.shared, slice(None), spans, contacts_of(target))
        for region, vertices in region_vertices(target).items():
            numbers[f"ver_{region}"] = _ratio_at(target, predicted, trial.truth, vertices)
        rows.append(Row(source.name, target.name, method, seed, set_up, numbers))
    return rows


def region_vertices(rig: Rig) -> dict[str, Int[Tensor, "N"]]:
    """Moving vertices of mouth, eyes and brows: each belongs to the region whose shapes move it farthest.

    Regions by ARKit's names; a built-in character with other shapes goes by its head with ARKit's.
    """
    from reenact.rigs import anny

    full = anny.with_arkit_shapes(rig.name) if rig.name in anny.CAST else rig
    known = [arkit.canonical(name) for name in full.names]
    moving = moving_vertices(rig)
    strength = []
    for words in REGIONS.values():
        shapes = {name for word in words for name in arkit.REGIONS[word]}
        rows = [index for index, name in enumerate(known) if name in shapes]
        motion = full.deltas[rows][:, moving].norm(dim=-1)
        strength.append(motion.amax(0) if rows else torch.zeros(len(moving)))
    owner = torch.stack(strength).argmax(0)
    return {region: moving[owner == index] for index, region in enumerate(REGIONS)}


def _ratio_at(rig: Rig, predicted: Tensor, truth: Tensor, vertices: Tensor) -> float:
    """VER over some vertices."""
    flat = rig.deltas[:, vertices].flatten(1)

    def lengths(weights: Tensor) -> float:
        return sum(float((part @ flat).unflatten(-1, (-1, 3)).norm(dim=-1).sum()) for part in weights.split(64))

    moved = lengths(truth)
    return lengths(predicted - truth) / moved if moved > 0 else 0.0


def table(rows: Sequence[Row], key: str = "ver") -> str:
    """A Markdown table of one number: a row per method, a column per pair, mean and spread over seeds."""
    pairs = list(dict.fromkeys((row.source, row.target) for row in rows))
    titles = [" to ".join(name.removeprefix("anny:") for name in pair) for pair in pairs]
    lines = [f"| {key} | {' | '.join(titles)} |"]
    lines.append("|---" * (1 + len(pairs)) + "|")
    for method in dict.fromkeys(row.method for row in rows):
        cells = []
        for pair in pairs:
            values = [
                _number(row.numbers, key) for row in rows if (row.source, row.target) == pair and row.method == method
            ]
            values = [value for value in values if value is not None]
            cells.append(f"{np.mean(values):.3f} ± {np.std(values):.3f}" if values else "-")
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _number(numbers: dict[str, Any], key: str) -> float | None:
    value: Any = numbers
    for word in key.split("."):
        value = value.get(word) if isinstance(value, dict) else None
    return None if value is None else float(value)
