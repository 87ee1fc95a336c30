"""Whole files in and out: bounded reads, and writes that either happen or do not."""

from __future__ import annotations

from pathlib import Path

from reenact.atomic import write_atomically
from reenact.errors import ReenactError

LIMIT = 1 << 30
"""Bytes beyond which a file, or what it unpacks to, is refused."""


def read_bytes(path: Path) -> bytes:
    """The whole file.

    Raises:
        ReenactError: It is missing, unreadable, not a regular file, empty, or larger than `LIMIT`.
    """
    try:
        if not path.is_file():
            reason = "a folder" if path.is_dir() else "nothing"
            raise ReenactError(f"{path}: expected a file, found {reason}; check the path")
        size = path.stat().st_size
        if size > LIMIT:
            raise ReenactError(f"{path}: expected at most {LIMIT:,} bytes, got {size:,}")
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        if isinstance(error, ReenactError):
            raise
        raise ReenactError(f"{path}: cannot be read ({error})") from error
    if not data:
        raise ReenactError(f"{path}: expected content, got an empty file")
    return data


def read_text(path: Path) -> str:
    """The whole file as UTF-8, with or without a byte order mark.

    Raises:
        ReenactError: As `read_bytes`, or it is not UTF-8.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ReenactError(
            f"{path}: expected UTF-8 text, got byte {error.start} = {error.object[error.start]:#x}"
        ) from None


def write_bytes(path: Path, data: bytes) -> None:
    """Puts the file there whole, or leaves what was there; see `reenact.atomic`.

    Raises:
        ReenactError: The folder is missing or cannot be written.
    """
    try:
        write_atomically(path, data)
    except OSError as error:
        raise ReenactError(f"{path}: cannot be written ({error.strerror}); choose a folder that exists") from error
