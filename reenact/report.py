"""Report: what a run is worth, on one page that anyone can open, print or send.

`write_report` turns the numbers of `reenact.evaluation` into RUN/report.html: two faces moving side by side, a verdict
in plain words, the numbers beside the trivial baselines, the worst frames first, curves of every shape, what each shape
does alone, error on the face. The page holds all of its pictures and asks no server for anything.
`python -m reenact.report RUN [RUN ...]` remakes it without evaluating.
"""

from __future__ import annotations

import base64
import io
import json
import shlex
import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np
import torch
from PIL import Image
from rich.console import Console
from torch import Tensor

from reenact.atomic import write_atomically
from reenact.errors import ReenactError
from reenact.evaluation import KINDS, PictureRetargeter, finite
from reenact.holdout import NUMBER
from reenact.metrics import vertex_errors
from reenact.portrait import Portrait
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig
from reenact.training import parsed_line
from reenact.truth import true_weights

PLAYER_FRAMES = 96
"""Frames in the player, shared by the runs of a page."""
PLAYER_SIZE = 256
"""Pixels of the faces in the player."""
SHEET_SIZE = 144
"""Pixels of the faces in contact sheets."""
HEAT_SIZE = 320
"""Pixels of the faces that show where the error is."""
MOST_SHAPES = 90
"""Rows of the table of single shapes; more could not be read."""

_HEAT = "OrRd"  # light where nothing is: shading stays visible
_PLAYED = ("mixed", "emotion")  # kinds of clips that the player shows: what a newcomer takes for a performance
_BASELINES = {"neutral": "neutral, never moves", "mean_pose": "mean pose", "shuffled": "shuffled truth"}
_KIND_TITLES = {
    "mixed": "everything at once",
    "speech": "speech",
    "emotion": "emotions",
    "expressions": "random expressions",
    "blinks": "blinks",
    "ramps": "one shape at a time",
}


def write_report(
    run_dirs: list[Path],
    results: list[dict],
    load: Callable[[Path], PictureRetargeter] | None = None,
) -> Path:
    """One self-contained page about the runs, in the first run's folder.

    Args:
        run_dirs: Folders of evaluated runs.
        results: What `reenact.evaluation.evaluate` returned for each, or its metrics.json.
        load: Retargeter of a run folder, for the pictures; None loads the networks that were evaluated.

    Returns:
        Path of the page, RUN/report.html.

    Raises:
        ReenactError: No run; a run was not evaluated.
    """
    if not run_dirs or len(run_dirs) != len(results):
        raise ReenactError(
            f"report: expected one result for each of at least one run, got {len(results)} for {len(run_dirs)}; "
            "evaluate the runs first"
        )
    if load is None:
        from reenact.inference import ImageRetargeter

        def load(folder: Path) -> PictureRetargeter:
            step = next(each.get("checkpoint") for run, each in zip(run_dirs, results) if Path(run) == folder)
            return ImageRetargeter.load(folder, **({} if step is None else {"checkpoint": str(step)}))

    share = max(24, PLAYER_FRAMES // len(run_dirs))  # a page of many runs stays small enough to send
    runs = [
        _run(index, Path(folder), finite(result), load, share)
        for index, (folder, result) in enumerate(zip(run_dirs, results, strict=True))
    ]
    together = _together(runs)
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("reenact").joinpath("report.html").read_text(encoding="utf-8"))
    page = template.render(
        title=f"{runs[0]['source']} → {runs[0]['target']}" if len(runs) == 1 else f"{len(runs)} runs",
        runs=runs,
        players=[run["player"]["script"] for run in runs],
        curves=[run["every_curve"] for run in runs],
        together=together,
        comparison=_comparison(runs) if len(runs) > 1 else [],
        one_direction=len({(run["source"], run["target"]) for run in runs}) == 1,
        compared=compared(runs) if len(runs) > 1 else "",
        shared=_shared_commands(run_dirs, results) if len(runs) > 1 else [],
    )
    path = Path(run_dirs[0]) / "report.html"
    write_atomically(path, page.encode())
    return path


def verdict(result: dict[str, Any]) -> str:
    """A paragraph for someone who has never heard of the numbers: how good, against what, and where it is lost."""
    source, target, truth = result["source"], result["target"], result.get("truth")
    opening = f"This run learned to move expressions from {source} to {target} without paired examples. "
    skill = result["cyclic"]["skill"]
    if truth is None or truth["ver"] is None:
        return opening + (
            "The two rigs share no shape name, so there is no known right answer: judge by the pictures. "
            f"Retargeted there and back, {_percent(skill)} of the picture error of a still face is gone, which is "
            "necessary but proves nothing about the face in between."
        )
    ver = truth["ver"]
    low, high = truth["ver_interval"]
    parts = [
        opening,
        f"On {result['frames']:,} frames it has never seen, the target's surface misses its place by {_percent(ver)} "
        f"of the motion it should make (VER {ver:.2f}, 95 % interval {_fixed(low)} to {_fixed(high)}; 0 is exact, 1 is "
        f"a face that never moves): {_grade(ver)}. ",
    ]
    trivial = {
        name: baseline["truth"]["ver"]
        for name, baseline in result["baselines"].items()
        if baseline["truth"] and baseline["truth"]["ver"] is not None
    }
    if trivial:
        best = min(trivial, key=lambda name: trivial[name])
        compared = "beats" if ver < trivial[best] else "does not beat"
        parts.append(f"It {compared} the best trivial answer ({_BASELINES[best]}, {trivial[best]:.2f}). ")
    direct = (result["direct"]["truth"] or {}).get("ver")
    if direct is not None:
        parts.append(
            f"Without ReenactNet in between it is {direct:.2f}"
            + (", so ReenactNet earns its place. " if ver < direct else ", so ReenactNet does not help here. ")
        )
    paired = ((result.get("paired") or {}).get("truth") or {}).get("ver")
    if paired is not None:
        parts.append(
            f"The labels that taught the networks reach {paired:.2f} without any network"
            + (": on these rigs, copying by look is better. " if paired < ver else ". ")
        )
    floor = result["bpnet"]["ver"]
    if floor is not None:
        parts.append(f"BPNet reads true pictures of the target at {floor:.2f}")
        if floor < 0.5 * ver:
            parts.append(": most of what is lost is lost between the two faces. ")
        else:
            parts.append(": reading weights from pictures is a large part of what is lost. ")
    gain = truth["gain"]
    if gain is not None and not 0.8 <= gain <= 1.25:
        parts.append(f"Shapes move {'too little' if gain < 1 else 'too far'} (gain {gain:.2f}). ")
    kinds = {
        kind: numbers["truth"]["ver"]
        for kind, numbers in result["kinds"].items()
        if numbers["truth"] and numbers["truth"]["ver"] is not None
    }
    if len(kinds) > 1:
        worst = max(kinds, key=lambda kind: kinds[kind])
        parts.append(f"It is weakest on {_KIND_TITLES.get(worst, worst)} ({kinds[worst]:.2f}).")
    return "".join(parts).strip()


# One run -------------------------------------------------------------------------------------------------------------


def _run(
    index: int, folder: Path, result: dict[str, Any], load: Callable[[Path], PictureRetargeter], share: int
) -> dict[str, Any]:
    """What the template shows of one run."""
    stored = folder / "evaluation" / "frames.npz"
    if not stored.is_file():
        raise ReenactError(
            f"{stored}: expected the frames of an evaluation, found none; run `reenact evaluate {folder}`"
        )
    with np.load(stored) as archive:
        arrays = {name: archive[name] for name in archive.files}
    forward = load(folder)
    frames = _player_frames(arrays["kind"], share)
    has_truth = result.get("truth") is not None
    maps, limit = _maps(arrays, result)
    return {
        "name": folder.resolve().name,
        "source": result["source"],
        "target": result["target"],
        "frames": f"{result['frames']:,}",
        "result": result,
        "has_truth": has_truth,
        "has_contacts": has_truth and "lids" in result["truth"],
        "verdict": verdict(result),
        "facts": _facts(folder, result),
        "figures": _figures(result),
        "player": _player(index, forward, arrays, frames),
        "moved": arrays["source"][frames],
        "methods": _methods(result),
        "kinds": _kinds(result),
        "sheets": _sheets(forward, arrays, result),
        "curves": _curves(forward.target, arrays, _span(frames)),
        "every_curve": _every_curve(forward.target, arrays, result),
        "alone": _alone(forward),
        "heat": _heat(forward.target, arrays),
        "curve_length": len(_span(frames)),
        "cuts": _cuts(arrays["kind"][_span(frames)]),
        "maps": maps,
        "map_limit": limit,
        "legend": _picture(_colored(np.linspace(0, 1, 256)[None].repeat(4, 0), 1.0), "PNG"),
        "training": _training(folder / "metrics.jsonl"),
        "commands": _commands(folder, result),
    }


def _figures(result: dict[str, Any]) -> list[dict[str, str]]:
    truth, bpnet, speed = result.get("truth"), result["bpnet"], result["speed"]
    figures = []
    if truth:
        low, high = truth["ver_interval"]
        figures += [
            {
                "title": "VER",
                "value": _fixed(truth["ver"]),
                "note": f"0 exact, 1 never moves; {_fixed(low)}–{_fixed(high)}",
            },
            {"title": "Correlation", "value": _fixed(truth["correlation"]), "note": "right shapes at the right time"},
            {"title": "Gain", "value": _fixed(truth["gain"]), "note": "1 is the right range of motion"},
        ]
    figures += [
        {"title": "Cyclic skill", "value": _fixed(result["cyclic"]["skill"]), "note": "there and back, in pictures"},
        {"title": "BPNet alone, VER", "value": _fixed(bpnet["ver"]), "note": "the floor under the whole"},
        {
            "title": "Frames a second",
            "value": _fixed(speed["fps"], 0),
            "note": f"{_fixed(speed['latency_ms_p50'], 1)} ms each, 99 % in {_fixed(speed['latency_ms_p99'], 1)} ms",
        },
    ]
    return figures


def _facts(folder: Path, result: dict[str, Any]) -> list[tuple[str, str]]:
    facts = [("run", folder.resolve().name), ("held-out frames", f"{result['frames']:,}")]
    facts += [("networks", f"of step {result['checkpoint']:,}")] if "checkpoint" in result else []
    facts.append(("shapes with a known answer", str(result["shared_shapes"])))
    config = folder / "config.toml"
    if config.is_file():
        settings = tomllib.loads(config.read_text(encoding="utf-8"))
        together = settings.get("training", {}).get("together", False)
        for title, section, key in (
            ("pixels", "images", "resolution"),
            ("steps", "training", "steps"),
            *([] if together else [("BPNet steps", "bpnet", "steps")]),
            ("labels", "pairs", "method"),
            ("layout", "layout", "method"),
            ("training seed", "training", "seed"),
        ):
            if key in settings.get(section, {}):
                value = settings[section][key]
                facts.append((title, f"{value:,}" if key == "steps" else str(value)))
        for side in ("source", "target"):
            facts.append((f"{side} motion", str(settings.get(f"{side}_clip", "random expressions"))))
    return facts


def _methods(result: dict[str, Any]) -> list[dict[str, Any]]:
    rows = [
        ("this run", {"truth": result.get("truth"), "cyclic": result["cyclic"]}),
        ("without ReenactNet", result["direct"]),
        *([("the labels that taught it, no network", result["paired"])] if result.get("paired") else []),
        *((f"{name}, no network", {"cyclic": {}, **numbers}) for name, numbers in result.get("methods", {}).items()),
        *((_BASELINES[name], result["baselines"][name]) for name in _BASELINES),
        *([("the truth, and what comes back of it", result["exact"])] if result.get("exact") else []),
    ]
    return [{"title": title, "width": _width(row["truth"]), **row} for title, row in rows]


def _kinds(result: dict[str, Any]) -> list[dict[str, Any]]:
    rows = [(_KIND_TITLES.get(kind, kind), numbers) for kind, numbers in result["kinds"].items()]
    rows.append(("all frames", {"truth": result.get("truth"), "cyclic": result["cyclic"]}))
    return [{"title": title, "width": _width(row["truth"]), **row} for title, row in rows]


def _commands(folder: Path, result: dict[str, Any]) -> list[tuple[str, str]]:
    run = shlex.quote(str(folder))
    config = shlex.quote(str(folder / "config.toml"))
    return [
        ("these numbers and this page", f"reenact evaluate {run}{_options([result])}"),
        ("this page alone", f"python -m reenact.report {run}"),
        ("a clip of your own onto the target", f"reenact infer {run} CLIP --out OUT.glb"),
        ("the same training again", f"reenact train --config {config} --run {shlex.quote(str(folder) + '-again')}"),
    ]


def _shared_commands(folders: Sequence[Path], results: Sequence[dict]) -> list[tuple[str, str]]:
    runs = shlex.join(str(folder) for folder in folders)
    return [
        ("all these numbers and this page", f"reenact evaluate {runs}{_options(results)}"),
        ("this page alone", f"python -m reenact.report {runs}"),
    ]


def _options(results: Sequence[dict]) -> str:
    """What `reenact evaluate` was told beside the runs, where all were told the same."""
    first = results[0]
    asked = [(each["frames"], each["seed"], each.get("checkpoint")) for each in results]
    if any(each != asked[0] for each in asked):
        return ""
    chosen = "" if asked[0][2] is None else f" --checkpoint {asked[0][2]}"
    methods = list(dict.fromkeys(name for each in results for name in each.get("methods", {})))
    chosen += f" --methods {' '.join(methods)}" * bool(methods)
    return f" --frames {first['frames']} --seed {first['seed']}{chosen}"


def compared(runs: list[dict[str, Any]]) -> str:
    """A sentence for each direction: who comes closest to the truth, and whether the distance means anything."""
    entries: dict[str, dict[str, tuple[float, float, float]]] = {}
    for run in runs:
        known = entries.setdefault(f"{run['source']} → {run['target']}", {})
        answers = {run["name"]: run["result"].get("truth")}
        answers |= {name: each["truth"] for name, each in run["result"].get("methods", {}).items()}
        for name, truth in answers.items():
            if truth and truth["ver"] is not None:
                known[name] = (truth["ver"], *truth["ver_interval"])
    sentences = []
    for direction, known in entries.items():
        if len(known) < 2:
            continue
        (first, best), (second, next_best) = sorted(known.items(), key=lambda each: each[1])[:2]
        sure = best[2] < next_best[1]
        sentences.append(
            f"{direction}: {first} comes closest to the truth (VER {best[0]:.2f}), {second} follows "
            f"({next_best[0]:.2f}); "
            + (
                "their intervals do not touch, so other frames would hardly change the order."
                if sure
                else "their intervals overlap, so other frames could change the order."
            )
        )
    return " ".join(sentences)


def _comparison(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row per run and method, and mean ± standard deviation for each direction that several runs share."""

    def numbers(result: dict[str, Any]) -> list[float | None]:
        truth, direct = result.get("truth") or {}, result["direct"]["truth"] or {}
        return [
            truth.get("ver"),
            truth.get("correlation"),
            truth.get("gain"),
            direct.get("ver"),
            result["cyclic"]["skill"],
            result["bpnet"]["ver"],
            result["speed"]["fps"],
        ]

    digits = [2, 2, 2, 2, 2, 2, 0]
    rows: list[dict[str, Any]] = []
    groups: dict[str, list[list[float | None]]] = {}
    for i, run in enumerate(runs, start=1):
        direction, values = f"{run['source']} → {run['target']}", numbers(run["result"])
        groups.setdefault(direction, []).append(values)
        shown = [_fixed(value, places) for value, places in zip(values, digits)]
        rows.append({"name": run["name"], "href": f"run-{i}", "direction": direction, "values": shown, "mean": False})
    measured: dict[tuple[str, str], dict[str, Any] | None] = {}
    for run in runs:
        for name, each in run["result"].get("methods", {}).items():
            measured.setdefault((name, f"{run['source']} → {run['target']}"), each["truth"])
    for (name, direction), truth in measured.items():
        shown = [_fixed((truth or {}).get(key)) for key in ("ver", "correlation", "gain")] + ["–"] * 4
        rows.append({"name": name, "href": "", "direction": direction, "values": shown, "mean": False})
    for direction, members in groups.items():
        if len(members) > 1:
            shown = []
            for column, places in zip(zip(*members), digits):
                known = [value for value in column if value is not None]
                spread = f" ± {np.std(known, ddof=1):.{places}f}" if len(known) > 1 else ""
                shown.append(f"{np.mean(known):.{places}f}{spread}" if known else "–")
            name = f"mean of {len(members)}"
            rows.append({"name": name, "href": "", "direction": direction, "values": shown, "mean": True})
    return rows


# Pictures ------------------------------------------------------------------------------------------------------------


def _player_frames(kind: np.ndarray, count: int) -> np.ndarray:
    """Every second frame of the clips that look like a performance, at most `count`, halved between the clips."""
    chosen = []
    for name in _PLAYED:
        frames = np.flatnonzero(kind == KINDS.index(name))
        chosen.append(frames[: 2 * (count // len(_PLAYED)) : 2])
    return np.concatenate(chosen)


def _span(frames: np.ndarray) -> np.ndarray:
    """All frames between the player's, its clips one after the other."""
    clips = np.split(frames, np.flatnonzero(np.diff(frames) != 2) + 1)
    return np.concatenate([np.arange(clip[0], clip[-1] + 1) for clip in clips])


def _cuts(kind: np.ndarray) -> list[int]:
    return (np.flatnonzero(np.diff(kind)) + 1).tolist()


def _player(
    index: int, forward: PictureRetargeter, arrays: dict[str, np.ndarray], frames: np.ndarray
) -> dict[str, Any]:
    views = [
        ("Source", forward.source, arrays["source"], False),
        ("Reenacted", forward.target, arrays["predicted"], False),
    ]
    if "truth" in arrays:
        views.append(("Truth", forward.target, arrays["truth"], True))
    for name in arrays:
        if name.startswith("method "):
            views.append((name.removeprefix("method "), forward.target, arrays[name], True))
    columns = 8
    span = _span(frames)
    return {
        "size": PLAYER_SIZE,
        "count": len(frames),
        "views": [
            {
                "id": f"sheet-{index}-{place}",
                "title": title,
                "subtitle": rig.name,
                "optional": optional,
                "sheet": _picture(_grid(_faces(rig, weights[frames], PLAYER_SIZE), columns)),
            }
            for place, (title, rig, weights, optional) in enumerate(views)
        ],
        "script": {
            "size": PLAYER_SIZE,
            "columns": columns,
            "count": len(frames),
            "fps": 15,
            "start": int(arrays["source"][frames].sum(1).argmax()),
            "frames": frames.tolist(),
            "labels": [_KIND_TITLES[KINDS[arrays["kind"][frame]]] for frame in frames],
            "positions": np.searchsorted(span, frames).tolist(),
            "length": len(span),
        },
    }


def _together(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Faces of all runs in step, where one source drives them all: views of their own players; else none."""
    first = runs[0]
    if len(runs) < 2 or not all(
        run["source"] == first["source"] and np.array_equal(run["moved"], first["moved"]) for run in runs
    ):
        return []
    shown, optional, seen = [first["player"]["views"][0]], [], set()
    for run in runs:
        _, own, *others = run["player"]["views"]
        shown.append({**own, "title": run["name"]})
        for view in others:
            if (view["title"], view["subtitle"]) not in seen:
                seen.add((view["title"], view["subtitle"]))
                optional.append(view)
    return shown + optional


def _sheets(forward: PictureRetargeter, arrays: dict[str, np.ndarray], result: dict[str, Any]) -> list[dict[str, Any]]:
    """Contact sheets: the worst frames, then frames at equal steps from worst to best; at equal times without truth."""
    count = 6
    if not result["worst"]:
        frames = np.linspace(0, len(arrays["source"]) - 1, count + 2).astype(int)[1:-1].tolist()
        note = "At equal times. The rigs share no shape name, so only the eye can judge."
        return [_sheet("Frame by frame", note, frames, forward, arrays)]
    order = result["worst"]
    worst: list[int] = []
    for frame in order:  # neighbours in time show the same failure twice
        if len(worst) < count and all(abs(frame - other) >= 12 for other in worst):
            worst.append(frame)
    typical = [order[int(share * (len(order) - 1))] for share in np.linspace(0.1, 0.9, count)]
    note = "Largest distance from the truth first; neighbouring frames are left out."
    even = "From the 10th to the 90th percentile of the error. If these look right, the run is right."
    return [
        _sheet("The worst frames", note, worst, forward, arrays),
        _sheet("From bad to good", even, typical, forward, arrays),
    ]


@torch.no_grad()
def _sheet(
    title: str, note: str, frames: list[int], forward: PictureRetargeter, arrays: dict[str, np.ndarray]
) -> dict[str, Any]:
    source = arrays.get("truth_source", arrays["source"])[frames]
    predicted = arrays.get("truth_predicted", arrays["predicted"])[frames]
    drawn = forward.reenact(forward.source_pictures(torch.from_numpy(source)))[:, :3].clamp(0, 1)
    rows = [
        (f"source, {forward.source.name}", _faces(forward.source, source, SHEET_SIZE)),
        ("what ReenactNet draws", _bytes(drawn)),
        ("target, predicted weights", _faces(forward.target, predicted, SHEET_SIZE)),
    ]
    if "truth" in arrays:
        rows.append(("target, truth", _faces(forward.target, arrays["truth"][frames], SHEET_SIZE)))
    titles = []
    for frame in frames:
        error = f"{1000 * arrays['error'][frame]:.2f} mm off" if "error" in arrays else f"frame {frame}"
        titles.append({"index": frame, "title": error, "subtitle": _KIND_TITLES[KINDS[arrays["kind"][frame]]]})
    return {
        "title": title,
        "note": note,
        "frames": titles,
        "rows": [{"title": name, "pictures": [_picture(face) for face in faces]} for name, faces in rows],
    }


def _maps(arrays: dict[str, np.ndarray], result: dict[str, Any]) -> tuple[list[dict[str, Any]], float]:
    wanted = [
        ("map_truth", f"{result['target']} against the truth"),
        ("map_truth_neutral", f"{result['target']}, never moving"),
        ("map_cyclic", f"{result['source']}, there and back"),
        ("map_cyclic_neutral", f"{result['source']}, never moving"),
    ]
    found = [(arrays[key], title) for key, title in wanted if key in arrays]
    limit = max(float(np.quantile(values, 0.995)) for values, _ in found) or 1.0
    return [
        {"title": title, "mean": float(values.mean()), "picture": _picture(_colored(values, limit), "PNG")}
        for values, title in found
    ], limit


@torch.no_grad()
def _faces(rig: Rig, weights: np.ndarray, resolution: int) -> np.ndarray:
    """Pictures (N, H, W, 3) of the expressions, rendered a few at a time."""
    portrait = Portrait.of(rig)
    parts = torch.from_numpy(weights).float().split(16)
    return np.concatenate([_bytes(portrait.render(rig.vertices(part), resolution)["color"]) for part in parts])


def _bytes(pictures: Tensor) -> np.ndarray:
    return (pictures.permute(0, 2, 3, 1).clamp(0, 1) * 255).round().byte().cpu().numpy()


def _grid(pictures: np.ndarray, columns: int) -> np.ndarray:
    """Pictures (N, H, W, 3) as one, row by row."""
    count, height, width, _ = pictures.shape
    rows = -(-count // columns)
    padded = np.zeros((rows * columns, height, width, 3), np.uint8)
    padded[:count] = pictures
    return padded.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)


def _colored(values: np.ndarray, limit: float, colors: str = "magma") -> np.ndarray:
    return (matplotlib.colormaps[colors](np.clip(values / limit, 0, 1))[..., :3] * 255).round().astype(np.uint8)


def _picture(pixels: np.ndarray, kind: str = "WEBP") -> str:
    """A data URI; WebP for faces, PNG for maps."""
    packed = io.BytesIO()
    Image.fromarray(pixels).save(packed, kind, quality=82)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(packed.getvalue()).decode()}"


# What each shape does alone, and where on the face errors are -------------------------------------------------------


@torch.no_grad()
def _alone(forward: PictureRetargeter) -> dict[str, Any]:
    """Every shape of the source alone at 1: what the target does, beside what it should where names tell."""
    source, target = forward.source, forward.target
    alone, names = torch.eye(len(source.names)), list(source.names)
    meaning = {arkit.canonical(name): k for k, name in enumerate(names)}
    for shape, base in arkit.CORRECTIVES.items():  # means nothing without the other
        if shape in meaning and base in meaning:
            alone[meaning[shape], meaning[base]] = 1
            names[meaning[shape]] += f" + {base}"
    known, right, covered = true_weights(source, target, alone)
    asked = torch.arange(len(alone))
    if covered:
        asked = ((known.amax(1) > 0.5) & (right.amax(1) > 0.25)).nonzero().flatten()
    known, right = (known if covered else alone)[asked], right[asked]
    answer = forward(Clip(source.names, known, 30.0)).weights.detach().float().cpu()
    wrong = torch.zeros(len(asked))
    if covered:
        distance, motion = vertex_errors(target, answer, right)
        wrong = (distance / motion.clamp_min(1e-12)).float()
    found = (answer.argmax(1) == right.argmax(1)) & (answer.amax(1) > 0.05)
    order = wrong.argsort(descending=True, stable=True)
    shown = order[:MOST_SHAPES].sort().values if len(order) > MOST_SHAPES else torch.arange(len(asked))
    names = [names[k] for k in asked.tolist()]
    return {
        "has_truth": bool(covered),
        "sentence": _alone_sentence(target, names, answer, right, wrong, found) if covered else "",
        "matrix": _matrix([names[k] for k in shown], target.names, answer[shown], right[shown], bool(covered)),
        "left_out": len(asked) - len(shown),
        "sheet": _alone_sheet(forward, names, known, answer, right, wrong, order, bool(covered)),
    }


def _alone_sentence(target: Rig, names: list[str], answer: Tensor, right: Tensor, wrong: Tensor, found: Tensor) -> str:
    sentence = (
        f"Of {len(names)} shapes whose right answer is known, {int(found.sum())} move the right shape most. "
        f"The median misses {_percent(float(wrong.median()))} of its motion"
    )
    worst = int(wrong.argmax())
    stray = answer[worst].clone()
    stray[right[worst] > 0.05] = 0
    sentence += f"; the worst is {names[worst]}, which misses {_percent(float(wrong[worst]))}"
    if float(stray.max()) > 0.1:
        sentence += f" and moves {target.names[int(stray.argmax())]} by {float(stray.max()):.2f}"
    elif float(answer[worst].max()) < 0.1:
        sentence += " and hardly moves anything"
    return sentence + "."


def _matrix(
    rows: list[str], columns: tuple[str, ...], answer: Tensor, right: Tensor, has_truth: bool
) -> dict[str, Any]:
    """Cells of the table: columns that anything happens in, ordered so that a perfect answer is a diagonal."""
    wanted = right if has_truth else answer
    busy = ((answer > 0.05) | (right > 0.05)).any(0).nonzero().flatten().tolist()
    first = {}
    for k in busy:
        most = float(wanted[:, k].max())
        first[k] = int((wanted[:, k] >= most - 1e-6).nonzero()[0]) if most > 0.05 else len(rows)
    busy.sort(key=lambda k: (first[k], k))
    place = {k: x for x, k in enumerate(busy)}
    cells = []
    for y, name in enumerate(rows):
        for k in busy:
            does, should = float(answer[y, k]), float(right[y, k])
            if does > 0.05 or should > 0.05:
                told = f"{name} → {columns[k]} {does:.2f}" + (f", should be {should:.2f}" if has_truth else "")
                cells.append({"x": place[k], "y": y, "does": round(does, 2), "should": should > 0.05, "told": told})
    return {"rows": rows, "columns": [columns[k] for k in busy], "cells": cells}


def _alone_sheet(
    forward: PictureRetargeter,
    names: list[str],
    known: Tensor,
    answer: Tensor,
    right: Tensor,
    wrong: Tensor,
    order: Tensor,
    has_truth: bool,
) -> dict[str, Any]:
    """Faces of the six shapes that are farthest off; of six at equal steps where nothing tells."""
    chosen = order[:6] if has_truth else torch.linspace(0, len(names) - 1, min(6, len(names))).long()
    rows = [
        (f"source, {forward.source.name}", _faces(forward.source, known[chosen].numpy(), SHEET_SIZE)),
        (f"{forward.target.name}, does", _faces(forward.target, answer[chosen].numpy(), SHEET_SIZE)),
    ]
    if has_truth:
        rows.append((f"{forward.target.name}, should", _faces(forward.target, right[chosen].numpy(), SHEET_SIZE)))
    titles = [
        {
            "index": names[k],
            "title": names[k],
            "subtitle": f"misses {_percent(float(wrong[k]))}" if has_truth else "at 1",
        }
        for k in chosen.tolist()
    ]
    return {
        "frames": titles,
        "rows": [{"title": title, "pictures": [_picture(face) for face in faces]} for title, faces in rows],
    }


@torch.no_grad()
def _heat(target: Rig, arrays: dict[str, np.ndarray]) -> dict[str, Any] | None:
    """Mean distance of each vertex from where it should be, on the face, beside how far it should move; None without
    a truth."""
    if "truth" not in arrays:
        return None
    predicted = torch.from_numpy(arrays["truth_predicted"]).float()
    truth = torch.from_numpy(arrays["truth"]).float()
    flat = target.deltas.flatten(1)

    def distances(weights: Tensor) -> Tensor:
        total = sum((part @ flat).unflatten(-1, (-1, 3)).norm(dim=-1).sum(0) for part in weights.split(16))
        return 1000 * total / len(weights)  # (V,) millimetres

    error, motion = distances(predicted - truth), distances(truth)
    seen = (Portrait.of(target).project(target.neutral, 2) - 1).abs().amax(-1) < 1
    middle = target.neutral[seen].mean(0)  # of what the picture shows: it is turned about that
    angle = torch.tensor(0.65)
    turn = torch.tensor([[angle.cos(), 0, angle.sin()], [0, 1, 0], [-angle.sin(), 0, angle.cos()]])
    shown = []
    for title, values in (("How far off it is", error), ("How far it should move", motion)):
        limit = float(torch.quantile(values, 0.995)) or 1.0
        colors = torch.from_numpy(_colored(values.numpy(), limit, _HEAT)).float() / 255
        painted = Portrait.of(replace(target, colors=colors, texture=None))
        views = (target.neutral, (target.neutral - middle) @ turn.T + middle)
        faces = [_bytes(painted.render(vertices[None], HEAT_SIZE)["color"])[0] for vertices in views]
        shown.append({"title": title, "limit": limit, "pictures": [_picture(face) for face in faces]})
    return {
        "shown": shown,
        "legend": _picture(_colored(np.linspace(0, 1, 256)[None].repeat(4, 0), 1.0, _HEAT), "PNG"),
        "sentence": f"Where it is worst it is {shown[0]['limit']:.2f} mm off; where it moves most it should move "
        f"{shown[1]['limit']:.2f} mm. Read the two scales.",
    }


# Curves --------------------------------------------------------------------------------------------------------------


def _curves(target: Rig, arrays: dict[str, np.ndarray], span: np.ndarray, count: int = 8) -> list[dict[str, Any]]:
    """The shapes that move most in the truth, or in the prediction where there is none."""
    predicted, truth = arrays["predicted"][span], arrays["truth"][span] if "truth" in arrays else None
    activity = (predicted if truth is None else truth).std(0)
    curves = []
    for k in np.argsort(-activity)[:count]:
        if activity[k] < 1e-3:
            break
        note = "" if truth is None else f"mean error {np.abs(predicted[:, k] - truth[:, k]).mean():.3f}"
        curves.append(
            {
                "name": target.names[k],
                "note": note,
                "predicted": _points(np.arange(len(span)), 100 * (1 - predicted[:, k])),
                "truth": "" if truth is None else _points(np.arange(len(span)), 100 * (1 - truth[:, k])),
            }
        )
    return curves


def _every_curve(target: Rig, arrays: dict[str, np.ndarray], result: dict[str, Any]) -> dict[str, Any]:
    """All weights of all frames in steps of 1/255, for the page to draw whichever is asked for."""

    def packed(weights: np.ndarray) -> str:
        return base64.b64encode((np.clip(weights, 0, 1).T * 255).round().astype(np.uint8).tobytes()).decode()

    lines = {"truth": arrays["truth"]} if "truth" in arrays else {}
    lines |= {"predicted": arrays["predicted"]}
    lines |= {name.removeprefix("method "): arrays[name] for name in arrays if name.startswith("method ")}
    kind = arrays["kind"]
    starts = [0, *(np.flatnonzero(np.diff(kind)) + 1).tolist()]
    notes = {
        each["name"]: f"mean error {each['mae']:.3f}, correlation {each['correlation']:.2f}, gain {each['gain']:.2f}"
        for each in result["shapes"]
        if each["moves"]
    }
    return {
        "names": list(target.names),
        "count": len(kind),
        "first": int(lines.get("truth", arrays["predicted"]).std(0).argmax()),
        "kinds": [[start, _KIND_TITLES[KINDS[kind[start]]]] for start in starts],
        "lines": [[name, packed(weights)] for name, weights in lines.items()],
        "notes": notes,
    }


def _training(path: Path) -> list[dict[str, Any]]:
    """Loss curves by stage, and those of the held-out error, logarithmic; empty where nothing was logged."""
    if not path.is_file():
        return []
    stages: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for entry in filter(None, map(parsed_line, path.read_text(encoding="utf-8", errors="replace").splitlines())):
        for key, words in (("loss", "Training loss"), (NUMBER, "Held-out error")):
            if isinstance(entry.get(key), float) and 0 < entry[key] < np.inf:
                stages.setdefault((entry["stage"], words), []).append((entry["step"], entry[key]))
    curves = []
    for (name, words), rows in stages.items():
        steps, losses = np.array(rows, dtype=float).T
        if len(steps) < 2:
            continue
        keep = np.unique(np.linspace(0, len(steps) - 1, 300).astype(int))
        low, high = np.log(losses.min()), np.log(losses.max())
        y = 100 - 100 * (np.log(losses) - low) / max(high - low, 1e-9)
        x = 1000 * (steps - steps[0]) / max(steps[-1] - steps[0], 1)
        curves.append(
            {
                "name": name if words == "Training loss" else f"{name}: {words.lower()}",
                "label": f"{words} of {name}",
                "first": losses[0],
                "last": losses[-1],
                "start": int(steps[0]),
                "stop": int(steps[-1]),
                "points": _points(x[keep], y[keep]),
            }
        )
    return curves


def _points(x: np.ndarray, y: np.ndarray) -> str:
    return " ".join(f"{a:.5g},{b:.4g}" for a, b in zip(x, y))


# Words ---------------------------------------------------------------------------------------------------------------


def _grade(ver: float) -> str:
    for limit, words in (
        (0.15, "it follows closely"),
        (0.25, "it follows well, with visible differences in strong expressions"),
        (0.5, "it follows roughly, and errors are easy to see"),
        (0.95, "it catches little of the motion"),
    ):
        if ver <= limit:
            return words
    return "it is no better than leaving the face still"


def _percent(share: float | None) -> str:
    return "an unknown part" if share is None else f"{100 * share:.0f} %"


def _fixed(value: float | None, places: int = 2) -> str:
    return "–" if value is None else f"{value:,.{places}f}"


def _width(truth: dict[str, Any] | None) -> int:
    """Length of the bar of a VER, in percent; 1.25 and above fill it."""
    if not truth or truth["ver"] is None:
        return 100
    return round(min(100 * truth["ver"] / 1.25, 100))


def main(arguments: Sequence[str] | None = None) -> int:
    """Remake the page of evaluated runs; exit status 0, or 2 after a mistake of the user."""
    folders = [Path(argument) for argument in (sys.argv[1:] if arguments is None else arguments)]
    try:
        if not folders or any(str(folder).startswith("-") for folder in folders):
            raise ReenactError("usage: python -m reenact.report RUN [RUN ...]")
        results = []
        for folder in folders:
            numbers = folder / "evaluation" / "metrics.json"
            if not numbers.is_file():
                raise ReenactError(
                    f"{numbers}: expected the numbers of a run, found none; run `reenact evaluate {folder}`"
                )
            results.append(json.loads(numbers.read_text(encoding="utf-8")))
        with Console(stderr=True, markup=False, emoji=False).status("Drawing"):
            page = write_report(folders, results)
        print(page)
    except (ReenactError, FileNotFoundError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
