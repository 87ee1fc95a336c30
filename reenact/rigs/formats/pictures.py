"""Pictures that a rig's file embeds or names."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.formats import disk

PIXELS = 8192 * 8192
"""Largest picture that is unpacked."""


def pixels(where: str, data: bytes) -> UInt8[np.ndarray, "H W C"]:
    """The picture in the bytes of a PNG, JPEG or WebP file, with alpha where it has some.

    Raises:
        ReenactError: It is something else, damaged, or larger than `PIXELS`.
    """
    try:
        with Image.open(io.BytesIO(data), formats=["PNG", "JPEG", "WEBP"]) as picture:
            if picture.width * picture.height > PIXELS:
                raise ReenactError(f"{where}: expected a picture of at most {PIXELS} pixels, got {picture.size}")
            clear = "A" in picture.getbands() or "transparency" in picture.info
            return np.asarray(picture.convert("RGBA" if clear else "RGB"))
    except ReenactError:
        raise
    except Exception as error:  # Pillow's decoders raise what they like on damaged data
        raise ReenactError(
            f"{where}: expected a PNG, JPEG or WebP picture, it cannot be read ({str(error)[:80]})"
        ) from None


def png(picture: UInt8[np.ndarray, "H W C"]) -> bytes:
    """The picture as a PNG file."""
    packed = io.BytesIO()
    Image.fromarray(picture).save(packed, format="PNG")
    return packed.getvalue()


def beside(path: Path, name: str) -> Path | None:
    """The picture that a file names, where it lies in the file's folder or below; None where it does not.

    Files name pictures by where they were on another machine. A name that leads elsewhere is looked for beside the
    file, in `textures` and in `<stem>.fbm`, and nowhere else.
    """
    folder = path.parent.resolve()
    last = PureWindowsPath(name).name  # splits at both / and \
    candidates = [f"{place}{last}" for place in ("", "textures/", f"{path.stem}.fbm/")] if last else []
    relative = name.replace("\\", "/")
    if relative and not relative.startswith("/") and not re.search(r"[:\0]", relative):
        candidates.insert(0, relative)
    for candidate in candidates:
        try:
            found = (folder / candidate).resolve()
            if found.is_relative_to(folder) and found.is_file():
                return found
        except (OSError, ValueError):  # a NUL, a name too long, a loop of links
            continue
    return None


def load(path: Path) -> UInt8[np.ndarray, "H W C"]:
    """The picture in a file.

    Raises:
        ReenactError: As `pixels` and `disk.read_bytes`.
    """
    return pixels(str(path), disk.read_bytes(path))


def gather(
    path: Path, named: Mapping[str, bytes | str]
) -> tuple[dict[str, Callable[[], UInt8[np.ndarray, "H W C"]]], tuple[str, ...], list[str]]:
    """Loaders of the pictures of a file, a line on each, and a line on each that is missing.

    Args:
        path: The file.
        named: By key what it embeds, or the name of what should lie beside it.
    """
    found: dict[str, Callable[[], np.ndarray]] = {}
    described, missing = [], []
    for key, content in named.items():
        name = key[-80:]
        if isinstance(content, bytes):
            found[key] = lambda content=content, name=name: pixels(f"{path}: {name}", content)
            described.append(f"{name}: in the file")
            continue
        place = beside(path, content)
        if place is None:
            missing.append(f"picture {name} is not in the file's folder; left out")
        else:
            found[key] = lambda place=place: load(place)
            described.append(f"{name}: {place.relative_to(path.parent.resolve())} beside the file")
    return found, tuple(described), missing
