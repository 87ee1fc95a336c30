"""Live Link Face: the CSV that Epic's phone app records, 52 ARKit weights and nine rotations a frame.

A timecode is HH:MM:SS:FF.sub, where FF counts frames of 1/60 or 1/30 s and `sub` is a fraction of one; a
take that never counts to 30 is taken for 30 frames a second. Producers
disagree on order and case, so columns are found by name. Takes have dropped and doubled frames: a clip is made at a
constant rate by the times, not by counting rows.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import torch

from reenact.errors import ReenactError
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, table
from reenact.rigs.timeline import steady

ROTATIONS = tuple(part + turn for part in ("Head", "LeftEye", "RightEye") for turn in ("Yaw", "Pitch", "Roll"))
"""Columns after the weights, in radians: `Clip.rotations`."""


def is_livelink(header: list[str]) -> bool:
    """Whether a table with these columns is a Live Link Face take."""
    return any(name.lower() == "timecode" for name in header)


def load(path: Path) -> Clip:
    """The take, by ARKit names in the order of the file. Rows without a tracked face count as dropped.

    Rotations are there where the file has any; those that it lacks, or leaves empty, are 0. Warns about columns that
    are no ARKit shapes and no rotations, and are not loaded.

    Raises:
        ReenactError: No timecodes, no ARKit columns, one of them twice, or a cell that is not a number.
    """
    header, body = table.rows(path)
    if not is_livelink(header):
        raise ReenactError(f"{path}: expected a column Timecode, got {', '.join(header[:4])[:200]}")
    clock = next(index for index, name in enumerate(header) if name.lower() == "timecode")
    columns = {index: name for index, raw in enumerate(header) if (name := arkit.canonical(raw)) is not None}
    if not columns:
        raise ReenactError(f"{path}: expected columns named as ARKit shapes, got {', '.join(header[:4])[:200]}")
    names = tuple(columns.values())
    table.check_names(path, names)
    body = [row for row in body if any(row[index] for index in columns)]
    times = _seconds(path, [row[clock] for row in body])
    spellings = [header[index] for index in columns]
    values = table.numbers(path, spellings, [[row[index] for index in columns] for row in body])
    turns = _rotations(path, header, body)
    made, fps = steady(str(path), times, values if turns is None else np.concatenate([values, turns], axis=1))
    _report_rest(path, header, {clock, *columns})
    made = torch.from_numpy(made.astype(np.float32))
    return Clip(names, made[:, : len(names)].clone(), fps, None if turns is None else made[:, len(names) :].clone())


def save(clip: Clip, path: Path) -> None:
    """Writes a take with eight decimals to a number; rotations and ARKit shapes that the clip lacks are 0.

    Frames are counted at 30 per second for clips of 30 frames per second and at 60 otherwise, with fractions where the
    clip's frames fall between. The first is at 0 s or, counting 60, at half a second: a frame number of 30 or more is
    all that tells the two apart.

    Raises:
        ReenactError: A name of the clip is not ARKit's, or two are the same shape; the file cannot be written.
    """
    known = [arkit.canonical(name) for name in clip.names]
    strange = [name for name, shape in zip(clip.names, known) if shape is None or known.count(shape) > 1]
    if strange:
        raise ReenactError(
            f"{path}: Live Link Face holds the ARKit shapes once each, not {', '.join(strange)[:200]}; "
            "write a table (.npz, .table.csv) instead"
        )
    weights = np.zeros((len(clip), len(arkit.NAMES)))
    weights[:, [arkit.NAMES.index(name) for name in known]] = clip.weights.detach().cpu().numpy()
    rate, start = (30, 0) if clip.fps == 30 else (60, 30)
    header = ["Timecode", "BlendShapeCount", *(name[0].upper() + name[1:] for name in arkit.NAMES), *ROTATIONS]
    lines = [",".join(header)]
    turns = np.zeros((len(clip), 9)) if clip.rotations is None else clip.rotations.detach().cpu().numpy()
    for frame, row in enumerate(np.concatenate([weights, turns], axis=1)):
        thousandths = round((frame / clip.fps * rate + start) * 1000)
        slots, sub = divmod(thousandths, 1000)
        seconds, slot = divmod(slots, rate)
        clock = f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}:{slot:02}.{sub:03}"
        lines.append(",".join([clock, "61", *(f"{value:.8f}" for value in row)]))
    disk.write_bytes(path, ("\n".join(lines) + "\n").encode())


def _seconds(path: Path, timecodes: list[str]) -> np.ndarray:
    """Times of the rows; they may pass midnight once."""
    fields = []
    for number, text in enumerate(timecodes, 1):
        match = re.fullmatch(r"(\d{1,2}):(\d{1,2}):(\d{1,2})[:;](\d{1,3}(?:\.\d{1,9})?)", text, re.ASCII)
        if match is None or int(match[2]) > 59 or int(match[3]) > 59:
            raise ReenactError(f"{path}: expected Timecode HH:MM:SS:FF.sub in tracked row {number}, got {text[:40]!r}")
        fields.append([float(group) for group in match.groups()])
    if not fields:
        raise ReenactError(f"{path}: expected at least one row with a tracked face, got none")
    hours, minutes, seconds, slots = np.array(fields).T
    if slots.max() >= 60:
        raise ReenactError(f"{path}: expected Timecode frames below 60, got {slots.max():g}")
    rate = 30 if slots.max() < 30 else 60
    times = hours * 3600 + minutes * 60 + seconds + slots / rate
    day = 86400
    return times + day * (times < times[0] - day / 2)


def _rotations(path: Path, header: list[str], body: list[list[str]]) -> np.ndarray | None:
    """Rotations (T, 9); None without any such column."""
    place = {name.lower(): index for index, name in enumerate(header)}
    found = [place.get(name.lower()) for name in ROTATIONS]
    if all(index is None for index in found):
        return None
    cells = [["0" if index is None else row[index] or "0" for index in found] for row in body]
    return table.numbers(path, ROTATIONS, cells)


def _report_rest(path: Path, header: list[str], used: set[int]) -> None:
    known = {"blendshapecount", *(name.lower() for name in ROTATIONS)}
    strange = [name for index, name in enumerate(header) if index not in used and name.lower() not in known]
    if strange:
        warnings.warn(
            f"{path}: columns that are no ARKit shape are not loaded: {', '.join(strange)[:300]}", stacklevel=4
        )
