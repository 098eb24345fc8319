"""A command that gets stuck is ended by its parent, and says where."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

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
    _, said = process.communicate(timeout=60)
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


def test_ctrl_c_is_heard_by_the_command_first() -> None:
    doing = (
        "try:\n    print('trying', flush=True)\n    time.sleep(1000)\n"
        "except KeyboardInterrupt:\n    sys.exit('tidied up')"
    )
    process = watched(doing)
    while process.stdout.readline() != "trying\n":
        pass
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (1, "tidied up\n")


_AT_ONCE = """
import os, signal, sys
from cell.computer import watched

fork = os.fork

def interrupted_fork():
    child = fork()
    if child:
        os.kill(os.getpid(), signal.SIGINT)
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
    until_s = time.monotonic() + 30.0
    while _lives(child) and time.monotonic() < until_s:
        time.sleep(0.05)
    assert not _lives(child)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
