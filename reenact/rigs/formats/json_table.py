"""Plain tables as .json: `{"names": [...], "fps": 30, "weights": [[...], ...]}`, with `"time": [...]` where fps is not.

The same fields as a .npz table: K names, T rows of K weights, T times in seconds. A file is parsed without evaluating
anything in it, and NaN, which JSON lacks and Python would read, is refused.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, table
from reenact.rigs.timeline import steady

BYTES = 1 << 26
"""Largest file that is parsed: in memory its lists are up to thirty times as large. Half an hour of 52 shapes fits."""


def load(path: Path) -> Clip:
    """The clip in a table; without `fps` its frame rate is read off the times, and gaps are filled linearly.

    Warns of other fields that move.

    Raises:
        ReenactError: Not JSON, a field is missing or of the wrong kind or size, or a number is not finite.
    """
    document = read(path)
    if not is_table(document):
        raise ReenactError(
            f"{path}: expected names and weights (a table), or facsNames and weightMat (Audio2Face), "
            f"got {brief(document)}"
        )
    names = read_names(path, document, "names")
    weights = read_rows(path, document, "weights", names)
    warn_of_motion(path, document, {"names", "weights", "time", "fps"})
    if "fps" in document:
        return Clip(names, torch.from_numpy(weights.astype(np.float32)), read_rate(path, document, "fps"))
    if "time" not in document:
        raise ReenactError(f"{path}: expected fps or time beside weights, got neither; add the frames per second")
    times = document["time"]
    if not isinstance(times, list) or len(times) != len(weights):
        raise ReenactError(f"{path}: expected {len(weights)} seconds in time, one per row, got {brief(times)}")
    for row, value in enumerate(times, 1):
        if not _is_number(value) or abs(value) > 1e300:
            raise ReenactError(f"{path}: expected a number in time, row {row}, got {brief(value)}")
    weights, fps = steady(str(path), np.array(times, dtype=np.float64), weights)
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


def save(clip: Clip, path: Path) -> None:
    """Writes the clip with a row per line; float32 weights survive exactly.

    Raises:
        ReenactError: The file cannot be written.
    """
    head = [f'"names": {json.dumps(clip.names, ensure_ascii=False)}', f'"fps": {clip.fps!r}']
    disk.write_bytes(path, text([*head, f'"weights": {rows_text(clip)}']).encode())


def is_table(document: Any) -> bool:
    """Whether a parsed file has the fields of a table."""
    return isinstance(document, dict) and "names" in document and "weights" in document


def read(path: Path) -> Any:
    """The parsed file.

    Raises:
        ReenactError: Too large, not text, not JSON, nested too deeply, NaN or infinity, or a doubled field.
    """
    try:
        size = path.stat().st_size
    except (OSError, ValueError):
        size = 0  # the next line says what is wrong
    if size > BYTES:
        raise ReenactError(f"{path}: expected at most {BYTES:,} bytes of JSON, got {size:,}; convert it to .npz")
    content = disk.read_text(path)
    try:
        return json.loads(content, parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except RecursionError:
        raise ReenactError(f"{path}: expected a table, its lists are nested too deeply") from None
    except ValueError as error:
        raise ReenactError(f"{path}: expected JSON, it cannot be parsed ({str(error)[:80]}); is it cut off?") from None


def read_names(path: Path, document: dict[str, Any], key: str) -> tuple[str, ...]:
    """A field of different names.

    Raises:
        ReenactError: It is no list of strings, one is empty or doubled.
    """
    names = document[key]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ReenactError(f"{path}: expected {key} as a list of strings, got {brief(names)}")
    for index, name in enumerate(names):
        if not name or any("\ud800" <= letter <= "\udfff" for letter in name):  # half of a pair cannot be written
            raise ReenactError(f"{path}: expected a name in {key}[{index}], got {brief(name)}")
    table.check_names(path, names)
    return tuple(names)


def read_rows(path: Path, document: dict[str, Any], key: str, names: tuple[str, ...]) -> Float[np.ndarray, "T K"]:
    """A field of one or more rows with a weight per name.

    Raises:
        ReenactError: It is no list of lists of that length, or a number is not finite as float32, by row and name.
    """
    rows = document[key]
    if not isinstance(rows, list) or not rows:
        raise ReenactError(f"{path}: expected {key} as a list of one or more rows, got {brief(rows)}")
    for number, row in enumerate(rows, 1):
        if not isinstance(row, list) or len(row) != len(names):
            got = len(row) if isinstance(row, list) else brief(row)
            raise ReenactError(f"{path}: expected {len(names)} weights, one per name, in {key} row {number}, got {got}")
        if not set(map(type, row)) <= {int, float}:
            index = next(index for index, value in enumerate(row) if not _is_number(value))
            raise ReenactError(
                f"{path}: expected a number in {key} row {number}, {names[index][:40]}, got {brief(row[index])}"
            )
    try:
        values = np.array(rows, dtype=np.float64)
    except OverflowError:  # a whole number of hundreds of digits
        values = np.array([[value if abs(value) < 1e300 else math.inf for value in row] for row in rows])
    with np.errstate(over="ignore"):
        wrong = ~np.isfinite(values.astype(np.float32))
    if wrong.any():
        row, index = np.argwhere(wrong)[0]
        raise ReenactError(
            f"{path}: expected a weight in {key} row {row + 1}, {names[index][:40]}, got {brief(rows[row][index])}"
        )
    return values


def read_rate(path: Path, document: dict[str, Any], key: str) -> float:
    """A field of frames per second.

    Raises:
        ReenactError: It is no positive finite number.
    """
    value = document[key]
    if not _is_number(value) or not 0 < value < 1e6:
        raise ReenactError(f"{path}: expected {key} as frames per second above 0, got {brief(value)}")
    return float(value)


def warn_of_motion(path: Path, document: dict[str, Any], known: Iterable[str]) -> None:
    """Warns of lists of lists that change over time, in fields that are not known."""
    moving = []
    for key in document.keys() - set(known):
        frames = document[key]
        listed = isinstance(frames, list) and frames and isinstance(frames[0], list)
        if listed and any(frame != frames[0] for frame in frames):
            moving.append(key)
    if moving:
        fields = ", ".join(sorted(moving))[:300]
        warnings.warn(f"{path}: fields that move but are no blendshapes are not loaded: {fields}", stacklevel=4)


def rows_text(clip: Clip) -> str:
    """The clip's weights as JSON, each in the fewest digits that are the same float32."""
    values = clip.weights.detach().cpu().numpy()
    return "[\n" + ",\n".join(f"[{', '.join(map(_shortest, row))}]" for row in values) + "\n]"


def text(fields: list[str]) -> str:
    """An object of the fields, one per line."""
    return "{\n" + ",\n".join(fields) + "\n}\n"


def brief(value: Any) -> str:
    """What a value is, in a few words, for messages."""
    if isinstance(value, dict):
        return f"an object of {', '.join(map(str, value))[:80]}" if value else "an empty object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**40:
        return "a whole number of more than 40 digits"
    return repr(value)[:60]


def _shortest(value: np.floating) -> str:
    return str(int(value)) if value == 0 or value == 1 else str(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"field {next(key for key in keys if keys.count(key) > 1)[:40]!r} stands twice")
    return fields
