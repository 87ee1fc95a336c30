"""Interrupts: a signal ends what can be dropped and asks what cannot; silence stops nothing."""

import io
import os
import signal
import sys

import pytest

from reenact.cli import COMMANDS, main
from reenact.interrupts import Output, listening


def _in_compiled_code(interrupt):
    """What is left of an interrupt that came while C code called Python in passing."""
    try:
        try:
            raise interrupt
        except BaseException as first:
            raise SystemError("<function unpickle> returned a result with an exception set") from first
    except SystemError as second:
        raise SystemError("<kernel> returned a result with an exception set") from second


def test_an_interrupt_in_compiled_code_is_still_one(monkeypatch, capsys):
    """R7: numba's unpickling of a kernel turned SIGTERM into a fault of ours, in 2 of 80 endings."""
    with listening() as interrupts, interrupts.patiently(), pytest.raises(SystemExit), interrupts.promptly():
        _in_compiled_code(SystemExit(143))
    with pytest.raises(SystemError), listening():
        raise SystemError("of another kind")
    monkeypatch.setitem(COMMANDS, "doctor", lambda: _in_compiled_code(KeyboardInterrupt()))
    assert main(["doctor"]) == 130
    assert "stopped" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_asks_once_and_a_second_interrupt_stops_at_once(number, status, request):
    inherited = signal.signal(number, signal.SIG_DFL)  # ignored where the tests run under nohup
    request.addfinalizer(lambda: signal.signal(number, inherited))
    before = signal.getsignal(signal.SIGINT)  # ignored where a shell started the tests in the background
    with listening() as interrupts:
        with interrupts.patiently():
            assert interrupts.asked is None
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)  # those who end a whole group of processes may send two
            assert isinstance(interrupts.asked, SystemExit)
            assert interrupts.asked.code == status
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(SystemExit), interrupts.promptly():
            pytest.fail("what is asked already ends what need not be finished before it begins")
    assert signal.getsignal(signal.SIGINT) is before


def test_a_signal_ends_what_need_not_be_finished_at_once():
    with listening() as interrupts, interrupts.patiently(), pytest.raises(SystemExit), interrupts.promptly():
        os.kill(os.getpid(), signal.SIGTERM)
    assert interrupts.asked.code == 143


def test_a_training_under_nohup_outlives_its_terminal():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with listening() as interrupts:
            os.kill(os.getpid(), signal.SIGHUP)
            assert interrupts.asked is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_output_that_nobody_reads_any_more_stops_nothing(monkeypatch):
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        output = Output()
        os.close(reader)
        for _ in range(2):
            assert output.write("text") == 4
            output.flush()
    closed = io.StringIO()
    closed.write = lambda _: (_ for _ in ()).throw(OSError(5, "Input/output error"))
    monkeypatch.setattr(sys, "stdout", closed)
    for _ in range(2):
        Output().write("text")
