"""FBX: rigs with blend channels, and their weight animation, in .fbx; read only.

Reading needs the package `ufbx` and runs in a process of its own (`isolated`).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import isolated, pictures
from reenact.rigs.formats.pieces import DEFAULT, Choice, Contents, assemble
from reenact.rigs.formats.polygons import Mesh, Surface, pieces_of
from reenact.rigs.rig import Rig


def load(path: Path, choice: Choice = DEFAULT) -> Rig:
    """The rig in the file; see `read`.

    Raises:
        ReenactError: As `read`.
    """
    return read(path, choice)[0]


def read(path: Path, choice: Choice = DEFAULT) -> tuple[Rig, Contents]:
    """The rig that the blend channels of a file make together, and what the file held.

    Unit, axes and transforms are applied; a skinned mesh stands as it was bound. Of a channel with shapes in between
    the full one counts. Pictures may be embedded, or lie in the file's folder or below.

    Raises:
        ReenactError: `ufbx` is not installed; the file is damaged, or has no blend channels.
    """
    scene = _scene(path)
    found, described, missing = pictures.gather(path, scene["pictures"])
    meshes = _meshes(scene, found)
    pieces = [piece for mesh in meshes for piece in pieces_of(path, mesh)]
    made = assemble(path, pieces, choice, found)
    units = []
    if scene["meters"] != 1:
        units.append(f"units of {scene['meters']:g} m made metres")
    if scene["turned"]:
        units.append("axes turned to +Y up")
    converted = dict.fromkeys([*units, *scene["notes"], *missing, *made.converted])
    animations = tuple(
        f"{take['name']}: {len(take['weights'])} frames at {take['rate']:g} per second, {len(_moving(take))} of "
        f"{len(take['names'])} shapes move"
        for take in scene["animations"]
    )
    creator = f", made by {scene['creator']}" if scene["creator"] else ""
    return made.rig, Contents(f"FBX{creator}", made.meshes, tuple(converted), animations, described)


def load_clip(path: Path) -> Clip:
    """The weights that the first moving take of a file gives its blend channels, at the file's frame rate.

    Raises:
        ReenactError: As `read`, or no take moves a blend channel.
    """
    scene = _scene(path)
    take = next((take for take in scene["animations"] if len(_moving(take))), None)
    if take is None:
        raise ReenactError(
            f"{path}: expected an animation of blend channels, got none; export the file with its shape key animation"
        )
    weights = take["weights"]
    if not np.isfinite(weights).all():
        raise ReenactError(f"{path}: the animation holds NaN or infinity; export it again")
    return Clip(tuple(take["names"]), torch.from_numpy(weights.astype(np.float32)), take["rate"])


def _scene(path: Path) -> dict[str, Any]:
    if importlib.util.find_spec("ufbx") is None:
        raise ReenactError(f"{path}: needs the package ufbx; pip install reenact[fbx]")
    return isolated.read(path, "fbx_scene:scene", "an FBX file")


def _meshes(scene: dict[str, Any], found: Collection[str]) -> list[Mesh]:
    names = [entry["name"] for entry in scene["meshes"]]
    meshes = []
    for index, entry in enumerate(scene["meshes"]):
        uv = entry.get("uv")
        surfaces = tuple(
            Surface(
                each["name"],
                tuple(each["color"]),
                each["picture"] if each["picture"] in found else None,
                each["opacity"],
            )
            for each in entry["surfaces"]
        )
        meshes.append(
            Mesh(
                name=entry["name"] if names.count(entry["name"]) == 1 else f"{entry['name']} {index}",
                positions=entry["positions"],
                names=tuple(entry["names"]),
                shapes={name: (rows, offsets) for name, (rows, offsets) in entry["shapes"].items()},
                counts=entry["counts"],
                corners=entry["corners"],
                matrix=entry["matrix"],
                uv=None if uv is None else np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1),
                uv_corners=entry.get("uv_corners"),
                colors=entry.get("colors"),
                surfaces=surfaces,
                surface=entry["surface"],
                label=entry["label"],
            )
        )
    return meshes


def _moving(take: dict[str, Any]) -> np.ndarray:
    """Columns whose weights change."""
    weights = take["weights"]
    if len(weights) == 0:
        return np.zeros(0, np.int64)
    return np.flatnonzero(~(np.ptp(weights, axis=0) < 1e-7))  # between equal keys, curves differ by rounding; NaN moves
