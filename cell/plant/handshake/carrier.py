"""What carries the signals between PLC and cell: the interface, and signals as numbered bits."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection
from typing import Protocol, Self

from cell.plant.handshake.signals import Inputs, Outputs
from cell.settings.plant.handshake import InputSignals, OutputSignals, signals_of


class CarrierError(OSError):
    """The other end is not there.  Scenario: the PLC was switched off, its cable was pulled."""


class Carrier(Protocol):
    """Carries bits from and to a PLC within a `with`; it comes back by itself after a loss."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def read(self) -> Inputs:
        """What the PLC says now.  Raises CarrierError: it is not known, or was not meanwhile."""
        ...

    def write(self, outputs: Outputs) -> None:
        """Tell the PLC; what is told while it is away is there when it comes back."""
        ...


class Heard:
    """Bits that have come last, between a protocol's thread and the adapter's.

    A loss is told by `read`, however soon the other end is back: edges begin anew after it.

    silence_s  without a word for so long the other end is away
    silent     what is said of it then
    """

    def __init__(self, silence_s: float, silent: str) -> None:
        self._silence_s, self._silent = silence_s, silent
        self._lock = threading.Lock()
        self._bits: frozenset[int] | None = None
        self._heard_s = 0.0
        self._why, self._is_told = silent, True

    def take(self, bits: Collection[int]) -> None:
        """Numbers of the bits that are 1 now."""
        with self._lock:
            self._notice_silence()
            self._bits, self._heard_s = frozenset(bits), time.monotonic()

    def lose(self, why: str) -> None:
        """Nothing is known any more."""
        with self._lock:
            self._bits, self._why, self._is_told = None, why, False

    def read(self) -> frozenset[int]:
        """Numbers of the bits that are 1.  Raises CarrierError: not known, or not meanwhile."""
        with self._lock:
            self._notice_silence()
            if self._bits is None or not self._is_told:
                self._is_told = True
                raise CarrierError(self._why)
            return self._bits

    def _notice_silence(self) -> None:
        if self._bits is not None and time.monotonic() - self._heard_s > self._silence_s:
            self._bits, self._why, self._is_told = None, self._silent, False


def inputs_of(bits: Collection[int], places: InputSignals) -> Inputs:
    """Signals from the numbers of the bits that are 1."""
    return Inputs(
        **{name: (at.number in bits) is not at.inverted for name, at in signals_of(places)}
    )


def bits_of(outputs: Outputs, places: OutputSignals) -> frozenset[int]:
    """Numbers of the bits that are 1."""
    return frozenset(
        at.number for name, at in signals_of(places) if getattr(outputs, name) is not at.inverted
    )
