"""RunLock: one process trains in a run folder, on this machine and on all that share its disk.

run/lock        process, machine and user that train there; empty after a clean end
"""

from __future__ import annotations

import getpass
import json
import os
import socket
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from reenact.errors import ReenactError

_BEAT = 10.0
"""Seconds between signs of life of a process that holds a lock."""
_SILENCE = 60.0
"""Seconds without one after which a process on another machine counts as dead."""


class RunLock:
    """Keeps a second process out of a run folder for the length of a `with` block, on this machine and on others.

    Two locks in one file. The system's belongs to the process, not to the file: the system takes it back when the
    process ends, however it ends. But some shared file systems have no such locks, or keep them on each machine. So the
    file also names process, machine and user, and is touched while they live: a process of this machine is looked up,
    one of another counts as dead after a minute of silence.

    Raises:
        ReenactError: Another process holds it; the message names that process.
        OSError: The folder cannot be written.
    """

    def __init__(self, run_dir: Path):
        self.run_dir = run_dir
        self.path = run_dir / "lock"
        self._descriptor: int | None = None
        self._left = threading.Event()
        self._content = b""

    def __enter__(self) -> RunLock:
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            holder = _holder(descriptor)
            try:
                free, shared = try_lock(descriptor), True
            except OSError:  # a file system without locks
                free, shared = not _alive(holder), False
            silence = _silence(descriptor, self.run_dir)
            if holder.get("host", socket.gethostname()) != socket.gethostname():
                free = free and silence > _SILENCE if shared else silence > _SILENCE
            if not free:
                raise self._refusal(holder, silence)
            owner = {"pid": os.getpid(), "host": socket.gethostname(), "user": _user(), "since": time.time()}
            self._content = json.dumps(owner).encode()
            os.ftruncate(descriptor, 0)
            os.lseek(descriptor, 0, os.SEEK_SET)
            os.write(descriptor, self._content)
            if not shared:  # two may have found the same dead one: the last to write has it
                time.sleep(0.3)
                self.check()
        except BaseException:
            os.close(descriptor)
            raise
        self._descriptor = descriptor
        self._left.clear()
        threading.Thread(target=self._beat, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        assert self._descriptor is not None, "a lock is left once, after it was entered"
        self._left.set()
        if self._is_ours():
            os.ftruncate(self._descriptor, 0)  # the file stays: removing it could remove the lock of the next process
        os.close(self._descriptor)
        self._descriptor = None

    def check(self) -> None:
        """Make sure that the folder is still this process's: a machine that slept may have been taken for dead.

        Raises:
            ReenactError: Another process has taken it over.
        """
        if not self._is_ours():
            raise self._refusal(_parse(self.path.read_bytes()), 0.0)

    def _is_ours(self) -> bool:
        try:
            return self.path.read_bytes() == self._content
        except FileNotFoundError:  # somebody removed it; nobody else is named
            return True

    def _beat(self) -> None:
        while not self._left.wait(_BEAT):
            with suppress(OSError):
                if self._is_ours():
                    os.utime(self.path)

    def _refusal(self, holder: dict[str, Any], silence: float) -> ReenactError:
        process, machine = holder.get("pid", "unknown"), holder.get("host", "an unknown machine")
        owner = f" of {holder['user']}" if holder.get("user") else ""
        heard = f", heard of {silence:.0f} s ago" if machine != socket.gethostname() and silence >= 1 else ""
        return ReenactError(
            f"{self.run_dir}: expected no other process to train here, got process {process}{owner} on {machine}"
            f"{heard}; wait for it, end it, or choose another run folder"
        )


def is_training(run_dir: Path) -> bool:
    """Whether a process seems to train in a run folder; looks, and takes no lock."""
    path = run_dir / "lock"
    try:
        holder, touched = _parse(path.read_bytes()), path.stat().st_mtime
    except OSError:
        return False
    return _alive(holder) and (holder.get("host") == socket.gethostname() or time.time() - touched < _SILENCE)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # a user without a name, as in containers
        return ""


def _silence(descriptor: int, folder: Path) -> float:
    """Seconds since the lock file was touched, by the clock of the disk that both machines write to."""
    with tempfile.TemporaryFile(dir=folder) as probe:
        probe.write(b"0")
        probe.flush()
        return os.fstat(probe.fileno()).st_mtime - os.fstat(descriptor).st_mtime


def try_lock(descriptor: int) -> bool:
    """Take the system's lock on the file unless another process has it; raises OSError where there are no locks."""
    if os.name == "nt":
        import msvcrt

        os.lseek(
            descriptor, 1 << 30, os.SEEK_SET
        )  # Windows hides locked bytes from readers: lock one that is not there
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError:
            return False
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _holder(descriptor: int) -> dict[str, Any]:
    """Process and machine that the lock file names; empty after a clean end."""
    return _parse(os.read(descriptor, 1000))


def _parse(text: bytes) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _alive(holder: dict[str, Any]) -> bool:
    if not isinstance(holder.get("pid"), int):
        return False
    if holder.get("host") != socket.gethostname():
        return True  # nobody here can tell
    return alive(holder["pid"])


def alive(process: int) -> bool:
    """Whether there is such a process on this machine."""
    try:
        os.kill(process, 0)  # signal 0 only asks
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # alive, and somebody else's
        return True
    return True
