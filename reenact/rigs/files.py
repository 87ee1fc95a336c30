"""Rigs and clips by name: built-in, synthetic, or files in a format that the suffix says."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType

from reenact.errors import ReenactError
from reenact.rigs import arkit, motion
from reenact.rigs.clip import Clip
from reenact.rigs.formats import npz
from reenact.rigs.formats.pieces import DEFAULT, Choice, Contents, reduced
from reenact.rigs.matching import conform
from reenact.rigs.rig import Rig

_GLTF, _USD = (".glb", ".gltf", ".vrm"), (".usd", ".usda", ".usdc", ".usdz")
_MODULES = {".npz": "npz", **dict.fromkeys(_GLTF, "gltf"), **dict.fromkeys(_USD, "usd"), ".fbx": "fbx", ".obj": "obj"}
"""Module of `formats` that reads rigs with a suffix; a folder holds .obj files."""

RIG_SUFFIXES = tuple(_MODULES)
"""Files that `load_rig` reads."""

CLIP_SUFFIXES = (".csv", ".npz", ".json", *_GLTF, *_USD, ".fbx")
"""Files that `load_clip` reads."""

SAVED_RIGS = (".glb", ".npz", *_USD, ".obj")
"""Files that `save_rig` writes; .obj a folder of them."""

SAVED_CLIPS = (".csv", ".npz", ".json", ".glb", ".vrm", *_USD, ".py")
"""Files that `save_clip` writes."""


def load_rig(name_or_path: str, choice: Choice = DEFAULT) -> Rig:
    """A built-in character such as `anny:man`, or the rig in a file or a folder of .obj files.

    Warns of meshes of the file that are left out; `choice` takes others.

    Raises:
        ReenactError: No such character or file, an unknown suffix, or a file that cannot be read as a rig.
    """
    rig, contents = read_rig(name_or_path, choice)
    left = [mesh.name for mesh in contents.meshes if not mesh.used]
    if left and choice == DEFAULT:
        warnings.warn(
            f"{name_or_path}: meshes without shapes are left out: {', '.join(left)[:300]}; choose others by --parts",
            stacklevel=2,
        )
    return rig


def read_rig(name_or_path: str, choice: Choice = DEFAULT) -> tuple[Rig, Contents]:
    """The rig of `load_rig`, and what its file holds.

    Raises:
        ReenactError: As `load_rig`.
    """
    if name_or_path.startswith("anny:"):
        from reenact.rigs import anny  # heavy, and only some commands build characters

        if name_or_path not in anny.BUILT_IN:
            raise ReenactError(f"{name_or_path}: no such character{_nearest(name_or_path, anny.BUILT_IN)}")
        return reduced(anny.build(name_or_path), choice, "built-in character")
    path = Path(name_or_path)
    if path.is_dir():
        return _module("obj").read(path, choice)
    path = _existing(name_or_path, RIG_SUFFIXES, "rig")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        if "weights" in npz.contents(path):
            raise ReenactError(
                f"{path}: expected a rig, found a clip (it has weights); give it where a clip is asked for"
            )
        return reduced(npz.load(path), choice, "Reenact's own arrays")
    with _naming(path):
        return _module(_MODULES[suffix]).read(path, choice)


def save_rig(rig: Rig, path: str | Path, clip: Clip | None = None) -> None:
    """Writes the rig as .glb or USD, there with the clip as its animation if one is given, as .npz, or as a folder of
    .obj files.

    Raises:
        ReenactError: Another suffix, a clip with .npz or .obj, a clip for other shapes, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    moved = None if clip is None else conform(clip, rig)
    if suffix in (".glb", *_USD):
        _module("gltf_write" if suffix == ".glb" else "usd").save(rig, path, moved)
    elif clip is not None and suffix in (".npz", ".obj", ""):
        raise ReenactError(f"{path}: {suffix or 'a folder'} holds a rig or a clip, not both; write a .glb")
    elif suffix == ".npz":
        npz.save(rig, path)
    elif suffix == ".obj" or path.is_dir():
        _module("obj").save(rig, path.with_suffix("") if suffix else path)
    else:
        raise ReenactError(f"{path}: a rig is written as {', '.join(SAVED_RIGS)}, got {suffix or 'no suffix'}")


def load_clip(text: str, rig: Rig) -> Clip:
    """The clip with the rig's shapes, in the rig's order; see `conform`.

    Args:
        text: A file (.csv of Live Link Face or a table; .json of Audio2Face or a table; .npz; .glb, .gltf, .vrm, .fbx
            or USD with animation), or `synthetic:SEED[:SECONDS[:KIND]]` for motion made by `motion.synthesize`, 20
            seconds of "mixed" unless said.
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


def save_clip(clip: Clip, path: str | Path, rig: Rig | None = None, avatar: str | None = None) -> None:
    """Writes the clip, or the clip together with the rig that it moves, by the suffix.

    - .csv: a Live Link Face take where every name is a different ARKit shape; a table otherwise, or where the name ends
      in .table.csv.
    - .json: a table; Audio2Face weights where the name ends in .a2f.json.
    - .npz: a table.
    - .py: a script that keys the shapes in Blender; in Maya where the name ends in .maya.py.
    - .glb, .vrm: the avatar itself with the clip as its first animation, if that is a glTF file; else the rig.
    - USD: the rig with its animation.

    Args:
        clip: What to write.
        path: Where.
        rig: The rig that it moves, for formats that hold one.
        avatar: Name or file that the rig came from.

    Raises:
        ReenactError: Another suffix, no rig for a format that holds one, or the file cannot be written.
    """
    path, name = Path(path), Path(path).name.lower()
    suffix = path.suffix.lower()
    if suffix == ".csv":
        shapes = [arkit.canonical(each) for each in clip.names]
        take = None not in shapes and len(set(shapes)) == len(shapes) and not name.endswith(".table.csv")
        _module("livelink").save(clip, path) if take else _module("table").save_csv(clip, path)
    elif suffix == ".json":
        _module("audio2face" if name.endswith(".a2f.json") else "json_table").save(clip, path)
    elif suffix == ".npz":
        _module("table").save_npz(clip, path)
    elif suffix == ".py":
        dcc = _module("dcc")
        (dcc.save_maya if name.endswith(".maya.py") else dcc.save_blender)(clip, path)
    elif suffix in (".glb", ".vrm", *_USD):
        if avatar is not None and suffix not in _USD and Path(avatar).suffix.lower() in _GLTF:
            lost = _module("gltf_write").animate(Path(avatar), clip, path)
            if lost:
                warnings.warn(f"{avatar}: shapes of the clip that it lacks: {', '.join(lost)[:300]}", stacklevel=2)
        elif suffix == ".vrm":
            raise ReenactError(f"{path}: a .vrm is written from a .vrm or .glb avatar, got {avatar or 'none'}")
        elif rig is None:
            raise ReenactError(
                f"{path}: a clip in {suffix} needs the rig that it moves; write .csv or .npz without one"
            )
        else:
            save_rig(rig, path, clip)
    else:
        raise ReenactError(f"{path}: a clip is written as {', '.join(SAVED_CLIPS)}, got {suffix or 'no suffix'}")


def _module(name: str) -> ModuleType:
    return import_module(f"reenact.rigs.formats.{name}")


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


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Errors within say which file they are about."""
    try:
        yield
    except ReenactError as error:
        if str(path) in str(error):
            raise
        raise ReenactError(f"{path}: {str(error).removeprefix('clip: ')}") from None


def _read_clip(path: Path) -> Clip:
    with _naming(path):
        return _clip_of(path)


def _clip_of(path: Path) -> Clip:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        if "neutral" in npz.contents(path):
            raise ReenactError(
                f"{path}: expected a clip, found a rig (it has a neutral); give it where a rig is asked for"
            )
        return _module("table").load_npz(path)
    if suffix == ".csv":
        table = _module("table")
        livelink = _module("livelink")
        audio2face = _module("audio2face")
        header = table.header(path)
        if audio2face.is_audio2face_csv(header):
            return audio2face.load_csv(path)
        return livelink.load(path) if livelink.is_livelink(header) else table.load_csv(path)
    if suffix == ".json":
        json_table, audio2face = _module("json_table"), _module("audio2face")
        return (audio2face if audio2face.is_audio2face(json_table.read(path)) else json_table).load(path)
    return _module(_MODULES[suffix]).load_clip(path)


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
