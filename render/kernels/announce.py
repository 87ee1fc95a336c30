"""Says that the kernels are being compiled: the first call of a new installation takes half a minute."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOBase

from numba.core import event


class _Counter(event.Listener):
    """Counts the functions that are compiled, on a line that a terminal overwrites."""

    def __init__(self, stream: TextIOBase) -> None:
        self.stream = stream
        self.finished = 0
        self.start = time.monotonic()
        self.announced = False

    def on_start(self, event: event.Event) -> None:
        if not self.announced:
            self.announced = True
            print("render: compiling for this computer; later starts find what was compiled", file=self.stream)

    def on_end(self, event: event.Event) -> None:
        self.finished += 1
        if self.stream.isatty():
            seconds = time.monotonic() - self.start
            print(f"\rrender: {self.finished} functions, {seconds:.0f} s ", end="", file=self.stream, flush=True)


@contextmanager
def announced(stream: TextIOBase | None = None) -> Iterator[None]:
    """Reports what numba compiles meanwhile, and nothing where it finds all of it in its cache.

    Args:
        stream: None is standard error.
    """
    counter = _Counter(stream or sys.stderr)
    with event.install_listener("numba:compile", counter):
        yield
    if counter.announced:
        ending = "\r" if counter.stream.isatty() else ""
        seconds = time.monotonic() - counter.start
        functions = f"{counter.finished} function{'s' if counter.finished > 1 else ''}"
        print(f"{ending}render: compiled {functions} in {seconds:.0f} s", file=counter.stream)
