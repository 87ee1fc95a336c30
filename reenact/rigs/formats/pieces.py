"""Pieces: the meshes of a file, and the one rig that they make together.

An avatar is rarely one mesh: head, eyes, teeth and lashes have each their own, with shapes of the same names, and body,
hair and clothes stand beside them. Every reader turns what it finds into `Piece`s, in metres and +Y up; what belongs to
the face, which vertices an exporter split, and how several pictures become one texture is decided here, once.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.formats import disk
from reenact.rigs.rig import PARTS, Rig

ATLAS = 2048
"""Largest side, in pixels, of the one texture that several pictures become."""

GUTTER = 8
"""Pixels of its own edge around each picture of an atlas, so that mip maps do not mix neighbours at once."""

_PART_WORDS = (
    ("lashes", r"lash"),
    ("brows", r"brow"),
    ("skin", r"socket.*eye|eye.*socket|eye.?lid"),
    ("tongue", r"tongue"),
    ("teeth", r"teeth|tooth|gum|denture"),
    ("lips", r"\blips?\b|_lips?\b|\blips?_"),
    ("mouth", r"mouth|oral"),
    ("eyes", r"eye|iris|cornea|sclera|pupil"),
)
_FACIAL = ("lashes", "brows", "tongue", "teeth", "lips", "mouth", "eyes")


@dataclass(frozen=True)
class Choice:
    """What of a file becomes the rig. Patterns are names with `*` and `?`, in either case.

    Raises:
        ReenactError: An empty pattern.
    """

    parts: tuple[str, ...] = ()
    """Meshes; none: those with shapes, and eyes, teeth, lashes and tongues without any that lie in the face."""
    shapes: tuple[str, ...] = ()
    """Blendshapes; none: all."""

    def __post_init__(self) -> None:
        if not all(self.parts) or not all(self.shapes):
            raise ReenactError("expected names or patterns of parts and shapes, got an empty one; leave it out")


DEFAULT = Choice()
"""What is taken where nobody chooses."""


@dataclass(frozen=True)
class Piece:
    """One mesh, or one material of a mesh, in metres, +Y up, at rest."""

    mesh: str
    """Name that `Choice.parts` is about."""
    positions: Float[np.ndarray, "V 3"]
    shapes: Mapping[str, Float[np.ndarray, "V 3"]]
    """Offsets by name; those that the mesh names but does not move may be left out."""
    names: tuple[str, ...]
    """All shapes that the mesh names, in its order."""
    faces: Int[np.ndarray, "F 3"]
    colors: Float[np.ndarray, "V 3"]
    """Linear."""
    uv: Float[np.ndarray, "U 2"] | None = None
    uv_faces: Int[np.ndarray, "F 3"] | None = None
    """None where uv go with the vertices."""
    picture: Hashable | None = None
    """Key into the pictures of the file; only with uv."""
    part: Int[np.ndarray, "V"] | None = None
    """Index into `PARTS`, where the file says it; None: from `label`."""
    label: str = ""
    """What mesh, node and material are called, for the part."""
    split: bool = False
    """Whether the format splits vertices along seams, so that equal ones are to be welded."""
    vertex: np.ndarray | None = None
    """Rig vertex that each vertex came from, in files of our own."""
    cutout: Float[np.ndarray, "F"] | None = None
    """How opaque each face is, where the material has holes."""


@dataclass(frozen=True)
class MeshFacts:
    """A mesh of the file, and what became of it."""

    name: str
    vertices: int
    faces: int
    shapes: int
    used: bool
    reason: str


@dataclass(frozen=True)
class Contents:
    """What a file holds, and what was done to make a rig of it."""

    format: str
    meshes: tuple[MeshFacts, ...]
    converted: tuple[str, ...] = ()
    """Sentences: units, axes, welded vertices, decoded compression."""
    animations: tuple[str, ...] = ()
    textures: tuple[str, ...] = ()


@dataclass
class Assembly:
    """A rig, and how it was put together."""

    rig: Rig
    meshes: tuple[MeshFacts, ...]
    converted: list[str] = field(default_factory=list)


def assemble(
    where: Path,
    pieces: Sequence[Piece],
    choice: Choice = DEFAULT,
    pictures: Mapping[Hashable, Callable[[], np.ndarray]] | None = None,
    name: str | None = None,
) -> Assembly:
    """The rig that the chosen pieces make.

    Shapes with the same name on several pieces are one shape; a piece without some shape stays still under it. One
    picture shared by all is the texture; several become one, side by side. A face that is mostly transparent is left
    out, as the renderer draws opaque surfaces.

    Args:
        where: File, for messages; the rig is named after it unless `name` is given.
        pieces: In the order of the file.
        choice: Which meshes and shapes to take.
        pictures: Pixels (H, W, 3 or 4) uint8 by the key that pieces have; called for those that are used.
        name: Of the rig.

    Raises:
        ReenactError: Nothing with shapes is left, a pattern matches nothing, or the shapes are larger than
            `disk.LIMIT`.
    """
    used, reasons = _chosen(where, pieces, choice)
    converted: list[str] = []
    names = _shape_names(where, [piece for piece, use in zip(pieces, used) if use], choice)
    facts = _facts(pieces, used, reasons)
    pieces = [piece for piece, use in zip(pieces, used) if use]
    total = sum(len(piece.positions) for piece in pieces)
    if len(names) * total * 12 > disk.LIMIT:
        raise ReenactError(
            f"{where}: {len(names)} shapes of {total} vertices are more than {disk.LIMIT:,} bytes; choose fewer with "
            "--shapes or --parts"
        )
    for piece in pieces:
        for array in (piece.positions, *piece.shapes.values()):
            if len(array) and not np.abs(array).max() < 1e15:
                raise ReenactError(f"{where}: {piece.mesh} has coordinates beyond all bounds; export the mesh again")
    pieces = [_without_holes(piece, converted) for piece in pieces]
    starts = np.cumsum([0, *(len(piece.positions) for piece in pieces)])
    positions = np.concatenate([piece.positions for piece in pieces]).astype(np.float32)
    deltas = np.zeros((len(names), total, 3), np.float32)
    row = {shape: index for index, shape in enumerate(names)}
    for piece, start, end in zip(pieces, starts[:-1], starts[1:]):
        for shape, offsets in piece.shapes.items():
            if shape in row:
                deltas[row[shape], start:end] = offsets
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, starts[:-1])])
    texture, uv, uv_faces, tints = _appearance(pieces, dict(pictures or {}), converted)
    colors = np.concatenate(tints)
    parts = [_part_of(piece) for piece in pieces]
    part = np.concatenate(parts)
    vertex = _own_vertices(pieces, positions, deltas)
    if vertex is None:
        vertex = np.arange(total)
        if any(piece.split for piece in pieces):
            meshes = {mesh: index for index, mesh in enumerate(dict.fromkeys(piece.mesh for piece in pieces))}
            group = np.concatenate([np.full(len(piece.positions), meshes[piece.mesh]) for piece in pieces])
            alone = np.concatenate([np.full(len(piece.positions), not piece.split) for piece in pieces])
            vertex = _weld(positions, deltas, colors, np.stack([group, part, np.arange(total) * alone], axis=1))
            corners = vertex[faces]
            sound = (corners != np.roll(corners, 1, axis=1)).all(1)  # welding folds slivers that an exporter added
            faces, uv_faces = faces[sound], None if uv_faces is None else uv_faces[sound]
            if int(vertex.max()) + 1 < total:
                converted.append(f"{total} vertices, split along seams, welded to {int(vertex.max()) + 1}")
    first = np.zeros(int(vertex.max()) + 1, np.int64)
    first[vertex[::-1]] = np.arange(total)[::-1]
    values: dict[str, np.ndarray] = {
        "neutral": positions[first],
        "deltas": np.ascontiguousarray(deltas[:, first]),
        "faces": vertex[faces],
    }
    if (colors != 1).any():
        values["colors"] = to_srgb(colors[first]).astype(np.float32)
    if any(piece.part is not None for piece in pieces) or (part != PARTS.index("skin")).any():
        values["parts"] = part[first]
    if uv is not None and uv_faces is not None:
        values["uv"], values["uv_faces"] = _seams(uv, uv_faces, faces, vertex, len(first))
    if texture is not None:
        values["texture"] = (texture[..., :3] / np.float32(255)).astype(np.float32)
    tensors = {key: torch.from_numpy(np.ascontiguousarray(value)) for key, value in values.items()}
    if "uv_faces" in tensors and torch.equal(tensors["uv_faces"], tensors["faces"]):
        del tensors["uv_faces"]
    try:
        rig = Rig(name=name or where.stem, names=names, **tensors)
    except ReenactError as error:
        text = str(error)
        raise error if text.startswith(str(where)) else ReenactError(f"{where}: {text}") from None
    return Assembly(rig, facts, converted)


def reduced(rig: Rig, choice: Choice, format: str) -> tuple[Rig, Contents]:
    """A whole rig with only the chosen parts and shapes, and what it held.

    Faces that touch a chosen part stay, with all of their vertices.

    Args:
        rig: Any.
        choice: Its `parts` are names of `PARTS` here.
        format: For `Contents`.

    Raises:
        ReenactError: A pattern matches nothing, or no shapes or faces are left.
    """
    names = _shape_names(Path(rig.name), [_shapes_of(rig)], choice)
    if names != rig.names:
        rig = replace(rig, names=names, deltas=rig.deltas[[rig.names.index(name) for name in names]])
    present = [] if rig.parts is None else [PARTS[index] for index in rig.parts.unique().tolist()]
    for pattern in choice.parts:
        if not any(matches(part, [pattern]) for part in present):
            raise ReenactError(f"{rig.name}: no part is called {pattern}; it has {', '.join(present) or 'no parts'}")
    used = [part for part in present if not choice.parts or matches(part, choice.parts)]
    if used != present:
        kept = torch.isin(rig.parts, torch.tensor([PARTS.index(part) for part in used]))[rig.faces].any(1)
        vertices, faces = rig.faces[kept].unique(return_inverse=True)
        fields = {"neutral": rig.neutral[vertices], "deltas": rig.deltas[:, vertices], "parts": rig.parts[vertices]}
        if rig.colors is not None:
            fields["colors"] = rig.colors[vertices]
        if rig.uv is not None:
            fields["uv_faces"] = (rig.faces if rig.uv_faces is None else rig.uv_faces)[kept]
        rig = replace(rig, faces=faces, **fields)
    counts = {} if rig.parts is None else {part: int((rig.parts == PARTS.index(part)).sum()) for part in present}
    facts = tuple(
        MeshFacts(part, counts[part], 0, len(names), part in used, "part of the rig" if part in used else "not chosen")
        for part in present
    )
    whole = MeshFacts(rig.name, len(rig.neutral), len(rig.faces), len(names), True, "has shapes")
    return rig, Contents(format, (whole, *facts) if len(facts) > 1 else (whole,))


def _shapes_of(rig: Rig) -> Piece:
    nothing = np.zeros((0, 3), np.float32)
    return Piece(rig.name, nothing, {}, rig.names, np.zeros((0, 3), np.int64), nothing)


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Whether the name fits one of the patterns, in either case."""
    return any(fnmatch.fnmatchcase(name.lower(), pattern.lower()) for pattern in patterns)


def part_named(label: str) -> int:
    """Index into `PARTS` of what something is called; skin where no word tells it."""
    for part, words in _PART_WORDS:
        if re.search(words, label.lower()):
            return PARTS.index(part)
    return PARTS.index("skin")


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB values of linear light."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


# Which pieces ---------------------------------------------------------------------------------------------------------


def _chosen(where: Path, pieces: Sequence[Piece], choice: Choice) -> tuple[list[bool], list[str]]:
    """For each piece whether it belongs to the rig, and why or why not."""
    meshes = list(dict.fromkeys(piece.mesh for piece in pieces))
    if choice.parts:
        idle = [pattern for pattern in choice.parts if not any(matches(mesh, [pattern]) for mesh in meshes)]
        if idle:
            raise ReenactError(
                f"{where}: no mesh is called {', '.join(idle)}; it has {', '.join(meshes)[:300] or 'no mesh'}"
            )
        used = [matches(piece.mesh, choice.parts) for piece in pieces]
        reasons = ["chosen" if use else "not chosen" for use in used]
    else:
        used = [bool(piece.names) for piece in pieces]
        reasons = ["has shapes" if use else "no shapes" for use in used]
        box = _moving_box([piece for piece in pieces if piece.names])
        if box is not None:
            for index, piece in enumerate(pieces):
                if not used[index] and PARTS[part_named(piece.label)] in _FACIAL and _inside(piece, box):
                    used[index], reasons[index] = True, "lies in the face"
    if not any(piece.names for piece, use in zip(pieces, used) if use):
        raise ReenactError(
            f"{where}: expected a mesh with named blendshapes, got {', '.join(meshes)[:300] or 'no mesh'}"
            + (" of those chosen" if choice.parts else "")
            + "; export the shape keys"
        )
    return used, reasons


def _moving_box(pieces: Sequence[Piece]) -> tuple[np.ndarray, np.ndarray] | None:
    """Corners of what shapes move by more than a hundredth of the largest offset."""
    points, lengths = [], []
    for piece in pieces:
        for offsets in piece.shapes.values():
            length = np.linalg.norm(offsets.astype(np.float64), axis=1)
            moving = length > 0
            points.append(piece.positions[moving])
            lengths.append(length[moving])
    if not points or not sum(map(len, points)):
        return None
    where, length = np.concatenate(points), np.concatenate(lengths)
    where = where[length > 0.01 * length.max()]
    return where.min(0), where.max(0)


def _inside(piece: Piece, box: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether the middle of the piece lies in the box, and the piece is no larger than it."""
    if len(piece.positions) == 0:
        return False
    low, high = piece.positions.min(0), piece.positions.max(0)
    middle, size = (low + high) / 2, float((box[1] - box[0]).max())
    within = (middle > box[0] - 0.1 * size).all() and (middle < box[1] + 0.1 * size).all()
    return bool(within and (high - low).max() < size)


def _facts(pieces: Sequence[Piece], used: list[bool], reasons: list[str]) -> tuple[MeshFacts, ...]:
    """One entry per mesh; its pieces are its materials."""
    facts: dict[str, MeshFacts] = {}
    for piece, use, reason in zip(pieces, used, reasons):
        before = facts.get(piece.mesh, MeshFacts(piece.mesh, 0, 0, 0, False, reason))
        facts[piece.mesh] = MeshFacts(
            piece.mesh,
            before.vertices + len(piece.positions),
            before.faces + len(piece.faces),
            max(before.shapes, len(piece.names)),
            before.used or use,
            reason if use or not before.used else before.reason,
        )
    return tuple(facts.values())


def _shape_names(where: Path, pieces: Sequence[Piece], choice: Choice) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name for piece in pieces for name in piece.names))
    if not choice.shapes:
        return names
    idle = [pattern for pattern in choice.shapes if not any(matches(name, [pattern]) for name in names)]
    if idle:
        raise ReenactError(f"{where}: no shape is called {', '.join(idle)}; it has {', '.join(names)[:300]}")
    return tuple(name for name in names if matches(name, choice.shapes))


# How they look --------------------------------------------------------------------------------------------------------


def _part_of(piece: Piece) -> np.ndarray:
    return np.full(len(piece.positions), part_named(piece.label)) if piece.part is None else piece.part


def _without_holes(piece: Piece, converted: list[str]) -> Piece:
    """The piece without its mostly transparent faces."""
    if piece.cutout is None:
        return piece
    solid = piece.cutout >= 0.5
    if not solid.all():
        converted.append(f"{piece.mesh}: {int((~solid).sum())} transparent of {len(solid)} faces left out")
    uv_faces = None if piece.uv_faces is None else piece.uv_faces[solid]
    return replace(piece, faces=piece.faces[solid], uv_faces=uv_faces, cutout=None)


def _appearance(
    pieces: Sequence[Piece], pictures: dict[Hashable, Callable[[], np.ndarray]], converted: list[str]
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None, list[np.ndarray]]:
    """Texture, uv of all pieces, faces that index them, and linear colours of each piece."""
    tints = [np.broadcast_to(piece.colors, (len(piece.positions), 3)) for piece in pieces]
    keys = list(dict.fromkeys(piece.picture for piece in pieces if piece.picture is not None))
    everywhere = all(piece.uv is not None for piece in pieces)
    uv_starts = np.cumsum([0, *(0 if piece.uv is None else len(piece.uv) for piece in pieces)])
    corners = [piece.faces if piece.uv_faces is None else piece.uv_faces for piece in pieces]
    if len(keys) == 0 or (len(keys) == 1 and everywhere and all(piece.picture == keys[0] for piece in pieces)):
        texture = pictures[keys[0]]() if keys else None
        if not everywhere:
            return None, None, None, tints
        uv = np.concatenate([piece.uv for piece in pieces])
        return texture, uv, np.concatenate([each + start for each, start in zip(corners, uv_starts)]), tints
    texture, place = _atlas([pictures[key]() for key in keys])
    uv, uv_faces, start = [], [], 0
    for piece, corner in zip(pieces, corners):
        if piece.picture is None or piece.uv is None:
            moved, corner = np.repeat(place[-1][:2][None], len(piece.positions), axis=0), piece.faces  # the white cell
        else:
            low, size = np.split(place[keys.index(piece.picture)], 2)
            moved = low + _wrapped(piece.uv) * size
        uv.append(moved.astype(np.float32))
        uv_faces.append(corner + start)
        start += len(moved)
    converted.append(f"{len(keys)} pictures put side by side in one texture of {len(texture)} x {len(texture)}")
    return texture, np.concatenate(uv), np.concatenate(uv_faces), tints


def _wrapped(uv: np.ndarray) -> np.ndarray:
    """The same places of a repeating picture within [0, 1]."""
    shifted = uv - np.floor(uv.min(0) + 1e-4)
    return shifted.clip(0, 1) if shifted.max() < 1.001 else shifted % 1


def _atlas(pictures: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Pictures side by side, with one white cell more, and (u, v, width, height) of each within it."""
    side = int(np.ceil(np.sqrt(len(pictures) + 1)))
    largest = max(max(picture.shape[:2]) for picture in pictures)
    size = min(ATLAS, 1 << int(np.ceil(np.log2(side * (largest + 2 * GUTTER)))))
    cell, inner = size // side, size // side - 2 * GUTTER
    atlas = np.full((size, size, 3), 255, np.uint8)
    places = []
    for index, picture in enumerate([*pictures, np.full((1, 1, 3), 255, np.uint8)]):
        row, column = divmod(index, side)
        shrunk = np.asarray(Image.fromarray(picture[..., :3]).resize((inner, inner), Image.Resampling.BOX))
        top, left = row * cell, column * cell
        atlas[top : top + cell, left : left + cell] = np.pad(shrunk, ((GUTTER,) * 2, (GUTTER,) * 2, (0, 0)), "edge")[
            :cell, :cell
        ]
        # Between the middles of the outermost pixels: looking up never leaves the cell.
        places.append(np.array([left + GUTTER + 0.5, top + GUTTER + 0.5, inner - 1, inner - 1]) / size)
    return atlas, places


# Vertices -------------------------------------------------------------------------------------------------------------


def _own_vertices(pieces: Sequence[Piece], positions: np.ndarray, deltas: np.ndarray) -> np.ndarray | None:
    """Rig vertex of each vertex where our writer said so and it is still true."""
    if len(pieces) != 1 or pieces[0].vertex is None:
        return None
    vertex = pieces[0].vertex
    if (vertex != np.round(vertex)).any() or vertex.min() < 0 or vertex.max() >= len(vertex):
        return None
    vertex = vertex.astype(np.int64)
    first = np.full(int(vertex.max()) + 1, -1)
    first[vertex[::-1]] = np.arange(len(vertex))[::-1]
    if (first < 0).any():
        return None
    again = first[vertex]
    same = np.array_equal(positions[again], positions) and np.array_equal(deltas[:, again], deltas)
    return vertex if same else None


def _weld(positions: np.ndarray, deltas: np.ndarray, colors: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Index of the vertex that each becomes: equal position, deltas, colour and labels are one; order is kept."""
    rows = np.concatenate(
        [positions, deltas.transpose(1, 0, 2).reshape(len(positions), -1), colors.astype(np.float32), labels], axis=1
    )
    rows = np.ascontiguousarray(rows, dtype=np.float32) + np.float32(0)  # -0 becomes 0
    keys = rows.view(np.uint32).astype(np.uint64)
    factors = np.random.default_rng(0).integers(1, 1 << 63, keys.shape[1], dtype=np.uint64) | np.uint64(1)
    digest = (keys ^ (keys >> np.uint64(7))) @ factors
    _, first, inverse = np.unique(digest, return_index=True, return_inverse=True)
    if not np.array_equal(rows[first[inverse]], rows):  # two rows with one digest: slower and sure
        _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    return order[inverse.reshape(-1)]


def _seams(
    uv: np.ndarray, uv_faces: np.ndarray, faces: np.ndarray, vertex: np.ndarray, vertex_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """uv (U, 2), those of the vertices first and in their order where each has some, and faces that index them."""
    corners = np.stack([vertex[faces].reshape(-1), *uv[uv_faces.reshape(-1)].T.astype(np.float64)], axis=1)
    _, where, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    owner = vertex[faces].reshape(-1)[where]
    # One uv per vertex comes first, the one that the first corner uses; a vertex without face gets (0, 0).
    order = np.lexsort([where, owner])
    lead = np.ones(len(order), bool)
    lead[1:] = owner[order[1:]] != owner[order[:-1]]
    place = np.empty(len(where), np.int64)
    place[order[lead]] = owner[order[lead]]
    place[order[~lead]] = vertex_count + np.argsort(np.argsort(where[order[~lead]]))
    ordered = np.zeros((vertex_count + int((~lead).sum()), 2), np.float32)
    ordered[place] = corners[where, 1:]
    return ordered, place[inverse].reshape(-1, 3)
