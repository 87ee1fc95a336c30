"""Disks that are full or fail in the middle of a save; docs/reliability.md."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from reenact.atomic import replacing, write_atomically

HERE = Path(__file__).parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}


def found(command, **environment):
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=600, check=False, env={**ENVIRONMENT, **environment}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def failing_calls(tmp_path_factory):
    """The library that lets calls fail."""
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("needs Linux and a C compiler")
    library = tmp_path_factory.mktemp("library") / "fail_calls.so"
    subprocess.run([compiler, "-shared", "-fPIC", HERE / "fail_calls.c", "-o", library, "-ldl"], check=True)
    return library


def test_a_save_of_which_any_call_fails_leaves_a_checkpoint_that_loads(failing_calls, tmp_path):
    """R4, in full: every call of the C library in a save, with each of three errors."""
    answer = found([sys.executable, HERE / "failing_saves.py", tmp_path], LD_PRELOAD=str(failing_calls))
    assert answer["wrong"] == []
    assert answer["tried"] == 3 * sum(answer["calls"].values())
    assert answer["raised"] > 90
    assert {"write", "fsync", "rename"} <= answer["calls"].keys()
    harmless = {"fstat64", "lseek64", "mkdir", "opendir", "readdir64", "fstat", "lseek", "readdir", "stat", "stat64"}
    assert set(answer["went_on"]) <= harmless  # the save was whole without them


def test_commands_on_a_full_disk_say_so_and_leave_nothing_half_written(tmp_path):
    """R5, in full: trainings, exports and films on disks of a few KiB."""
    alone = ["unshare", "--user", "--map-root-user", "--mount"]
    if shutil.which("unshare") is None or subprocess.run([*alone, "true"], check=False).returncode:
        pytest.skip("needs unshare, and the right to use it")
    answer = found([*alone, sys.executable, HERE / "full_disk.py", tmp_path])
    assert answer["wrong"] == []
    assert answer["tried"] >= 13


def test_an_error_without_a_file_gets_the_name_of_the_one_that_was_meant(tmp_path):
    with pytest.raises(OSError, match=r"x\.bin") as caught, replacing(tmp_path / "x.bin"):
        raise OSError(28, "No space left on device")
    assert caught.value.filename == str(tmp_path / "x.bin")
    with pytest.raises(FileNotFoundError, match=r"none/x\.bin'$"):
        write_atomically(tmp_path / "none" / "x.bin", b"")
