"""The one error that a user's input can cause."""


class ReenactError(ValueError):
    """A file, an argument or a setting that cannot work.

    The message is one sentence: what was read, what was expected, what came, what to do. Commands print it without a
    traceback and exit with status 2; anything else that escapes is our own mistake and keeps its traceback.
    """
