"""Polygon meshes as OBJ, USD and FBX have them, made into `Piece`s.

These formats share vertices between faces of any number of corners, keep uv per corner and a material per face. A rig
has triangles, one colour per vertex and one picture; what that costs is decided here, once.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from reenact.errors import ReenactError
from reenact.rigs.formats import disk
from reenact.rigs.formats.pieces import Piece, part_named
from reenact.rigs.rig import PARTS

BOUND = 1e30
"""Largest coordinate; beyond it squares are no longer finite in float32."""


@dataclass(frozen=True)
class Surface:
    """A material, as far as a rig has use for it."""

    name: str = ""
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear; multiplies vertex colours and the picture."""
    picture: Hashable | None = None
    """Key into the pictures of the file."""
    opacity: float = 1.0


@dataclass(frozen=True)
class Mesh:
    """A mesh as it stands in a file, true or not: sizes and indices are checked by `pieces_of`."""

    name: str
    positions: Float[np.ndarray, "_ 3"]
    names: tuple[str, ...]
    """Shapes, all different, in the order of the file."""
    shapes: Mapping[str, tuple[Int[np.ndarray, "_"] | None, Float[np.ndarray, "_ 3"]]]
    """Vertices that move, None for all, and by how much; those of `names` that move nothing may be left out."""
    counts: Int[np.ndarray, "_"]
    """Corners of each face."""
    corners: Int[np.ndarray, "_"]
    """Vertex of each corner, face after face."""
    matrix: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """To metres, +Y up, applied to columns."""
    clockwise: bool = False
    """Whether corners go clockwise seen from outside."""
    uv: Float[np.ndarray, "_ 2"] | None = None
    """(0, 0) top left."""
    uv_corners: Int[np.ndarray, "_"] | None = None
    """uv of each corner; None where uv go with the vertices."""
    colors: Float[np.ndarray, "_ 3"] | None = None
    """Linear."""
    surfaces: tuple[Surface, ...] = (Surface(),)
    surface: Int[np.ndarray, "_"] | None = None
    """Index into `surfaces` of each face; None where it is 0 for all."""
    label: str = ""
    """What mesh and node are called, for the part."""
    labels: tuple[str, ...] = ()
    """What groups of faces are called, for the part."""
    group: Int[np.ndarray, "_"] | None = None
    """Index into `labels` of each face."""
    part: Int[np.ndarray, "_"] | None = None
    """Index into `PARTS`, where the file says it."""


def pieces_of(where: Path, mesh: Mesh) -> list[Piece]:
    """The pieces of a mesh: one, or one per picture where its materials have several.

    Faces become fans of triangles; those with a corner twice or fewer than three corners are left out. Vertices keep
    their order. One that lies between materials of different colours is there once more for each further colour, after
    the others.

    Raises:
        ReenactError: A number is not finite or far too large, an index names nothing, sizes disagree.
    """
    _check(where, mesh)
    matrix = mesh.matrix
    positions = mesh.positions
    if not np.array_equal(matrix, np.eye(4)):
        positions = positions @ matrix[:3, :3].T + matrix[:3, 3]
    first, second, third, face = _fans(mesh.counts)
    mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0)
    if mesh.clockwise != mirrored:
        second, third = third, second
    place = np.stack([first, second, third], axis=1)  # (F, 3) corners
    faces = mesh.corners[place]
    sound = (faces != np.roll(faces, 1, axis=1)).all(1)
    place, faces, face = place[sound], faces[sound], face[sound]
    surface = np.zeros(len(face), np.int64) if mesh.surface is None else mesh.surface[face]
    part = _parts(mesh, faces, face, surface)
    shapes = {}
    for name, (rows, offsets) in mesh.shapes.items():
        if not np.array_equal(matrix[:3, :3], np.eye(3)):
            offsets = offsets @ matrix[:3, :3].T
        moved = np.zeros(positions.shape, np.float32)
        moved[slice(None) if rows is None else rows] = offsets
        shapes[name] = moved
    whole = np.arange(len(positions))
    used = sorted({0, *np.unique(surface).tolist()}) if len(surface) == 0 else np.unique(surface).tolist()
    keys = list(dict.fromkeys(_picture(mesh, index) for index in used))
    pieces = []
    for key in keys:
        mine = np.isin(surface, [index for index in used if _picture(mesh, index) == key])
        # A vertex without a face stays with the first piece.
        owned = np.union1d(faces[mine], np.setdiff1d(whole, faces)) if key == keys[0] else np.unique(faces[mine])
        vertex = whole if len(keys) == 1 else owned
        pieces.append(_piece(mesh, positions, shapes, part, vertex, faces[mine], place[mine], surface[mine], key))
    # Pieces of one mesh are closed again along their borders, where nothing else differs.
    return pieces if len(pieces) == 1 else [replace(piece, split=True) for piece in pieces]


def _piece(
    mesh: Mesh,
    positions: np.ndarray,
    shapes: Mapping[str, np.ndarray],
    part: np.ndarray | None,
    vertex: np.ndarray,
    faces: np.ndarray,
    place: np.ndarray,
    surface: np.ndarray,
    key: Hashable | None,
) -> Piece:
    tints = np.array([each.color for each in mesh.surfaces], np.float64).reshape(-1, 3)
    kinds, kind = np.unique(tints, axis=0, return_inverse=True)
    kind = kind.reshape(-1)[surface]  # (F,) which colour
    # Pairs of vertex and colour; the first colour of a vertex keeps its place.
    pairs = np.stack([faces.reshape(-1), np.repeat(kind, 3)], axis=1)
    lead = np.full(len(positions), -1)
    lead[pairs[::-1, 0]] = pairs[::-1, 1]
    more = np.unique(pairs[pairs[:, 1] != lead[pairs[:, 0]]], axis=0)
    index = np.full(len(positions), -1)
    index[vertex] = np.arange(len(vertex))
    lookup = {(int(a), int(b)): len(vertex) + row for row, (a, b) in enumerate(more)}
    corners = index[pairs[:, 0]]
    for row in np.flatnonzero(pairs[:, 1] != lead[pairs[:, 0]]):
        corners[row] = lookup[int(pairs[row, 0]), int(pairs[row, 1])]
    taken = np.concatenate([vertex, more[:, 0]])
    tint = kinds[np.concatenate([np.maximum(lead[vertex], 0), more[:, 1]])]
    colors = tint if mesh.colors is None else tint * mesh.colors[taken]
    uv, uv_faces = mesh.uv, None
    if uv is not None:
        uv_faces = faces if mesh.uv_corners is None else mesh.uv_corners[place]
    opacity = np.array([each.opacity for each in mesh.surfaces])[surface]
    names = " ".join(dict.fromkeys(mesh.surfaces[index].name for index in np.unique(surface)))
    return Piece(
        mesh=mesh.name,
        positions=positions[taken],
        shapes={name: moved[taken] for name, moved in shapes.items()},
        names=mesh.names,
        faces=corners.reshape(-1, 3),
        colors=colors,
        uv=uv,
        uv_faces=uv_faces,
        picture=key,
        part=None if part is None else part[taken],
        label=f"{mesh.label} {names}",
        cutout=opacity if (opacity < 0.5).any() else None,
    )


def _picture(mesh: Mesh, index: int) -> Hashable | None:
    return None if mesh.uv is None else mesh.surfaces[index].picture


def _fans(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corner, next corner, corner after that, and face of each triangle."""
    starts = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    face = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(face)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = starts[face]
    return first, first + step + 1, first + step + 2, face


def _parts(mesh: Mesh, faces: np.ndarray, face: np.ndarray, surface: np.ndarray) -> np.ndarray | None:
    """Part of each vertex: as the file says, or by what its mesh, group and material are called."""
    if mesh.part is not None:
        return mesh.part
    named = part_named(mesh.label)
    part = np.full(len(mesh.positions), named)
    skin = PARTS.index("skin")
    for names, index in (
        ([each.name for each in mesh.surfaces], surface),
        (mesh.labels, None if mesh.group is None else mesh.group[face]),
    ):
        if index is None:
            continue
        kinds = np.array([part_named(f"{mesh.label} {name}") if named == skin else named for name in names])
        for kind in np.unique(kinds[kinds != named]) if len(kinds) else ():
            part[faces[kinds[index] == kind]] = kind
    return part if (part != named).any() else None


def _check(where: Path, mesh: Mesh) -> None:
    name = f"{where}: mesh {mesh.name[:60]!r}"
    count, corner_count = len(mesh.positions), len(mesh.corners)
    if not np.isfinite(mesh.matrix).all() or np.abs(mesh.matrix).max() > BOUND:
        raise ReenactError(f"{name} is placed beyond all bounds; check its transforms")
    for noun, values in (("positions", mesh.positions), ("uv", mesh.uv), ("colours", mesh.colors)):
        if values is not None and values.size and not np.abs(values).max() < BOUND:
            raise ReenactError(f"{name}: {noun} hold NaN, infinity or numbers far too large; export it again")
    if len(mesh.counts) and (mesh.counts.min() < 0 or mesh.counts.max() > corner_count):
        raise ReenactError(f"{name}: a face says it has {mesh.counts.min()} or {mesh.counts.max()} corners")
    if int(mesh.counts.sum()) != corner_count:
        raise ReenactError(f"{name}: expected {int(mesh.counts.sum())} corners of its faces, got {corner_count}")
    if corner_count and (mesh.corners.min() < 0 or mesh.corners.max() >= count):
        raise ReenactError(f"{name}: a face names a vertex outside 0..{count - 1}")
    if len(mesh.shapes) * count * 12 > disk.LIMIT:
        raise ReenactError(f"{name}: {len(mesh.shapes)} shapes of {count} vertices are more than {disk.LIMIT:,} bytes")
    for shape, (rows, offsets) in mesh.shapes.items():
        place = f"{name}, shape {shape[:60]!r}"
        if offsets.shape != (count if rows is None else len(rows), 3):
            expected = f"{count if rows is None else len(rows)} offsets"
            raise ReenactError(f"{place}: expected {expected}, got {len(offsets)}; export it again")
        if rows is not None and len(rows) and (rows.min() < 0 or rows.max() >= count):
            raise ReenactError(f"{place}: moves a vertex outside 0..{count - 1}")
        if offsets.size and not np.abs(offsets).max() < BOUND:
            raise ReenactError(f"{place}: holds NaN, infinity or numbers far too large; export it again")
    if mesh.uv is not None:
        have = count if mesh.uv_corners is None else corner_count
        got = len(mesh.uv) if mesh.uv_corners is None else len(mesh.uv_corners)
        if got != have:
            raise ReenactError(f"{name}: expected {have} uv, got {got}; export it with its uv map again")
        if (
            mesh.uv_corners is not None
            and have
            and not 0 <= mesh.uv_corners.min() <= mesh.uv_corners.max() < len(mesh.uv)
        ):
            raise ReenactError(f"{name}: a face names a uv outside 0..{len(mesh.uv) - 1}")
    for noun, index, size in (
        ("material", mesh.surface, len(mesh.surfaces)),
        ("group", mesh.group, len(mesh.labels)),
    ):
        if index is not None and len(index) and not 0 <= index.min() <= index.max() < size:
            raise ReenactError(f"{name}: a face names a {noun} that is not there")
    if mesh.colors is not None and len(mesh.colors) != count:
        raise ReenactError(f"{name}: expected {count} vertex colours, got {len(mesh.colors)}")


def vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Unit normals, weighted by area; +Z where there is none. float32, for files."""
    a, b, c = vertices[faces].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(normal[:, axis], 3), len(vertices)) for axis in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-30, total / np.maximum(length, 1e-30), [0.0, 0.0, 1.0]).astype(np.float32)
