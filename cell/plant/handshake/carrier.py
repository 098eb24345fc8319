"""What carries the signals between PLC and cell: the interface, and signals as numbered bits."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from cell.plant.handshake.signals import Inputs, Outputs
from cell.settings.plant.handshake import InputSignals, OutputSignals, signals_of


class CarrierError(OSError):
    """The other end is not there.  Scenario: the PLC was switched off, its cable was pulled."""


class Carrier(Protocol):
    """Carries bits from and to a PLC within a `with`; it comes back by itself after a loss."""

    def read(self) -> Inputs:
        """What the PLC says now.  Raises CarrierError: it is not known."""
        ...

    def write(self, outputs: Outputs) -> None:
        """Tell the PLC; what is told while it is away is there when it comes back."""
        ...


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
