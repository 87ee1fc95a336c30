"""Rigs and clips by name: built-in, synthetic, or files in a format that the suffix says."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Iterable
from pathlib import Path

import torch

from reenact.errors import ReenactError
from reenact.rigs import arkit, motion
from reenact.rigs.clip import Clip
from reenact.rigs.formats import gltf, livelink, npz, table
from reenact.rigs.rig import Rig

RIG_SUFFIXES = (".glb", ".gltf", ".npz")
"""Files that `load_rig` reads."""

CLIP_SUFFIXES = (".csv", ".npz", ".glb", ".gltf")
"""Files that `load_clip` reads."""


def load_rig(name_or_path: str) -> Rig:
    """A built-in character such as `anny:man`, or the rig in a file.

    Raises:
        ReenactError: No such character or file, an unknown suffix, or a file that cannot be read as a rig.
    """
    if name_or_path.startswith("anny:"):
        from reenact.rigs import anny  # heavy, and only some commands build characters

        if name_or_path not in anny.BUILT_IN:
            raise ReenactError(f"{name_or_path}: no such character{_nearest(name_or_path, anny.BUILT_IN)}")
        return anny.build(name_or_path)
    path = _existing(name_or_path, RIG_SUFFIXES, "rig")
    if path.suffix.lower() != ".npz":
        return gltf.load(path)
    if "weights" in npz.contents(path):
        raise ReenactError(f"{path}: expected a rig, found a clip (it has weights); give it where a clip is asked for")
    return npz.load(path)


def save_rig(rig: Rig, path: str | Path, clip: Clip | None = None) -> None:
    """Writes the rig as .glb, there with the clip as its animation if one is given, or as .npz.

    Raises:
        ReenactError: Another suffix, a clip with .npz, a clip for other shapes, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() == ".glb":
        gltf.save(rig, path, None if clip is None else conform(clip, rig))
    elif path.suffix.lower() == ".npz":
        if clip is not None:
            raise ReenactError(f"{path}: .npz holds a rig or a clip, not both; write a .glb")
        npz.save(rig, path)
    else:
        raise ReenactError(f"{path}: a rig is written as .glb or .npz, got {path.suffix or 'no suffix'}")


def load_clip(text: str, rig: Rig) -> Clip:
    """The clip with the rig's shapes, in the rig's order; see `conform`.

    Args:
        text: A file (.csv of Live Link Face or a table, .npz, .glb or .gltf with animation), or
            `synthetic:SEED[:SECONDS[:KIND]]` for motion made by `motion.synthesize`, 20 seconds of "mixed" unless said.
        rig: Whose shapes the clip is to have.

    Raises:
        ReenactError: No such file, an unknown suffix, a file that cannot be read as a clip, or no shape in common.
    """
    if text.startswith("synthetic"):
        return _synthetic(text, rig)
    path = _existing(text, CLIP_SUFFIXES, "clip")
    return conform(_read_clip(path), rig, str(path))


def read_clip(path: str | Path) -> Clip:
    """The clip in a file with the names that the file has, for any rig or none.

    Raises:
        ReenactError: No such file, an unknown suffix, or a file that cannot be read as a clip.
    """
    return _read_clip(_existing(str(path), CLIP_SUFFIXES, "clip"))


def save_clip(clip: Clip, path: str | Path, rig: Rig | None = None) -> None:
    """Writes the clip as .csv, .npz, or together with its rig as .glb.

    A .csv is a Live Link Face take where every name is a different ARKit shape, and a table otherwise or where the name
    ends in .table.csv.

    Raises:
        ReenactError: Another suffix, .glb without a rig, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".csv":
        shapes = [arkit.canonical(name) for name in clip.names]
        takes = None not in shapes and len(set(shapes)) == len(shapes)
        if takes and not path.name.lower().endswith(".table.csv"):
            livelink.save(clip, path)
        else:
            table.save_csv(clip, path)
    elif suffix == ".npz":
        table.save_npz(clip, path)
    elif suffix == ".glb":
        if rig is None:
            raise ReenactError(f"{path}: a clip in .glb needs the rig that it moves; write .csv or .npz without one")
        gltf.save(rig, path, conform(clip, rig))
    else:
        raise ReenactError(f"{path}: a clip is written as .csv, .npz or .glb, got {path.suffix or 'no suffix'}")


def conform(clip: Clip, rig: Rig, where: str = "clip") -> Clip:
    """The clip with the rig's shapes, in the rig's order.

    A shape takes the column with its name. Without one it takes the mean of the columns that stand for the same ARKit
    shapes (`arkit.meaning`): `eyeBlink_L` takes `EyeBlinkLeft`; both halves of a split `browInnerUp` take the whole,
    and the whole the mean of the halves; a merged `eyeBlink` takes the mean of both sides. Shapes that nothing matches
    stay at 0. Warns of columns that move but match no shape, and of shapes that stay at 0.

    Raises:
        ReenactError: Nothing matches.
    """
    if clip.names == rig.names:
        return clip
    column_of = {name: index for index, name in enumerate(clip.names)}
    standing: dict[str, list[int]] = {}
    for index, name in enumerate(clip.names):
        for part in arkit.meaning(name):
            standing.setdefault(part, []).append(index)
    mixing = torch.zeros(len(clip.names), len(rig.names), dtype=clip.weights.dtype, device=clip.weights.device)
    for index, name in enumerate(rig.names):
        if name in column_of:
            mixing[column_of[name], index] = 1
            continue
        parts = [standing[part] for part in arkit.meaning(name) if part in standing]
        for columns in parts:
            for column in columns:
                mixing[column, index] += 1 / (len(parts) * len(columns))
    if not mixing.any():
        raise ReenactError(
            f"{where}: none of its {len(clip.names)} shapes ({', '.join(clip.names[:3])}, ...) is one of {rig.name} "
            f"({', '.join(rig.names[:3])}, ...); rename its columns"
        )
    unused = (mixing == 0).all(1) & (clip.weights.abs().amax(0) > 0 if len(clip) else False)
    lost = [clip.names[index] for index in unused.nonzero().flatten().tolist()]
    still = [rig.names[index] for index in (mixing == 0).all(0).nonzero().flatten().tolist()]
    if lost:
        warnings.warn(f"{where}: shapes that {rig.name} lacks are left out: {', '.join(lost)}", stacklevel=2)
    if still:
        warnings.warn(f"{where}: shapes of {rig.name} that it lacks stay at 0: {', '.join(still)}", stacklevel=2)
    return Clip(rig.names, clip.weights @ mixing, clip.fps)


def _synthetic(text: str, rig: Rig) -> Clip:
    fields = text.split(":")
    try:
        head, seed, *rest = fields
        if head != "synthetic" or len(rest) > 2 or int(seed) < 0:
            raise ValueError(text)
        seconds = float(rest[0]) if rest else 20.0
    except ValueError:
        raise ReenactError(f"{text}: expected synthetic:SEED[:SECONDS[:KIND]], as in synthetic:7:20:speech") from None
    kind = rest[1] if len(rest) == 2 else "mixed"
    return motion.synthesize(rig.names, seconds, int(seed), kind=kind)


def _read_clip(path: Path) -> Clip:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        if "neutral" in npz.contents(path):
            raise ReenactError(
                f"{path}: expected a clip, found a rig (it has a neutral); give it where a rig is asked for"
            )
        return table.load_npz(path)
    if suffix != ".csv":
        return gltf.load_clip(path)
    return livelink.load(path) if livelink.is_livelink(table.header(path)) else table.load_csv(path)


def _existing(text: str, suffixes: tuple[str, ...], noun: str) -> Path:
    """The path, which has one of the suffixes and is there."""
    path = Path(text)
    if path.suffix.lower() not in suffixes:
        known = [*suffixes, *(("anny:man",) if noun == "rig" else ("synthetic:0",))]
        hint = _nearest(path.suffix or text, known)
        raise ReenactError(
            f"{text}: expected a {noun}, one of {', '.join(known)}, got {path.suffix or 'no suffix'}{hint}"
        )
    try:
        there = path.exists()
        beside = [str(path.parent / entry.name) for entry in path.parent.iterdir()] if not there else []
    except (OSError, ValueError):
        there, beside = False, []
    if not there:
        raise ReenactError(f"{text}: no such file{_nearest(text, beside)}")
    return path


def _nearest(text: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(text, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""
