"""A PLC as a separate program: starts cycles, and misbehaves on purpose.

    python -m tools.faults.scripted_plc modbus:502 50         a Modbus/TCP client
    python -m tools.faults.scripted_plc controller:127.0.0.2 50   wired to an emulated controller

It writes a line of JSON for every change of its signals, and for every cycle: habit and outcome.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from drivers.emulators.launch import EmulatedController

INPUTS = ("start", "part_present", "upstream_ready", "downstream_ready", "acknowledge", "stop")
OUTPUTS = ("ready", "busy", "done", "rejected", "fault")
#: A broken wire stops, and reads as a fault.
INVERTED = ("stop", "fault")
#: Duration of the test that nothing happens, s: several polls of the adapter.
WATCHED_S = 0.2
#: `silence_s` of the settings, s: long enough for a PLC on a busy computer.
SILENCE_S = 1.5
#: Time limit for the answer to a start, s.
UNANSWERED_S = 8.0
#: Time for which a neighbouring machine is not ready, s: a pause waits for the end of a motion.
PAUSED_S = 1.0
#: Time limit of a cycle, s: on a computer under load one took 125 s.
LONGEST_S = 600.0


def places() -> dict[str, dict[str, dict[str, object]]]:
    """Entries `inputs` and `outputs` of the settings, as this PLC is wired."""
    return {
        side: {
            name: {"number": number, "inverted": name in INVERTED}
            for number, name in enumerate(names)
        }
        for side, names in (("inputs", INPUTS), ("outputs", OUTPUTS))
    }


class Wire(Protocol):
    """Bits between the PLC and the cell, in the order of their numbers."""

    def write(self, bits: Sequence[bool]) -> None:
        """Write the inputs of the cell."""

    def read(self) -> Sequence[bool]:
        """Read the outputs of the cell."""

    def part(self) -> None:
        """Disconnect, until `mend`."""

    def mend(self, bits: Sequence[bool]) -> None:
        """Connect again; `bits` are the first that the cell reads."""

    def close(self) -> None:
        """Close the connection."""


class ModbusWire:
    """A Modbus/TCP client at a port of this computer."""

    def __init__(self, port: int) -> None:
        from pymodbus.client import ModbusTcpClient

        self._client = ModbusTcpClient("127.0.0.1", port=port)
        assert self._client.connect()

    def write(self, bits: Sequence[bool]) -> None:
        written = self._client.write_coils(0, list(bits), device_id=1)
        assert not written.isError(), written

    def read(self) -> Sequence[bool]:
        read = self._client.read_discrete_inputs(0, count=len(OUTPUTS), device_id=1)
        assert not read.isError(), read
        return read.bits

    def part(self) -> None:
        self._client.close()

    def mend(self, bits: Sequence[bool]) -> None:
        assert self._client.connect()
        self.write(bits)

    def close(self) -> None:
        self._client.close()


class ControllerWire:
    """Wires to the digital inputs and outputs of an emulated controller, which may fall silent."""

    def __init__(self, host: str) -> None:
        self._controller = EmulatedController(host)

    def write(self, bits: Sequence[bool]) -> None:
        self._controller.request("inputs", bits=sum(bit << k for k, bit in enumerate(bits)))

    def read(self) -> Sequence[bool]:
        bits = self._controller.request("outputs")["bits"]
        return [bool(bits >> k & 1) for k in range(len(OUTPUTS))]

    def part(self) -> None:
        self._controller.request("freeze", seconds=LONGEST_S)

    def mend(self, bits: Sequence[bool]) -> None:
        self.write(bits)  # before it sends again, or the cell sees the change as an edge
        self._controller.request("freeze", seconds=0.0)

    def close(self) -> None:
        pass


class Plc:
    """Signals by their names; a wait for longer than `longest_s` is an error."""

    def __init__(
        self,
        wire: Wire,
        log: Callable[..., None] = lambda **entry: None,
        longest_s: float = 30.0,
    ) -> None:
        self.wire = wire
        self._longest_s = longest_s
        self._log = log
        self._inputs = dict.fromkeys(INPUTS, False)

    def say(self, **signals: bool) -> None:
        if signals:
            self._inputs.update(signals)
            self._log(said=self._inputs)
        self.wire.write(self._bits())

    def mend(self, **signals: bool) -> None:
        """Connect again, with these signals on from the first moment."""
        self._inputs.update(signals)
        self._log(said=self._inputs)
        self.wire.mend(self._bits())

    def _bits(self) -> list[bool]:
        return [self._inputs[name] is not (name in INVERTED) for name in INPUTS]

    def heard(self) -> dict[str, bool]:
        """Write the inputs and read the outputs, as in a PLC's cycle."""
        self.say()
        return self.read()

    def read(self) -> dict[str, bool]:
        bits = self.wire.read()
        return {n: bit is not (n in INVERTED) for n, bit in zip(OUTPUTS, bits, strict=False)}

    def wait(self, reached: Callable[[dict[str, bool]], bool]) -> dict[str, bool]:
        until_s = time.monotonic() + self._longest_s
        while not reached(heard := self.heard()):
            assert time.monotonic() < until_s, heard
            time.sleep(0.01)
        return heard

    def listen(self, seconds: float) -> Iterator[dict[str, bool]]:
        """Repeat the PLC's cycle for a time; the outputs of each."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            yield self.heard()
            time.sleep(0.01)

    def quiet(self) -> None:
        """Check that nothing begins for a while."""
        for heard in self.listen(WATCHED_S):
            assert not heard["busy"], "the cell has begun"

    def connect(self) -> None:
        """Set the signals of normal operation, and wait until the cell is ready."""
        self.say(part_present=True, upstream_ready=True, downstream_ready=True)
        self.wait(lambda heard: heard["ready"])

    def begin(self) -> None:
        """Start a cycle correctly.

        A controller keeps its outputs until they are set: `start` is dropped and raised again if
        there is no answer.
        """
        for _ in range(int(self._longest_s / UNANSWERED_S)):
            self.wait(lambda heard: heard["ready"])
            self.say(start=True)
            if any(heard["busy"] for heard in self.listen(UNANSWERED_S)):
                return
            self.say(start=False)
            self.quiet()
        raise AssertionError("the cell does not begin")

    def outcome(self) -> str:
        """Outcome signal at the end of a cycle."""
        ended = self.wait(has_ended)
        return next(name for name in ("fault", "done", "rejected") if ended[name])

    def cycle(self) -> str:
        """Run a cycle correctly; its outcome signal."""
        self.begin()
        return self.outcome()

    def release(self) -> None:
        """Drop start."""
        self.say(start=False)
        self.wait(lambda heard: not (heard["done"] or heard["rejected"]))

    def acknowledge(self) -> None:
        """Press once, for as long as a finger does."""
        self.say(acknowledge=True)
        for _ in self.listen(WATCHED_S):
            pass
        self.say(acknowledge=False)


def has_ended(heard: dict[str, bool]) -> bool:
    return not heard["busy"] and (heard["done"] or heard["rejected"] or heard["fault"])


# --- habits: one cycle each, and its outcome signal ---------------------------------------------


def held(plc: Plc) -> str:
    """Habit: start stays on after the cycle; no further cycle may begin."""
    outcome = plc.cycle()
    if outcome != "fault":
        plc.quiet()
    return outcome


def without_part(plc: Plc) -> str:
    """Habit: the part goes as start comes, and comes again while start is held."""
    plc.wait(lambda heard: heard["ready"])
    plc.say(part_present=False, start=True)
    plc.quiet()
    plc.say(part_present=True)
    plc.quiet()
    plc.say(start=False)
    return plc.cycle()


def part_taken(plc: Plc) -> str:
    """Habit: the part goes within the cycle, and is missing at the next start.

    That start has no effect, nor has the part that arrives while start is held.
    """
    plc.begin()
    plc.say(part_present=False)
    outcome = plc.outcome()
    if outcome != "fault":
        plc.say(start=False)
        plc.quiet()
        plc.say(start=True)
        plc.quiet()
    plc.say(part_present=True)
    plc.quiet()
    return outcome


def twice(plc: Plc) -> str:
    """Habit: a second start within the cycle."""
    plc.begin()
    plc.say(start=False)
    time.sleep(0.06)
    plc.say(start=True)
    ended = plc.wait(lambda heard: not heard["busy"])
    plc.quiet()
    ended = plc.heard()
    return next((name for name in ("fault", "done", "rejected") if ended[name]), "no outcome")


def paused(plc: Plc) -> str:
    """Habit: the machines up- and downstream are not ready for a while, one after the other."""
    plc.begin()
    for name in ("downstream_ready", "upstream_ready"):
        plc.say(**{name: False})
        for _ in plc.listen(PAUSED_S):
            pass
        plc.say(**{name: True})
    return plc.outcome()


def stopped(plc: Plc) -> str:
    """Habit: the cycle is stopped, and start is tried while stop is held."""
    plc.begin()
    plc.say(start=False, stop=True)
    outcome = plc.outcome()
    plc.say(start=True)
    plc.quiet()
    plc.say(start=False, stop=False)
    return outcome


def lost(plc: Plc) -> str:
    """Habit: the connection breaks between two cycles, and start is on when it returns."""
    plc.wait(lambda heard: heard["ready"])
    plc.wire.part()
    time.sleep(1.5 * SILENCE_S)
    plc.mend(start=True)
    plc.wait(lambda heard: not heard["fault"])
    plc.quiet()
    plc.say(start=False)
    return plc.cycle()


def after_fault(plc: Plc) -> None:
    """Check that start has no effect before a fault is acknowledged, or if held since before."""
    plc.say(start=False)
    plc.quiet()
    plc.say(start=True)
    plc.quiet()
    plc.acknowledge()
    plc.wait(lambda heard: not heard["fault"])
    plc.quiet()
    plc.say(start=False)
    plc.wait(lambda heard: heard["ready"])


HABITS: dict[str, Callable[[Plc], str]] = {
    "plain": Plc.cycle,
    "start held": held,
    "no part": without_part,
    "double start": twice,
    "paused": paused,
    "part gone": part_taken,
    "stopped": stopped,
    "wire lost": lost,
}


def play(plc: Plc, cycles: int, log: Callable[..., None]) -> None:
    """Run cycles; each uses the next of `HABITS`, the PLC's ways to behave."""
    plc.connect()
    for number in range(cycles):
        name = list(HABITS)[number % len(HABITS)]
        log(habit=name, told=(outcome := HABITS[name](plc)))
        if outcome == "fault":
            after_fault(plc)
        else:
            plc.release()


def main(place: str, cycles: int) -> None:
    def log(**entry: object) -> None:
        print(json.dumps({"time_s": time.time(), **entry}), flush=True)

    kind, _, where = place.partition(":")
    wire: Wire = ModbusWire(int(where)) if kind == "modbus" else ControllerWire(where)
    play(Plc(wire, log, LONGEST_S), cycles, log)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
