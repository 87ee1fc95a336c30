"""OBJ folders: a neutral and one file per shape, all with the same vertices in the same order.

Source: Wavefront, Object Files (.obj) and its material library format. A file says neither its unit nor its axes, and
its vertices are absolute: what a shape adds is its file less the neutral. Our own neutral has a line `# reenact {...}`
with what OBJ has no place for: the rig's name, the true names and the order of its shapes, and parts.
"""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reenact.errors import ReenactError
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, pictures
from reenact.rigs.formats.pieces import DEFAULT, Choice, Contents, assemble, matches, to_linear
from reenact.rigs.formats.polygons import Mesh, Surface, pieces_of
from reenact.rigs.rig import PARTS, Rig

NEUTRALS = (
    *("neutral", "00_neutral", "000_neutral", "base", "basis", "basic", "rest", "default", "mean", "template"),
    *("generic_neutral_mesh", "neutral_mesh", "base_mesh", "basemesh", "head", "face", "neutral_pose", "rest_pose"),
)
"""Names of the file that is taken for the neutral, in either case, the likeliest first."""

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres of each unit that a file may be in."""

FILES = 2000
"""Most shapes in a folder."""


# Reading --------------------------------------------------------------------------------------------------------------


def load(path: Path, choice: Choice = DEFAULT, neutral: str | None = None, unit: str | None = None) -> Rig:
    """The rig in the folder; see `read`.

    Raises:
        ReenactError: As `read`.
    """
    return read(path, choice, neutral, unit)[0]


def read(
    path: Path, choice: Choice = DEFAULT, neutral: str | None = None, unit: str | None = None
) -> tuple[Rig, Contents]:
    """The rig that a folder of .obj files makes, and what the folder held.

    Every file is a shape named after it, but the neutral. Polygons become fans of triangles; colour and picture are
    those of the neutral's material library. OBJ says no unit: it is guessed by size. +Y is up, unless a shape jawOpen
    moves mostly along -Z.

    Args:
        path: The folder, or the file of the neutral in it.
        choice: Which objects and shapes to take.
        neutral: Which file is the neutral, without .obj; None: `path` if it is a file, else the first of `NEUTRALS`
            that is there, else the one named as the folder.
        unit: One of `UNITS`; None: that which makes the face, where its shapes move it, between 7 and 70 cm large.

    Raises:
        ReenactError: No neutral, no shapes, files of different vertices, a damaged line, a name outside the folder.
    """
    if unit is not None and unit not in UNITS:
        raise ReenactError(f"{path}: expected a unit among {', '.join(UNITS)}, got {unit}")
    rest, files = _files(path, neutral)
    source = _parse(rest)
    names = _names(rest, files, source, choice)
    sound: set[bytes] = set()
    shapes = {name: _offsets(files[stem], rest, source, sound) for stem, name in names.items()}
    converted: list[str] = []
    matrix = _placement(source, shapes, unit, converted)
    surfaces, found, described, missing = _materials(rest, source)
    pieces = [
        piece for mesh in _meshes(rest, source, shapes, surfaces, matrix) for piece in pieces_of(rest, mesh)
    ]  # fmt: skip
    title = source.own.get("name") if isinstance(source.own.get("name"), str) else None
    made = assemble(rest, pieces, choice, found, title or rest.parent.resolve().name or rest.stem)
    converted = list(dict.fromkeys([*converted, *missing, *made.converted]))
    facts = f"OBJ, {len(files)} shapes beside {rest.name}"
    return made.rig, Contents(facts, made.meshes, tuple(converted), (), described)


def _files(path: Path, neutral: str | None) -> tuple[Path, dict[str, Path]]:
    """The neutral, and the other .obj files beside it by their stems, in natural order."""
    try:
        folder = path.parent if path.is_file() else path
        found = sorted((each for each in folder.iterdir() if each.suffix.lower() == ".obj"), key=_natural)
    except (OSError, ValueError):
        raise ReenactError(f"{path}: expected a folder of .obj files, found nothing; check the path") from None
    if len(found) > FILES:
        raise ReenactError(f"{folder}: expected at most {FILES} .obj files, got {len(found)}")
    if path.is_file() and neutral is None:
        neutral = path.stem
    by_stem = {each.stem: each for each in found}
    if len(by_stem) < len(found):
        raise ReenactError(f"{folder}: two .obj files have the same name; rename one")
    listed = ", ".join(list(by_stem)[:12]) + (", ..." if len(by_stem) > 12 else "")
    if not by_stem:
        raise ReenactError(f"{folder}: expected .obj files, one neutral and one per shape, got none")
    lower = {stem.lower(): stem for stem in reversed(by_stem)}
    if neutral is not None:
        stem = lower.get(neutral.lower().removesuffix(".obj"))
    else:
        guesses = (*NEUTRALS, folder.resolve().name.lower())
        stem = next((lower[guess] for guess in guesses if guess in lower), None)
    if stem is None:
        raise ReenactError(
            f"{folder}: which file is the neutral? expected {neutral or 'one called neutral'} among {listed}; give the "
            "path of the neutral"
        )
    if len(by_stem) == 1:
        raise ReenactError(f"{folder}: expected one .obj per shape beside {stem}.obj, got none")
    rest = by_stem.pop(stem)
    return rest, by_stem


def _natural(path: Path) -> list[Any]:
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", path.stem.lower())]


def _names(rest: Path, files: dict[str, Path], source: _Source, choice: Choice) -> dict[str, str]:
    """Shape by stem, in order: as our own neutral lists them, the others after."""
    listed = source.own.get("shapes")
    pairs = listed if isinstance(listed, list) else []
    own = {
        pair[0]: pair[1]
        for pair in pairs
        if isinstance(pair, list) and len(pair) == 2 and all(isinstance(each, str) and each for each in pair)
    }
    names = {stem: own[stem] for stem in own if stem in files}
    names |= {stem: stem for stem in files if stem not in names}
    doubled = sorted({name for name in names.values() if list(names.values()).count(name) > 1})
    if doubled:
        raise ReenactError(f"{rest}: shapes must differ, doubled: {', '.join(doubled)[:200]}")
    if not choice.shapes:
        return names
    # Shapes that were not chosen are not read; a pattern that fits none is refused by name.
    idle = [pattern for pattern in choice.shapes if not any(matches(name, [pattern]) for name in names.values())]
    if idle:
        raise ReenactError(f"{rest}: no shape is called {', '.join(idle)}; it has {', '.join(names.values())[:300]}")
    return {stem: name for stem, name in names.items() if matches(name, choice.shapes)}


# One file -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Source:
    """An .obj file as arrays; corners are polygons one after another."""

    vertices: np.ndarray  # (V, 3) float64
    colors: np.ndarray | None  # (V, 3) sRGB
    uv: np.ndarray  # (U, 2), (0, 0) bottom left
    counts: np.ndarray  # (P,)
    corners: np.ndarray  # (C,)
    uv_corners: np.ndarray | None  # (C,)
    runs: list[tuple[int, str, str, str]]
    """From which face on which object, group and material: (face, object, group, material)."""
    libraries: list[str]
    own: dict[str, Any]


_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_OWN = b"# reenact "


def _parse(path: Path) -> _Source:
    data = _joined(path)
    lines = data.split(b"\n")
    heads = [line[:2] for line in lines]
    vertices, colors = _vertices(path, [line for line, head in zip(lines, heads) if head in (b"v ", b"v\t")])
    uv = _table(path, "vt", [line[3:] for line, head in zip(lines, heads) if head == b"vt"], (1, 2, 3))[:, :2]
    if uv.shape[1] == 1:
        uv = np.concatenate([uv, np.zeros_like(uv)], axis=1)
    starts: dict[str, np.ndarray] = {}
    face_lines, runs, libraries, own = [], [], [], {}
    thing, group, material = "", "", ""
    places: list[int] = []
    for number, (line, head) in enumerate(zip(lines, heads)):
        if head in (b"f ", b"f\t"):
            face_lines.append(line)
            places.append(number)
            continue
        if head in (b"v ", b"v\t", b"vn", b"vt", b"s ", b"") or not line.strip():
            continue
        word, *rest = line.split(None, 1)
        text = rest[0].decode("utf-8", "replace").strip() if rest else ""
        if word == b"o":
            thing = text
        elif word == b"g":
            group = text
        elif word == b"usemtl":
            material = text
        elif word == b"mtllib":
            libraries.append(text)
            continue
        elif line.startswith(_OWN):
            own = _own(line[len(_OWN) :])
            continue
        else:
            continue
        if runs and runs[-1][0] == len(face_lines):
            runs.pop()
        runs.append((len(face_lines), thing, group, material))
    if not runs or runs[0][0] > 0:
        runs.insert(0, (0, "", "", ""))
    counts, corners, uv_corners = _faces(path, face_lines)
    if (corners < 0).any() or (uv_corners is not None and (uv_corners < 0).any()):
        # -1 is the last vertex before the face: how many there are at each line.
        for key in (b"v", b"vt"):
            mine = np.array([head.strip() == key for head in heads], np.int64)
            starts[key.decode()] = np.cumsum(mine)[places]
        corners = np.where(corners < 0, corners + np.repeat(starts["v"], counts), corners - 1)
        if uv_corners is not None:
            uv_corners = np.where(uv_corners < 0, uv_corners + np.repeat(starts["vt"], counts), uv_corners - 1)
    else:
        corners = corners - 1
        uv_corners = None if uv_corners is None else uv_corners - 1
    for noun, index, count in (("vertex", corners, len(vertices)), ("uv", uv_corners, len(uv))):
        if index is not None and len(index) and (index.min() < 0 or index.max() >= count):
            wrong = int(((index < 0) | (index >= count)).argmax())
            face = int(np.searchsorted(np.cumsum(counts), wrong, side="right"))
            raise ReenactError(f"{path}: face {face + 1} names a {noun} outside 1..{count}")
    return _Source(vertices, colors, uv, counts, corners, uv_corners, runs, libraries, own)


def _joined(path: Path) -> bytes:
    """The file with unified line ends; lines continued by a backslash are one."""
    data = disk.read_bytes(path).removeprefix(b"\xef\xbb\xbf")
    if b"\0" in data[:4096]:
        raise ReenactError(f"{path}: expected an OBJ file, which is text, got something else")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\\n" in data:
        data = data.replace(b"\\\n", b" ")
    return re.sub(rb"\n[ \t]+", b"\n", data) if b"\n " in data or b"\n\t" in data else data


def _own(line: bytes) -> dict[str, Any]:
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _vertices(path: Path, lines: list[bytes]) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions, and colours where each line has three numbers more."""
    table = _table(path, "v", [line[2:] for line in lines], (3, 4, 6, 7))
    if len(table) == 0:
        raise ReenactError(f"{path}: expected an OBJ file with vertices, got none")
    if not np.abs(table[:, :3]).max() < 1e30:
        raise ReenactError(f"{path}: positions hold NaN, infinity or numbers far too large; export it again")
    colors = table[:, -3:] if table.shape[1] >= 6 else None
    if colors is not None:
        colors = colors / 255 if colors.max() > 1.5 else colors  # some write 0 to 255
        if not ((colors >= 0) & (colors <= 1.0001)).all():
            colors = None
    return table[:, :3], colors


def _table(path: Path, key: str, lines: list[bytes], widths: tuple[int, ...]) -> np.ndarray:
    """The numbers of lines as (N, width), all of the same width."""
    if not lines:
        return np.zeros((0, widths[0]))
    width = len(lines[0].split())
    if width in widths:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what is no number ends the array early, with a warning
                values = np.fromstring(b" ".join(lines), sep=" ")
            # As many words as there should be may still be too many in one line and too few in another.
            if len(values) == len(lines) * width and all(len(line.split()) == width for line in lines):
                return values.reshape(-1, width)
        except ValueError:
            pass
    return _slow_table(path, key, lines, widths)


def _slow_table(path: Path, key: str, lines: list[bytes], widths: tuple[int, ...]) -> np.ndarray:
    """As `_table`, line by line: names the line that is wrong, and takes what all lines have where they differ."""
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.split(b"#")[0].split()
        if len(words) not in widths or not all(re.fullmatch(_NUMBER, word) for word in words):
            expected = " or ".join(map(str, widths))
            raise ReenactError(
                f"{path}: expected {expected} numbers in line {number} of {key}, got "
                f"{line[:60].decode('utf-8', 'replace')!r}"
            )
        rows.append([float(word) for word in words])
    width = max(each for each in widths if each <= min(map(len, rows)))
    return np.array([row[:width] for row in rows])


def _faces(path: Path, lines: list[bytes]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Corners of each face, their vertices and uv as the file counts them; uv only where every corner has one."""
    if not lines:
        raise ReenactError(f"{path}: expected an OBJ file with faces, got none")
    words = [(line.split(b"#")[0] if b"#" in line else line).split()[1:] for line in lines]
    counts = np.array([len(each) for each in words], np.int64)
    if (counts < 3).any():
        number = int((counts < 3).argmax())
        text = lines[number][:60].decode("utf-8", "replace")
        raise ReenactError(f"{path}: expected at least 3 corners in face {number + 1}, got {text!r}")
    flat = [word for each in words for word in each]
    slashes = flat[0].count(b"/")
    doubled = b"//" in flat[0]
    joined = b" ".join(flat)
    try:
        if slashes == 0 and b"/" not in joined:
            return counts, _whole(joined, len(flat)), None
        if doubled and all(word.count(b"//") == 1 == word.count(b"/") - 1 for word in flat):
            return counts, _whole(joined.replace(b"//", b" "), 2 * len(flat)).reshape(-1, 2)[:, 0], None
        if not doubled and b"//" not in joined and all(word.count(b"/") == slashes for word in flat):
            values = _whole(joined.replace(b"/", b" "), (slashes + 1) * len(flat)).reshape(-1, slashes + 1)
            return counts, values[:, 0], values[:, 1]
    except ValueError:
        pass
    return counts, *_mixed_faces(path, words)


def _whole(text: bytes, count: int) -> np.ndarray:
    """That many whole numbers, none of them 0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        values = np.fromstring(text, np.int64, sep=" ")
    if len(values) != count or (values == 0).any():
        raise ValueError("expected whole numbers, counted from 1")
    return values


def _mixed_faces(path: Path, words: list[list[bytes]]) -> tuple[np.ndarray, np.ndarray | None]:
    corners, uv = [], []
    for number, each in enumerate(words, 1):
        for word in each:
            found = re.fullmatch(rb"([-+]?\d{1,18})(?:/([-+]?\d{1,18})?(?:/(?:[-+]?\d{1,18})?)?)?", word)
            if not found or int(found[1]) == 0 or (found[2] and int(found[2]) == 0):
                text = word[:40].decode("utf-8", "replace")
                raise ReenactError(f"{path}: expected corners as v, v/vt or v/vt/vn in face {number}, got {text!r}")
            corners.append(int(found[1]))
            uv.append(int(found[2]) if found[2] else 0)
    values = np.array(uv, np.int64)
    return np.array(corners, np.int64), values if values.all() else None


# Shapes, unit, axes ---------------------------------------------------------------------------------------------------


def _offsets(path: Path, rest: Path, source: _Source, sound: set[bytes]) -> np.ndarray:
    """What a shape adds to the neutral (V, 3); `sound` are faces that were found to be the neutral's."""
    lines = _joined(path).split(b"\n")
    vertices, _ = _vertices(path, [line for line in lines if line[:2] in (b"v ", b"v\t")])
    face_lines = [line for line in lines if line[:2] in (b"f ", b"f\t")]
    advice = "export all files alike, in the same order of vertices and without splitting"
    if len(vertices) != len(source.vertices) or len(face_lines) not in (0, len(source.counts)):
        raise ReenactError(
            f"{path}: expected the {len(source.vertices)} vertices and {len(source.counts)} faces of {rest.name}, got "
            f"{len(vertices)} and {len(face_lines)}; {advice}"
        )
    faces = b"\n".join(face_lines)
    if faces and faces not in sound:
        counts, corners = _shape_faces(path, face_lines, len(vertices))
        if not np.array_equal(_digest(counts, corners), _digest(source.counts, source.corners)):
            raise ReenactError(f"{path}: its faces join other vertices than those of {rest.name}; {advice}")
        sound.add(faces)
    return vertices - source.vertices


def _shape_faces(path: Path, lines: list[bytes], vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of each face and their vertices, all vertices before all faces."""
    counts, corners, _ = _faces(path, lines)
    return counts, np.where(corners < 0, corners + vertex_count, corners - 1)


def _digest(counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """A number for the vertices of each face, whatever their order and that of the faces."""
    factors = np.random.default_rng(0).integers(1, 1 << 63, max(int(corners.max(initial=0)) + 1, 1), dtype=np.uint64)
    inside = np.where(corners < 0, 0, corners)
    return np.sort(np.add.reduceat(factors[inside], np.cumsum(counts) - counts))


def _placement(source: _Source, shapes: dict[str, np.ndarray], unit: str | None, converted: list[str]) -> np.ndarray:
    """To metres, +Y up, by what can be seen of the rig."""
    matrix = np.eye(4)
    size = _face_size(source.vertices, shapes)
    if source.own and unit is None:
        return matrix
    if unit is None:
        unit = _guessed_unit(size)
        converted.append(f"no unit in OBJ: taken as {unit}, its face is then {size * UNITS[unit] * 100:.3g} cm large")
    jaw = [offsets for name, offsets in shapes.items() if arkit.meaning(name) == ("jawOpen",)]
    if jaw:
        down = jaw[0].sum(0)
        if -down[2] > 2 * max(abs(down[0]), abs(down[1])):
            matrix[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
            converted.append("jawOpen moves along -Z: +Z up made +Y up")
    matrix[:3, :3] *= UNITS[unit]
    if unit != "m":
        converted.append(f"units of {UNITS[unit]:g} m made metres")
    return matrix


def _face_size(vertices: np.ndarray, shapes: dict[str, np.ndarray]) -> float:
    """Largest side of the box around what the shapes move by more than a hundredth of the most."""
    length = np.zeros(len(vertices))
    for offsets in shapes.values():
        length = np.maximum(length, np.linalg.norm(offsets, axis=1))
    moving = vertices[length > 0.01 * length.max()] if length.max() > 0 else vertices
    return float(np.ptp(moving, axis=0).max())


def _guessed_unit(size: float) -> str:
    """The unit in which a face of that size is nearest to 22 cm, as a ratio."""
    candidates = ("m", "dm", "cm", "mm")
    if not size > 0:
        return "m"
    return min(candidates, key=lambda unit: abs(np.log(size * UNITS[unit] / 0.22)))


# Objects and materials ------------------------------------------------------------------------------------------------


def _meshes(
    rest: Path, source: _Source, shapes: dict[str, np.ndarray], surfaces: dict[str, Surface], matrix: np.ndarray
) -> list[Mesh]:
    """One mesh per object, where objects share no vertices and stand one after another; else one of all."""
    face_run = np.zeros(len(source.counts), np.int64)
    for index, (start, *_) in enumerate(source.runs):
        face_run[start:] = index
    objects = list(dict.fromkeys(run[1] for index, run in enumerate(source.runs) if (face_run == index).any()))
    face_object = np.array([objects.index(run[1]) if run[1] in objects else -1 for run in source.runs])[face_run]
    bounds = _bounds(source, face_object, len(objects))
    if bounds is None:
        objects, face_object, bounds = [objects[0]], np.zeros_like(face_object), [(0, len(source.vertices))]
    used = list(dict.fromkeys(run[3] for run in source.runs))
    groups = list(dict.fromkeys(run[2] for run in source.runs))
    surface = np.array([used.index(run[3]) for run in source.runs])[face_run]
    group = np.array([groups.index(run[2]) for run in source.runs])[face_run]
    part = _own_parts(rest, source)
    colors = None if source.colors is None else to_linear(source.colors)
    uv = np.stack([source.uv[:, 0], 1 - source.uv[:, 1]], axis=1) if source.uv_corners is not None else None
    meshes = []
    for index, ((low, high), name) in enumerate(zip(bounds, objects)):
        mine = face_object == index
        corner = np.repeat(mine, source.counts)
        meshes.append(
            Mesh(
                name=name or rest.stem,
                positions=source.vertices[low:high],
                names=tuple(shapes),
                shapes={shape: (None, offsets[low:high]) for shape, offsets in shapes.items()},
                counts=source.counts[mine],
                corners=source.corners[corner] - low,
                matrix=matrix,
                uv=uv,
                uv_corners=None if uv is None else source.uv_corners[corner],
                colors=None if colors is None else colors[low:high],
                surfaces=tuple(surfaces.get(each, Surface(each)) for each in used),
                surface=surface[mine],
                label=name,
                labels=tuple(groups),
                group=group[mine],
                part=None if part is None else part[low:high],
            )
        )
    return meshes


def _bounds(source: _Source, face_object: np.ndarray, count: int) -> list[tuple[int, int]] | None:
    """First vertex and the one after the last of each object; None where they overlap or change order."""
    owner = np.repeat(face_object, source.counts)
    starts, ends = [], []
    for index in range(count):
        mine = source.corners[owner == index]
        starts.append(int(mine.min()))
        ends.append(int(mine.max()) + 1)
    if any(end > start for end, start in zip(ends, starts[1:])):
        return None
    # Vertices without a face stay with the object before them.
    edges = [0, *starts[1:], len(source.vertices)]
    return list(pairwise(edges))


def _own_parts(rest: Path, source: _Source) -> np.ndarray | None:
    """Parts of the vertices as our own neutral lists them: [part, how many], one after another."""
    runs = source.own.get("parts")
    if runs is None:
        return None
    good = isinstance(runs, list) and all(
        isinstance(run, list) and len(run) == 2 and run[0] in PARTS and type(run[1]) is int and run[1] > 0
        for run in runs
    )
    if not good or sum(run[1] for run in runs) != len(source.vertices):
        raise ReenactError(
            f"{rest}: expected parts in the line # reenact for {len(source.vertices)} vertices, got others; remove it"
        )
    return np.repeat([PARTS.index(run[0]) for run in runs], [run[1] for run in runs])


def _materials(rest: Path, source: _Source) -> tuple[dict[str, Surface], dict[str, Any], tuple[str, ...], list[str]]:
    """Surfaces by name, loaders of pictures, a line on each, and what is missing."""
    surfaces: dict[str, Surface] = {}
    named: dict[str, bytes | str] = {}
    missing = []
    for library in source.libraries:
        place = _library(rest, library)
        if place is None:
            missing.append(f"material library {library[:80]} is not in the folder; left out")
            continue
        for name, surface in _library_surfaces(place).items():
            surfaces.setdefault(name, surface)
            if surface.picture is not None:
                named[str(surface.picture)] = str(surface.picture)
    found, described, lost = pictures.gather(rest, named)
    surfaces = {
        name: surface if surface.picture in found else replace(surface, picture=None)
        for name, surface in surfaces.items()
    }
    return surfaces, found, described, missing + lost


def _library(rest: Path, name: str) -> Path | None:
    place = pictures.beside(rest, name)
    return place if place is not None and place.suffix.lower() == ".mtl" else None


def _library_surfaces(path: Path) -> dict[str, Surface]:
    """Colour and picture of each material; other properties do not matter to a rig."""
    surfaces: dict[str, Surface] = {}
    name = None
    for line in _joined(path).split(b"\n"):
        words = line.decode("utf-8", "replace").strip().split(maxsplit=1)
        if len(words) < 2:
            continue
        key, text = words
        if key == "newmtl":
            name = text
            surfaces[name] = Surface(name)
        elif name is not None and key == "Kd":
            color = _color(path, text)
            if color is not None and surfaces[name].picture is None:
                surfaces[name] = replace(surfaces[name], color=color)
        elif name is not None and key == "d" and re.fullmatch(_NUMBER, text.encode()):
            surfaces[name] = replace(surfaces[name], opacity=float(np.clip(float(text), 0, 1)))
        elif name is not None and key == "map_Kd":
            # A picture takes the place of the colour, which exporters leave at grey; options come before its name.
            file = re.sub(r"^(-\w+\s+(?:(?:[-+.\deE]+|on|off)\s+)*)+", "", text)
            surfaces[name] = replace(surfaces[name], color=(1.0, 1.0, 1.0), picture=file)
    return surfaces


def _color(path: Path, text: str) -> tuple[float, float, float] | None:
    words = text.split()
    if words[0] in ("spectral", "xyz"):
        return None
    if len(words) not in (1, 3) or not all(re.fullmatch(_NUMBER, word.encode()) for word in words):
        raise ReenactError(f"{path}: expected Kd as 3 numbers, got {text[:60]!r}")
    values = [min(max(float(word), 0.0), 1e3) for word in words]
    return (values[0], values[0], values[0]) if len(values) == 1 else (values[0], values[1], values[2])


# Writing --------------------------------------------------------------------------------------------------------------


def save(rig: Rig, path: Path, clip: Clip | None = None) -> None:
    """Writes the rig as a folder: neutral.obj, one .obj per shape, and neutral.mtl with its texture.

    Metres, nine digits, colours as sRGB after the positions. A shape whose name cannot be that of a file gets one like
    it; the true names are in neutral.obj. The neutral is written last: a folder without it is not whole.

    Args:
        rig: What to write.
        path: The folder, made if it is not there.
        clip: Refused: OBJ has no animation.

    Raises:
        ReenactError: A clip was given, the folder holds other .obj files, or cannot be written.
    """
    if clip is not None:
        raise ReenactError(f"{path}: a folder of .obj files has no place for a clip; write it as .csv")
    stems = _stems(rig.names)
    try:
        path.mkdir(exist_ok=True)
        others = {each.name for each in path.iterdir() if each.suffix.lower() == ".obj"}
    except OSError as error:
        raise ReenactError(f"{path}: cannot be written ({error.strerror}); choose a folder that exists") from error
    others -= {"neutral.obj", *(f"{stem}.obj" for stem in stems)}
    if others:
        raise ReenactError(
            f"{path}: holds other .obj files ({', '.join(sorted(others))[:100]}); choose an empty folder"
        )
    arrays = {key: value.detach().cpu().numpy() for key, value in vars(rig).items() if isinstance(value, torch.Tensor)}
    positions = _lines("%.9g %.9g %.9g", arrays["neutral"])
    neutral = np.array(" ".join(positions).split(), dtype="S").astype(np.float64).reshape(-1, 3)  # as it is read
    faces = "\n".join(_lines("f %d %d %d", arrays["faces"] + 1))
    for stem, offsets in zip(stems, arrays["deltas"]):
        moved = neutral + offsets
        text = "\n".join(["# Reenact", *_lines("v %.9g %.9g %.9g", moved), faces, ""])
        disk.write_bytes(path / f"{stem}.obj", text.encode())
    own: dict[str, Any] = {"name": rig.name, "shapes": [list(pair) for pair in zip(stems, rig.names)]}
    if "parts" in arrays:
        part = arrays["parts"]
        starts = np.flatnonzero(np.append(True, part[1:] != part[:-1]))
        lengths = np.diff([*starts, len(part)])
        own["parts"] = [[PARTS[part[start]], int(length)] for start, length in zip(starts, lengths)]
    head = ["# Reenact", f"# reenact {json.dumps(own)}", "mtllib neutral.mtl", "o face"]
    body = [f"v {line}" for line in positions]
    if "colors" in arrays:
        colors = _lines("%.9g %.9g %.9g", arrays["colors"])
        body = [f"{line} {color}" for line, color in zip(body, colors)]
    if "uv" in arrays:
        uv = arrays["uv"].astype(np.float64)
        body += _lines("vt %.9g %.9g", np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1))
        pairs = np.stack([arrays["faces"], arrays.get("uv_faces", arrays["faces"])], axis=2) + 1
        faces = "\n".join(_lines("f %d/%d %d/%d %d/%d", pairs.reshape(-1, 6)))
    material = ["newmtl face", "Kd 1 1 1"]
    if "texture" in arrays:
        picture = (arrays["texture"] * 255).round().clip(0, 255).astype(np.uint8)
        disk.write_bytes(path / "neutral_texture.png", pictures.png(picture))
        material.append("map_Kd neutral_texture.png")
    disk.write_bytes(path / "neutral.mtl", "\n".join([*material, ""]).encode())
    disk.write_bytes(path / "neutral.obj", "\n".join([*head, *body, "usemtl face", faces, ""]).encode())


def _lines(form: str, values: np.ndarray) -> list[str]:
    """Each row in that form."""
    return ("\n".join([form] * len(values)) % tuple(values.reshape(-1).tolist())).split("\n") if len(values) else []


def _stems(names: tuple[str, ...]) -> list[str]:
    """A file name for each shape, all different in either case, legal on every system."""
    taken, stems = {"neutral"}, []
    for name in names:
        base = re.sub(r'[<>:"/\\|?*%\x00-\x1f\x7f]', "_", name).strip(". ")[:60] or "shape"
        if re.fullmatch(r"(?i)con|prn|aux|nul|com\d|lpt\d", base):
            base += "_"
        stem, number = base, 1
        while stem.lower() in taken:
            number += 1
            stem = f"{base}_{number}"
        taken.add(stem.lower())
        stems.append(stem)
    return stems
