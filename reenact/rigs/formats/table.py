"""Plain tables: a column `time` in seconds and one column per blendshape, as .csv or .npz.

In .npz, `names` (K,) and `weights` (T, K) stand beside `time` (T,) or `fps`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, npz
from reenact.rigs.timeline import steady


def rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a .csv file; cells are stripped, empty rows are left out, rows are as long as the header.

    Raises:
        ReenactError: Not text, no header, a doubled or empty column name, a row of another length.
    """
    try:
        lines = [row for row in csv.reader(io.StringIO(disk.read_text(path)), strict=True) if any(map(str.strip, row))]
    except csv.Error as error:
        raise ReenactError(f"{path}: expected comma-separated values ({error})") from None
    if not lines:
        raise ReenactError(f"{path}: expected a header and rows, got only empty lines")
    header, body = [cell.strip() for cell in lines[0]], lines[1:]
    while header and not header[-1]:  # a comma at the end of the line
        header.pop()
    check_names(path, header)
    for number, row in enumerate(body, 1):
        while len(row) > len(header) and not row[-1].strip():
            row.pop()
        if len(row) != len(header):
            raise ReenactError(f"{path}: expected {len(header)} cells in row {number}, got {len(row)}; is it cut off?")
    return header, [[cell.strip() for cell in row] for row in body]


def header(path: Path) -> list[str]:
    """Column names of a .csv file.

    Raises:
        ReenactError: As `rows`.
    """
    return rows(path)[0]


def numbers(path: Path, columns: Sequence[str], body: Sequence[Sequence[str]]) -> Float[np.ndarray, "T K"]:
    """The cells as numbers.

    Raises:
        ReenactError: A cell that is not a finite number, by row and column.
    """
    values = np.empty((len(body), len(columns)))
    for index, row in enumerate(body):
        try:
            values[index] = [float(cell) for cell in row]
        except ValueError:
            values[index] = [_number(cell) for cell in row]
    wrong = ~np.isfinite(values)
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        cell = body[row][column][:40]
        raise ReenactError(f"{path}: expected a number in row {row + 1}, column {columns[column]}, got {cell!r}")
    return values


def check_names(path: Path, names: Sequence[str]) -> None:
    """
    Raises:
        ReenactError: A name is empty or doubled.
    """
    if not names or not all(names):
        raise ReenactError(f"{path}: expected a name for every column, column {len(names)} or before has none")
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ReenactError(f"{path}: column names must differ, doubled: {', '.join(doubled)[:200]}")


def load_csv(path: Path) -> Clip:
    """The clip in a table; its frame rate is read off the times, and gaps between them are filled linearly.

    Raises:
        ReenactError: No column `time`, no other column, or anything in it that is not a number.
    """
    titles, body = rows(path)
    clocks = [index for index, name in enumerate(titles) if name.lower() == "time"]
    if len(clocks) != 1 or len(titles) < 2:
        found = ", ".join(titles[:4])
        raise ReenactError(f"{path}: expected a column time (or Timecode) and one per blendshape, got {found[:200]}")
    values = numbers(path, titles, body)
    names = tuple(name for index, name in enumerate(titles) if index != clocks[0])
    weights, fps = steady(str(path), values[:, clocks[0]], np.delete(values, clocks[0], axis=1))
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


def save_csv(clip: Clip, path: Path) -> None:
    """Writes the clip as a table; float32 weights survive exactly.

    Raises:
        ReenactError: The file cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time", *clip.names])
    for frame, row in enumerate(clip.weights.detach().cpu().numpy()):
        writer.writerow([repr(frame / clip.fps), *(str(value) for value in row)])
    disk.write_bytes(path, text.getvalue().encode())


def load_npz(path: Path) -> Clip:
    """The clip in a .npz table.

    Raises:
        ReenactError: An array is missing, of the wrong kind or size, or not finite.
    """
    arrays = npz.read(path, ("names", "weights", "time", "fps"))
    names = npz.names(path, arrays)
    weights = npz.floats(path, arrays, "weights", (None, len(names)))
    check_names(path, names)
    if len(weights) == 0:
        raise ReenactError(f"{path}: expected at least one frame in weights, got none")
    if "fps" in arrays:
        fps = float(npz.floats(path, arrays, "fps", (), np.float64))
        return Clip(names, torch.from_numpy(weights), fps)
    if "time" not in arrays:
        raise ReenactError(f"{path}: expected an array time or fps beside weights, got neither")
    times = npz.floats(path, arrays, "time", (len(weights),), np.float64)
    weights, fps = steady(str(path), times, weights)
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


def save_npz(clip: Clip, path: Path) -> None:
    """Writes the clip as names, time, fps and weights.

    Raises:
        ReenactError: The file cannot be written.
    """
    time = np.arange(len(clip)) / clip.fps
    weights = clip.weights.detach().cpu().numpy()
    npz.write(path, names=np.array(clip.names), time=time, fps=np.float64(clip.fps), weights=weights)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
