"""What the settings say of the digital handshake with a PLC."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, model_validator

from cell.settings.section import Host, Section


class HandshakeSignal(Section):
    """Place of one bit."""

    number: Annotated[int, Field(ge=0, le=1023)]
    """Address of the coil or of the discrete input, or number at the controller; from 0."""
    inverted: bool = False
    """Whether the signal is on when the bit is 0."""


class InputSignals(Section):
    """Bits from the PLC.  Null = not wired: always fine, and never asked for."""

    start: HandshakeSignal | None = HandshakeSignal(number=0)
    """Its rising edge asks for a cycle; obeyed while `ready` is on."""
    part_present: HandshakeSignal | None = HandshakeSignal(number=1)
    """A cable is where the cell grips it; without one no cycle begins."""
    upstream_ready: HandshakeSignal | None = HandshakeSignal(number=2)
    """The machine before the cell allows it to work; off suspends a cycle."""
    downstream_ready: HandshakeSignal | None = HandshakeSignal(number=3)
    """The machine after the cell allows it to work; off suspends a cycle."""
    acknowledge: HandshakeSignal | None = HandshakeSignal(number=4)
    """Its rising edge clears Aborted and resets Stopped: a person has looked."""
    stop: HandshakeSignal | None = HandshakeSignal(number=5)
    """Its rising edge stops the cycle.  It is not safety-rated."""
    product_0: HandshakeSignal | None = None
    """Lowest bit of the product's number, from 1 in the order of `products`; 0 = not said."""
    product_1: HandshakeSignal | None = None
    """Next bit of the product's number."""
    product_2: HandshakeSignal | None = None
    """Next bit of the product's number."""
    product_3: HandshakeSignal | None = None
    """Highest bit of the product's number."""


class OutputSignals(Section):
    """Bits to the PLC.  Null = not told."""

    ready: HandshakeSignal | None = HandshakeSignal(number=0)
    """A rising edge of `start` is obeyed."""
    busy: HandshakeSignal | None = HandshakeSignal(number=1)
    """A cycle is under way."""
    done: HandshakeSignal | None = HandshakeSignal(number=2)
    """The last cycle has ended as wanted; until `start` changes."""
    rejected: HandshakeSignal | None = HandshakeSignal(number=3)
    """The last cycle has ended without an insertion; until `start` changes."""
    fault: HandshakeSignal | None = HandshakeSignal(number=4)
    """The cell waits for a person, or is not reached."""


#: Entries that one carrier alone has.
_OWN = {"modbus": ("listen", "port"), "controller": ("host",)}
#: Highest number of a controller's inputs and outputs.
_LAST = 17


class Handshake(Section):
    """Digital handshake (`cell handshake`): a PLC starts the cell with bits.

    Modbus knows neither users nor encryption: whoever reaches the port can start the cell.
    """

    carrier: Literal["modbus", "controller"] = "modbus"
    """What carries the bits: a Modbus/TCP server, or digital inputs and outputs of a UR controller:
    0 to 7 standard, 8 to 15 configurable, 16 and 17 at the tool."""
    listen: Host = "127.0.0.1"
    """Address at which the Modbus server listens; 0.0.0.0 = all of this computer."""
    port: Annotated[int, Field(ge=1, le=65535)] = 502
    """TCP port.  502 is that of Modbus, and needs rights of its own below 1024."""
    host: Host | None = None
    """Address of the controller that has the inputs and outputs.  Null = that of the arm."""
    silence_s: Annotated[float, Field(ge=0.1, le=60.0)] = 1.0
    """A PLC writes its coils, or the controller reports, at least so often.  One that does not is
    lost, and starts nothing."""
    by: Annotated[str, Field(min_length=1, max_length=100)] = "plc"
    """Who is said to have asked, and to have acknowledged, in the ledger."""
    inputs: InputSignals = InputSignals()
    """What the PLC says."""
    outputs: OutputSignals = OutputSignals()
    """What the cell says."""

    @model_validator(mode="after")
    def _each_bit_once(self) -> Handshake:
        for group in (self.inputs, self.outputs):
            named: dict[int, str] = {}
            for name, signal in signals_of(group):
                if signal.number in named:
                    raise ValueError(
                        f"has {name} and {named[signal.number]} at number {signal.number}; "
                        "give each a number of its own"
                    )
                named[signal.number] = name
        return self

    @model_validator(mode="after")
    def _fits_carrier(self) -> Handshake:
        for carrier, names in _OWN.items():
            for name in names:
                default = type(self).model_fields[name].default
                if carrier != self.carrier and getattr(self, name) != default:
                    raise ValueError(
                        f"has {name}, which only the carrier {carrier} has; remove it, or set "
                        f"carrier: {carrier}"
                    )
        if self.carrier == "controller":
            for group in (self.inputs, self.outputs):
                for name, signal in signals_of(group):
                    if signal.number > _LAST:
                        raise ValueError(
                            f"has {name} at number {signal.number}; a controller has 0 to 7 "
                            "standard, 8 to 15 configurable, 16 and 17 at the tool"
                        )
        return self


def signals_of(group: InputSignals | OutputSignals) -> Iterator[tuple[str, HandshakeSignal]]:
    """Name and place of every signal that is wired."""
    for name, signal in group:
        if signal is not None:
            yield name, signal
