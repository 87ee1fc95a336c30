"""Decoders that can crash, in a process of their own.

Libraries that read a format in C or C++ end the whole program when a damaged file surprises them. A child of limited
time and memory reads the file instead, and answers in JSON and plain arrays; nothing is pickled.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from reenact.errors import ReenactError
from reenact.rigs.formats import disk

SECONDS = 10.0
"""Time that any file may take, start of the process included."""

SECONDS_PER_MEGABYTE = 1.0
"""Time that its size adds."""

MEMORY = 2 << 30
"""Bytes that any file may take; four times its size is added."""


def read(path: Path, task: str, noun: str) -> dict[str, Any]:
    """What a function of another module makes of a file.

    Args:
        path: The file.
        task: `module:function` in this package; the function takes the path and returns a dict of JSON values, bytes
            and arrays. It raises ReenactError for files that it refuses.
        noun: What the file should be, for messages.

    Raises:
        ReenactError: The task refused the file, crashed on it, or took too long or too much memory; the file is
            missing, empty or larger than `disk.LIMIT`.
        RuntimeError: The task failed by a mistake of ours.
    """
    size = _size(path)
    limit = MEMORY + 4 * size
    seconds = SECONDS + SECONDS_PER_MEGABYTE * size / 1e6
    root = Path(__file__).resolve().parents[3]
    # An empty entry would be the current folder.
    places = [str(root), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    environment.setdefault("OMP_NUM_THREADS", "1")
    # -P: a module in the current folder must not be taken for one of ours.
    command = [sys.executable, "-P", "-m", __name__, task, str(path.resolve()), str(path), str(limit)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=seconds, env=environment, check=False)
    except subprocess.TimeoutExpired:
        raise ReenactError(
            f"{path}: expected {noun}, reading it took more than {seconds:.0f} s; it is damaged, export it again"
        ) from None
    except OSError as error:
        raise ReenactError(f"{path}: cannot be read, no process could be started ({error.strerror})") from error
    if done.returncode == 0:
        answer = _unpack(done.stdout)
        if "error" in answer:
            raise ReenactError(answer["error"])
        return answer
    text = done.stderr.decode("utf-8", "replace")
    if done.returncode == 1 and "Traceback" in text:
        raise RuntimeError(f"{path}: {task} failed\n{text[-4000:]}")
    raise ReenactError(
        f"{path}: expected {noun}, the library that reads it crashed ({_exit(done.returncode)}); it is damaged, "
        "export it again"
    )


def _size(path: Path) -> int:
    """Bytes of a regular file that is neither empty nor too large."""
    try:
        if not path.is_file():
            reason = "a folder" if path.is_dir() else "nothing"
            raise ReenactError(f"{path}: expected a file, found {reason}; check the path")
        size = path.stat().st_size
        with path.open("rb"):
            pass
    except (OSError, ValueError) as error:
        if isinstance(error, ReenactError):
            raise
        raise ReenactError(f"{path}: cannot be read ({error})") from error
    if size > disk.LIMIT:
        raise ReenactError(f"{path}: expected at most {disk.LIMIT:,} bytes, got {size:,}")
    if size == 0:
        raise ReenactError(f"{path}: expected content, got an empty file")
    return size


def _exit(code: int) -> str:
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"exit {code}"


# The answer: length of the JSON, the JSON, then arrays one after another --------------------------------------------


def _pack(value: dict[str, Any]) -> bytes:
    blocks: list[bytes] = []
    offset = 0

    def plain(item: Any) -> Any:
        nonlocal offset
        if isinstance(item, bytes):
            item = np.frombuffer(item, np.uint8)
            return {"__bytes__": plain(item)}
        if isinstance(item, np.ndarray):
            blocks.append(np.ascontiguousarray(item).tobytes())
            entry = {"__array__": [item.dtype.str, list(item.shape), offset]}
            offset += len(blocks[-1])
            return entry
        if isinstance(item, dict):
            return {str(key): plain(each) for key, each in item.items()}
        if isinstance(item, (list, tuple)):
            return [plain(each) for each in item]
        return item

    text = json.dumps(plain(value)).encode()
    return b"".join([len(text).to_bytes(8, "little"), text, *blocks])


def _unpack(data: bytes) -> dict[str, Any]:
    start = 8 + int.from_bytes(data[:8], "little")

    def array(item: dict[str, Any]) -> Any:
        if "__array__" in item:
            dtype, shape, offset = item["__array__"]
            count = int(np.prod(shape, dtype=np.int64))
            return np.frombuffer(data, dtype, count, start + offset).reshape(shape)
        return item["__bytes__"].tobytes() if "__bytes__" in item else item

    return json.loads(data[8:start], object_hook=array)


def main(task: str, path: str, shown: str, limit: str) -> None:
    """The child's side: runs the task and writes its answer to standard output."""
    out = os.dup(1)
    os.dup2(2, 1)  # libraries talk on standard output; the answer must be alone there
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (int(limit), int(limit)))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (ImportError, ValueError, OSError):  # Windows has no such limits
        pass
    gc.disable()  # ufbx 0.0.5 frees a scene before what is in it, and crashes; nothing here lives long
    module, function = task.split(":")
    try:
        answer = getattr(importlib.import_module(f"reenact.rigs.formats.{module}"), function)(Path(path))
        packed = _pack(answer)
    except ReenactError as error:
        packed = _pack({"error": str(error).replace(path, shown, 1)})
    except MemoryError:
        packed = _pack({"error": f"{shown}: needs more than {int(limit):,} bytes to read; it is damaged or too large"})
    with os.fdopen(out, "wb") as stream:
        stream.write(packed)
    os._exit(0)  # without the library's own clean-up, which may crash after the work is done


if __name__ == "__main__":
    main(*sys.argv[1:])
