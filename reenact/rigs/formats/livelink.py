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
"""Columns after the weights, in radians. A `Clip` has no place for them: they are not loaded, and written as 0; where
the eyes look is also in the eyeLook weights."""


def is_livelink(header: list[str]) -> bool:
    """Whether a table with these columns is a Live Link Face take."""
    return any(name.lower() == "timecode" for name in header)


def load(path: Path) -> Clip:
    """The take, by ARKit names in the order of the file. Rows without a tracked face count as dropped.

    Warns about rotations that move, and about columns that are no ARKit shapes; neither is loaded.

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
    weights, fps = steady(str(path), times, values)
    _report_rest(path, header, body, {clock, *columns})
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


def save(clip: Clip, path: Path) -> None:
    """Writes a take with eight decimals to a weight and rotations of 0; ARKit shapes that the clip lacks are 0.

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
    rest = ["0.00000000"] * len(ROTATIONS)
    for frame, row in enumerate(weights):
        thousandths = round((frame / clip.fps * rate + start) * 1000)
        slots, sub = divmod(thousandths, 1000)
        seconds, slot = divmod(slots, rate)
        clock = f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}:{slot:02}.{sub:03}"
        lines.append(",".join([clock, "61", *(f"{value:.8f}" for value in row), *rest]))
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


def _report_rest(path: Path, header: list[str], body: list[list[str]], used: set[int]) -> None:
    turning, strange = [], []
    known = {name.lower() for name in ROTATIONS}
    for index, name in enumerate(header):
        if index in used or name.lower() == "blendshapecount":
            continue
        if name.lower() not in known:
            strange.append(name)
        elif any(row[index].strip("-+0. ") for row in body):
            turning.append(name)
    if turning:
        warnings.warn(
            f"{path}: rotations are not loaded: {', '.join(turning)}; the weights of the blendshapes are", stacklevel=4
        )
    if strange:
        warnings.warn(
            f"{path}: columns that are no ARKit shape are not loaded: {', '.join(strange)[:300]}", stacklevel=4
        )
