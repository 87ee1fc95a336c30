"""What reaches a training from outside: signals, and an output that nobody reads any more.

A step is never torn: while a training is patient, a signal only asks for its end; what can be dropped anywhere ends at
once. Who closes the terminal or the pipe stops nothing but the words.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from reenact.errors import interruptions


class Interrupts:
    """Ctrl-C, SIGTERM and a lost terminal: they end work at once, or ask for its end where work is patient."""

    def __init__(self) -> None:
        self.asked: BaseException | None = None
        """What ends the training, once somebody has asked."""
        self._patient = False

    def hear(self, number: int, _frame: object) -> None:
        """Handler of the signals; a second Ctrl-C stops at once, anything else that follows the first is ignored."""
        if self.asked is not None:
            if number == signal.SIGINT:
                raise KeyboardInterrupt
            return
        self.asked = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
        if not self._patient:
            raise self.asked

    @contextmanager
    def patiently(self) -> Iterator[None]:
        """Work that must not be torn: it looks at `asked` by itself."""
        before, self._patient = self._patient, True
        try:
            yield
        finally:
            self._patient = before

    @contextmanager
    def promptly(self) -> Iterator[None]:
        """Work that can be dropped anywhere, inside patient work."""
        before, self._patient = self._patient, False
        try:
            if self.asked is not None:
                raise self.asked
            with interruptions():
                yield
        finally:
            self._patient = before


@contextmanager
def listening() -> Iterator[Interrupts]:
    """Listens to signals for the length of a `with` block."""
    interrupts, previous = Interrupts(), {}
    hangup = getattr(signal, "SIGHUP", None)  # Windows has none
    for number in (signal.SIGINT, signal.SIGTERM, hangup):
        if number is None or (number == hangup and signal.getsignal(number) == signal.SIG_IGN):  # nohup
            continue
        try:
            previous[number] = signal.signal(number, interrupts.hear)
        except ValueError:  # not the main thread: signals are somebody else's
            break
    try:
        with interruptions():
            yield interrupts
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class Output:
    """Standard output that falls silent, instead of failing, once nobody is there: a training outlives its terminal."""

    def __init__(self) -> None:
        self._stream = sys.stdout

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, call: Callable[..., object], *arguments: str) -> None:
        try:
            call(*arguments)
        except OSError:
            try:  # what is buffered must go somewhere, or Python complains when it ends
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            except OSError:
                self._stream = io.StringIO()
