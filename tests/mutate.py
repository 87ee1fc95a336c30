"""Loads mutants of a file, in a process of its own: `python mutate.py NOUN FILE COUNT SEED` prints what happened.

NOUN is `rig` or `clip`. A mutant has some bytes replaced, cut out, doubled or cut off, or a number in its text replaced
by one that hurts. Anything but a loaded file or a `ReenactError` ends the process with its traceback.

Files that are read in a process of their own are read in a fork of this one instead, which takes a hundredth of the
time of a fresh one and is as easily crashed; a crash, and 10 seconds, count as refused, as they do there.
"""

import importlib
import json
import os
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from reenact.errors import ReenactError
from reenact.rigs import files
from reenact.rigs.formats import isolated, usd

HURTFUL = [
    b"-1",
    b"0",
    b"4294967295",
    b"1e308",
    b"999999999999",
    b"null",
    b"[]",
    b"{}",
    b'"x"',
    b"true",
    b"-0.5",
    b"NaN",
]


def mutant(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with one to eight faults."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 9)):
        place = int(rng.integers(len(changed) + 1))
        kind = rng.random()
        if kind < 0.6:
            changed[place : place + 1] = bytes([rng.integers(256)])
        elif kind < 0.7:
            del changed[place : place + int(rng.integers(1, 30))]
        elif kind < 0.8:
            changed[place:place] = changed[place : place + int(rng.integers(1, 30))]
        elif kind < 0.97:
            numbers = list(re.finditer(rb"-?\d+(\.\d+)?", bytes(changed[place : place + 400])))
            if numbers:
                found = numbers[int(rng.integers(len(numbers)))]
                changed[place + found.start() : place + found.end()] = HURTFUL[rng.integers(len(HURTFUL))]
        else:
            del changed[place:]
    return bytes(changed)


def forked(path: Path, task: str, noun: str) -> dict:
    """What `isolated.read` does, without the start of a process."""
    with tempfile.TemporaryFile() as answer:
        child = os.fork()
        if child == 0:
            os.dup2(answer.fileno(), 1)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what a crash has to say
            signal.alarm(10)
            mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            isolated.main(task, str(path), str(path), str(mapped + isolated.MEMORY))
        _, status = os.waitpid(child, 0)
        if os.WIFSIGNALED(status) or os.WEXITSTATUS(status):
            raise ReenactError(f"{path}: expected {noun}, it ends its reader ({status})")
        answer.seek(0)
        found = isolated._unpack(answer.read())
    if "error" in found:
        raise ReenactError(found["error"])
    return found


def main(noun: str, file: str, count: str, seed: str) -> None:
    """Prints loaded, refused, the longest load in seconds, and the most memory in MiB beyond what starting took."""
    warnings.simplefilter("ignore")
    data, rng = Path(file).read_bytes(), np.random.default_rng(int(seed))
    load = files.load_rig if noun == "rig" else files.read_clip
    if Path(file).suffix in (".fbx", *usd.SUFFIXES):
        load(file)  # as users do; then everything is imported before the first fork
        importlib.import_module(f"reenact.rigs.formats.{'fbx' if file.endswith('.fbx') else 'usd'}_scene")
        importlib.import_module("ufbx" if file.endswith(".fbx") else "pxr.UsdSkel")
        isolated.read = forked
    loaded = refused = 0
    longest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / Path(file).name
        path.write_bytes(data)
        load(str(path))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(int(count)):
            path.write_bytes(mutant(data, rng))
            start = time.perf_counter()
            try:
                load(str(path))
                loaded += 1
            except ReenactError as error:
                refused += 1
                if str(path) not in str(error):
                    sys.exit(f"names no file: {error}")
            longest = max(longest, time.perf_counter() - start)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(json.dumps({"loaded": loaded, "refused": refused, "longest": longest, "grown": grown}))


if __name__ == "__main__":
    main(*sys.argv[1:])
