from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from drivers import priority

_ASK = (
    "import os; from drivers.priority import run_in_real_time\n"
    "print(run_in_real_time(), os.sched_getscheduler(0) == os.SCHED_FIFO)"
)
_SPIN = (
    "import sys, time; from drivers.priority import bound_spinning, run_in_real_time\n"
    "if not run_in_real_time(): sys.exit(77)\n"
    "bound_spinning(0.05)\n"
    "until = time.monotonic() + 2.0\n"
    "while time.monotonic() < until: pass\n"
)

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_setscheduler"), reason="this system has no such scheduler"
)


def test_says_truly_whether_it_was_granted() -> None:
    out = subprocess.run([sys.executable, "-c", _ASK], capture_output=True, text=True, check=True)
    granted, real_time = out.stdout.split()
    assert granted == real_time


def test_a_refusal_is_not_an_error(monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert priority.run_in_real_time() is False


def test_a_spinning_process_ends() -> None:
    out = subprocess.run([sys.executable, "-c", _SPIN], check=False)
    if out.returncode == 77:
        pytest.skip("this user may not run in real time")
    assert out.returncode == -signal.SIGXCPU


_POLL = """
import os, threading
from pathlib import Path
from drivers.priority import Pollers, own_threads, run_in_real_time

granted = run_in_real_time()
before, end = own_threads(), threading.Event()
threading.Thread(target=end.wait).start()
(thread,) = own_threads() - before
pollers = Pollers([thread], 4e-4)
for _ in 0, 1:
  with pollers.eased():
      slack_ns = Path(f"/proc/{thread}/timerslack_ns").read_text().strip()
      print(os.sched_getscheduler(thread), os.getpriority(os.PRIO_PROCESS, thread), slack_ns)
print(granted, os.sched_getscheduler(thread), os.sched_getscheduler(0))
end.set()
"""


@pytest.mark.skipif(not Path("/proc/self/timerslack_ns").exists(), reason="no slack here")
def test_threads_that_poll_leave_real_time_while_their_user_sleeps() -> None:
    done = subprocess.run([sys.executable, "-c", _POLL], capture_output=True, text=True, check=True)
    *eased, (granted, *awake) = map(str.split, done.stdout.splitlines())
    if granted == "False":
        pytest.skip("this user may not run in real time")
    assert eased == 2 * [[str(os.SCHED_OTHER), "-20", "400000"]]
    assert awake == 2 * [str(os.SCHED_FIFO)]


_PRECEDE = """
import os
from pathlib import Path
from drivers.priority import take_precedence

session = Path("/proc/self/autogroup")
granted = take_precedence()
words = session.read_text().split() if session.exists() else []
print(granted, os.getpriority(os.PRIO_PROCESS, 0), words[-1] if words else "none")
"""

#: In one session: what it has while such a process runs, and when it has ended.
_PRECEDE_FIRST = f"""
import subprocess, sys
from pathlib import Path

subprocess.run([sys.executable, "-c", {_PRECEDE!r}], check=True)
session = Path("/proc/self/autogroup")
print(session.read_text().split()[-1] if session.exists() else "none")
"""


def test_a_cell_goes_before_other_sessions_too() -> None:
    """Raised in its session alone it had waited for another session's programs: 0.7 s, not 0.2."""
    done = subprocess.run(
        [sys.executable, "-c", _PRECEDE_FIRST],
        capture_output=True,
        text=True,
        check=True,
        start_new_session=True,
    )
    granted, nice, session, afterwards = done.stdout.split()
    if granted == "False":
        pytest.skip("this user may not go before others")
    assert int(nice) <= -10
    assert session in ("none", "-10")
    assert afterwards in ("none", "0"), "it outlasts the cell"


_LESS = (
    "import resource as r; from drivers.priority import bound_spinning\n"
    "r.setrlimit(r.RLIMIT_RTTIME, (200_000, 200_000))\n"
    "bound_spinning(0.5)\n"
    "print(*r.getrlimit(r.RLIMIT_RTTIME))\n"
)


@pytest.mark.skipif(sys.platform != "linux", reason="no such limit here")
def test_an_administrators_limit_is_kept() -> None:
    done = subprocess.run([sys.executable, "-c", _LESS], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["200000", "200000"]
