"""Locks: one process per run, on this machine and on others."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from reenact import lock as module
from reenact.errors import ReenactError
from reenact.lock import RunLock

HOLD = """
import sys, time
from pathlib import Path
from reenact.lock import RunLock
with RunLock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_and_told_who_was_first_until_that_one_is_killed(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "held\n"
        with pytest.raises(ReenactError, match=f"got process {first.pid}.* on {socket.gethostname()}; wait for it"):
            RunLock(tmp_path).__enter__()
        first.send_signal(signal.SIGKILL)
    with RunLock(tmp_path):
        assert json.loads((tmp_path / "lock").read_text())["pid"] == os.getpid()


def test_a_lock_is_free_again_after_its_block(tmp_path):
    for _ in range(2):
        with RunLock(tmp_path), pytest.raises(ReenactError, match=f"got process {os.getpid()}"):
            RunLock(tmp_path).__enter__()


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"pid": 1, "host": "HERE"}', '{"pid": "x"}'])
def test_a_lock_file_that_nobody_holds_is_taken_over(content, tmp_path):
    (tmp_path / "lock").write_text(content.replace("HERE", socket.gethostname()))
    with RunLock(tmp_path):
        pass


@pytest.mark.parametrize("shared", [True, False])
def test_a_process_of_another_machine_is_believed_for_a_minute_after_its_last_sign(shared, tmp_path, monkeypatch):
    """Some file systems give each machine its own locks, some none at all."""
    if not shared:
        monkeypatch.setattr(module, "try_lock", no_locks)
    (tmp_path / "lock").write_text('{"pid": 7, "host": "elsewhere", "user": "ana"}')
    now = time.time()
    os.utime(tmp_path / "lock", (now - 50, now - 50))
    with pytest.raises(ReenactError, match=r"got process 7 of ana on elsewhere, heard of 5[0-9] s ago; wait for it"):
        RunLock(tmp_path).__enter__()
    os.utime(tmp_path / "lock", (now - 70, now - 70))
    with RunLock(tmp_path):
        pass


def test_a_lock_gives_signs_of_life(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_BEAT", 0.02)
    with RunLock(tmp_path):
        os.utime(tmp_path / "lock", (1, 1))
        deadline = time.monotonic() + 10
        while (tmp_path / "lock").stat().st_mtime == 1:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_a_process_that_was_taken_for_dead_notices_and_leaves_the_lock_to_the_other(tmp_path):
    with RunLock(tmp_path) as lock:
        lock.check()
        (tmp_path / "lock").write_text('{"pid": 7, "host": "elsewhere"}')
        with pytest.raises(ReenactError, match="got process 7 on elsewhere"):
            lock.check()
    assert json.loads((tmp_path / "lock").read_text())["pid"] == 7


def test_a_lock_file_that_was_removed_stops_nobody(tmp_path):
    with RunLock(tmp_path) as lock:
        (tmp_path / "lock").unlink()
        lock.check()


def no_locks(_):
    raise OSError(errno.ENOLCK, "No locks available")


@pytest.mark.parametrize(
    ("pid", "host", "free"),
    [(os.getppid(), None, False), (2**22 + 1, None, True), (1, "elsewhere", False), (None, None, True)],
)
def test_where_the_file_system_has_no_locks_the_process_in_the_file_decides(pid, host, free, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "try_lock", no_locks)
    (tmp_path / "lock").write_text(json.dumps({"pid": pid, "host": host or socket.gethostname()}))
    if free:  # 2^22 is the most that Linux counts to: no such process
        with RunLock(tmp_path):
            pass
    else:
        with pytest.raises(ReenactError, match=f"got process {pid} on"):
            RunLock(tmp_path).__enter__()


def test_a_missing_run_folder_cannot_be_locked(tmp_path):
    with pytest.raises(FileNotFoundError):
        RunLock(tmp_path / "missing").__enter__()
