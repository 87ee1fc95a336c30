"""Rigs as .npz: `names` (K,), `neutral` (V, 3), `deltas` (K, V, 3), `faces` (F, 3), and what else a `Rig` has.

Units are metres, +Y up, as in `Rig`. Nothing in a file is unpickled, and no array is made before its size was checked
against the bytes that are there.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reenact.errors import ReenactError
from reenact.rigs.formats import disk
from reenact.rigs.rig import PARTS, Rig


def load(path: Path) -> Rig:
    """The rig in the file.

    Raises:
        ReenactError: An array is missing, of the wrong kind or size, or not finite.
    """
    optional = ("name", "colors", "parts", "part_names", "uv", "uv_faces", "texture")
    arrays = read(path, ("names", "neutral", "deltas", "faces", *optional))
    shape_names = names(path, arrays)
    neutral = floats(path, arrays, "neutral", (None, 3))
    values: dict[str, Any] = {
        "neutral": neutral,
        "deltas": floats(path, arrays, "deltas", (len(shape_names), len(neutral), 3)),
        "faces": _integers(path, arrays, "faces", (None, 3)),
    }
    for key, shape in {"colors": (len(neutral), 3), "uv": (None, 2), "texture": (None, None, 3)}.items():
        if key in arrays:
            values[key] = floats(path, arrays, key, shape)
    if "uv_faces" in arrays:
        values["uv_faces"] = _integers(path, arrays, "uv_faces", (len(values["faces"]), 3))
    if "parts" in arrays:
        part_names = names(path, arrays, "part_names") if "part_names" in arrays else PARTS
        values["parts"] = _parts(path, _integers(path, arrays, "parts", (len(neutral),)), part_names)
    name = str(arrays["name"])[:200] if "name" in arrays and arrays["name"].dtype.kind == "U" else path.stem
    try:
        return Rig(name=name, names=shape_names, **{key: torch.from_numpy(value) for key, value in values.items()})
    except ReenactError as error:
        raise ReenactError(f"{path}: {error}") from None


def save(rig: Rig, path: Path) -> None:
    """Writes every field of the rig, numbers unchanged.

    Raises:
        ReenactError: The file cannot be written.
    """
    arrays = {key: value.detach().cpu().numpy() for key, value in vars(rig).items() if isinstance(value, torch.Tensor)}
    if rig.parts is not None:
        arrays["part_names"] = np.array(PARTS)
    write(path, name=np.array(rig.name), names=np.array(rig.names), **arrays)


def read(path: Path, wanted: Sequence[str]) -> dict[str, np.ndarray]:
    """Those of the wanted arrays that the file has, nothing else unpacked.

    Raises:
        ReenactError: Not a zip file, damaged, an array of objects, or larger than `disk.LIMIT` when unpacked.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(disk.read_bytes(path))) as archive:
            members = {key: archive.getinfo(f"{key}.npy") for key in wanted if f"{key}.npy" in archive.namelist()}
            total = sum(member.file_size for member in members.values())
            if total > disk.LIMIT:
                raise ReenactError(f"{path}: expected at most {disk.LIMIT:,} bytes unpacked, got {total:,}")
            return {key: _array(f"{path}: {key}", archive.read(member)) for key, member in members.items()}
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError) as error:
        if isinstance(error, ReenactError):
            raise
        raise ReenactError(f"{path}: expected a .npz archive, it is damaged or something else ({error})") from None


def contents(path: Path) -> tuple[str, ...]:
    """Names of the arrays in the file, without reading them.

    Raises:
        ReenactError: Not a zip file.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(disk.read_bytes(path))) as archive:
            return tuple(name.removesuffix(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, ValueError) as error:
        if isinstance(error, ReenactError):
            raise
        raise ReenactError(f"{path}: expected a .npz archive, it is damaged or something else ({error})") from None


def write(path: Path, **arrays: Any) -> None:
    """Writes the arrays; the same arrays make the same bytes.

    Raises:
        ReenactError: The file cannot be written.
    """
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    disk.write_bytes(path, packed.getvalue())


def names(path: Path, arrays: dict[str, np.ndarray], key: str = "names") -> tuple[str, ...]:
    """An array of names as strings.

    Raises:
        ReenactError: It is missing or holds something else.
    """
    array = _present(path, arrays, key)
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    if array.ndim != 1 or array.dtype.kind != "U":
        raise ReenactError(f"{path}: expected {key} as a list of strings, got {array.dtype} {array.shape}")
    return tuple(str(name) for name in array)


def floats(
    path: Path, arrays: dict[str, np.ndarray], key: str, shape: tuple[int | None, ...], dtype: type = np.float32
) -> np.ndarray:
    """An array of finite numbers of that shape, where None is any size.

    Raises:
        ReenactError: It is missing, has another shape, or is not finite.
    """
    array = _present(path, arrays, key)
    _check_shape(path, array, key, shape)
    if array.dtype.kind not in "fiu":
        raise ReenactError(f"{path}: expected numbers in {key}, got {array.dtype}")
    with np.errstate(over="ignore"):
        array = array.astype(dtype)
    if not np.isfinite(array).all():
        raise ReenactError(f"{path}: {key} holds NaN or infinity; export it again")
    return array


def _integers(path: Path, arrays: dict[str, np.ndarray], key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    array = _present(path, arrays, key)
    _check_shape(path, array, key, shape)
    if array.dtype.kind not in "iu":
        raise ReenactError(f"{path}: expected whole numbers in {key}, got {array.dtype}")
    return array.astype(np.int64)


def _parts(path: Path, parts: np.ndarray, part_names: tuple[str, ...]) -> np.ndarray:
    known = np.array([PARTS.index(name) if name in PARTS else -1 for name in part_names])
    if len(parts) and (len(known) == 0 or parts.min() < 0 or parts.max() >= len(known) or (known[parts] < 0).any()):
        raise ReenactError(f"{path}: expected parts among {', '.join(PARTS)}, got others")
    return known[parts]


def _present(path: Path, arrays: dict[str, np.ndarray], key: str) -> np.ndarray:
    if key not in arrays:
        raise ReenactError(f"{path}: expected an array {key}, got {', '.join(arrays) or 'none that is known'}")
    return arrays[key]


def _check_shape(path: Path, array: np.ndarray, key: str, shape: tuple[int | None, ...]) -> None:
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, array.shape)):
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise ReenactError(f"{path}: expected {key} of shape ({expected}), got {array.shape}")


def _array(where: str, data: bytes) -> np.ndarray:
    """The array in the bytes of a .npy file."""
    stream = io.BytesIO(data)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        version = np.lib.format.read_magic(stream)
        shape, fortran, dtype = readers[version](stream)
    except (ValueError, KeyError, TypeError, SyntaxError, RecursionError, MemoryError, OverflowError) as error:
        raise ReenactError(f"{where}: expected an array in .npy format, its header is damaged") from error
    if dtype.hasobject or dtype.kind not in "fiuUS" or dtype.itemsize == 0:
        raise ReenactError(f"{where}: expected numbers or strings, got {dtype}; save it without objects")
    start = stream.tell()
    # Python integers: a lying shape cannot overflow, nor make numpy allocate.
    if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ReenactError(f"{where}: expected {shape} values of {dtype}, got {len(data) - start} bytes")
    array = np.frombuffer(data, dtype, offset=start).reshape(shape, order="F" if fortran else "C")
    if dtype.kind == "U" and array.size and int(array.reshape(-1).view(f"{dtype.str[0]}u4").max()) > 0x10FFFF:
        raise ReenactError(f"{where}: expected Unicode strings, got a code point beyond its range")
    return array.astype(dtype.newbyteorder("="))
