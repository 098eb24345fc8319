"""Runs a command's computations in a child process, which the parent ends if a call hangs.

An endless loop in compiled code, or in C code that holds the interpreter lock, blocks Ctrl-C and
all timers of its process.  Calls that may never return are therefore registered in shared memory.
If the parent finds the same call there for too long, it reports it, and ends the child.
"""

from __future__ import annotations

import contextlib
import ctypes
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
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

#: A call that takes so long counts as endless, s: a motion takes milliseconds.  Time in which other
#: processes had the cores does not count …
PATIENCE_S = 3.0
#: … up to so many times the patience.
_BUSY = 2.5
#: Sampling interval of the parent, s.  It counts samples: while both processes are stopped, as by
#: Ctrl-Z, nothing is counted.
POLL_S = 0.25
#: Time for the child to clean up after Ctrl-C, s.
_TIDYING_S = 2.0
#: The same if it has declared that it will still answer, s.
_ANSWERING_S = 30.0
#: Equal signals within this are one, s: `timeout` sends it to the command and to its group.
_ONE_S = 0.5
#: Environment variable by which the caller of a command sets the time between two lines of
#: progress, s.
PROGRESS_VARIABLE = "CELL_PROGRESS_EVERY_S"
#: Begins a line with the error of a fitted model as JSON, for the caller of the command.
FIT_ERROR = "fit error: "
#: Signals after which a command may still print results.
ANSWERED = (signal.SIGINT, signal.SIGTERM)
#: Signals that the parent forwards to the child.
_PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

#: Largest number of forks of the child at a time, and slots of each, at the end of the table.
MOST_FORKS, _OF_FORK = 64, 16
#: Slots of the child itself: calls under way at a time.
_OWN = 128
_SLOT_BYTES = 1024

_STUCK = 2


class _CallSlot(ctypes.Structure):
    """Place of one call.

    number  odd during a call; incremented at its beginning and at its end
    name    UTF-8 name of the current or last call
    """

    _fields_ = (("number", ctypes.c_uint64), ("name", ctypes.c_char * (_SLOT_BYTES - 8)))
    number: int
    name: bytes


class _SharedCalls(ctypes.Structure):
    """Layout of the memory: slots, the process of each fork (0 = none), see `Calls`."""

    _fields_ = (
        ("slots", _CallSlot * (_OWN + MOST_FORKS * _OF_FORK)),
        ("processes", ctypes.c_uint64 * MOST_FORKS),
        ("answers", ctypes.c_bool),
    )
    slots: ctypes.Array[_CallSlot]
    processes: ctypes.Array[ctypes.c_uint64]
    answers: bool


class Calls:
    """Table of running calls, in memory that parent and child share.

    shared  its `answers`: whether the child still answers after Ctrl-C or SIGTERM
    """

    def __init__(self) -> None:
        self.shared = _SharedCalls.from_buffer(mmap.mmap(-1, ctypes.sizeof(_SharedCalls)))
        self._free = deque(range(_OWN))

    def begin(self, name: str) -> int:
        """Slot of a call that begins now; −1 = none was free, the call is not watched."""
        try:
            slot = self._free.popleft()
        except IndexError:
            return -1
        self.shared.slots[slot].name = name.encode()[: _SLOT_BYTES - 9]
        self.shared.slots[slot].number += 1
        return slot

    def end(self, slot: int) -> None:
        """The call of a slot has ended."""
        if slot >= 0:
            self.shared.slots[slot].number += 1
            self._free.append(slot)

    def numbers(self) -> list[int]:
        """Number of every slot."""
        return [slot.number for slot in self.shared.slots]

    def name(self, slot: int) -> str:
        """Name of the current or last call in a slot."""
        return self.shared.slots[slot].name.decode(errors="replace")

    def fork(self, slot: int) -> int | None:
        """Number of the fork to which a slot belongs; None = the child itself."""
        return None if slot < _OWN else (slot - _OWN) // _OF_FORK

    def belong(self, fork: int, process: int) -> None:
        """Assign the slots of a fork to this process, which is that fork; 0 = it has ended."""
        slots = range(_OWN + fork * _OF_FORK, _OWN + (fork + 1) * _OF_FORK)
        for slot in slots:
            self.shared.slots[slot].number += self.shared.slots[slot].number % 2  # it ended in it
        self.shared.processes[fork] = process
        if process:
            self._free = deque(slots)


_calls: Calls | None = None


@contextmanager
def must_end(what: str) -> Iterator[None]:
    """Register a call that may never return; `what` begins the error message about it."""
    if _calls is None:
        yield
        return
    slot = _calls.begin(what)
    try:
        yield
    finally:
        _calls.end(slot)


def fork_started(fork: int) -> None:
    """Register this process as a fork of a watched one; its number is below `MOST_FORKS`."""
    if _calls is not None:
        _calls.belong(fork, os.getpid())


def fork_ended(fork: int) -> None:
    """Unregister the fork with this number, whatever it was doing."""
    if _calls is not None:
        _calls.belong(fork, 0)


def responds_after_interrupt() -> None:
    """Declare that this process still prints results after Ctrl-C: its parent then waits longer."""
    if _calls is not None:
        _calls.shared.answers = True


def go_on_watched(patience_s: float | None = None) -> None:
    """Fork: return in the child; in the parent watch the child and exit with its exit code.

    The exit code is 2, with a message, if a call registered by `must_end` hangs or ends the child.
    Ctrl-C or SIGTERM end the child, whatever it is doing, the second time soon.  To be called
    while there is one thread only.

    patience_s  None = `PATIENCE_S`
    """
    global _calls
    calls = Calls()
    ended, child_end = os.pipe()
    parent_end, lasting = os.pipe()
    # signals wait until their handlers are installed
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
        except KeyboardInterrupt:  # a signal that came before
            os.write(2, b"interrupted\n")
            os._exit(128 + signal.SIGINT)
        return
    os.close(child_end)
    os.close(parent_end)
    code = _Watch(child, ended, calls, PATIENCE_S if patience_s is None else patience_s).code()
    sys.stderr.flush()
    os._exit(code)


def _interrupt_once(number: int, frame: FrameType | None) -> None:
    """Interrupt once: cleaning up is not interrupted again, and the parent waits only shortly."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


def _end_with(parent_end: int) -> None:
    """End this process when the other end of the pipe is closed, as its holder's death does."""
    try:
        os.read(parent_end, 1)
    finally:
        os._exit(1)


def cpu_s(process: int) -> float:
    """CPU time of a process, s; 0 where the system does not report it."""
    try:
        after_name = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")


def no_end(patience_s: float) -> str:
    """Message about a call that took longer than `patience_s`."""
    return f"takes more than {patience_s:g} s, as a loop without end does: mend that"


def wants_to_compute(process: int) -> bool:
    """Whether a thread of a process runs or waits for a core; False if unknown."""
    try:
        threads = [p.read_text() for p in Path(f"/proc/{process}/task").glob("*/stat")]
    except OSError:
        return False
    return any(text.rsplit(")", 1)[1].split()[0] == "R" for text in threads)


class GrantedTime:
    """Measures for how long a process could have run, from one sample to the next."""

    def __init__(self, process: int) -> None:
        self._process = process
        self._cpu_s = cpu_s(process)

    def since_last_sample_s(self) -> float:
        """Full interval while the process sleeps; its CPU time while it wants to compute."""
        before_s, self._cpu_s = self._cpu_s, cpu_s(self._process)
        if not wants_to_compute(self._process):
            return POLL_S
        return min(POLL_S, self._cpu_s - before_s)


@dataclass
class RunningCall:
    """Time granted to an unfinished call: its process's own time, s, and sampled time, s."""

    own_s: float = 0.0
    sampled_s: float = 0.0

    def sample(self, granted_s: float) -> None:
        """Count one more sample in which the call is unfinished."""
        self.own_s += granted_s
        self.sampled_s += POLL_S

    def is_stuck(self, patience_s: float) -> bool:
        """Whether a call that ends would have ended; others may have held the cores."""
        return self.own_s >= patience_s - 0.5 * POLL_S or self.sampled_s >= _BUSY * patience_s


class CallMonitor:
    """Samples the calls of a process, and identifies one that hangs."""

    def __init__(self, calls: Calls, process: int, patience_s: float) -> None:
        self._calls = calls
        self._granted = GrantedTime(process)
        self._forks: dict[int, GrantedTime] = {}  # by process
        self._patience_s = patience_s
        self._numbers = calls.numbers()
        self._under_way = [RunningCall() for _ in self._numbers]

    def stuck(self) -> int | None:
        """Take a sample: slot of a call that takes too long; None = there is none."""
        numbers, granted_s = self._calls.numbers(), self._granted.since_last_sample_s()
        by_fork = self._granted_to_forks()
        for slot, (number, before) in enumerate(zip(numbers, self._numbers, strict=True)):
            if number == before and number % 2 == 1:
                fork = self._calls.fork(slot)
                self._under_way[slot].sample(granted_s if fork is None else by_fork[fork])
            elif self._under_way[slot].sampled_s:
                self._under_way[slot] = RunningCall()
        self._numbers = numbers
        stuck = (s for s, u in enumerate(self._under_way) if u.is_stuck(self._patience_s))
        return next(stuck, None)

    def _granted_to_forks(self) -> list[float]:
        """Time in which each fork could have run since the last sample, s."""
        processes: list[int] = list(self._calls.shared.processes)
        self._forks = {p: self._forks.get(p) or GrantedTime(p) for p in processes if p}
        granted = {p: g.since_last_sample_s() for p, g in self._forks.items()}
        return [granted.get(p, 0.0) for p in processes]


class _Watch:
    """The parent: waits for the child's end, forwards signals, and monitors calls."""

    def __init__(self, child: int, ended: int, calls: Calls, patience_s: float) -> None:
        self._child = child
        self._ended = ended
        self._calls = calls
        self._patience_s = patience_s
        self._monitor = CallMonitor(calls, child, patience_s)
        self._signal: int | None = None
        self._signal_s = float("inf")
        self._kill_s = float("inf")
        for number in _PASSED_ON:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # under `nohup` it continues without its terminal
            signal.signal(number, self._pass_on)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _PASSED_ON)

    def code(self) -> int:
        """Exit code of the command, once the child has ended."""
        while not select.select([self._ended], [], [], POLL_S)[0]:
            if time.monotonic() > self._kill_s:
                os.kill(self._child, signal.SIGKILL)
            elif (stuck := self._monitor.stuck()) is not None:
                os.kill(self._child, signal.SIGKILL)
                if self._signal is not None:
                    continue
                os.waitpid(self._child, 0)
                self._say(f"{self._calls.name(stuck)} {no_end(self._patience_s)}")
                return _STUCK
        _, status = os.waitpid(self._child, 0)
        code = os.waitstatus_to_exitcode(status)
        return code if code >= 0 else self._code_after(-code)

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        now_s, repeated = time.monotonic(), self._signal is not None
        if repeated and number == self._signal and now_s - self._signal_s < _ONE_S:
            return
        if not repeated:
            self._signal, self._signal_s = number, now_s
        answers = self._calls.shared.answers and number in ANSWERED and not repeated
        self._kill_s = min(self._kill_s, now_s + (_ANSWERING_S if answers else _TIDYING_S))
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._child, number)

    def _code_after(self, number: int) -> int:
        """Exit code after a signal has ended the child; prints the call under way."""
        if self._signal is not None:
            self._say("interrupted")
            return 128 + self._signal
        under_way = [s for s, n in enumerate(self._calls.numbers()) if n % 2 == 1]
        name = signal.Signals(number).name
        if under_way:
            self._say(f"{self._calls.name(under_way[0])} ends the process ({name}): mend that")
            return _STUCK
        self._say(f"the computing was ended from outside ({name}); is there enough memory?")
        return 128 + number

    @staticmethod
    def _say(text: str) -> None:
        """Print on the error stream; at a terminal the cursor may have been hidden by the child."""
        shown = "\x1b[?25h\r\x1b[K" if sys.stderr.isatty() else ""
        print(f"{shown}{text}", file=sys.stderr)
