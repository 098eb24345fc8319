"""Programs that are halted or killed: no old picture of a running cell, no motion that comes late.

The cell here makes the transitions of PackML and nothing else, in a process of its own.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from cell.plant.client import Client
from cell.plant.messages import CommandReply, Request
from cell.run.machine import CellState, MachineEvent
from tests.waiting import free_port, listens, wait_until

from .test_web import CONFIG, LivePage, browser  # noqa: F401

pytestmark = pytest.mark.real_time

#: Prints every command that it obeys.
CELL = """
import sys, time
from pathlib import Path
from cell.plant.link import Link
from cell.plant.messages import CommandReply, MessageKind, Status
from cell.run.machine import CellState, MachineEvent, EventRefusedError, Machine

def told(state):
    since = {'state': state.value, 'step': None, 'since': time.time()}
    link.publish(MessageKind.STATE, since)

def obey(request):
    try:
        machine.send(request.command)
    except EventRefusedError as error:
        return CommandReply(False, machine.state, str(error))
    print(request.command.value, flush=True)
    while machine.state is not CellState.EXECUTE and machine.can(MachineEvent.DONE):
        machine.send(MachineEvent.DONE)
    return CommandReply(True, machine.state)

machine = Machine(time.monotonic, told)
with Link(Path(sys.argv[1]), Status('', 0, CellState.STOPPED, time.time()), obey) as link:
    for event in (MachineEvent.RESET, MachineEvent.DONE):
        machine.send(event)
    print('ready', flush=True)
    sys.stdin.read()
"""
#: A picture of a running cell may be so old, s; a busy computer draws it a little later.
OLDEST_S, DRAWN_S = 2.0, 1.0


class Process:
    """A program that can be halted; nothing of it goes on meanwhile."""

    def __init__(self, *words: object) -> None:
        command = [sys.executable, *map(str, words)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)

    def line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def halt(self) -> None:
        os.kill(self._process.pid, signal.SIGSTOP)
        tasks = Path(f"/proc/{self._process.pid}/task")
        state = [t / "stat" for t in tasks.iterdir()]
        wait_until(lambda: all(s.read_text().rpartition(")")[2].split()[0] == "T" for s in state))

    def go_on(self) -> None:
        os.kill(self._process.pid, signal.SIGCONT)

    def end(self) -> list[str]:
        """Kill it; all that it has printed and nobody has read."""
        self._process.kill()
        with suppress(ValueError):
            return self._process.communicate()[0].split()
        return []


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def cell(runs: Path) -> Iterator[Process]:
    process = Process("-c", CELL, runs)
    assert process.line() == "ready"
    yield process
    process.end()


@pytest.fixture
def served(runs: Path) -> Iterator[tuple[Process, int]]:
    port = free_port()
    process = Process("-m", "cell", "serve", "-c", CONFIG, "--runs", runs, "--port", port)
    wait_until(lambda: listens(port))
    yield process, port
    process.end()


#: What a person sees, and what can be pressed.
_SEEN = """
const text = (w) => [...document.querySelectorAll(w)].filter((e) => e.checkVisibility())
    .map((e) => e.innerText).join(' ');
return {plate: text('[data-test=unknown]'), state: text('[data-test=state]'),
        lost: text('[data-test=no-answer]'),
        pressed: [...document.querySelectorAll('main button')].filter((b) => !b.disabled).length};
"""


class Screen(LivePage):
    """The live page, looked at."""

    def seen(self) -> dict[str, Any]:
        return dict(self._browser.execute_script(_SEEN))

    def is_unknown_within(self, seconds: float) -> dict[str, Any]:
        end_s = time.monotonic() + seconds
        while not ((seen := self.seen())["plate"] or seen["state"] == "No connection"):
            assert time.monotonic() < end_s, seen
            time.sleep(0.02)
        return seen


def opened(browser: Any, port: int) -> Screen:  # noqa: F811
    browser.get(f"http://127.0.0.1:{port}/")
    screen = Screen(browser)
    screen.reaches("Idle")
    screen.click("take")
    wait_until(lambda: screen.text("control") == "You have control.")
    return screen


def press_at_once(browser: Any, what: str) -> None:  # noqa: F811
    """A click that the page sends, whatever the server does."""
    browser.execute_script(f"document.querySelector('[data-test={what}]').click()")


def test_a_halted_server_is_seen_and_a_start_that_it_gets_late_is_refused(
    browser: Any,  # noqa: F811
    cell: Process,
    served: tuple[Process, int],
    runs: Path,
) -> None:
    server, port = served
    screen, asks = opened(browser, port), Client(runs)
    server.halt()
    press_at_once(browser, "start")  # within the time in which nobody can know it
    seen = screen.is_unknown_within(OLDEST_S + DRAWN_S)
    assert "No connection" in seen["plate"] and "State unknown since" in seen["plate"]
    assert (seen["state"], seen["pressed"]) == ("", 0)
    wait_until(lambda: "no answer. If it comes late it is refused" in screen.seen()["lost"])
    assert screen.seen()["lost"].startswith("Start, ")
    server.go_on()
    wait_until(lambda: screen.seen()["state"] == "Idle")
    try:
        wait_until(lambda: "start was given" in screen.text_at("body"), 10.0)  # for some seconds
    except AssertionError:  # on a busy computer its connection may be lost, and the start with it
        assert screen.seen()["lost"].startswith("Start, "), "what is lost is said until the next"
    assert asks.status().state is CellState.IDLE
    assert asks.status().cycle == 0, "the arm has not moved"
    screen.command("start", "Execute")
    server.end()
    seen = screen.is_unknown_within(OLDEST_S + DRAWN_S)
    assert (seen["state"], seen["pressed"]) == ("", 0)


def test_a_halted_cell_is_seen_and_obeys_nothing_that_it_gets_late(
    browser: Any,  # noqa: F811
    cell: Process,
    served: tuple[Process, int],
    runs: Path,
) -> None:
    _, port = served
    screen = opened(browser, port)
    cell.halt()
    press_at_once(browser, "start")
    shell = Client(runs, timeout_s=60.0)  # as `cell send` has it
    answered: list[CommandReply] = []
    sending = threading.Thread(
        target=lambda: answered.append(shell.send(Request(MachineEvent.START, "shell")))
    )
    sending.start()
    seen = screen.is_unknown_within(OLDEST_S + DRAWN_S)
    assert seen["state"] == "No connection" and "State unknown since" in screen.text("step")
    for command in ("start", "stop"):
        assert not browser.find_element("css selector", f"[data-test={command}]").is_enabled()
    time.sleep(1.5)  # until what was sent is too old
    cell.go_on()
    wait_until(lambda: screen.seen()["state"] == "Idle")
    assert Client(runs).send(Request(MachineEvent.STOP, "test")).accepted
    screen.reaches("Stopped")
    assert cell.end() == ["stop"]
    screen.reaches("No cell runs")
    sending.join(60.0)
    assert [a.wrong for a in answered] == ["asked_s"]


def test_a_page_is_connecting_until_it_had_a_connection_or_time_for_it(
    browser: Any,  # noqa: F811
    cell: Process,
    served: tuple[Process, int],
) -> None:
    """A page that opened slowly on a busy computer began with the alarm of a lost connection."""
    screen, at = Screen(browser), f"http://127.0.0.1:{served[1]}/"
    never = "Object.defineProperty(window, 'did_handshake', {get: () => false, set() {}})"
    added = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": never})
    try:
        browser.get(at)
        seen = screen.is_unknown_within(4.0)
        assert seen["plate"].strip() == "Connecting …" and not seen["pressed"]
        wait_until(lambda: "No connection" in screen.seen()["plate"])
        assert "State unknown since" in screen.seen()["plate"]
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)
    browser.get(at)
    screen.reaches("Idle")
