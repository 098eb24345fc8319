"""A PLC as a program of its own: starts cycles over Modbus, and misbehaves on purpose.

    python scripted_plc.py PORT CYCLES

It prints a line for every cycle: what it did, and what it was told.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from pymodbus.client import ModbusTcpClient

INPUTS = ("start", "part_present", "upstream_ready", "downstream_ready", "acknowledge", "stop")
OUTPUTS = ("ready", "busy", "done", "rejected", "fault")
#: So long it watches that nothing happens, s: several looks of the adapter.
WATCHED_S = 0.2


def has_ended(heard: dict[str, bool]) -> bool:
    return not heard["busy"] and (heard["done"] or heard["rejected"] or heard["fault"])


class Plc:
    """Signals by their names; every wait has a deadline."""

    def __init__(self, port: int) -> None:
        self._client = ModbusTcpClient("127.0.0.1", port=port)
        assert self._client.connect()
        self._said = dict.fromkeys(INPUTS, False)

    def say(self, **signals: bool) -> None:
        self._said.update(signals)
        written = self._client.write_coils(0, [self._said[name] for name in INPUTS], device_id=1)
        assert not written.isError(), written

    def heard(self) -> dict[str, bool]:
        """Both directions of a PLC's cycle."""
        self.say()
        return self.read()

    def read(self) -> dict[str, bool]:
        read = self._client.read_discrete_inputs(0, count=len(OUTPUTS), device_id=1)
        assert not read.isError(), read
        return dict(zip(OUTPUTS, read.bits, strict=False))

    def wait(self, reached: Callable[[dict[str, bool]], bool]) -> dict[str, bool]:
        until_s = time.monotonic() + 20.0
        while not reached(heard := self.heard()):
            assert time.monotonic() < until_s, heard
            time.sleep(0.01)
        return heard

    def quiet(self) -> None:
        """Nothing begins for a while."""
        until_s = time.monotonic() + WATCHED_S
        while time.monotonic() < until_s:
            assert not self.heard()["busy"], "the cell has begun"
            time.sleep(0.01)

    def close(self) -> None:
        self._client.close()

    def connect(self) -> None:
        """Say that all is well, and wait until the cell is ready."""
        self.say(part_present=True, upstream_ready=True, downstream_ready=True)
        self.wait(lambda heard: heard["ready"])

    def cycle(self) -> str:
        """A cycle as it should be; what was told at its end."""
        self.wait(lambda heard: heard["ready"])
        self.say(start=True)
        self.wait(lambda heard: heard["busy"])
        ended = self.wait(has_ended)
        return next(name for name in ("fault", "done", "rejected") if ended[name])

    def release(self) -> None:
        """Let start fall."""
        self.say(start=False)
        self.wait(lambda heard: not (heard["done"] or heard["rejected"]))

    def acknowledge(self) -> None:
        """Press twice: clear, reset."""
        for _ in range(2):
            self.say(acknowledge=True)
            time.sleep(WATCHED_S)
            self.say(acknowledge=False)
            time.sleep(WATCHED_S)


def held(plc: Plc) -> str:
    """Start is not let fall after the cycle: no other begins."""
    told = plc.cycle()
    if told != "fault":
        plc.quiet()
    return told


def without_part(plc: Plc) -> str:
    """The part goes as start comes, and comes again while start is held."""
    plc.wait(lambda heard: heard["ready"])
    plc.say(part_present=False, start=True)
    plc.quiet()
    plc.say(part_present=True)
    plc.quiet()
    plc.say(start=False)
    return plc.cycle()


def twice(plc: Plc) -> str:
    """A second start within the cycle."""
    plc.wait(lambda heard: heard["ready"])
    plc.say(start=True)
    plc.wait(lambda heard: heard["busy"])
    plc.say(start=False)
    time.sleep(0.06)
    plc.say(start=True)
    ended = plc.wait(lambda heard: not heard["busy"])
    plc.quiet()
    ended = plc.heard()
    return next((name for name in ("fault", "done", "rejected") if ended[name]), "no outcome")


def paused(plc: Plc) -> str:
    """The machine after the cell is not ready for a while."""
    plc.wait(lambda heard: heard["ready"])
    plc.say(start=True)
    plc.wait(lambda heard: heard["busy"])
    plc.say(downstream_ready=False)
    time.sleep(WATCHED_S)
    plc.say(downstream_ready=True)
    ended = plc.wait(has_ended)
    return next(name for name in ("fault", "done", "rejected") if ended[name])


def after_fault(plc: Plc) -> None:
    """Start does nothing until someone has acknowledged, nor while it is held since before."""
    plc.say(start=False)
    plc.say(start=True)
    plc.quiet()
    plc.acknowledge()
    plc.quiet()
    plc.say(start=False)
    plc.wait(lambda heard: heard["ready"])


HABITS = {"plain": Plc.cycle, "held": held, "no part": without_part, "twice": twice}
HABITS["paused"] = paused


def main(port: int, cycles: int) -> None:
    plc = Plc(port)
    plc.connect()
    for number in range(1, cycles + 1):
        name, habit = list(HABITS.items())[number % len(HABITS)]
        told = habit(plc)
        print(number, name, told, flush=True)
        if told == "fault":
            after_fault(plc)
        else:
            plc.release()
    plc.close()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
