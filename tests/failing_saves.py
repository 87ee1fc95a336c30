"""Saves of which one call of the system fails: `python failing_saves.py FOLDER`, with fail_calls.so preloaded.

Tries every call with every error, each in a fork; prints what became of them as JSON.
"""

import ctypes
import errno
import json
import os
import shutil
import sys
import warnings
from collections import Counter
from pathlib import Path

import torch

from reenact.checkpoint import load_checkpoint, save_checkpoint

ERRORS = ("ENOSPC", "EIO", "EACCES")


def main(folder: Path) -> None:
    library = ctypes.CDLL(None)
    library.fail_names.restype = ctypes.c_char_p
    run, first = folder / "run", folder / "first"
    for step in (1, 2):
        save_checkpoint(first, step, {"w": torch.full((5000,), float(step))}, {"step": step}, error=1.0 / step, keep=2)

    def save(number: int, error: int) -> bool:
        """Whether the save, whose third checkpoint replaces the first, raised."""
        library.fail_arm(number, error)
        try:
            save_checkpoint(run, 3, {"w": torch.full((5000,), 3.0)}, {"step": 3}, error=0.1, keep=2)
        except OSError:
            return True
        finally:
            library.fail_seen()
        return False

    shutil.copytree(first, run)
    assert not save(-1, 0)
    names = library.fail_names().decode().split()
    found = {"calls": dict(Counter(names)), "tried": 0, "raised": 0, "went_on": [], "wrong": []}
    for number in range(1, len(names) + 1):
        for name in ERRORS:
            shutil.rmtree(run)
            shutil.copytree(first, run)
            child = os.fork()
            if child == 0:
                os._exit(save(number, getattr(errno, name)))
            raised = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            call = f"{name} from {names[number - 1]}, call {number}"
            found["tried"] += 1
            found["raised"] += raised
            if not raised:
                found["went_on"].append(names[number - 1])
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # of a checkpoint that is not whole
                try:
                    loaded = load_checkpoint(run)
                    if load_checkpoint(run, "best").step != loaded.step:
                        raise AssertionError("another one is the best")
                except Exception as error:
                    found["wrong"].append(f"{call}: {error}")
                    continue
            if loaded.step not in ((2, 3) if raised else (3,)) or not (loaded.tensors["w"] == loaded.step).all():
                found["wrong"].append(f"{call}: step {loaded.step}, {'raised' if raised else 'went on'}")
            left = {path.name for path in (run / "checkpoints").iterdir() if path.suffix == ".tmp"}
            if left and names[number - 1] != "unlink":
                found["wrong"].append(f"{call}: left {left}")
    found["went_on"] = sorted(set(found["went_on"]))
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
