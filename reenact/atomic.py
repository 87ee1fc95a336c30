"""Files that are either whole or absent, whatever happens while they are written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def write_atomically(path: Path | str, data: bytes) -> None:
    """Write a file so that a crash or a full disk leaves the old content, or none, under its name.

    Raises:
        OSError: As the system says; nothing is left behind.
    """
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(data)


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """A name beside the file to write to; what lies there at the end of the block takes the file's place.

    Raises:
        OSError: As the system says; nothing is left behind.
    """
    path = Path(path)
    # Beside the target: a rename stays on one disk. Cut short: the longest name that a disk takes may be the target's.
    temporary = path.with_name(f".{path.name[:50]}.{os.getpid()}.tmp")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())  # without it a power cut may keep the new name and lose the content
        os.replace(temporary, path)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary), temporary):
            error.filename = str(path)  # a full disk names no file, and nobody knows the temporary one
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def sweep(folder: Path, name: str = "") -> None:
    """Remove what killed processes left half written in a folder to which no other process writes now; or of one file
    to which none does."""
    for leftover in folder.glob(f".{name}*.tmp"):
        leftover.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    if os.name == "nt":  # Windows cannot open a folder; NTFS journals the rename
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
