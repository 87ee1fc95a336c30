"""The errors that a user's input can cause: one class, and the same for what is not there."""


class ReenactError(ValueError):
    """A file, an argument or a setting that cannot work.

    The message is one sentence: what was read, what was expected, what came, what to do. Commands print it without a
    traceback and exit with status 2; anything else that escapes is our own mistake and keeps its traceback.
    """


class MissingError(ReenactError, FileNotFoundError):
    """A file or folder that was named and is not there; also Python's own class for that."""
