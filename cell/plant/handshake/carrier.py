"""Carriers of signals between PLC and cell: their interface, and the arm's controller as one."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol, Self

from cell.settings.plant import Handshake, InputSignals, OutputSignals, signals_of
from drivers.ur_io import UrIo


@dataclass(frozen=True)
class Inputs:
    """Signals from the PLC.  One that is not wired has its default.

    start             its rising edge asks for a cycle
    part_present      a cable is where the cell grips it
    upstream_ready    the machine before the cell allows it to work
    downstream_ready  the machine after the cell allows it to work
    acknowledge       its rising edge acknowledges a fault in a person's name
    stop              its rising edge asks for a stop
    product_0 …       number of the product that a start is of, lowest bit first; 0 = not named
    """

    start: bool = False
    part_present: bool = True
    upstream_ready: bool = True
    downstream_ready: bool = True
    acknowledge: bool = False
    stop: bool = False
    product_0: bool = False
    product_1: bool = False
    product_2: bool = False
    product_3: bool = False

    @property
    def product(self) -> int:
        """Number of the product, from 1 in the order of the settings; 0 = no product is named."""
        bits = (self.product_0, self.product_1, self.product_2, self.product_3)
        return sum(bit << place for place, bit in enumerate(bits))


@dataclass(frozen=True)
class Outputs:
    """Signals to the PLC.

    ready     a rising edge of start is obeyed now
    busy      a cycle is under way
    done      the last cycle has ended as wanted
    rejected  the last cycle has ended, and the cable is not inserted
    fault     the cell waits for a person, or is not reached
    """

    ready: bool = False
    busy: bool = False
    done: bool = False
    rejected: bool = False
    fault: bool = False


#: Outputs while the state of the cell is not known.
UNKNOWN = Outputs(fault=True)


class CarrierError(OSError):
    """The PLC is not connected.  Scenario: it was switched off, or its cable was pulled."""


class Carrier(Protocol):
    """Carries bits from and to a PLC within a `with`; reconnects by itself after a loss."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def read(self) -> Inputs:
        """Newest inputs.  Raises CarrierError: lost now, or since the last call."""
        ...

    def write(self, outputs: Outputs) -> None:
        """Set the outputs; while the PLC is away they are stored until it comes back."""
        ...


class LatestBits:
    """The newest bits, passed from a protocol's thread to the adapter's.

    `read` reports every loss once, even a short one, because edge detection restarts after it.

    silence_s       time without a message after which the other end counts as lost, s
    silence_reason  message of the error then
    """

    def __init__(self, silence_s: float, silence_reason: str) -> None:
        self._silence_s, self._silence_reason = silence_s, silence_reason
        self._lock = threading.Lock()
        self._bits: frozenset[int] | None = None
        self._heard_s = 0.0
        self._reason, self._is_reported = silence_reason, True

    def take(self, bits: Collection[int]) -> None:
        """Store the newest bits, by the numbers of those that are 1."""
        with self._lock:
            self._notice_silence()
            self._bits, self._heard_s = frozenset(bits), time.monotonic()

    def lose(self, reason: str) -> None:
        """Mark the bits as unknown."""
        with self._lock:
            self._bits, self._reason, self._is_reported = None, reason, False

    def read(self) -> frozenset[int]:
        """Numbers of the bits that are 1.  Raises CarrierError: lost since the last call."""
        with self._lock:
            self._notice_silence()
            if self._bits is None or not self._is_reported:
                self._is_reported = True
                raise CarrierError(self._reason)
            return self._bits

    def _notice_silence(self) -> None:
        if self._bits is not None and time.monotonic() - self._heard_s > self._silence_s:
            self._bits, self._reason, self._is_reported = None, self._silence_reason, False


def inputs_of(bits: Collection[int], places: InputSignals) -> Inputs:
    """Signals from the set of bits that are 1."""
    return Inputs(
        **{name: (at.number in bits) is not at.inverted for name, at in signals_of(places)}
    )


def bits_of(outputs: Outputs, places: OutputSignals) -> frozenset[int]:
    """Set of bits that are 1."""
    return frozenset(
        at.number for name, at in signals_of(places) if getattr(outputs, name) is not at.inverted
    )


class ControllerCarrier:
    """A UR controller's inputs and outputs, wired to the PLC, over a connection of their own.

    host  address of the controller
    """

    def __init__(self, settings: Handshake, host: str) -> None:
        self._settings = settings
        silence_s = settings.silence_s
        self._latest = LatestBits(silence_s, f"{host} reports nothing for {silence_s:g} s")
        ours = [at.number for _, at in signals_of(settings.outputs)]
        self._io = UrIo(host, ours, self._latest.take, self._latest.lose, silence_s)
        self.write(UNKNOWN)

    def __enter__(self) -> Self:
        self._io.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._io.__exit__()

    def read(self) -> Inputs:
        """Newest inputs.  Raises CarrierError: the controller is away."""
        return inputs_of(self._latest.read(), self._settings.inputs)

    def write(self, outputs: Outputs) -> None:
        """Set the outputs, which stay as they are when the program ends."""
        self._io.set(bits_of(outputs, self._settings.outputs))
