"""Nudges: frames that a person corrected, kept, spread over their neighbours, and usable as labels.

A nudge says what some shapes of one rig weigh at one frame of one clip. The viewer writes them all to one JSON file,
RUN/nudges.json beside a run:

    {
      "format": "reenact nudges 1",
      "rigs": {"man": ["browDownLeft", ...], "toon": [...]},
      "nudges": [
        {
          "clip": "synthetic:7:10",        as it was named on the command line
          "fps": 30.0,                     of that clip
          "frame": 42,                     counted from 0
          "radius": 8,                     frames after which the correction has faded
          "source": "man",                 whose performance it is: a key of "rigs"
          "rig": "toon",                   whose weights are corrected: a key of "rigs", the source too
          "method": "networks",            what had made the weights that were corrected
          "shapes": {"jawOpen": 0.31},     what the person set
          "weights": [...],                all weights of "rig" at that frame as the person left them
          "source_weights": [...]          all weights of "source" at that frame
        }
      ]
    }

A label for training is the pair (`source_weights`, `weights`) of a nudge whose `rig` is not its `source`; see `labels`.
`corrected` spreads nudges over a clip, and the page does the same while it plays.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.atomic import write_atomically
from reenact.errors import ReenactError
from reenact.rigs.clip import Clip

FORMAT = "reenact nudges 1"
_LIMIT = 64 << 20
"""Bytes of a file; ten thousand nudges of two rigs of 300 shapes."""


@dataclass(frozen=True)
class Nudge:
    """One corrected frame; the fields are those of the file."""

    clip: str
    fps: float
    frame: int
    radius: int
    source: str
    rig: str
    method: str
    shapes: dict[str, float]
    weights: tuple[float, ...]
    source_weights: tuple[float, ...]


@dataclass(frozen=True)
class Nudges:
    """All nudges of a file, and the shapes of the rigs that they are about."""

    rigs: dict[str, tuple[str, ...]]
    """Names of shapes by key of the rig."""
    items: tuple[Nudge, ...] = ()


def load_nudges(path: Path | str) -> Nudges:
    """The nudges in a file.

    Raises:
        ReenactError: It is missing, not such a file, or damaged.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _LIMIT:
            raise ReenactError(f"{path}: expected at most {_LIMIT:,} bytes, got {path.stat().st_size:,}")
        document = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ReenactError(f"{path}: cannot be read ({error.strerror}); the viewer writes it") from None
    except (ValueError, RecursionError) as error:
        if isinstance(error, ReenactError):
            raise
        raise ReenactError(f"{path}: expected nudges as JSON, got something else ({error})") from None
    return parse_nudges(document, str(path))


def parse_nudges(document: Any, where: str) -> Nudges:
    """The nudges in the content of a file.

    Raises:
        ReenactError: A field is missing, of another kind, or does not fit the others.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ReenactError(f'{where}: expected "format": "{FORMAT}", got another or none')
    rigs = _field(where, document, "rigs", dict)
    for key, names in rigs.items():
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise ReenactError(f"{where}: rigs.{key}: expected a list of names of shapes")
    shapes = {key: tuple(names) for key, names in rigs.items()}
    entries = _field(where, document, "nudges", list)
    return Nudges(shapes, tuple(_nudge(f"{where}: nudges[{i}]", entry, shapes) for i, entry in enumerate(entries)))


def save_nudges(nudges: Nudges, path: Path | str) -> None:
    """Writes the file, whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    document = {
        "format": FORMAT,
        "rigs": {key: list(names) for key, names in nudges.rigs.items()},
        "nudges": [asdict(nudge) for nudge in nudges.items],
    }
    write_atomically(path, json.dumps(document, ensure_ascii=False, indent=1).encode())


def corrected(clip: Clip, nudges: Sequence[Nudge]) -> Clip:
    """The clip with the nudges of its rig spread over the frames around them.

    Shape by shape, the correction is whole at its frame and falls to nothing over `radius` frames like half a wave of a
    cosine, or by the next frame that corrects the same shape, so that every corrected frame stays as it was left.
    Ours.

    Args:
        clip: As a method made it.
        nudges: Of this clip and of one rig, whose shapes are the clip's. Of two at the same frame the later counts.

    Raises:
        ReenactError: A nudge lies outside the clip, or names a shape that it lacks.
    """
    index = {name: k for k, name in enumerate(clip.names)}
    wanted: dict[int, dict[int, tuple[float, int]]] = {}
    for nudge in nudges:
        if not nudge.frame < len(clip) or not nudge.shapes.keys() <= index.keys():
            raise ReenactError(
                f"nudge: expected a frame of 0..{len(clip) - 1} and shapes of the clip, got frame {nudge.frame} and "
                f"{', '.join(nudge.shapes)[:200]}"
            )
        for name, value in nudge.shapes.items():
            wanted.setdefault(index[name], {})[nudge.frame] = (value, nudge.radius)
    weights = clip.weights.clone()
    frames = torch.arange(len(clip))
    for k, points in wanted.items():
        base, places = clip.weights[:, k], sorted(points)
        total = base.clone()
        for place, before, after in zip(places, [-math.inf, *places], [*places[1:], math.inf]):
            value, radius = points[place]
            reach = torch.where(frames < place, min(radius, place - before), min(radius, after - place))
            share = (frames - place).abs() / reach
            total += torch.where(share < 1, (value - base[place]) * (1 + torch.cos(math.pi * share)) / 2, 0)
        weights[:, k] = torch.clamp(total, base.clamp(max=0), base.clamp(min=1))
    return replace(clip, weights=weights)


def labels(
    nudges: Nudges, source: str, target: str
) -> tuple[Float[Tensor, "N Ks"], Float[Tensor, "N Kt"], Float[Tensor, "N"]]:
    """Weights of the source, weights of the target as a person wants them, and radii in frames, a row per nudge.

    Args:
        nudges: Of a file.
        source: Key of the rig that performs.
        target: Key of the rig that was corrected.

    Raises:
        ReenactError: The file knows no such rig.
    """
    for key in (source, target):
        if key not in nudges.rigs:
            raise ReenactError(f"nudges: expected the rig {key}, got {', '.join(nudges.rigs) or 'none'}")
    chosen = [nudge for nudge in nudges.items if (nudge.source, nudge.rig) == (source, target)]
    return (
        torch.tensor([nudge.source_weights for nudge in chosen]).reshape(-1, len(nudges.rigs[source])),
        torch.tensor([nudge.weights for nudge in chosen]).reshape(-1, len(nudges.rigs[target])),
        torch.tensor([float(nudge.radius) for nudge in chosen]),
    )


def _nudge(where: str, entry: Any, rigs: dict[str, tuple[str, ...]]) -> Nudge:
    if not isinstance(entry, dict):
        raise ReenactError(f"{where}: expected an object, got {type(entry).__name__}")
    clip, method, source, rig = (_field(where, entry, key, str) for key in ("clip", "method", "source", "rig"))
    for key, value in (("source", source), ("rig", rig)):
        if value not in rigs:
            raise ReenactError(f"{where}.{key}: expected one of {', '.join(rigs)}, got {value[:80]}")
    frame, radius = _whole(where, entry, "frame", 0), _whole(where, entry, "radius", 1)
    fps = _numbers(f"{where}.fps", [_field(where, entry, "fps", float)], 1)[0]
    if fps <= 0:
        raise ReenactError(f"{where}.fps: expected a positive rate, got {fps}")
    shapes = _field(where, entry, "shapes", dict)
    strange = sorted(shapes.keys() - set(rigs[rig]))
    if strange:
        raise ReenactError(f"{where}.shapes: expected shapes of {rig}, got {', '.join(strange)[:200]}")
    values = _numbers(f"{where}.shapes", list(shapes.values()), len(shapes))
    weights = _numbers(f"{where}.weights", _field(where, entry, "weights", list), len(rigs[rig]))
    source_weights = _numbers(
        f"{where}.source_weights", _field(where, entry, "source_weights", list), len(rigs[source])
    )
    return Nudge(clip, fps, frame, radius, source, rig, method, dict(zip(shapes, values)), weights, source_weights)


def _field(where: str, entry: dict, key: str, kind: type) -> Any:
    value = entry.get(key)
    fits = isinstance(value, (int, float)) and not isinstance(value, bool) if kind is float else isinstance(value, kind)
    if not fits:
        raise ReenactError(f"{where}.{key}: expected {kind.__name__}, got {type(value).__name__}")
    return value


def _whole(where: str, entry: dict, key: str, least: int) -> int:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value < 2**31:
        raise ReenactError(f"{where}.{key}: expected a whole number of {least} or more, got {value!r:.40}")
    return value


def _numbers(where: str, values: list, count: int) -> tuple[float, ...]:
    sound = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
    if len(values) != count or not sound or not all(abs(value) < 1e6 for value in values):  # NaN compares false
        raise ReenactError(f"{where}: expected {count} numbers, got {len(values)} values or others than numbers")
    return tuple(float(value) for value in values)
