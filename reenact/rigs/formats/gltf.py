"""glTF 2.0: rigs with morph targets, and their weight animation, in .glb and .gltf.

Source: Khronos, glTF 2.0 Specification. The reader is strict: it follows no address outside the file's folder and makes
no array before its size was checked against the bytes that are there. It is lenient where exporters differ: meshes and
primitives that share morph names become one rig, and vertices that an exporter split along seams are put together.

Beside the standard we write two vertex attributes: `_VERTEX`, the rig vertex that each glTF vertex came from, and
`_PART`, an index into `mesh.extras.partNames`; with them a rig comes back with the same vertices and parts.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import re
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk
from reenact.rigs.rig import PARTS, Rig
from reenact.rigs.timeline import steady

COMPRESSED = {
    "KHR_draco_mesh_compression": "Draco compression",
    "EXT_meshopt_compression": "meshopt compression",
    "KHR_meshopt_compression": "meshopt compression",
}
"""Extensions whose data we do not decode."""

UNDERSTOOD = frozenset(
    {
        *("KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual"),
        # These change how light falls on a surface, not its shape or base colour.
        *("KHR_materials_unlit", "KHR_materials_ior", "KHR_materials_specular", "KHR_materials_sheen"),
        *("KHR_materials_clearcoat", "KHR_materials_transmission", "KHR_materials_volume"),
        *("KHR_materials_emissive_strength", "KHR_materials_iridescence", "KHR_materials_anisotropy"),
    }
)
"""Extensions that a file may require."""

PIXELS = 8192 * 8192
"""Largest picture that is unpacked."""

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
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


# Reading --------------------------------------------------------------------------------------------------------------


def load(path: Path) -> Rig:
    """The rig that a file's meshes with morph targets make together.

    Node transforms are applied. Shapes with the same name on several meshes are one shape; a mesh without some shape
    stays still under it. Meshes without any are left out, with a warning that names them, and so is a skin's pose.
    A vertex belongs to the part that its mesh, node or material is named after. One picture shared by all of the rig is
    its texture; of several, each vertex takes the colour under its uv.

    Raises:
        ReenactError: The file is damaged, lies about a size, reaches outside its folder, needs an extension that we
            lack, or has no named morph targets.
    """
    document = _open(path)
    pieces = _pieces(document)
    try:
        return _merge(document, pieces)
    except ReenactError as error:
        text = str(error)
        raise error if text.startswith(str(path)) else ReenactError(f"{path}: {text}") from None


def load_clip(path: Path) -> Clip:
    """The first weight animation of a file, by the names of its shapes, at a constant rate.

    The rate is `animation.extras.fps` where it fits the keys, else that of evenly spaced keys at 10 per second or more,
    else 30. Keys of LINEAR, STEP and CUBICSPLINE are evaluated at every frame.

    Raises:
        ReenactError: As `load`, or no animation moves morph weights.
    """
    return _clip(_open(path))


@dataclass(frozen=True)
class _Document:
    path: Path
    root: dict[str, Any]
    binary: bytes | None
    buffers: dict[int, bytes]  # filled as they are used

    def fail(self, message: str) -> ReenactError:
        return ReenactError(f"{self.path}: {message}")

    def get(self, owner: dict[str, Any], key: str, kind: type, where: str, default: Any = ...) -> Any:
        """owner[key], which must be of that kind; integers must not be negative, numbers are returned as float."""
        value = owner.get(key, default)
        if value is ...:
            raise self.fail(f"expected {where}.{key}, it is missing")
        if value is default and key not in owner:
            return default
        good = isinstance(value, (int, float) if kind is float else kind) and not isinstance(value, bool)
        if not good or (kind is int and not 0 <= value < 1 << 53):
            raise self.fail(f"expected {where}.{key} as {_KINDS[kind]}, got {str(value)[:40]!r}")
        return float(value) if kind is float and abs(value) < 1e300 else value

    def item(self, key: str, index: Any, where: str) -> dict[str, Any]:
        """root[key][index], an object."""
        items = self.get(self.root, key, list, "glTF", [])
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            raise self.fail(f"expected {where} among {len(items)} {key}, got {str(index)[:40]}")
        if not isinstance(items[index], dict):
            raise self.fail(f"expected {key}[{index}] as an object, got {str(items[index])[:40]!r}")
        return items[index]

    def numbers(self, owner: dict[str, Any], key: str, count: int, where: str, default: list[Any]) -> np.ndarray:
        values = self.get(owner, key, list, where, default)
        good = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
        if len(values) != count or not good or not all(abs(value) < 1e30 for value in values):
            raise self.fail(f"expected {where}.{key} as {count} numbers, got {str(values)[:60]}")
        return np.array(values, dtype=np.float64)


_KINDS = {int: "a whole number from 0", float: "a number", list: "a list", dict: "an object", str: "a string"}


def _open(path: Path) -> _Document:
    data = disk.read_bytes(path)
    binary = None
    if data[:4] == b"glTF" or path.suffix.lower() == ".glb":
        text, binary = _chunks(path, data)
    else:
        text = data
    try:
        root = json.loads(text.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ReenactError(f"{path}: expected glTF JSON, it cannot be parsed ({str(error)[:80]})") from None
    if not isinstance(root, dict):
        raise ReenactError(f"{path}: expected a glTF object, got {str(root)[:40]!r}")
    document = _Document(path, root, binary, {})
    version = document.get(document.get(root, "asset", dict, "glTF"), "version", str, "asset")
    if not version.startswith("2."):
        raise document.fail(f"expected glTF 2.0, got version {version[:20]}; export it as glTF 2.0")
    required = document.get(root, "extensionsRequired", list, "glTF", [])
    unknown = [str(name)[:60] for name in required if not isinstance(name, str) or name not in UNDERSTOOD]
    if unknown:
        packed = sorted({COMPRESSED[name] for name in unknown if name in COMPRESSED})
        advice = f"export it without {' and '.join(packed)}" if packed else "export it without them"
        raise document.fail(f"needs extensions that are not supported: {', '.join(unknown)[:300]}; {advice}")
    return document


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB file."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ReenactError(f"{path}: expected a GLB file, its header is missing or cut off")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length > len(data) or length < 20:
        raise ReenactError(
            f"{path}: expected GLB version 2 of {length} bytes, got version {version}, {len(data)} bytes"
        )
    chunks, offset = [], 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, offset)
        if offset + 8 + size > length:
            raise ReenactError(
                f"{path}: chunk {len(chunks)} says {size} bytes, {length - offset - 8} are left; cut off?"
            )
        chunks.append((kind, data[offset + 8 : offset + 8 + size]))
        offset += 8 + size + -size % 4
    if not chunks or chunks[0][0] != b"JSON":
        raise ReenactError(f"{path}: expected a JSON chunk first, got {chunks[0][0] if chunks else 'none'}")
    return chunks[0][1], next((body for kind, body in chunks[1:] if kind == b"BIN\0"), None)


def _buffer(document: _Document, index: Any, where: str) -> bytes:
    if index in document.buffers:
        return document.buffers[index]
    entry = document.item("buffers", index, where)
    length = document.get(entry, "byteLength", int, f"buffers[{index}]")
    uri = document.get(entry, "uri", str, f"buffers[{index}]", None)
    if uri is None:
        if index != 0 or document.binary is None:
            raise document.fail(f"buffers[{index}] has no uri, and the file no binary chunk for it")
        data = document.binary
    else:
        data = _uri(document, uri, f"buffers[{index}].uri")
    if length > len(data):
        raise document.fail(f"buffers[{index}].byteLength says {length}, the data has {len(data)} bytes")
    document.buffers[index] = data[:length]
    return document.buffers[index]


def _uri(document: _Document, uri: str, where: str) -> bytes:
    if uri.startswith("data:"):
        header, _, payload = uri.partition(",")
        if not header.endswith(";base64"):
            raise document.fail(f"expected {where} as base64 data, got {header[:40]!r}")
        try:
            return base64.b64decode(payload, validate=True)
        except (binascii.Error, ValueError):
            raise document.fail(f"{where} holds damaged base64 data") from None
    name = unquote(uri)
    parts = name.split("/")
    outside = not name or name.startswith("/") or re.search(r"[\\:\0]", name) or ".." in parts
    folder = document.path.parent.resolve()
    if outside or not (folder / name).resolve().is_relative_to(folder):  # a symbolic link may also lead outside
        raise document.fail(f"{where} must stay in the file's folder, got {uri[:60]!r}")
    return disk.read_bytes(folder / name)


def _view(document: _Document, index: Any, where: str) -> tuple[bytes, int, int, int | None]:
    """Buffer, start, length and stride of a buffer view, within its buffer."""
    view = document.item("bufferViews", index, where)
    name = f"bufferViews[{index}]"
    extensions = document.get(view, "extensions", dict, name, {})
    buffer_index = document.get(view, "buffer", int, name)
    start = document.get(view, "byteOffset", int, name, 0)
    length = document.get(view, "byteLength", int, name)
    stride = document.get(view, "byteStride", int, name, None)
    buffer = document.item("buffers", buffer_index, f"{name}.buffer")
    for key, packing in COMPRESSED.items():
        if key in extensions and "uri" not in buffer and buffer_index != 0:
            raise document.fail(f"{name} is packed with {key}; export it without {packing}")
    data = _buffer(document, buffer_index, f"{name}.buffer")
    if start + length > len(data):
        raise document.fail(f"{name} ends at byte {start + length}, buffers[{buffer_index}] has {len(data)}")
    if stride is not None and (not 4 <= stride <= 252 or stride % 4):
        raise document.fail(f"expected {name}.byteStride as a multiple of 4 up to 252, got {stride}")
    return data, start, length, stride


def _strided(document: _Document, view: Any, offset: int, count: int, dtype: str, width: int, where: str) -> np.ndarray:
    """Elements (count, width) in a buffer view, without a copy."""
    data, start, length, stride = _view(document, view, f"{where}.bufferView")
    size = np.dtype(dtype).itemsize
    stride = stride or size * width
    end = offset + (count - 1) * stride + size * width
    if stride < size * width or end > length:
        raise document.fail(f"{where} needs {end} bytes for {count} elements, its bufferView has {length}")
    return np.ndarray((count, width), dtype, data, start + offset, (stride, size))


def _accessor(
    document: _Document, index: Any, where: str, kinds: tuple[str, ...], count: int | None = None
) -> np.ndarray:
    """Values (count, width) of an accessor: float32 if stored as floats or normalised, else integers.

    Args:
        where: What refers to it, for messages.
        kinds: Types that it may have.
        count: How many elements it must have, where that is known.
    """
    entry = document.item("accessors", index, where)
    name = f"accessors[{index}] ({where})"
    kind = document.get(entry, "type", str, name)
    code = document.get(entry, "componentType", int, name)
    length = document.get(entry, "count", int, name)
    if kind not in kinds or code not in _COMPONENTS:
        raise document.fail(f"expected {name} of type {' or '.join(kinds)}, got {kind[:20]} of component type {code}")
    if length < 1 or (count is not None and length != count):
        raise document.fail(f"expected {name} with {count or 'one or more'} elements, got {length}")
    dtype, width = _COMPONENTS[code], _WIDTHS[kind]
    offset = document.get(entry, "byteOffset", int, name, 0)
    sparse = document.get(entry, "sparse", dict, name, None)
    view = document.get(entry, "bufferView", int, name, None)
    if view is not None:
        values = _strided(document, view, offset, length, dtype, width, name)
    elif count is None:
        raise document.fail(f"{name} has {length} elements and no bufferView")
    else:
        values = np.zeros((length, width), dtype)
    if sparse is not None:
        values = _sparse(document, sparse, values, name)
    if dtype == "<f4":
        if not np.isfinite(values).all():
            raise document.fail(f"{name} holds NaN or infinity; export the mesh again")
        return values.astype(np.float32)
    if entry.get("normalized") is True:
        return np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1)).astype(np.float32)
    return values


def _sparse(document: _Document, sparse: dict[str, Any], values: np.ndarray, name: str) -> np.ndarray:
    where = f"{name}.sparse"
    count = document.get(sparse, "count", int, where)
    if not 1 <= count <= len(values):
        raise document.fail(f"expected {where}.count from 1 to {len(values)}, got {count}")
    indices = document.get(sparse, "indices", dict, where)
    replaced = document.get(sparse, "values", dict, where)
    code = document.get(indices, "componentType", int, f"{where}.indices")
    if code not in (5121, 5123, 5125):
        raise document.fail(f"expected {where}.indices as unsigned integers, got component type {code}")
    places = []
    for part, dtype, width in ((indices, _COMPONENTS[code], 1), (replaced, values.dtype.str, values.shape[1])):
        place = f"{where}.{'indices' if part is indices else 'values'}"
        offset = document.get(part, "byteOffset", int, place, 0)
        places.append(_strided(document, part.get("bufferView"), offset, count, dtype, width, place))
    rows = places[0][:, 0].astype(np.int64)
    if rows.max() >= len(values):
        raise document.fail(f"expected {where}.indices below {len(values)}, got {rows.max()}")
    values = values.copy()
    values[rows] = places[1]
    return values


@dataclass(frozen=True)
class _Piece:
    """One primitive of one node, in world space."""

    names: tuple[str, ...]
    positions: np.ndarray  # (V, 3) float32
    shapes: tuple[tuple[str, np.ndarray], ...]  # names and (V, 3) float32
    faces: np.ndarray  # (F, 3)
    colors: np.ndarray  # (V, 3) linear
    uv: np.ndarray | None  # (V, 2)
    image: int | None
    part: np.ndarray  # (V,)
    has_parts: bool  # the file says something about parts
    vertex: np.ndarray | None  # (V,) of our own files
    group: int  # mesh


def _nodes(document: _Document) -> list[tuple[int, dict[str, Any], np.ndarray]]:
    """Nodes of the scene that have a mesh, with their transform to world space (4, 4)."""
    nodes = document.get(document.root, "nodes", list, "glTF", [])
    if "scenes" in document.root:
        scene = document.item("scenes", document.root.get("scene", 0), "glTF.scene")
        roots = document.get(scene, "nodes", list, "scene", [])
    else:
        children = {str(child) for node in nodes if isinstance(node, dict) for child in _children(document, node)}
        roots = [index for index in range(len(nodes)) if str(index) not in children]
    found, seen = [], set()
    stack = [(index, np.eye(4)) for index in reversed(roots)]
    while stack:
        index, above = stack.pop()
        node = document.item("nodes", index, "a scene's or node's children")
        if index in seen:
            raise document.fail(f"nodes[{index}] is reached twice; nodes must form a tree")
        seen.add(index)
        world = above @ _local(document, node, f"nodes[{index}]")
        if not np.isfinite(world).all() or np.abs(world).max() > 1e30:
            raise document.fail(f"the transforms above nodes[{index}] grow beyond all bounds")
        if "mesh" in node:
            found.append((index, node, world))
        stack += [(child, world) for child in reversed(_children(document, node))]
    return found


def _children(document: _Document, node: dict[str, Any]) -> list[Any]:
    return document.get(node, "children", list, "node", [])


def _local(document: _Document, node: dict[str, Any], where: str) -> np.ndarray:
    if "matrix" in node:
        return document.numbers(node, "matrix", 16, where, []).reshape(4, 4).T
    x, y, z, w = document.numbers(node, "rotation", 4, where, [0, 0, 0, 1])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = np.eye(4)
    local[:3, :3] = rotation * document.numbers(node, "scale", 3, where, [1, 1, 1])
    local[:3, 3] = document.numbers(node, "translation", 3, where, [0, 0, 0])
    return local


def _shape_names(document: _Document, mesh: dict[str, Any], where: str) -> tuple[str, ...]:
    """Names of a mesh's morph targets; empty where it has none."""
    primitives = document.get(mesh, "primitives", list, where)
    counts = set()
    for index, primitive in enumerate(primitives):
        if not isinstance(primitive, dict):
            raise document.fail(f"expected {where}.primitives[{index}] as an object, got {str(primitive)[:40]!r}")
        counts.add(len(document.get(primitive, "targets", list, f"{where}.primitives[{index}]", [])))
    if len(counts) != 1:
        raise document.fail(f"expected the same number of morph targets on all primitives of {where}, got {counts}")
    count = counts.pop()
    extras = mesh.get("extras")
    names = extras.get("targetNames") if isinstance(extras, dict) else None
    if count == 0:
        return ()
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        raise document.fail(
            f"expected named morph targets ({where}.extras.targetNames), got none; name the shapes before exporting"
        )
    if len(names) != count or len(set(names)) != count:
        raise document.fail(f"expected {count} different names in {where}.extras.targetNames, got {len(set(names))}")
    return tuple(names)


def _pieces(document: _Document) -> list[_Piece]:
    pieces, still, posed = [], [], []
    for index, node, world in _nodes(document):
        mesh_index = node["mesh"]
        mesh = document.item("meshes", mesh_index, f"nodes[{index}].mesh")
        where = f"meshes[{mesh_index}]"
        names = _shape_names(document, mesh, where)
        label = str(mesh.get("name", node.get("name", where)))[:60]
        if not names:
            still.append(label)
            continue
        if "skin" in node:
            posed.append(label)
            world = np.eye(4)  # the specification: a skinned mesh ignores its node
        for number, primitive in enumerate(mesh["primitives"]):
            piece = _piece(document, node, mesh, primitive, names, world, f"{where}.primitives[{number}]", index)
            if piece is not None:
                pieces.append(piece)
    if not pieces:
        raise document.fail(
            "expected a mesh with named morph targets (mesh.extras.targetNames), got "
            f"{', '.join(still) or 'no mesh'}; export the shape keys"
        )
    if still:
        warnings.warn(f"{document.path}: meshes without shapes are left out: {', '.join(still)[:300]}", stacklevel=4)
    if posed:
        warnings.warn(f"{document.path}: skins are not applied to: {', '.join(posed)[:300]}", stacklevel=4)
    return pieces


def _piece(
    document: _Document,
    node: dict[str, Any],
    mesh: dict[str, Any],
    primitive: dict[str, Any],
    names: tuple[str, ...],
    world: np.ndarray,
    where: str,
    group: int,
) -> _Piece | None:
    mode = document.get(primitive, "mode", int, where, 4)
    if mode not in (4, 5, 6):
        return None  # points and lines are not part of a face
    extensions = document.get(primitive, "extensions", dict, where, {})
    attributes = document.get(primitive, "attributes", dict, where)
    if "KHR_draco_mesh_compression" in extensions and "bufferView" not in document.item(
        "accessors", attributes.get("POSITION"), f"{where}.attributes.POSITION"
    ):
        raise document.fail(f"{where} is packed with KHR_draco_mesh_compression; export it without Draco compression")
    place = f"{where}.attributes"
    positions = _accessor(document, attributes.get("POSITION"), f"{place}.POSITION", ("VEC3",)).astype(np.float32)
    count = len(positions)
    if len(names) * count * 12 > disk.LIMIT:
        raise document.fail(f"{where}: {len(names)} shapes of {count} vertices are more than {disk.LIMIT:,} bytes")
    linear = world[:3, :3]
    moved = not np.array_equal(world, np.eye(4))
    shapes = []
    for index, (name, target) in enumerate(zip(names, primitive["targets"])):
        if not isinstance(target, dict):
            raise document.fail(f"expected {where}.targets[{index}] as an object, got {str(target)[:40]!r}")
        if "POSITION" in target:
            label = f"{where}.targets[{index}].POSITION"
            offsets = _accessor(document, target["POSITION"], label, ("VEC3",), count).astype(np.float32)
            shapes.append((name, (offsets @ linear.T.astype(np.float32)) if moved else offsets))
    if moved:
        positions = (positions.astype(np.float64) @ linear.T + world[:3, 3]).astype(np.float32)
    faces = _triangles(document, primitive, mode, count, where)
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    material, colors, image, uv = _surface(document, primitive, attributes, count, where)
    vertex = None
    if "_VERTEX" in attributes:
        vertex = _accessor(document, attributes["_VERTEX"], f"{place}._VERTEX", ("SCALAR",), count)[:, 0]
    labels = [owner.get("name") for owner in (mesh, node, material)]
    part = np.full(count, _part(" ".join(label for label in labels if isinstance(label, str))))
    if "_PART" in attributes:
        part = _stored_parts(document, mesh, attributes["_PART"], part, f"{place}._PART")
    has_parts = "_PART" in attributes or bool((part != PARTS.index("skin")).any())
    return _Piece(names, positions, tuple(shapes), faces, colors, uv, image, part, has_parts, vertex, group)


def _part(label: str) -> int:
    for part, words in _PART_WORDS:
        if re.search(words, label.lower()):
            return PARTS.index(part)
    return PARTS.index("skin")


def _stored_parts(document: _Document, mesh: dict[str, Any], index: Any, default: np.ndarray, where: str) -> np.ndarray:
    values = _accessor(document, index, where, ("SCALAR",), len(default))[:, 0]
    extras = mesh.get("extras")
    names = extras.get("partNames", list(PARTS)) if isinstance(extras, dict) else list(PARTS)
    if not isinstance(names, list) or not names:
        raise document.fail(f"expected mesh.extras.partNames as a list of names, got {str(names)[:60]}")
    known = np.array([PARTS.index(name) if name in PARTS else PARTS.index("skin") for name in names])
    if values.min() < 0 or values.max() >= len(known):
        raise document.fail(f"expected {where} from 0 to {len(known) - 1}, got {values.max():g}")
    return known[values.astype(np.int64)]


def _triangles(document: _Document, primitive: dict[str, Any], mode: int, count: int, where: str) -> np.ndarray:
    if "indices" in primitive:
        corners = _accessor(document, primitive["indices"], f"{where}.indices", ("SCALAR",))[:, 0]
        if corners.dtype.kind != "u" or corners.max() >= count:
            raise document.fail(f"expected {where}.indices as whole numbers below {count}, got {corners.max():g}")
        corners = corners.astype(np.int64)
    else:
        corners = np.arange(count)
    if mode == 4:
        if len(corners) % 3:
            raise document.fail(f"expected {where}.indices in threes, got {len(corners)}")
        return corners.reshape(-1, 3)
    if len(corners) < 3:
        raise document.fail(f"expected {where} with at least 3 indices, got {len(corners)}")
    if mode == 6:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    strip[1::2] = strip[1::2, [1, 0, 2]]
    return strip


def _surface(
    document: _Document, primitive: dict[str, Any], attributes: dict[str, Any], count: int, where: str
) -> tuple[dict[str, Any], np.ndarray, int | None, np.ndarray | None]:
    """Material, vertex colours (V, 3) linear, image and texture coordinates of a primitive."""
    material: dict[str, Any] = {}
    if "material" in primitive:
        material = document.item("materials", primitive["material"], f"{where}.material")
    name = f"materials[{primitive.get('material')}].pbrMetallicRoughness"
    surface = document.get(material, "pbrMetallicRoughness", dict, name, {})
    factor = document.numbers(surface, "baseColorFactor", 4, name, [1, 1, 1, 1])[:3].clip(0, 1)
    colors = np.broadcast_to(factor, (count, 3))
    if "COLOR_0" in attributes:
        stored = _accessor(document, attributes["COLOR_0"], f"{where}.attributes.COLOR_0", ("VEC3", "VEC4"), count)
        colors = colors * stored[:, :3].astype(np.float64).clip(0, 1)
    texture = document.get(surface, "baseColorTexture", dict, name, {})
    image = None
    if texture:
        entry = document.item("textures", texture.get("index"), f"{name}.baseColorTexture.index")
        extensions = document.get(entry, "extensions", dict, "texture", {})
        webp = document.get(extensions, "EXT_texture_webp", dict, "texture.extensions", {})
        image = document.get(webp or entry, "source", int, "texture", None)
    extensions = document.get(texture, "extensions", dict, f"{name}.baseColorTexture", {})
    transform = document.get(extensions, "KHR_texture_transform", dict, f"{name}.baseColorTexture.extensions", {})
    channel = document.get(texture, "texCoord", int, f"{name}.baseColorTexture", 0)
    channel = document.get(transform, "texCoord", int, "KHR_texture_transform", channel)
    uv = None
    if f"TEXCOORD_{channel}" in attributes:
        label = f"{where}.attributes.TEXCOORD_{channel}"
        uv = _accessor(document, attributes[f"TEXCOORD_{channel}"], label, ("VEC2",), count).astype(np.float32)
        if transform:
            scale = document.numbers(transform, "scale", 2, "KHR_texture_transform", [1, 1])
            offset = document.numbers(transform, "offset", 2, "KHR_texture_transform", [0, 0])
            turn = document.get(transform, "rotation", float, "KHR_texture_transform", 0.0)
            cos, sin = np.cos(turn), np.sin(turn)
            uv = ((uv * scale) @ np.array([[cos, -sin], [sin, cos]]) + offset).astype(np.float32)
    return material, colors, image if uv is not None else None, uv


def _picture(document: _Document, index: int) -> np.ndarray:
    """Pixels (H, W, 3) uint8 of an image."""
    entry = document.item("images", index, "texture.source")
    where = f"images[{index}]"
    if "uri" in entry:
        data = _uri(document, document.get(entry, "uri", str, where), f"{where}.uri")
    else:
        buffer, start, length, _ = _view(document, entry.get("bufferView"), f"{where}.bufferView")
        data = buffer[start : start + length]
    try:
        with Image.open(io.BytesIO(data), formats=["PNG", "JPEG", "WEBP"]) as picture:
            if picture.width * picture.height > PIXELS:
                raise document.fail(f"expected {where} of at most {PIXELS} pixels, got {picture.size}")
            return np.asarray(picture.convert("RGB"))
    except ReenactError:
        raise
    except Exception as error:  # Pillow's decoders raise what they like on damaged data
        raise document.fail(f"expected {where} as PNG, JPEG or WebP, it cannot be read ({str(error)[:80]})") from None


def _merge(document: _Document, pieces: list[_Piece]) -> Rig:
    names = tuple(dict.fromkeys(name for piece in pieces for name in piece.names))
    starts = np.cumsum([0, *(len(piece.positions) for piece in pieces)])
    total = int(starts[-1])
    if len(names) * total * 12 > disk.LIMIT:
        raise document.fail(f"{len(names)} shapes of {total} vertices are more than {disk.LIMIT:,} bytes")
    positions = np.concatenate([piece.positions for piece in pieces])
    deltas = np.zeros((len(names), total, 3), np.float32)
    row = {name: index for index, name in enumerate(names)}
    for piece, start, end in zip(pieces, starts[:-1], starts[1:]):
        for name, offsets in piece.shapes:
            deltas[row[name], start:end] = offsets
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, starts[:-1])])
    part = np.concatenate([piece.part for piece in pieces])
    texture, uv, tints = _appearance(document, pieces)
    colors = np.concatenate(tints)
    vertex = _own_vertices(pieces, positions, deltas)
    if vertex is None:
        group = np.concatenate([np.full(len(piece.positions), piece.group) for piece in pieces])
        vertex = _weld(positions, deltas, colors, np.stack([group, part], axis=1))
        corners = vertex[faces]
        sound = (corners != np.roll(corners, 1, axis=1)).all(1)  # welding folds slivers that an exporter added
        faces = faces[sound]
    first = np.zeros(int(vertex.max()) + 1, np.int64)
    first[vertex[::-1]] = np.arange(total)[::-1]
    extras = document.root["asset"].get("extras")
    stored = extras.get("name") if isinstance(extras, dict) else None
    colored = (colors != 1).any()
    values: dict[str, np.ndarray] = {
        "neutral": positions[first],
        "deltas": np.ascontiguousarray(deltas[:, first]),
        "faces": vertex[faces],
    }
    if colored:
        values["colors"] = _to_srgb(colors[first]).astype(np.float32)
    if any(piece.has_parts for piece in pieces):
        values["parts"] = part[first]
    if uv is not None:
        values["uv"], values["uv_faces"] = _seams(uv, faces, vertex, first)
    if texture is not None:
        values["texture"] = (texture / np.float32(255)).astype(np.float32)
    tensors = {key: torch.from_numpy(np.ascontiguousarray(value)) for key, value in values.items()}
    if "uv_faces" in tensors and torch.equal(tensors["uv_faces"], tensors["faces"]):
        del tensors["uv_faces"]
    return Rig(name=stored if isinstance(stored, str) and stored else document.path.stem, names=names, **tensors)


def _appearance(
    document: _Document, pieces: list[_Piece]
) -> tuple[np.ndarray | None, np.ndarray | None, list[np.ndarray]]:
    """Texture, uv of all vertices, and linear colours of each piece."""
    images = {piece.image for piece in pieces}
    tints = [piece.colors for piece in pieces]
    uv = None
    if all(piece.uv is not None for piece in pieces):
        uv = np.concatenate([piece.uv for piece in pieces])
    if images == {None}:
        return None, uv, tints
    pictures = {image: _picture(document, image) for image in images if image is not None}
    if len(images) == 1 and uv is not None:
        return pictures[pieces[0].image], uv, tints
    for index, piece in enumerate(pieces):
        if piece.image is not None:
            picture = pictures[piece.image]
            size = np.array([picture.shape[1], picture.shape[0]])
            column, line = (((piece.uv % 1) * size).astype(np.int64).clip(0, size - 1)).T
            tints[index] = piece.colors * _to_linear(picture[line, column] / 255)
    return None, uv, tints


def _own_vertices(pieces: list[_Piece], positions: np.ndarray, deltas: np.ndarray) -> np.ndarray | None:
    """Rig vertex of each glTF vertex where our writer said so and it is still true."""
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


def _seams(uv: np.ndarray, faces: np.ndarray, vertex: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """uv (U, 2), the first V of them in the order of the vertices, and faces that index them."""
    pairs = np.concatenate([vertex[:, None].astype(np.float64), uv.astype(np.float64)], axis=1)
    _, where, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    main = np.zeros(len(where), bool)
    main[inverse[first]] = True
    place = np.empty(len(where), np.int64)
    place[inverse[first]] = np.arange(len(first))
    place[~main] = len(first) + np.argsort(np.argsort(where[~main]))
    ordered = np.empty((len(where), 2), np.float32)
    ordered[place] = uv[where]
    return ordered, place[inverse][faces]


def _clip(document: _Document) -> Clip:
    for number, animation in enumerate(document.get(document.root, "animations", list, "glTF", [])):
        if not isinstance(animation, dict):
            raise document.fail(f"expected animations[{number}] as an object, got {str(animation)[:40]!r}")
        where = f"animations[{number}]"
        tracks = [
            _track(document, animation, channel, f"{where}.channels[{index}]")
            for index, channel in enumerate(document.get(animation, "channels", list, where))
        ]
        tracks = [track for track in tracks if track is not None]
        if tracks:
            return _sampled(document, animation, tracks)
    raise document.fail(
        "expected an animation of morph weights, got none; export the file with its shape key animation"
    )


@dataclass(frozen=True)
class _Track:
    names: tuple[str, ...]
    times: np.ndarray  # (N,) float64
    keys: np.ndarray  # (N, K), or (N, 3, K) of tangent in, value, tangent out
    interpolation: str

    def at(self, times: np.ndarray) -> np.ndarray:
        """Weights (T, K) at the times; before the first and after the last key they stay."""
        after = np.searchsorted(self.times, times, side="right").clip(1, max(1, len(self.times) - 1))
        if len(self.times) == 1:
            value = self.keys[0, 1] if self.interpolation == "CUBICSPLINE" else self.keys[0]
            return np.broadcast_to(value, (len(times), len(self.names)))
        t0, t1 = self.times[after - 1], self.times[after]
        x = ((times - t0) / (t1 - t0)).clip(0, 1)[:, None]
        if self.interpolation == "CUBICSPLINE":
            span = (t1 - t0)[:, None]
            p0, p1 = self.keys[after - 1, 1], self.keys[after, 1]
            m0, m1 = span * self.keys[after - 1, 2], span * self.keys[after, 0]
            x2, x3 = x * x, x * x * x
            return (2 * x3 - 3 * x2 + 1) * p0 + (x3 - 2 * x2 + x) * m0 + (3 * x2 - 2 * x3) * p1 + (x3 - x2) * m1
        if self.interpolation == "STEP":
            x = np.floor(x + 1e-6)
        return (1 - x) * self.keys[after - 1] + x * self.keys[after]


def _track(document: _Document, animation: dict[str, Any], channel: Any, where: str) -> _Track | None:
    if not isinstance(channel, dict):
        raise document.fail(f"expected {where} as an object, got {str(channel)[:40]!r}")
    target = document.get(channel, "target", dict, where)
    if target.get("path") != "weights" or "node" not in target:
        return None
    node = document.item("nodes", target["node"], f"{where}.target.node")
    mesh = document.item("meshes", node.get("mesh"), f"the mesh of {where}.target.node")
    names = _shape_names(document, mesh, f"meshes[{node['mesh']}]")
    samplers = document.get(animation, "samplers", list, "animation")
    index = document.get(channel, "sampler", int, where)
    if index >= len(samplers) or not isinstance(samplers[index], dict):
        raise document.fail(f"expected {where}.sampler among {len(samplers)} samplers, got {index}")
    sampler = samplers[index]
    interpolation = document.get(sampler, "interpolation", str, where, "LINEAR")
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise document.fail(f"expected {where} LINEAR, STEP or CUBICSPLINE, got {interpolation[:20]}")
    times = _accessor(document, sampler.get("input"), f"{where} input", ("SCALAR",))[:, 0].astype(np.float64)
    if not names or (np.diff(times) <= 0).any():
        raise document.fail(f"expected {where} to have named shapes and rising times")
    each = 3 if interpolation == "CUBICSPLINE" else 1
    values = _accessor(document, sampler.get("output"), f"{where} output", ("SCALAR",), len(times) * len(names) * each)
    shape = (len(times), each, len(names)) if each == 3 else (len(times), len(names))
    return _Track(names, times, values.astype(np.float64).reshape(shape), interpolation)


def _sampled(document: _Document, animation: dict[str, Any], tracks: list[_Track]) -> Clip:
    names = tuple(dict.fromkeys(name for track in tracks for name in track.names))
    first = tracks[0]
    extras = animation.get("extras")
    stored = extras.get("fps") if isinstance(extras, dict) else None
    if len(tracks) == 1 and first.interpolation != "CUBICSPLINE":
        steps = np.diff(first.times)
        fits = isinstance(stored, (int, float)) and not isinstance(stored, bool) and 0 < stored < 1e6
        if fits and np.abs((first.times - first.times[0]) * stored - np.arange(len(first.times))).max() < 0.1:
            return Clip(names, torch.from_numpy(first.keys.astype(np.float32)), float(stored))
        if len(steps) and np.ptp(steps) < 0.1 * steps.min() and np.median(steps) <= 0.1:
            weights, fps = steady(str(document.path), first.times, first.keys)
            return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)
    start, end = min(track.times[0] for track in tracks), max(track.times[-1] for track in tracks)
    steps = np.diff(first.times)
    even = len(steps) and np.ptp(steps) < 0.1 * steps.min() and 1 / 240 < np.median(steps) <= 0.1
    fps = 1 / float(np.median(steps)) if even else 30.0
    fps = float(round(fps)) if abs(fps - round(fps)) < 0.002 * fps else fps
    if (end - start) * fps * len(names) > disk.LIMIT / 32:
        raise document.fail(f"the animation lasts {end - start:g} s, too long for {len(names)} shapes; check its times")
    times = start + np.arange(round((end - start) * fps) + 1) / fps
    weights = np.zeros((len(times), len(names)))
    for track in reversed(tracks):  # where meshes disagree, the first counts
        weights[:, [names.index(name) for name in track.names]] = track.at(times)
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


# Writing --------------------------------------------------------------------------------------------------------------


def save(rig: Rig, path: Path, clip: Clip | None = None) -> None:
    """Writes the rig as one mesh, and the clip as the animation of its weights.

    Numbers are stored as they are; colours become linear as glTF wants them, a texture an 8-bit PNG. Shapes that move
    less than half of the vertices are sparse.

    Args:
        rig: What to write.
        path: A .glb file.
        clip: Motion whose names are the rig's, in its order.

    Raises:
        ReenactError: The clip is for another rig, or the file cannot be written.
    """
    if clip is not None and clip.names != rig.names:
        raise ReenactError(f"{path}: expected a clip with the {len(rig.names)} shapes of {rig.name}; conform it first")
    writer = _Writer()
    mesh = _mesh(writer, rig)
    root: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Reenact", "extras": {"name": rig.name}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": rig.name}],
        "meshes": [mesh],
        "materials": [{"name": "face", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.6}}],
    }
    if rig.texture is not None:
        pixels = (rig.texture.detach().cpu().numpy() * 255).round().clip(0, 255).astype(np.uint8)
        packed = io.BytesIO()
        Image.fromarray(pixels).save(packed, format="PNG")
        root["images"] = [{"bufferView": writer.view(packed.getvalue()), "mimeType": "image/png"}]
        root["textures"] = [{"source": 0}]
        root["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    if clip is not None:
        times = (np.arange(len(clip)) / clip.fps).astype(np.float32)
        weights = clip.weights.detach().cpu().numpy().astype(np.float32).reshape(-1)
        sampler = {
            "input": writer.accessor(times, "SCALAR", bounds=True),
            "output": writer.accessor(weights, "SCALAR"),
            "interpolation": "LINEAR",
        }
        target = {"node": 0, "path": "weights"}
        root["animations"] = [
            {
                "name": "clip",
                "samplers": [sampler],
                "channels": [{"sampler": 0, "target": target}],
                "extras": {"fps": clip.fps},
            }
        ]
    root |= {"accessors": writer.accessors, "bufferViews": writer.views, "buffers": [{"byteLength": len(writer.data)}]}
    text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary = bytes(writer.data) + b"\0" * (-len(writer.data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    disk.write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


class _Writer:
    """Collects accessors and the bytes behind them."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.data += data
        self.views.append(view)
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        code = {"f": 5126, "u": 5125}[values.dtype.kind]
        entry = {"componentType": code, "count": len(values), "type": kind}
        if bounds:
            entry |= _bounds(values)
        entry["bufferView"] = self.view(np.ascontiguousarray(values).tobytes(), target)
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def offsets(self, values: np.ndarray) -> int:
        """Accessor of a morph target (V, 3), sparse where that is smaller."""
        rows = np.flatnonzero(values.any(1))
        if 2 * len(rows) >= len(values):
            return self.accessor(values, "VEC3", 34962, bounds=True)
        if len(rows) == 0:
            rows = np.zeros(1, np.int64)  # the specification wants at least one entry
        sparse = {
            "count": len(rows),
            "indices": {"bufferView": self.view(rows.astype("<u4").tobytes()), "componentType": 5125},
            "values": {"bufferView": self.view(np.ascontiguousarray(values[rows]).tobytes())},
        }
        self.accessors.append(
            {"componentType": 5126, "count": len(values), "type": "VEC3", **_bounds(values), "sparse": sparse}
        )
        return len(self.accessors) - 1


def _bounds(values: np.ndarray) -> dict[str, list[float]]:
    table = values.reshape(len(values), -1)
    return {"min": [float(value) for value in table.min(0)], "max": [float(value) for value in table.max(0)]}


def _mesh(writer: _Writer, rig: Rig) -> dict[str, Any]:
    arrays = {key: value.detach().cpu().numpy() for key, value in vars(rig).items() if isinstance(value, torch.Tensor)}
    neutral, faces = arrays["neutral"].astype(np.float32), arrays["faces"]
    vertex, uv = np.arange(len(neutral)), arrays.get("uv")
    corners = faces
    if uv is not None:
        # A glTF vertex has one uv: one for each pair of vertex and uv that a face uses, and for vertices without face.
        uv_faces = arrays.get("uv_faces", faces)
        used = np.stack([faces.reshape(-1), uv_faces.reshape(-1)], axis=1)
        loose = np.setdiff1d(vertex, faces)
        used = np.concatenate([used, np.stack([loose, np.zeros_like(loose)], axis=1)])
        pairs, inverse = np.unique(used, axis=0, return_inverse=True)
        corners = inverse.reshape(-1)[: faces.size].reshape(-1, 3)
        vertex, uv = pairs[:, 0], uv[pairs[:, 1]].astype(np.float32)
    attributes = {
        "POSITION": writer.accessor(neutral[vertex], "VEC3", 34962, bounds=True),
        "NORMAL": writer.accessor(_normals(neutral, faces)[vertex], "VEC3", 34962),
    }
    if uv is not None:
        attributes["TEXCOORD_0"] = writer.accessor(uv, "VEC2", 34962)
    if "colors" in arrays:
        linear = _to_linear(arrays["colors"].astype(np.float64).clip(0, 1)).astype(np.float32)
        attributes["COLOR_0"] = writer.accessor(linear[vertex], "VEC3", 34962)
    attributes["_VERTEX"] = writer.accessor(vertex.astype(np.float32), "SCALAR", 34962)
    extras: dict[str, Any] = {"targetNames": list(rig.names)}
    if "parts" in arrays:
        attributes["_PART"] = writer.accessor(arrays["parts"].astype(np.float32)[vertex], "SCALAR", 34962)
        extras["partNames"] = list(PARTS)
    deltas = arrays["deltas"].astype(np.float32)
    primitive = {
        "attributes": attributes,
        "indices": writer.accessor(corners.astype(np.uint32).reshape(-1), "SCALAR", 34963),
        "targets": [{"POSITION": writer.offsets(offsets[vertex])} for offsets in deltas],
        "material": 0,
    }
    return {"name": rig.name, "primitives": [primitive], "weights": [0.0] * len(rig.names), "extras": extras}


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3), weighted by area; +Z where there is none."""
    a, b, c = vertices[faces].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(normal[:, axis], 3), len(vertices)) for axis in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-30, total / np.maximum(length, 1e-30), [0.0, 0.0, 1.0]).astype(np.float32)


def _to_linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _to_srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
