"""A command that gets stuck is ended by its parent, and says where."""

import signal
import subprocess
import sys
import time

import pytest

from cell.computer import watched as module
from tests.waiting import is_alive, wait_until

PROGRAM = """
import os, sys, time
from cell.computer.watched import go_on_watched, must_end
go_on_watched({patience_s})
print(os.getpid(), flush=True)
{doing}
"""
IN_C = "with must_end('f.py:3: mine.force'): sum(range(10**13))"


def watched(doing: str, patience_s: float = 1.0) -> "subprocess.Popen[str]":
    program = PROGRAM.format(doing=doing, patience_s=patience_s)
    return subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(doing: str, patience_s: float = 1.0) -> tuple[int, str]:
    process = watched(doing, patience_s)
    try:
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    return process.returncode, said


@pytest.mark.parametrize("doing", [IN_C, "with must_end('f.py:3: mine.force'): time.sleep(1000)"])
def test_a_call_without_end_is_named_and_ended(doing: str) -> None:
    assert ended(doing) == (
        2,
        "f.py:3: mine.force takes more than 1 s, as a loop without end does: mend that\n",
    )


def test_a_call_without_end_is_seen_beside_others_that_end() -> None:
    others = "while True:\n        with must_end('others'): time.sleep(0.01)"
    doing = (
        "import threading\ndef others():\n    " + others + "\n"
        "threading.Thread(target=others, daemon=True).start()\n"
        "with must_end('this one'): time.sleep(1000)"
    )
    code, said = ended(doing)
    assert (code, said.split(" takes")[0]) == (2, "this one")


IN_FORKS = """
from cell.computer.forks import forks
here = os.getpid()
def job(number):
    if os.getpid() == here:
        time.sleep(0.3)
        return
    with must_end('f.py:3: mine.force'):
        {doing}
with forks([job], most=2) as beside:
    beside.map(job, [0, 1])
sys.exit(7)
"""


def test_a_call_without_end_in_a_fork_is_named_and_all_is_ended() -> None:
    code, said = ended(IN_FORKS.format(doing="print(os.getpid(), flush=True); sum(range(10**13))"))
    assert (code, said.split(" takes")[0]) == (2, "f.py:3: mine.force")


def test_a_fork_that_was_killed_in_a_call_leaves_none_under_way() -> None:
    program = IN_FORKS.format(doing="os.kill(os.getpid(), 9)").replace("0.3", "2.5")
    assert ended(program) == (7, "")


def test_many_calls_that_end_may_take_long_together() -> None:
    doing = "for k in range(300):\n    with must_end('short'): time.sleep(0.01)\nsys.exit(7)"
    assert ended(doing, 1.0) == (7, "")


def test_what_is_not_said_to_end_may_take_its_time() -> None:
    assert ended("with must_end('first'): pass\ntime.sleep(2.5); sys.exit(1)", 1.0) == (1, "")


def test_a_call_that_ends_the_process_is_named() -> None:
    code, said = ended("with must_end('f.py:3: mine.force'): os.kill(os.getpid(), 11)")
    assert (code, said) == (2, "f.py:3: mine.force ends the process (SIGSEGV): mend that\n")


def test_a_command_that_is_ended_from_outside_says_so() -> None:
    code, said = ended("os.kill(os.getpid(), 9)")
    assert code == 128 + signal.SIGKILL
    assert "is there enough memory?" in said


@pytest.mark.parametrize("given", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_what_hears_none(given: signal.Signals) -> None:
    process = watched("import signal; signal.signal(signal.SIGTERM, lambda n, f: 0)\n" + IN_C, 1e3)
    process.stdout.readline()
    process.send_signal(given)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + given
    assert said.splitlines()[-1] == "interrupted"


def test_a_signal_to_a_command_and_to_its_group_is_one() -> None:
    """As `timeout` sends it: the answer was not waited for, and a diagnosis said nothing."""
    doing = (
        "from cell.computer.watched import responds_after_interrupt\n"
        "import signal\nheard = []\nresponds_after_interrupt()\n"
        "signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))\n"
        "print('trying', flush=True)\nwhile not heard: time.sleep(0.05)\n"
        "time.sleep(2.5); sys.exit(7)"
    )
    process = watched(doing, 1e3)
    while (line := process.stdout.readline()) != "trying\n":
        assert line, process.stderr.read()
    process.send_signal(signal.SIGTERM)
    time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (7, "")


def test_ctrl_c_is_heard_by_the_command_first() -> None:
    doing = (
        "try:\n    print('trying', flush=True)\n    time.sleep(1000)\n"
        "except KeyboardInterrupt:\n    sys.exit('tidied up')"
    )
    process = watched(doing)
    while (line := process.stdout.readline()) != "trying\n":
        assert line, process.stderr.read()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (1, "tidied up\n")


class Computer:
    """What the system tells of a process, instead of a real one."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cpu_s, self.computes = 100.0, True
        monkeypatch.setattr(module, "cpu_s", lambda process: self.cpu_s)
        monkeypatch.setattr(module, "wants_to_compute", lambda process: self.computes)

    def looks_until_stuck(self, share: float, change: int = 0) -> int:
        """Looks at a call under way, if its process is given a share of the time between them.

        change  after so many looks the process is given all of it
        """
        calls = module.Calls()
        slot = calls.begin("f.py:3: mine.force")
        looks = module.CallMonitor(calls, 1, 3.0)
        for count in range(1, 1000):
            given = 1.0 if change and count > change else share
            self.cpu_s += given * module.POLL_S
            if (stuck := looks.stuck()) is not None:
                assert stuck == slot
                return count
        return 1000


@pytest.mark.parametrize(
    ("share", "computes", "looks_s"),
    [(1.0, True, 3.0), (0.0, False, 3.0), (0.5, True, 6.0), (0.3, True, 7.5), (0.0, True, 7.5)],
)
def test_time_in_which_others_hold_the_cores_does_not_count_up_to_a_limit(
    monkeypatch: pytest.MonkeyPatch, share: float, computes: bool, looks_s: float
) -> None:
    computer = Computer(monkeypatch)
    computer.computes = computes
    looks = computer.looks_until_stuck(share) * module.POLL_S
    assert looks == pytest.approx(looks_s, abs=module.POLL_S)


def test_a_call_that_was_starved_and_ends_then_is_not_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    computer, calls = Computer(monkeypatch), module.Calls()
    looks = module.CallMonitor(calls, 1, 3.0)
    for _ in range(3):
        slot = calls.begin("mine.force")
        assert [looks.stuck() for _ in range(25)] == [None] * 25, "6.25 s, none of it its own"
        computer.cpu_s += 1.0
        assert looks.stuck() is None
        calls.end(slot)


def test_a_starved_call_has_the_rest_of_its_time_when_it_is_given_the_core(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert Computer(monkeypatch).looks_until_stuck(0.0, 12) == pytest.approx(24, abs=1)


_AT_ONCE = """
import os, signal, sys, time
from cell.computer import watched

fork = os.fork

def interrupted_fork():
    child = fork()
    if child:
        os.kill(os.getpid(), signal.SIGINT)
    else:  # the child must not be under way before it is handed on: who comes first is chance
        while signal.SIGINT not in signal.sigpending():
            time.sleep(0.01)
    return child

os.fork = interrupted_fork
watched.go_on_watched(1.0)
with watched.must_end("f.py:3: mine.force"): sum(range(10**13))
"""


def test_a_signal_before_the_parent_listens_is_passed_on() -> None:
    """It ended the parent with a traceback, and the child went on for ever."""
    done = subprocess.run(
        [sys.executable, "-c", _AT_ONCE], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_the_child_does_not_outlive_its_parent() -> None:
    process = watched("time.sleep(1000)")
    child = int(process.stdout.readline())
    process.kill()
    process.wait()
    process.stdout.close()
    process.stderr.close()
    wait_until(lambda: not is_alive(child))
