import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from pathlib import Path

import pytest

from cell.computer.second_process import SecondProcess
from tests.waiting import is_alive, wait_until


@pytest.fixture
def second() -> Iterator[SecondProcess]:
    second = SecondProcess()
    yield second
    second.shutdown(cancel_futures=True)


def test_jobs_run_elsewhere_one_after_another_and_their_errors_come_back(
    second: SecondProcess,
) -> None:
    here = second.submit(os.getpid)
    assert here.result() not in (os.getpid(), None)
    assert second.submit(os.getpid).result() == here.result()
    with pytest.raises(ValueError, match="invalid literal"):
        second.submit(int, "x").result()


def test_a_killed_process_is_told_and_replaced(second: SecondProcess) -> None:
    process = second.submit(os.getpid).result()
    job = second.submit(time.sleep, 60.0)
    os.kill(process, signal.SIGKILL)
    with pytest.raises(BrokenExecutor):
        job.result(timeout=30.0)
    assert second.submit(os.getpid).result() != process


def test_after_a_shutdown_it_begins_anew(second: SecondProcess) -> None:
    process = second.submit(os.getpid).result()
    second.shutdown()
    assert not Path(f"/proc/{process}").exists()
    assert second.submit(abs, -1).result() == 1


def test_one_that_hangs_is_ended_at_once(second: SecondProcess) -> None:
    process = second.submit(os.getpid).result()
    job = second.submit(time.sleep, 60.0)
    os.kill(process, signal.SIGSTOP)
    second.shutdown(wait=False)
    with pytest.raises(BrokenExecutor):
        job.result(timeout=30.0)
    wait_until(lambda: not is_alive(process))  # the pipe breaks a moment before
    assert second.submit(abs, -2).result() == 2


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_it_does_not_outlive_the_first_process(end: signal.Signals) -> None:
    """Even busy, and however that ends."""
    code = (
        "import os, time\n"
        "from cell.computer.second_process import SecondProcess\n"
        "if __name__ == '__main__':\n"
        "    second = SecondProcess()\n"
        "    print(second.submit(os.getpid).result(), flush=True)\n"
        "    second.submit(time.sleep, 60.0).result()\n"
    )
    first = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None
    process = int(first.stdout.readline())
    first.send_signal(end)
    first.wait()
    first.stdout.close()
    wait_until(lambda: not is_alive(process))


def test_it_gives_way_except_while_somebody_waits_for_it(second: SecondProcess) -> None:
    """On a busy computer the gripper waited for a process that gave way to nobody any more."""

    def niceness() -> int:
        return second.submit(os.getpriority, os.PRIO_PROCESS, 0).result()

    own = os.getpriority(os.PRIO_PROCESS, 0)
    with second.hurried():
        pass  # it has not begun yet
    assert niceness() == min(own + 5, 19)
    with second.hurried():
        hurried = niceness()
    assert niceness() == min(own + 5, 19)
    if hurried != own:
        pytest.skip("this user may not hurry a process")


def test_one_that_has_ended_cannot_be_hurried(second: SecondProcess) -> None:
    os.kill(second.submit(os.getpid).result(), signal.SIGKILL)
    with second.hurried():
        pass


def test_a_number_that_is_another_process_by_now_is_left_alone(
    second: SecondProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system gives the number of a process that has ended to another."""
    process = second.submit(os.getpid).result()
    job = second.submit(time.sleep, 60.0)
    os.kill(process, signal.SIGKILL)
    with pytest.raises(BrokenExecutor):
        job.result(timeout=30.0)
    wait_until(lambda: not Path(f"/proc/{process}").exists())  # its number is free
    killed = []
    monkeypatch.setattr(os, "kill", lambda pid, number: killed.append(pid))
    second.shutdown(wait=False)
    assert killed == []
