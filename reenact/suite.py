"""Every method and every configuration of the networks on every pair of rigs: worth what it is worth on other faces.

One measurement for all of them: held-out clips of six kinds and, where one is given, a recorded take; truth from names
or, where a rig has other shapes than ARKit's, from the same head with ARKit's. Cyclic numbers stand beside the truth,
never alone: they are small for anything that moves little, and perfect for what smuggles weights through a wrong face.

A *cell* is one method on one pair with one seed. Cells are appended to a file as they are finished, so that a suite of
hours goes on where it stopped, several processes can share the work, and tables are drawn from what is there.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from reenact.config import Config, changed_settings
from reenact.errors import ReenactError
from reenact.evaluation import contacts_of, finite, held_out_clips, speed, true_numbers
from reenact.metrics import (
    image_mae,
    image_ssim,
    jitter,
    masked_mae,
    moving_vertices,
    psnr_of,
    skill,
    vertex_error_ratio,
    weight_metrics,
)
from reenact.portrait import Portrait
from reenact.retargeting import METHODS, Retargeter
from reenact.retargeting.correspondence import Correspondence, find_correspondence
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_clip, load_rig
from reenact.rigs.rig import Rig
from reenact.truth import true_return, true_weights

TARGETS = ("anny:woman", "anny:child", "anny:toon", "anny:merged", "anny:units")
"""Whom `anny:man` is retargeted to."""

REGIONS = {
    "mouth": ("jaw", "mouth", "tongue"),
    "eyes": ("eyelids", "gaze"),
    "brows": ("brows",),
}
"""Regions of `arkit.REGIONS` that numbers are given for."""

SHOWN_AT = 128
"""Pixels at which pictures are compared, whatever networks look at: the published resolution."""

_CHUNK = 64  # frames at a time: bounds memory, not results


@dataclass(frozen=True)
class Cell:
    """One method, or one configuration of the networks, on one pair with one seed."""

    source: str
    target: str
    method: str
    """A name in `METHODS`, or the name of a configuration."""
    seed: int
    """Of the clips, and of the training."""
    seconds: float
    """Of one core to set up a method, without finding the correspondence; of all cores to train networks."""
    numbers: dict[str, Any]
    """See `measure`; empty where the method cannot work on this pair."""
    failed: str = ""
    """Why not."""
    settings: dict[str, Any] | None = None
    """What the configuration of networks sets otherwise than the defaults; None for geometric methods."""
    code: str = ""
    """`code_version` that made the cell."""

    @property
    def key(self) -> tuple[str, str, str, int]:
        """Cells with equal keys are the same cell, made by the same code or not."""
        return self.source, self.target, self.method, self.seed


@dataclass(frozen=True)
class Trial:
    """What every method is asked on one pair with one seed, and what is right."""

    source: Rig
    target: Rig
    clips: dict[str, Clip]
    """Of the source, by kind; shapes whose meaning the target does not know rest."""
    truth: Float[Tensor, "T Kt"]
    """For all clips, one after the other."""
    shared: list[int]
    """Shapes of the target that the truth covers."""
    take: tuple[Clip, Tensor] | None
    """A recorded clip and its truth."""

    @classmethod
    def of(cls, source: Rig, target: Rig, frames: int, seed: int, take: str | None = None) -> Trial:
        """
        Args:
            source: Where motion comes from.
            target: Where it goes to.
            frames: Held-out frames in all.
            seed: Of the clips.
            take: A file with a recorded clip; only its first 600 frames are used.

        Raises:
            ReenactError: No name of the rigs tells what is right, or the take cannot be read.
        """
        made = held_out_clips(source.names, frames, seed)
        known, truth, shared = true_weights(source, target, torch.cat([clip.weights for clip in made.values()]))
        if not shared:
            raise ReenactError(
                f"{source.name} to {target.name}: no shape has the same meaning by name, so nothing is true"
            )
        parts = known.split([len(clip) for clip in made.values()])
        clips = {kind: replace(clip, weights=part) for (kind, clip), part in zip(made.items(), parts)}
        recorded = None
        if take is not None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # names without a shape are known of this take
                clip = load_clip(take, source)
            known, right, _ = true_weights(source, target, clip.weights[:600])
            recorded = (Clip(clip.names, known, clip.fps), right)
        return cls(source, target, clips, truth, shared, recorded)

    @property
    def spans(self) -> dict[str, slice]:
        """Frames of each kind within the truth."""
        spans, at = {}, 0
        for kind, clip in self.clips.items():
            spans[kind] = slice(at, at + len(clip))
            at += len(clip)
        return spans


def run_suite(
    pairs: Sequence[tuple[str, str]],
    methods: Sequence[str] = tuple(METHODS),
    frames: int = 600,
    seeds: Sequence[int] = (0,),
    markers: int = 300,
    say: Callable[[str], None] = lambda _: None,
    *,
    configs: dict[str, Config] | None = None,
    take: str | None = None,
    results: Path | None = None,
    runs: Path | None = None,
) -> list[Cell]:
    """Numbers of each geometric method and each configuration on each pair.

    Args:
        pairs: Names or files of source and target.
        methods: Of `METHODS`, with correspondences that are found.
        frames: Held-out frames in all.
        seeds: Of the clips, and of training.
        markers: Places that are found; methods that need a dense correspondence complete it.
        say: Told what is being done.
        configs: Settings of networks by name, to be trained on each pair with each seed.
        take: A recorded clip of ARKit shapes, measured as well.
        results: File of finished cells (JSON, one a line): those in it are not made again, new ones are appended.
        runs: Keep the run folders of the networks here, and go on with those that stopped; None trains them in a
            temporary folder.

    Raises:
        ReenactError: An unknown method, a rig that cannot be loaded, or a damaged file of results.
    """
    for method in methods:
        if method not in METHODS:
            raise ReenactError(f"suite: expected methods among {', '.join(METHODS)}, got {method}")
    kept = [] if results is None else load_cells(results)
    wanted = set()

    def missing(source: Rig, target: Rig, method: str) -> list[int]:
        nonlocal kept
        kept = kept if results is None else load_cells(results)  # another process may have made some meanwhile
        done = {cell.key for cell in kept}
        keys = {seed: (source.name, target.name, method, seed) for seed in seeds}
        wanted.update(keys.values())
        return [seed for seed, key in keys.items() if key not in done]

    def keep(cell: Cell) -> None:
        kept.append(cell)
        if results is not None:
            append_cell(results, cell)

    for source_name, target_name in pairs:
        source, target = load_rig(source_name), load_rig(target_name)
        correspondence, trials = None, {}

        def trial(seed: int, source: Rig = source, target: Rig = target, trials: dict = trials) -> Trial:
            if seed not in trials:
                trials[seed] = Trial.of(source, target, frames, seed, take)
            return trials[seed]

        for method in methods:
            todo = missing(source, target, method)
            if todo and correspondence is None:
                say(f"{source.name} -> {target.name}: finding the correspondence")
                correspondence = find_correspondence(source, target, markers)
            if todo:
                say(f"{source.name} -> {target.name}: {method}")
                for cell in _geometric_cells(method, correspondence, {seed: trial(seed) for seed in todo}):
                    keep(cell)
        for name, config in (configs or {}).items():
            for seed in missing(source, target, name):
                say(f"{source.name} -> {target.name}: training {name}, seed {seed}")
                keep(
                    _network_cell(
                        name, replace(config, source=source_name, target=target_name), trial(seed), seed, runs
                    )
                )
    return [cell for cell in kept if cell.key in wanted]


def _geometric_cells(method: str, correspondence: Correspondence | None, trials: dict[int, Trial]) -> list[Cell]:
    first = next(iter(trials.values()))
    source, target = first.source, first.target

    def cell(seed: int, **others: Any) -> Cell:
        return Cell(source.name, target.name, method, seed, code=code_version(), **others)

    start = time.thread_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shapes without a namesake are counted in the numbers
        try:
            forward = METHODS[method](source, target, correspondence)
        except ReenactError as error:
            return [cell(seed, seconds=0.0, numbers={}, failed=str(error)) for seed in trials]
        set_up = time.thread_time() - start
        try:
            reverse = METHODS[method](target, source, correspondence and correspondence.reversed())
        except ReenactError:
            reverse = None
    return [cell(seed, seconds=set_up, numbers=measure(forward, reverse, trial)) for seed, trial in trials.items()]


def _network_cell(name: str, config: Config, trial: Trial, seed: int, runs: Path | None) -> Cell:
    """Networks trained and measured. Their own seed is the clips' seed."""
    from reenact.inference import ImageRetargeter
    from reenact.training import train

    with tempfile.TemporaryDirectory() as spare:
        title = re.sub(r"[^A-Za-z0-9_-]+", "-", f"{name}-{trial.source.name}-{trial.target.name}-{seed}")
        folder = (runs or Path(spare)) / title
        config = replace(config, run=str(folder), training=replace(config.training, seed=seed))
        before = time.process_time()
        train(config, resume=(folder / "config.toml").exists())
        seconds = time.process_time() - before
        forward, reverse = ImageRetargeter.load(folder), ImageRetargeter.load(folder, reverse=True)
        told = forward.paired(_weights(trial))
        numbers = measure(forward, reverse, trial) | {
            "own": own_numbers(forward, seed),
            "taught": None if told is None else vertex_error_ratio(trial.target, told, trial.truth),
            "speed": speed(forward, _weights(trial), 300, 20),
        }
        if runs is not None:  # only what is needed to use it
            for checkpoint in sorted((folder / "checkpoints").iterdir())[:-1]:
                if checkpoint.is_dir():
                    shutil.rmtree(checkpoint)
    ignored = ("run", "source", "target", "training.seed", "training.threads")
    settings = {key: value for key, value in changed_settings(Config(), config).items() if key not in ignored}
    return Cell(trial.source.name, trial.target.name, name, seed, seconds, numbers, "", settings, code_version())


def _weights(trial: Trial) -> Tensor:
    return torch.cat([clip.weights for clip in trial.clips.values()])


@torch.no_grad()
def measure(forward: Retargeter, reverse: Retargeter | None, trial: Trial) -> dict[str, Any]:
    """All numbers of one method on one pair.

    Args:
        forward: Asked for the target's weights.
        reverse: Asked for the source's weights of those, for the cyclic numbers; None leaves them out.
        trial: What is asked and what is right.

    Returns:
        What `true_numbers` says of all frames; `ver_mouth`, `ver_eyes`, `ver_brows`; `kinds`, the VER of each kind of
        clip; `take`, the VER, correlation and jitter of the recorded one; `single`, of single shapes: the share whose
        strongest answer is the right one, and the share of energy that goes elsewhere; `cyclic`: `mae`, `ssim`,
        `mae_masked`, `skill`, `skill_masked`, `wmae`, `ver` of the recovered weights, pictures at `SHOWN_AT` pixels.
    """
    source, target, spans = trial.source, trial.target, trial.spans
    # Clip by clip: some methods look at neighbours in time.
    answers = {kind: forward(clip) for kind, clip in trial.clips.items()}
    predicted = torch.cat([answer.weights for answer in answers.values()]).float()
    numbers = true_numbers(
        target, predicted, trial.truth, trial.shared, slice(None), list(spans.values()), contacts_of(target)
    )
    for region, vertices in region_vertices(target).items():
        numbers[f"ver_{region}"] = _ratio_at(target, predicted, trial.truth, vertices)
    numbers["kinds"] = {
        kind: vertex_error_ratio(target, predicted[span], trial.truth[span]) for kind, span in spans.items()
    }
    numbers["single"] = _single_shapes(forward, trial)
    if trial.take is not None:
        clip, right = trial.take
        answer = forward(clip).weights.float()
        numbers["take"] = {
            "ver": vertex_error_ratio(target, answer, right),
            "correlation": weight_metrics(answer[:, trial.shared], right[:, trial.shared])["correlation"],
            "jitter": jitter(answer[:, trial.shared], right[:, trial.shared]),
        }
    if reverse is not None:
        recovered = torch.cat([reverse(answer).weights for answer in answers.values()]).float()
        numbers["cyclic"] = recovered_numbers(source, recovered, _weights(trial))
    return finite(numbers)


@torch.no_grad()
def recovered_numbers(
    rig: Rig, recovered: Float[Tensor, "T K"], original: Float[Tensor, "T K"], resolution: int = SHOWN_AT
) -> dict[str, float]:
    """Pictures of recovered weights against those of the original ones, in the rig's own colours.

    Returns:
        `mae`, `ssim` and `psnr` over the full picture, as published, `mae_masked` over the face; `skill` and
        `skill_masked`, what is gained on a face that does not move; `wmae` and `ver` of the weights.

    Source: Kim et al. 2021, Sec. 4, for the protocol; skill and masks are ours.
    """
    portrait = Portrait.of(rig)
    rest = portrait.render(rig.neutral[None], resolution)["color"]
    sums = dict.fromkeys(("mae", "ssim", "mse", "mae_masked", "still", "still_masked"), 0.0)
    for there, back in zip(original.split(_CHUNK), recovered.split(_CHUNK)):
        shown = portrait.render(rig.vertices(there), resolution, ("color", "mask"))
        again = portrait.render(rig.vertices(back), resolution)["color"]
        still = rest.expand_as(again)
        sums["mae"] += float(image_mae(again, shown["color"]).sum())
        sums["ssim"] += float(image_ssim(again, shown["color"]).sum())
        sums["mse"] += float((again - shown["color"]).double().square().mean((1, 2, 3)).sum())
        sums["mae_masked"] += float(masked_mae(again, shown["color"], shown["mask"]).sum())
        sums["still"] += float(image_mae(still, shown["color"]).sum())
        sums["still_masked"] += float(masked_mae(still, shown["color"], shown["mask"]).sum())
    means = {name: value / len(original) for name, value in sums.items()}
    return {
        **{name: means[name] for name in ("mae", "ssim", "mae_masked")},
        "psnr": psnr_of(means["mse"]),
        "skill": skill(means["mae"], means["still"]),
        "skill_masked": skill(means["mae_masked"], means["still_masked"]),
        "wmae": float((recovered - original).abs().mean()),
        "ver": vertex_error_ratio(rig, recovered, original),
    }


def best_return(trial: Trial) -> dict[str, float]:
    """The cyclic numbers of the truth itself, see `true_return`: about what a faithful method can reach at most."""
    return recovered_numbers(trial.source, true_return(trial.source, trial.target, trial.truth), _weights(trial))


def _single_shapes(forward: Retargeter, trial: Trial) -> dict[str, float]:
    """Of shapes that move the target alone: is the right one the strongest answer, and how much goes elsewhere."""
    known, right, _ = true_weights(trial.source, trial.target, torch.eye(len(trial.source.names)))
    asked = (known.amax(1) > 0.5) & (right.amax(1) > 0.25)
    answer = forward(Clip(trial.source.names, known[asked], 30.0)).weights.float()
    best = right[asked].argmax(1)
    energy = answer.square().sum(1).clamp_min(1e-12)
    elsewhere = 1 - answer.gather(1, best[:, None])[:, 0].square() / energy
    return {
        "asked": float(asked.sum()),
        "right": float((answer.argmax(1) == best).float().mean()),
        "elsewhere": float(elsewhere.mean()),
    }


@torch.no_grad()
def own_numbers(forward: Any, seed: int) -> dict[str, float]:
    """BPNet alone, on pictures of the target's own clips: VER, weight error, and PSNR and SSIM of renders.

    Args:
        forward: An `ImageRetargeter`.
        seed: Of the clips.
    """
    target = forward.target
    clips = held_out_clips(target.names, 300, seed + 50)  # other clips than the source's
    weights = torch.cat([clip.weights for clip in clips.values()])
    read = torch.cat([forward.read(forward.target_pictures(part)) for part in weights.split(_CHUNK)])
    seen = recovered_numbers(target, read, weights)
    return {name: seen[name] for name in ("ver", "wmae", "psnr", "ssim")}


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
        return sum(float((part @ flat).unflatten(-1, (-1, 3)).norm(dim=-1).sum()) for part in weights.split(_CHUNK))

    moved = lengths(truth)
    return lengths(predicted - truth) / moved if moved > 0 else 0.0


# ---- results ----


@cache
def code_version() -> str:
    """Twelve digits that change when the code changes that numbers depend on; comments and docstrings do not count."""
    import reenact
    import render

    digest = hashlib.sha256()
    for package in (reenact, render):
        root = Path(package.__file__).parent
        for path in sorted(root.rglob("*.py")):
            if "viewer" in path.parts or path.stem in ("cli", "report", "preview", "inspection", "doctor"):
                continue
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(ast.dump(_without_docstrings(ast.parse(path.read_bytes()))).encode())
    return digest.hexdigest()[:12]


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [
                each for each in body if not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant))
            ]
    return tree


def load_cells(path: Path) -> list[Cell]:
    """Finished cells, the last of each key; none where there is no file.

    Raises:
        ReenactError: A line is not a cell.
    """
    if not path.exists():
        return []
    cells: dict[tuple, Cell] = {}
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip():
            continue
        try:
            cell = Cell(**json.loads(line))
        except (ValueError, TypeError) as error:
            raise ReenactError(
                f"{path}, line {number}: expected a cell of a suite, got something else ({error}); remove the line"
            ) from error
        cells[cell.key] = cell
    return list(cells.values())


def append_cell(path: Path, cell: Cell) -> None:
    """One more line, written at once, so that two processes do not mix theirs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(finite(asdict(cell))) + "\n")


def table(cells: Sequence[Cell], key: str = "ver") -> str:
    """A Markdown table of one number: a row per method, a column per pair, mean and spread over seeds."""
    pairs = list(dict.fromkeys((cell.source, cell.target) for cell in cells))
    titles = [" to ".join(name.removeprefix("anny:") for name in pair) for pair in pairs]
    lines = [f"| {key} | {' | '.join(titles)} |"]
    lines.append("|---" * (1 + len(pairs)) + "|")
    for method in dict.fromkeys(cell.method for cell in cells):
        row = []
        for pair in pairs:
            values = [
                number(cell, key) for cell in cells if (cell.source, cell.target) == pair and cell.method == method
            ]
            values = [value for value in values if value is not None]
            row.append(f"{np.mean(values):.3f} ± {np.std(values):.3f}" if values else "-")
        lines.append(f"| {method} | " + " | ".join(row) + " |")
    return "\n".join(lines)


def versions(cells: Sequence[Cell]) -> str:
    """A sentence on whether one code made all cells."""
    found = sorted({cell.code for cell in cells if cell.code})
    if len(found) <= 1:
        return f"{len(cells)} cells of one code version ({', '.join(found) or 'unknown'})."
    return f"{len(cells)} cells of {len(found)} code versions ({', '.join(found)}): compare with care."


def number(cell: Cell, key: str) -> float | None:
    """A number by its dotted name; None where the cell lacks it."""
    value: Any = cell.numbers
    for word in key.split("."):
        value = value.get(word) if isinstance(value, dict) else None
    return None if value is None else float(value)
