"""A glTF 2.0 file: its JSON, its bytes, and the arrays in them.

Source: Khronos, glTF 2.0 Specification. Strict: no address outside the file's folder is followed, and no array is made
before its size was checked against the bytes that are there.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from reenact.errors import ReenactError
from reenact.rigs.formats import disk

MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
"""Extensions whose buffer views the package `meshopt` decodes."""

DRACO = "KHR_draco_mesh_compression"
"""The extension whose primitives the package `DracoPy` decodes."""

UNDERSTOOD = frozenset(
    {
        *("KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", *MESHOPT, DRACO),
        # These change how light falls on a surface or how a body is moved, not its shape or base colour.
        *("KHR_lights_punctual", "KHR_materials_unlit", "KHR_materials_ior", "KHR_materials_specular"),
        *("KHR_materials_sheen", "KHR_materials_clearcoat", "KHR_materials_transmission", "KHR_materials_volume"),
        *("KHR_materials_emissive_strength", "KHR_materials_iridescence", "KHR_materials_anisotropy"),
        *("KHR_materials_dispersion", "KHR_materials_pbrSpecularGlossiness", "KHR_xmp_json_ld"),
        *("VRM", "VRMC_vrm", "VRMC_springBone", "VRMC_node_constraint", "VRMC_materials_mtoon"),
        *("VRMC_materials_hdr_emissiveMultiplier", "VRMC_springBone_extended_collider"),
    }
)
"""Extensions that a file may require."""

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Component types of accessors."""

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
"""Numbers in an element of each type of accessor."""


@dataclass(frozen=True)
class Document:
    """A parsed file."""

    path: Path
    root: dict[str, Any]
    binary: bytes | None
    """The binary chunk of a .glb."""
    decoded: set[str] = field(default_factory=set)
    """Kinds of compression that were undone."""
    _buffers: dict[int, bytes] = field(default_factory=dict, repr=False)
    _views: dict[int, tuple[bytes, int, int, int | None]] = field(default_factory=dict, repr=False)

    # JSON

    def fail(self, message: str) -> ReenactError:
        """The error that names this file."""
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
        """owner[key], so many finite numbers."""
        values = self.get(owner, key, list, where, default)
        good = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
        if len(values) != count or not good or not all(abs(value) < 1e30 for value in values):
            raise self.fail(f"expected {where}.{key} as {count} numbers, got {str(values)[:60]}")
        return np.array(values, dtype=np.float64)

    # Bytes

    def uri(self, uri: str, where: str) -> bytes:
        """What an address in the file holds: data within it, or a file beside it."""
        if uri.startswith("data:"):
            header, _, payload = uri.partition(",")
            if not header.endswith(";base64"):
                raise self.fail(f"expected {where} as base64 data, got {header[:40]!r}")
            try:
                return base64.b64decode(payload, validate=True)
            except (binascii.Error, ValueError):
                raise self.fail(f"{where} holds damaged base64 data") from None
        name = unquote(uri)
        parts = name.split("/")
        outside = not name or name.startswith("/") or re.search(r"[\\:\0]", name) or ".." in parts
        folder = self.path.parent.resolve()
        if outside or not (folder / name).resolve().is_relative_to(folder):  # a symbolic link may also lead outside
            raise self.fail(f"{where} must stay in the file's folder, got {uri[:60]!r}")
        return disk.read_bytes(folder / name)

    def buffer(self, index: Any, where: str) -> bytes:
        """The bytes of a buffer."""
        if index in self._buffers:
            return self._buffers[index]
        entry = self.item("buffers", index, where)
        length = self.get(entry, "byteLength", int, f"buffers[{index}]")
        uri = self.get(entry, "uri", str, f"buffers[{index}]", None)
        if uri is None:
            if index != 0 or self.binary is None:
                raise self.fail(f"buffers[{index}] has no uri, and the file no binary chunk for it")
            data = self.binary
        else:
            data = self.uri(uri, f"buffers[{index}].uri")
        if length > len(data):
            raise self.fail(f"buffers[{index}].byteLength says {length}, the data has {len(data)} bytes")
        self._buffers[index] = data[:length]
        return self._buffers[index]

    def view(self, index: Any, where: str) -> tuple[bytes, int, int, int | None]:
        """Buffer, start, length and stride of a buffer view, within its buffer; unpacked where it was packed."""
        if type(index) is int and index in self._views:
            return self._views[index]
        view = self.item("bufferViews", index, where)
        name = f"bufferViews[{index}]"
        extensions = self.get(view, "extensions", dict, name, {})
        stride = self.get(view, "byteStride", int, name, None)
        if stride is not None and (not 4 <= stride <= 252 or stride % 4):
            raise self.fail(f"expected {name}.byteStride as a multiple of 4 up to 252, got {stride}")
        packed = next((key for key in MESHOPT if key in extensions), None)
        if packed is not None:
            data = _unpacked(self, self.get(extensions, packed, dict, name), f"{name}.extensions.{packed}")
            self.decoded.add("meshopt")
            found = data, 0, len(data), stride
        else:
            found = (*self._span(view, name), stride)
        self._views[index] = found
        return found

    def _span(self, view: dict[str, Any], name: str) -> tuple[bytes, int, int]:
        buffer_index = self.get(view, "buffer", int, name)
        start = self.get(view, "byteOffset", int, name, 0)
        length = self.get(view, "byteLength", int, name)
        data = self.buffer(buffer_index, f"{name}.buffer")
        if start + length > len(data):
            raise self.fail(f"{name} ends at byte {start + length}, buffers[{buffer_index}] has {len(data)}")
        return data, start, length

    # Arrays

    def strided(self, view: Any, offset: int, count: int, dtype: str, width: int, where: str) -> np.ndarray:
        """Elements (count, width) in a buffer view, without a copy."""
        data, start, length, stride = self.view(view, f"{where}.bufferView")
        size = np.dtype(dtype).itemsize
        stride = stride or size * width
        end = offset + (count - 1) * stride + size * width
        if stride < size * width or end > length:
            raise self.fail(f"{where} needs {end} bytes for {count} elements, its bufferView has {length}")
        return np.ndarray((count, width), dtype, data, start + offset, (stride, size))

    def accessor(self, index: Any, where: str, kinds: tuple[str, ...], count: int | None = None) -> np.ndarray:
        """Values (count, width) of an accessor: float32 if stored as floats or normalised, else integers.

        Args:
            index: Of the accessor.
            where: What refers to it, for messages.
            kinds: Types that it may have.
            count: How many elements it must have, where that is known.
        """
        entry = self.item("accessors", index, where)
        name = f"accessors[{index}] ({where})"
        kind = self.get(entry, "type", str, name)
        code = self.get(entry, "componentType", int, name)
        length = self.get(entry, "count", int, name)
        if kind not in kinds or code not in COMPONENTS:
            raise self.fail(f"expected {name} of type {' or '.join(kinds)}, got {kind[:20]} of component type {code}")
        if length < 1 or (count is not None and length != count):
            raise self.fail(f"expected {name} with {count or 'one or more'} elements, got {length}")
        dtype, width = COMPONENTS[code], WIDTHS[kind]
        offset = self.get(entry, "byteOffset", int, name, 0)
        sparse = self.get(entry, "sparse", dict, name, None)
        view = self.get(entry, "bufferView", int, name, None)
        if view is not None:
            values = self.strided(view, offset, length, dtype, width, name)
        elif count is None:
            raise self.fail(f"{name} has {length} elements and no bufferView")
        else:
            values = np.zeros((length, width), dtype)
        if sparse is not None:
            values = self._sparse(sparse, values, name)
        return self.plain(values, entry.get("normalized") is True, name)

    def plain(self, values: np.ndarray, normalized: bool, name: str) -> np.ndarray:
        """Stored numbers as they are meant: finite float32, normalised integers as fractions, other integers."""
        if values.dtype.kind == "f":
            if not np.isfinite(values).all():
                raise self.fail(f"{name} holds NaN or infinity; export the mesh again")
            return values.astype(np.float32)
        if normalized:
            return np.maximum(values / np.float32(np.iinfo(values.dtype).max), np.float32(-1)).astype(np.float32)
        return values

    def _sparse(self, sparse: dict[str, Any], values: np.ndarray, name: str) -> np.ndarray:
        where = f"{name}.sparse"
        count = self.get(sparse, "count", int, where)
        if not 1 <= count <= len(values):
            raise self.fail(f"expected {where}.count from 1 to {len(values)}, got {count}")
        indices = self.get(sparse, "indices", dict, where)
        replaced = self.get(sparse, "values", dict, where)
        code = self.get(indices, "componentType", int, f"{where}.indices")
        if code not in (5121, 5123, 5125):
            raise self.fail(f"expected {where}.indices as unsigned integers, got component type {code}")
        places = []
        for part, dtype, width in ((indices, COMPONENTS[code], 1), (replaced, values.dtype.str, values.shape[1])):
            place = f"{where}.{'indices' if part is indices else 'values'}"
            offset = self.get(part, "byteOffset", int, place, 0)
            places.append(self.strided(part.get("bufferView"), offset, count, dtype, width, place))
        rows = places[0][:, 0].astype(np.int64)
        if rows.max() >= len(values):
            raise self.fail(f"expected {where}.indices below {len(values)}, got {rows.max()}")
        values = values.copy()
        values[rows] = places[1]
        return values


_KINDS = {int: "a whole number from 0", float: "a number", list: "a list", dict: "an object", str: "a string"}


def open_document(path: Path) -> Document:
    """The file, its JSON parsed and its version and needs checked.

    Raises:
        ReenactError: Damaged, another version, or it requires an extension that we do not know.
    """
    data = disk.read_bytes(path)
    binary = None
    if data[:4] == b"glTF" or path.suffix.lower() in (".glb", ".vrm"):
        text, binary = _chunks(path, data)
    else:
        text = data
    try:
        root = json.loads(text.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ReenactError(f"{path}: expected glTF JSON, it cannot be parsed ({str(error)[:80]})") from None
    if not isinstance(root, dict):
        raise ReenactError(f"{path}: expected a glTF object, got {str(root)[:40]!r}")
    document = Document(path, root, binary)
    version = document.get(document.get(root, "asset", dict, "glTF"), "version", str, "asset")
    if not version.startswith("2."):
        raise document.fail(f"expected glTF 2.0, got version {version[:20]}; export it as glTF 2.0")
    required = document.get(root, "extensionsRequired", list, "glTF", [])
    unknown = [str(name)[:60] for name in required if not isinstance(name, str) or name not in UNDERSTOOD]
    if unknown:
        raise document.fail(
            f"needs extensions that are not supported: {', '.join(unknown)[:300]}; export it without them"
        )
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


def _unpacked(document: Document, packed: dict[str, Any], where: str) -> bytes:
    """Bytes of a buffer view that meshopt compressed."""
    try:
        import meshopt
    except ImportError:
        raise document.fail(
            f"{where} is packed with meshopt; needs the package meshopt: pip install 'reenact[gltf]'"
        ) from None
    data, start, length = document._span(packed, where)
    count = document.get(packed, "count", int, where)
    stride = document.get(packed, "byteStride", int, where)
    mode = document.get(packed, "mode", str, where)
    kind = document.get(packed, "filter", str, where, "NONE")
    if not 1 <= stride <= 256 or not count * stride <= disk.LIMIT:
        raise document.fail(f"expected {where} of at most {disk.LIMIT:,} bytes, got {count} elements of {stride}")
    # A compressed element is never smaller than a bit in 16 bytes: a lying count ends here and not in the decoder.
    if count * stride > 2048 * (length + 1):
        raise document.fail(f"{where} says {count} elements of {stride} bytes, packed in {length} bytes")
    try:
        values = meshopt.decode_gltf_buffer(data[start : start + length], count, stride, mode, kind)
    except Exception as error:  # the decoder raises what it likes on damaged data
        raise document.fail(f"{where} cannot be unpacked ({str(error)[:80]})") from None
    return np.ascontiguousarray(values).tobytes()
