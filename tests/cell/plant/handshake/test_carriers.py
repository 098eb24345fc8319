"""What every carrier does alike: bits to and fro, inverted or not, losses, and the end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, replace

import pytest

from cell.plant.handshake.carrier import UNKNOWN, Carrier, CarrierError, Inputs, Outputs
from tests.cell.plant.handshake.conftest import Wired, wired_by
from tests.waiting import wait_until
from tools.faults.scripted_plc import INPUTS, OUTPUTS, Plc

QUIET = Inputs(part_present=False, upstream_ready=False, downstream_ready=False)


@pytest.fixture(params=["modbus", "controller", "fake"])
def wired(request: pytest.FixtureRequest) -> Iterator[Wired]:
    yield (made := wired_by(request.param, 0.5, request))
    made.close()


def reads(carrier: Carrier, plc: Plc, wanted: Inputs) -> None:
    """Wait until the carrier reads it."""

    def reached() -> bool:
        plc.say()
        try:
            return carrier.read() == wanted
        except CarrierError:
            return False

    wait_until(reached)


def is_told(plc: Plc, wanted: Outputs) -> None:
    """Wait until the PLC reads it."""
    wait_until(lambda: plc.read() == asdict(wanted))


def test_every_input_is_read_by_its_name(wired: Wired) -> None:
    with wired.carrier() as carrier:
        plc = wired.plc()
        for name in INPUTS:
            plc.say(**{name: True})
            reads(carrier, plc, replace(QUIET, **{name: True}))
            plc.say(**{name: False})


def test_every_output_is_told_and_a_fault_before_anything_is_known(wired: Wired) -> None:
    with wired.carrier() as carrier:
        plc = wired.plc()
        is_told(plc, UNKNOWN)
        for name in OUTPUTS:
            carrier.write(Outputs(**{name: True}))
            is_told(plc, Outputs(**{name: True}))


def test_before_the_first_word_and_after_a_silence_nothing_is_known(wired: Wired) -> None:
    begun = wired.carrier()
    with pytest.raises(CarrierError):
        begun.read()
    with begun as carrier:
        plc = wired.plc()
        reads(carrier, plc, QUIET)
        plc.wire.part()

        def lost() -> bool:
            try:
                carrier.read()
            except CarrierError:
                return True
            return False

        wait_until(lost)
        assert lost()
        carrier.write(Outputs(ready=True))  # it is there when the PLC is
        plc.mend()
        reads(carrier, plc, QUIET)
        is_told(plc, Outputs(ready=True))


def test_a_loss_that_nobody_saw_is_told(wired: Wired) -> None:
    with wired.carrier() as carrier:
        plc = wired.plc()
        reads(carrier, plc, QUIET)
        plc.wire.part()
        time.sleep(2.0 * wired.said.silence_s)  # of the loss itself: nobody looks meanwhile
        plc.mend(start=True)
        with pytest.raises(CarrierError):
            carrier.read()
        reads(carrier, plc, replace(QUIET, start=True))


def test_the_end_leaves_what_was_told_and_lets_another_begin(wired: Wired) -> None:
    with wired.carrier() as carrier:
        plc = wired.plc()
        reads(carrier, plc, QUIET)
        carrier.write(Outputs(ready=True))
        is_told(plc, Outputs(ready=True))
        carrier.write(UNKNOWN)
    if wired.tells_at_end:
        assert plc.read() == asdict(UNKNOWN)
    plc.wire.part()
    with wired.carrier() as carrier:
        plc.mend()
        reads(carrier, plc, QUIET)
