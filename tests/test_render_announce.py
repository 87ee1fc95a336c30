"""The first call of a new installation says what it waits for."""

from __future__ import annotations

import io

import numba

from render.kernels.announce import announced


def test_compiling_is_announced_and_summed_up():
    stream = io.StringIO()
    fresh = numba.njit(lambda x: x + 1)
    with announced(stream):
        assert fresh(1) == 2
    first, last = stream.getvalue().splitlines()
    assert "compiling for this computer" in first
    assert last.startswith("render: compiled 1 function in ")


def test_what_is_compiled_already_is_not_announced():
    stream = io.StringIO()
    known = numba.njit(lambda x: x + 1)
    known(1)
    with announced(stream):
        known(2)
    assert stream.getvalue() == ""


def test_a_terminal_sees_progress():
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with announced(stream):
        numba.njit(lambda x: x + 2)(1)
    assert "\rrender: 1 functions" in stream.getvalue()
