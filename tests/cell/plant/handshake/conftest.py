"""A cell that plays PackML behind a real link, the adapter in a thread, and every carrier."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Self

import pytest

from cell.plant.handshake.adapter import HandshakeAdapter
from cell.plant.handshake.carrier import (
    UNKNOWN,
    Carrier,
    ControllerCarrier,
    Inputs,
    LatestBits,
    Outputs,
    bits_of,
    inputs_of,
)
from cell.plant.handshake.modbus import ModbusCarrier
from cell.plant.link import Link
from cell.plant.messages import CommandReply, FaultNotice, MessageKind, Request, Status
from cell.run.machine import CellState, EventRefusedError, Machine, MachineEvent
from cell.settings.plant import Handshake
from drivers.emulators.launch import EmulatedController
from tests.waiting import free_port
from tools.faults.scripted_plc import (
    OUTPUTS,
    SILENCE_S,
    ControllerWire,
    ModbusWire,
    Plc,
    Wire,
    places,
)

BEGUN = Status(run="", sequence=0, state=CellState.STOPPED, since_s=0.0, line="L1")
#: Duration of a cycle, s: a few looks of the adapter.
CYCLE_S = 0.4


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
        self._machine.send(MachineEvent.RESET)
        self._machine.send(MachineEvent.DONE)
        return self

    def __exit__(self, *_: object) -> None:
        if self._part_of_cycle is not None:
            self._part_of_cycle.join(10.0)
        self.link.__exit__(None, None, None)

    def _told(self, state: CellState) -> None:
        self.states.append(state)
        self.link.publish(MessageKind.STATE, {"state": state.value, "step": None, "since": 1.0})

    def _answer(self, request: Request) -> CommandReply:
        self.asked.append(request)
        command = request.command
        assert command is not None
        with self._lock:
            try:
                state = self._machine.send(command)
            except EventRefusedError as error:
                return CommandReply(False, self._machine.state, str(error))
            match command:
                case MachineEvent.START:
                    assert self._fault is None
                    self.starts += 1
                    self._part_of_cycle = threading.Thread(target=self._cycle, daemon=True)
                    self._part_of_cycle.start()
                case MachineEvent.SUSPEND:
                    self.link.publish(MessageKind.WAITING, {"waiting_for": [request.note]})
                    self._machine.send(MachineEvent.DONE)
                case (
                    MachineEvent.UNSUSPEND
                    | MachineEvent.RESET
                    | MachineEvent.STOP
                    | MachineEvent.CLEAR
                ):
                    self._machine.send(MachineEvent.DONE)
            if command in (MachineEvent.CLEAR, MachineEvent.RESET) and self._fault is not None:
                self._fault = None
                self.link.publish(
                    MessageKind.ACKNOWLEDGED, {"by": request.by, "note": request.note}
                )
        return CommandReply(True, state)

    def _cycle(self) -> None:
        self._machine.send(MachineEvent.DONE)
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
                self._machine.send(MachineEvent.ABORT)
                self._machine.send(MachineEvent.DONE)
                self.link.publish(MessageKind.FAULT, asdict(self._fault))
            else:
                self._machine.send(MachineEvent.DONE)
                self._machine.send(MachineEvent.DONE)
            self.link.publish(MessageKind.RESULT, {"outcome": outcome, "cycle": self.ended})
            if self._machine.state is CellState.COMPLETE:
                self._machine.send(MachineEvent.RESET)
                self._machine.send(MachineEvent.DONE)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def fake(runs: Path) -> Iterator[FakeCell]:
    with FakeCell(runs) as cell:
        yield cell


class FakeWire:
    """Bits in memory."""

    def __init__(self, silence_s: float) -> None:
        self.heard = LatestBits(silence_s, "the fake is silent")
        self.told: frozenset[int] = frozenset()

    def write(self, bits: Sequence[bool]) -> None:
        self.heard.take({number for number, bit in enumerate(bits) if bit})

    def read(self) -> Sequence[bool]:
        return [number in self.told for number in range(len(OUTPUTS))]

    def part(self) -> None:
        pass  # and writes no more

    def mend(self, bits: Sequence[bool]) -> None:
        self.write(bits)

    def close(self) -> None:
        pass


class FakeCarrier:
    """Carries what is in memory."""

    def __init__(self, said: Handshake, wire: FakeWire) -> None:
        self._said, self._wire = said, wire
        self.write(UNKNOWN)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def read(self) -> Inputs:
        return inputs_of(self._wire.heard.read(), self._said.inputs)

    def write(self, outputs: Outputs) -> None:
        self._wire.told = bits_of(outputs, self._said.outputs)


@dataclass
class Wired:
    """A carrier and the PLC at its other end, made anew with every call.

    tells_at_end  whether a PLC reads outputs when the carrier has ended; else it gets no answer
    """

    said: Handshake
    carrier: Callable[[], Carrier]
    wire: Callable[[], Wire]
    tells_at_end: bool
    _plcs: list[Plc] = field(default_factory=list)

    def plc(self) -> Plc:
        self._plcs.append(made := Plc(self.wire()))
        return made

    def close(self) -> None:
        for plc in self._plcs:
            plc.wire.close()


@pytest.fixture(scope="module")
def controller(free_loopback: Callable[[], str]) -> Iterator[EmulatedController]:
    with EmulatedController(free_loopback()) as emulator:
        yield emulator


def wired_by(kind: str, silence_s: float, request: pytest.FixtureRequest) -> Wired:
    """A carrier by its name."""
    said = Handshake.model_validate({"silence_s": silence_s, **places()})
    match kind:
        case "modbus":
            said = said.model_copy(update={"port": (port := free_port())})
            return Wired(said, lambda: ModbusCarrier(said), lambda: ModbusWire(port), False)
        case "controller":
            host = request.getfixturevalue("controller").host
            Plc(ControllerWire(host)).mend()
            said = said.model_copy(update={"carrier": kind, "host": host})
            return Wired(
                said, lambda: ControllerCarrier(said, host), lambda: ControllerWire(host), True
            )
    fake = FakeWire(silence_s)
    return Wired(said, lambda: FakeCarrier(said, fake), lambda: fake, True)


@pytest.fixture(params=["modbus", "controller", "fake"])
def wired(request: pytest.FixtureRequest) -> Iterator[Wired]:
    yield (made := wired_by(request.param, SILENCE_S, request))
    made.close()


@pytest.fixture
def adapter(runs: Path, wired: Wired) -> Iterator[HandshakeAdapter]:
    with wired.carrier() as carrier:
        made = HandshakeAdapter(carrier, runs, wired.said.by)
        thread = threading.Thread(target=made.run)
        thread.start()
        yield made
        made.end()
        thread.join(10.0)
        assert not thread.is_alive()
