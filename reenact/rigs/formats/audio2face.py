"""NVIDIA Audio2Face: the weights that its blendshape solver exports as .json, and the .csv of Audio2Face-3D.

The .json has `exportFps`, `trackPath` (the sound), `numPoses` and `facsNames` (K), `numFrames` and `weightMat` (T rows
of K). Some exports also write `joints`, `rotations` (T, J, 4) and `translations` (T, J, 3), which move bones: a clip
has no place for them. Those of older versions lack `exportFps`.

The .csv (`animation_frames.csv` of the service's sample client) has a column `timeCode` in seconds and columns
`blendShapes.EyeBlinkLeft` and so on.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, json_table, table
from reenact.rigs.timeline import steady

FIELDS = ("exportFps", "trackPath", "numPoses", "numFrames", "facsNames", "weightMat")
"""What we read and write."""

RATE = 30.0
"""Frames per second of a file that does not say."""

_PREFIX = "blendshapes."


def is_audio2face(document: Any) -> bool:
    """Whether a parsed .json file has the fields of an Audio2Face export."""
    return isinstance(document, dict) and "facsNames" in document and "weightMat" in document


def load(path: Path) -> Clip:
    """The clip in a .json export.

    Warns of joints that move, and of a file that does not say its frame rate.

    Raises:
        ReenactError: Not JSON, a field is missing or of the wrong kind, its counts disagree, or a weight is not finite.
    """
    document = json_table.read(path)
    if not is_audio2face(document):
        raise ReenactError(f"{path}: expected facsNames and weightMat of Audio2Face, got {json_table.brief(document)}")
    names = json_table.read_names(path, document, "facsNames")
    weights = json_table.read_rows(path, document, "weightMat", names)
    for key, rows, count in (("numPoses", "facsNames", len(names)), ("numFrames", "weightMat", len(weights))):
        said = document.get(key, count)
        if isinstance(said, bool) or said != count:
            raise ReenactError(
                f"{path}: {key} says {json_table.brief(said)}, {rows} has {count}; was the file cut off or edited?"
            )
    json_table.warn_of_motion(path, document, FIELDS)
    if document.get("exportFps") is None:
        warnings.warn(f"{path}: no exportFps, taken as {RATE:g} frames per second", stacklevel=3)
        document = {**document, "exportFps": RATE}
    fps = json_table.read_rate(path, document, "exportFps")
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


def save(clip: Clip, path: Path) -> None:
    """Writes an export without a sound; float32 weights survive exactly.

    Raises:
        ReenactError: The file cannot be written.
    """
    frames, shapes = clip.weights.shape
    fields = {
        "exportFps": repr(clip.fps),
        "trackPath": '""',
        "numPoses": str(shapes),
        "numFrames": str(frames),
        "facsNames": json.dumps(clip.names, ensure_ascii=False),
        "weightMat": json_table.rows_text(clip),
    }
    disk.write_bytes(path, json_table.text([f'"{key}": {value}' for key, value in fields.items()]).encode())


def is_audio2face_csv(header: list[str]) -> bool:
    """Whether a table with these columns is one of Audio2Face-3D."""
    return any(name.lower().startswith(_PREFIX) for name in header)


def load_csv(path: Path) -> Clip:
    """The clip in a .csv of Audio2Face-3D, by the names behind `blendShapes.`, at a constant rate.

    Warns of other columns; they are not loaded.

    Raises:
        ReenactError: No column `timeCode`, no column of weights, or anything in one that is not a number.
    """
    header, body = table.rows(path)
    clocks = [index for index, name in enumerate(header) if name.lower() == "timecode"]
    columns = {index: name for index, name in enumerate(header) if name.lower().startswith(_PREFIX)}
    if len(clocks) != 1 or not columns:
        raise ReenactError(
            f"{path}: expected a column timeCode and columns blendShapes.NAME, got {', '.join(header[:4])[:200]}"
        )
    names = tuple(name[len(_PREFIX) :] for name in columns.values())
    table.check_names(path, names)
    rest = [name for index, name in enumerate(header) if index not in columns and index not in clocks]
    if rest:
        warnings.warn(f"{path}: columns that are no blendshapes are not loaded: {', '.join(rest)[:300]}", stacklevel=3)
    read = [*clocks, *columns]
    values = table.numbers(path, [header[index] for index in read], [[row[index] for index in read] for row in body])
    weights, fps = steady(str(path), values[:, 0], values[:, 1:])
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)
