"""A cell that plays PackML behind a real link, and the adapter in a thread."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cell.plant.handshake.adapter import HandshakeAdapter
from cell.plant.handshake.modbus import ModbusCarrier
from cell.plant.link import Link
from cell.plant.messages import Answer, FaultNotice, Kind, Request, Status, to_json
from cell.run.machine import CellState, Event, EventRefusedError, Machine
from cell.settings.plant.handshake import Handshake

BEGUN = Status(run="", sequence=0, state=CellState.STOPPED, since_s=0.0, line="L1")
#: Duration of a cycle, s: a few looks of the adapter.
CYCLE_S = 0.15


def wait_until(reached: Callable[[], bool]) -> None:
    until_s = time.monotonic() + 20.0
    while not reached():
        assert time.monotonic() < until_s
        time.sleep(0.01)


def free_port() -> int:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


class FakeCell:
    """Takes PackML's transitions, and ends every third cycle rejected, every seventh failed."""

    def __init__(self, runs: Path) -> None:
        self.starts = 0
        self.ended = 0
        self.asked: list[Request] = []
        self.states: list[CellState] = []
        self._machine = Machine(time.monotonic, self._told)
        self._lock = threading.Lock()
        self._fault: FaultNotice | None = None
        self._part_of_cycle: threading.Thread | None = None
        self.link = Link(runs, BEGUN, self._answer)

    def __enter__(self) -> FakeCell:
        self.link.__enter__()
        self._machine.send(Event.RESET)
        self._machine.send(Event.DONE)
        return self

    def __exit__(self, *_: object) -> None:
        if self._part_of_cycle is not None:
            self._part_of_cycle.join(10.0)
        self.link.__exit__(None, None, None)

    def _told(self, state: CellState) -> None:
        self.states.append(state)
        self.link.publish(Kind.STATE, {"state": state.value, "step": None, "since": 1.0})

    def _answer(self, request: Request) -> Answer:
        self.asked.append(request)
        command = request.command
        assert command is not None
        with self._lock:
            try:
                state = self._machine.send(command)
            except EventRefusedError as error:
                return Answer(False, self._machine.state, str(error))
            match command:
                case Event.START:
                    assert self._fault is None
                    self.starts += 1
                    self._part_of_cycle = threading.Thread(target=self._cycle, daemon=True)
                    self._part_of_cycle.start()
                case Event.SUSPEND:
                    self.link.publish(Kind.WAITING, {"waiting_for": [request.note]})
                    self._machine.send(Event.DONE)
                case Event.UNSUSPEND | Event.RESET | Event.STOP | Event.CLEAR:
                    self._machine.send(Event.DONE)
            if command in (Event.CLEAR, Event.RESET) and self._fault is not None:
                self._fault = None
                self.link.publish(Kind.ACKNOWLEDGED, {"by": request.by, "note": request.note})
        return Answer(True, state)

    def _cycle(self) -> None:
        self._machine.send(Event.DONE)
        end_s = time.monotonic() + CYCLE_S
        while time.monotonic() < end_s or self._machine.state is CellState.SUSPENDED:
            time.sleep(0.01)
        with self._lock:
            if self._machine.state is not CellState.EXECUTE:
                return  # stopped
            self.ended += 1
            outcome = "inserted" if self.ended % 3 else "rejected"
            if self.ended % 7 == 0:
                outcome = "failed"
                self._fault = FaultNotice(self.ended, "grip", "no cable", 0.0)
                self._machine.send(Event.ABORT)
                self._machine.send(Event.DONE)
                self.link.publish(Kind.FAULT, to_json(self._fault))
            else:
                self._machine.send(Event.DONE)
                self._machine.send(Event.DONE)
            self.link.publish(Kind.RESULT, {"outcome": outcome, "cycle": self.ended})
            if self._machine.state is CellState.COMPLETE:
                self._machine.send(Event.RESET)
                self._machine.send(Event.DONE)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def fake(runs: Path) -> Iterator[FakeCell]:
    with FakeCell(runs) as cell:
        yield cell


@pytest.fixture
def said() -> Handshake:
    return Handshake(port=free_port(), silence_s=1.5)


@pytest.fixture
def adapter(runs: Path, said: Handshake) -> Iterator[HandshakeAdapter]:
    with ModbusCarrier(said) as carrier:
        made = HandshakeAdapter(carrier, runs, said.by)
        thread = threading.Thread(target=made.run)
        thread.start()
        yield made
        made.end()
        thread.join(10.0)
        assert not thread.is_alive()
