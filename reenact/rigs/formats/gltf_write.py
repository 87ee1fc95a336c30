"""Writing glTF 2.0: a rig of our own with its animation, or an animation into somebody's avatar.

Source: Khronos, glTF 2.0 Specification. What we write has no errors and no warnings from the Khronos validator.
"""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, gltf
from reenact.rigs.formats.gltf_document import MESHOPT, Document, open_document
from reenact.rigs.formats.pieces import to_linear
from reenact.rigs.formats.polygons import vertex_normals
from reenact.rigs.rig import PARTS, Rig


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
    writer = _Writer(bytearray(), [], [])
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
    disk.write_bytes(path, _packed(root, bytes(writer.data)))


def animate(avatar: Path, clip: Clip, path: Path) -> tuple[str, ...]:
    """Writes somebody's avatar as it is, with the clip as its first animation, and says what it could not move.

    Meshes, skeleton, materials, expressions and extensions stay untouched, compressed data included; other animations
    stay behind ours. A shape that several meshes have is moved on each of them.

    Args:
        avatar: A .glb, .gltf or .vrm file with named morph targets.
        clip: Weights by the names of its shapes, VRM expressions included.
        path: A .glb or .vrm file.

    Returns:
        Names of the clip that move, and that no mesh has.

    Raises:
        ReenactError: The avatar cannot be read, has none of the clip's shapes, or the file cannot be written.
    """
    document = open_document(avatar)
    root, weights = document.root, clip.weights.detach().cpu().numpy().astype(np.float64)
    column = {name: index for index, name in enumerate(clip.names)}
    writer = _Writer(_own_buffers(document), root.setdefault("bufferViews", []), root.setdefault("accessors", []))
    times = writer.accessor((np.arange(len(clip)) / clip.fps).astype(np.float32), "SCALAR", bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    moved: set[str] = set()
    for node, mixing in gltf.morph_mixes(document):
        here = {name: mix for name, mix in mixing.items() if name in column}
        if not here:
            continue
        moved |= here.keys()
        values = sum(weights[:, column[name], None] * mix for name, mix in here.items())
        output = writer.accessor(np.asarray(values, np.float32).reshape(-1), "SCALAR")
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": "weights"}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    if not channels:
        raise document.fail(
            f"expected some of the clip's shapes ({', '.join(clip.names[:3])}, ...) on its meshes, found none"
        )
    animation = {"name": "Reenact", "samplers": samplers, "channels": channels, "extras": {"fps": clip.fps}}
    root["animations"] = [animation, *root.get("animations", [])]
    root["buffers"][0]["byteLength"] = len(writer.data)
    disk.write_bytes(path, _packed(root, bytes(writer.data)))
    still = (np.abs(weights) > 0).any(0) if len(weights) else np.zeros(len(clip.names), bool)
    return tuple(name for name, moves in zip(clip.names, still) if moves and name not in moved)


def _own_buffers(document: Document) -> bytearray:
    """Bytes of all buffers one after another; views, and pictures beside the file, move into them."""
    root = document.root
    data, places, kept = bytearray(), {}, []
    for index, buffer in enumerate(root.get("buffers", [])):
        if "uri" not in buffer and index:
            kept.append(index)  # a stand-in for what a compressed view holds: it has no bytes
            continue
        data += b"\0" * (-len(data) % 8)
        places[index] = len(data)
        data += document.buffer(index, "glTF.buffers")
    numbers = {index: 1 + number for number, index in enumerate(kept)}
    for view in root.get("bufferViews", []):
        for part in (view, *(view.get("extensions", {}).get(name, {}) for name in MESHOPT)):
            if part.get("buffer") in places:
                part["byteOffset"] = part.get("byteOffset", 0) + places[part["buffer"]]
                part["buffer"] = 0
            elif part.get("buffer") in numbers:
                part["buffer"] = numbers[part["buffer"]]
    root["buffers"] = [{}, *(root["buffers"][index] for index in kept)]
    for index, image in enumerate(root.get("images", [])):
        if "uri" in image:
            picture = document.uri(image.pop("uri"), f"images[{index}].uri")
            data += b"\0" * (-len(data) % 8)
            root.setdefault("bufferViews", []).append(
                {"buffer": 0, "byteOffset": len(data), "byteLength": len(picture)}
            )
            image |= {"bufferView": len(root["bufferViews"]) - 1, "mimeType": _picture_kind(picture)}
            data += picture
    return data


def _picture_kind(data: bytes) -> str:
    if data[:3] == b"\xff\xd8\xff":
        return "image/jpeg"
    return "image/webp" if data[8:12] == b"WEBP" else "image/png"


def _packed(root: dict[str, Any], data: bytes) -> bytes:
    """A .glb of the JSON and the bytes of its first buffer."""
    text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


class _Writer:
    """Collects accessors and the bytes behind them."""

    def __init__(self, data: bytearray, views: list[dict[str, Any]], accessors: list[dict[str, Any]]) -> None:
        self.data, self.views, self.accessors = data, views, accessors

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
        "NORMAL": writer.accessor(vertex_normals(neutral, faces)[vertex], "VEC3", 34962),
    }
    if uv is not None:
        attributes["TEXCOORD_0"] = writer.accessor(uv, "VEC2", 34962)
    if "colors" in arrays:
        linear = to_linear(arrays["colors"].astype(np.float64).clip(0, 1)).astype(np.float32)
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
