"""What interrupts a cell: Ctrl-C, SIGTERM, a terminal that is closed; once, and never lost."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal

import pytest

from cell.cli.shared import interrupted_once


def test_a_swallowed_interruption_is_raised_again() -> None:
    with interrupted_once() as interruption:
        interruption.raise_again()
        # as the interpreter does in a callback or a destructor
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            interruption.raise_again()


@pytest.mark.parametrize(
    ("number", "why"),
    [(signal.SIGINT, ""), (signal.SIGTERM, ""), (signal.SIGHUP, "the terminal was closed")],
)
def test_every_ending_interrupts_once_and_says_why(
    number: signal.Signals, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    former = signal.getsignal(number)
    with interrupted_once() as received:
        with pytest.raises(KeyboardInterrupt) as interruption:
            os.kill(os.getpid(), number)
        assert str(interruption.value) == why
        assert received.code(1) == (1 if number == signal.SIGHUP else 128 + number)
        os.kill(os.getpid(), signal.SIGHUP)  # the shell sends one more
        os.kill(os.getpid(), signal.SIGTERM)
    assert capsys.readouterr().err == "already stopping\n" * 2
    assert signal.getsignal(number) == former


def test_a_second_signal_does_not_break_the_halt_when_nobody_reads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("sys.stderr", Gone())
    with interrupted_once():
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)


def test_what_nohup_has_ignored_stays_ignored() -> None:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupted_once() as interruption:
            os.kill(os.getpid(), signal.SIGHUP)
            interruption.raise_again()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, former)
