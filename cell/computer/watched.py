"""A command whose computing is done in a child, which its parent ends where it gets stuck.

A loop without end in compiled code, or in C with Python's lock, hears neither Ctrl-C nor a clock of
its own process.  So whoever runs code that may not come to an end says so in memory that the parent
reads: it sees that the same call is under way for too long, names it, and ends the child.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

#: A call that takes so long does not come to an end, s: a motion takes milliseconds.  Time in which
#: others had the cores does not count …
PATIENCE_S = 3.0
#: … up to so many times the patience.
_BUSY = 2.5
#: The parent looks so often, s.  What it counts are looks: while both processes are stopped, as by
#: Ctrl-Z, nothing is counted.
_LOOK_S = 0.25
#: After Ctrl-C the child may tidy up for so long, s.
_TIDYING_S = 2.0
#: So long if it has said that it will still answer, s.
_ANSWERING_S = 30.0
#: What the parent hands on to the child.
_PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

#: Calls under way at a time, each in a slot: 8 bytes of a number that is odd during a call and
#: grows by one at its beginning and at its end, then UTF-8 of what is called.
_SLOTS, _SLOT_BYTES, _NUMBER_BYTES = 256, 1024, 8

_STUCK = 2


class _Calls:
    """Calls that are under way, in memory that parent and child share."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, _SLOTS * _SLOT_BYTES + 1)
        self._free = deque(range(_SLOTS))

    @property
    def answers(self) -> bool:
        """Whether the child still answers after Ctrl-C."""
        return self._memory[-1] != 0

    @answers.setter
    def answers(self, yes: bool) -> None:
        self._memory[-1] = int(yes)

    def begin(self, what: str) -> int:
        """Slot of a call that begins now; −1 = none was free, the call is not watched."""
        try:
            slot = self._free.popleft()
        except IndexError:
            return -1
        text = what.encode()[: _SLOT_BYTES - _NUMBER_BYTES - 1] + b"\0"
        begin = slot * _SLOT_BYTES + _NUMBER_BYTES
        self._memory[begin : begin + len(text)] = text
        self._count(slot)
        return slot

    def end(self, slot: int) -> None:
        """The call of a slot has ended."""
        if slot >= 0:
            self._count(slot)
            self._free.append(slot)

    def numbers(self) -> list[int]:
        """Number of every slot."""
        starts = range(0, _SLOTS * _SLOT_BYTES, _SLOT_BYTES)
        return [int.from_bytes(self._memory[s : s + _NUMBER_BYTES], "little") for s in starts]

    def what(self, slot: int) -> str:
        """What is, or was last, called in a slot."""
        begin = slot * _SLOT_BYTES
        text = self._memory[begin + _NUMBER_BYTES : begin + _SLOT_BYTES]
        return text.split(b"\0", 1)[0].decode(errors="replace")

    def _count(self, slot: int) -> None:
        begin = slot * _SLOT_BYTES
        number = int.from_bytes(self._memory[begin : begin + _NUMBER_BYTES], "little") + 1
        self._memory[begin : begin + _NUMBER_BYTES] = number.to_bytes(_NUMBER_BYTES, "little")


_calls: _Calls | None = None


@contextmanager
def must_end(what: str) -> Iterator[None]:
    """During it something runs that may not come to an end; `what` begins the error's message."""
    if _calls is None:
        yield
        return
    slot = _calls.begin(what)
    try:
        yield
    finally:
        _calls.end(slot)


def answers_after_interrupt() -> None:
    """This process will still answer after Ctrl-C: its parent then waits for longer."""
    if _calls is not None:
        _calls.answers = True


def go_on_watched(patience_s: float | None = None) -> None:
    """Returns in a child; this process watches it, and ends as it ends.

    With 2 and a message if a call that `must_end` does not, or ends the child; Ctrl-C or SIGTERM
    end the child, whatever it is doing, the second time soon.  To be called while there is one
    thread only.

    patience_s  None = as usual
    """
    global _calls
    calls = _Calls()
    ended, child_end = os.pipe()
    parent_end, lasting = os.pipe()
    # a signal waits until whoever gets it knows what to do with it
    signal.pthread_sigmask(signal.SIG_BLOCK, _PASSED_ON)
    child = os.fork()
    if child == 0:
        os.close(ended)
        os.close(lasting)
        _calls = calls
        signal.signal(signal.SIGINT, _interrupt_once)
        threading.Thread(target=_end_with, args=(parent_end,), daemon=True).start()
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _PASSED_ON)
        except KeyboardInterrupt:  # given before there was anything to interrupt
            os.write(2, b"interrupted\n")
            os._exit(128 + signal.SIGINT)
        return
    os.close(child_end)
    os.close(parent_end)
    code = _Watch(child, ended, calls, PATIENCE_S if patience_s is None else patience_s).code()
    sys.stderr.flush()
    os._exit(code)


def _interrupt_once(number: int, frame: FrameType | None) -> None:
    """What is tidied up after Ctrl-C is not interrupted again: the parent's patience is short."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


def _end_with(parent_end: int) -> None:
    """End this process when the other end of the pipe is closed, as its holder's death does."""
    os.read(parent_end, 1)
    os._exit(1)


def cpu_s(process: int) -> float:
    """CPU time that a process has taken, s; 0 where the system does not tell."""
    try:
        after_name = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")


def wants_to_compute(process: int) -> bool:
    """Whether a thread of a process has a core or waits for one; False if nobody can tell."""
    try:
        threads = [p.read_text() for p in Path(f"/proc/{process}/task").glob("*/stat")]
    except OSError:
        return False
    return any(text.rsplit(")", 1)[1].split()[0] == "R" for text in threads)


class _Watch:
    """The parent: waits for the child's end, passes signals on, counts looks at the same call."""

    def __init__(self, child: int, ended: int, calls: _Calls, patience_s: float) -> None:
        self._child = child
        self._ended = ended
        self._calls = calls
        self._patience_s = patience_s
        self._numbers = calls.numbers()
        self._looks_s = [0.0] * _SLOTS
        self._own_s = [0.0] * _SLOTS
        self._cpu_s = cpu_s(child)
        self._given: int | None = None
        self._kill_s = float("inf")
        for number in _PASSED_ON:
            signal.signal(number, self._pass_on)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _PASSED_ON)

    def code(self) -> int:
        """Exit code of the command, once the child has ended."""
        while not select.select([self._ended], [], [], _LOOK_S)[0]:
            if time.monotonic() > self._kill_s:
                os.kill(self._child, signal.SIGKILL)
            elif (stuck := self._stuck()) is not None:
                os.kill(self._child, signal.SIGKILL)
                if self._given is not None:
                    continue
                os.waitpid(self._child, 0)
                self._say(
                    f"{self._calls.what(stuck)} takes more than {self._patience_s:g} s, as a loop "
                    "without end does: mend that"
                )
                return _STUCK
        _, status = os.waitpid(self._child, 0)
        code = os.waitstatus_to_exitcode(status)
        return code if code >= 0 else self._killed(-code)

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        again = self._given is not None
        if not again:
            self._given = number
        answers = self._calls.answers and number == signal.SIGINT and not again
        self._kill_s = min(
            self._kill_s, time.monotonic() + (_ANSWERING_S if answers else _TIDYING_S)
        )
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._child, number)

    def _stuck(self) -> int | None:
        """Slot of a call that is under way for too long."""
        numbers, own_s = self._calls.numbers(), self._since_last_look_s()
        for slot, (number, before) in enumerate(zip(numbers, self._numbers, strict=True)):
            same = number == before and number % 2 == 1
            self._looks_s[slot] = self._looks_s[slot] + _LOOK_S if same else 0.0
            self._own_s[slot] = self._own_s[slot] + own_s if same else 0.0
        self._numbers = numbers
        return next((s for s in range(_SLOTS) if self._is_stuck(s)), None)

    def _is_stuck(self, slot: int) -> bool:
        if self._own_s[slot] >= self._patience_s - 0.5 * _LOOK_S:
            return True
        return self._looks_s[slot] >= _BUSY * self._patience_s

    def _since_last_look_s(self) -> float:
        """Time since the last look in which the child could have gone on, s.

        All of it while it sleeps; while it wants to compute, what it was given of the cores.
        """
        before_s, self._cpu_s = self._cpu_s, cpu_s(self._child)
        if not wants_to_compute(self._child):
            return _LOOK_S
        return min(_LOOK_S, self._cpu_s - before_s)

    def _killed(self, number: int) -> int:
        """Exit code after a signal has ended the child; says what was called then."""
        if self._given is not None:
            self._say("interrupted")
            return 128 + self._given
        under_way = [s for s, n in enumerate(self._calls.numbers()) if n % 2 == 1]
        name = signal.Signals(number).name
        if under_way:
            self._say(f"{self._calls.what(under_way[0])} ends the process ({name}): mend that")
            return _STUCK
        self._say(f"the computing was ended from outside ({name}); is there enough memory?")
        return 128 + number

    @staticmethod
    def _say(text: str) -> None:
        """Print on the error stream; at a terminal the cursor may have been hidden by the child."""
        shown = "\x1b[?25h\r\x1b[K" if sys.stderr.isatty() else ""
        print(f"{shown}{text}", file=sys.stderr)
