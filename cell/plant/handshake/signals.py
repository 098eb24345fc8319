"""The signals of the handshake, as they are meant: where they are and inverted is the carrier's."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Inputs:
    """What the PLC says.  A signal that is not wired has the value here.

    start             its rising edge asks for a cycle
    part_present      a cable is where the cell grips it
    upstream_ready    the machine before the cell allows it to work
    downstream_ready  the machine after the cell allows it to work
    acknowledge       its rising edge says that a person has looked
    stop              its rising edge asks for a stop
    product_0 …       number of the product that a start is of, lowest bit first; 0 = not said
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
        """Number of the product, from 1 in the order of the settings; 0 = not said."""
        bits = (self.product_0, self.product_1, self.product_2, self.product_3)
        return sum(bit << place for place, bit in enumerate(bits))


@dataclass(frozen=True)
class Outputs:
    """What the cell says.

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


#: What a PLC reads while nothing is known of the cell.
UNKNOWN = Outputs(fault=True)
