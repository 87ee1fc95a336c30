"""The errors that a user's input can cause: one class, and the same for what is not there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class ReenactError(ValueError):
    """A file, an argument or a setting that cannot work.

    The message is one sentence: what was read, what was expected, what came, what to do. Commands print it without a
    traceback and exit with status 2; anything else that escapes is our own mistake and keeps its traceback.
    """


class MissingError(ReenactError, FileNotFoundError):
    """A file or folder that was named and is not there; also Python's own class for that."""


@contextmanager
def interruptions() -> Iterator[None]:
    """Lets Ctrl-C and signals through compiled code: what it made of them is made good.

    A signal's handler runs in any Python code, also in code that C calls in passing, as when numba unpacks a kernel.
    What C cannot pass on becomes `SystemError: ... returned a result with an exception set`, once or several times.
    """
    try:
        yield
    except SystemError as error:
        cause: BaseException | None = error
        while isinstance(cause, SystemError):
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt | SystemExit):
            raise cause from None
        raise
