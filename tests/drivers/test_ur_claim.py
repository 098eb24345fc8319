"""One program commands a controller: who it is, and that its end frees the claim."""

from __future__ import annotations

import os
import time

import pytest

from drivers.emulators.launch import EmulatedController
from drivers.interfaces import ConnectError
from drivers.rtde_client import RtdeClient
from drivers.ur import UrArm, UrOptions
from drivers.ur_claim import COMMANDS, ClaimedError, claim
from tests.waiting import wait_until


def claimed(host: str) -> ClaimedError:
    with pytest.raises(ClaimedError) as error:
        claim(host, 1, [COMMANDS]).close()
    return error.value


def eventually_free(host: str) -> None:
    """A controller notices in its next cycles that a connection has ended."""

    def is_free() -> bool:
        try:
            claim(host, 1, [COMMANDS]).close()
        except ClaimedError:
            return False
        return True

    wait_until(is_free, 5.0)


def begun(emulator: EmulatedController) -> list[float]:
    """When programs were started."""
    events = emulator.request("state")["events"]
    return [e["t_s"] for e in events if e["what"] == "program started"]


def test_the_owner_is_named_until_its_connection_ends(ur_emulator: EmulatedController) -> None:
    with claim(ur_emulator.host, 4_000_000_000):  # no number that is too large for a register
        error = claimed(ur_emulator.host)
        owner = error.commander
        assert owner is not None and (owner.pid, owner.here) == (4_000_000_000, True)
        assert abs(owner.since_s - time.time()) < 60.0
        assert "process 4000000000 on this computer, since 20" in str(error)
    eventually_free(ur_emulator.host)


def test_a_client_that_is_no_cell_is_said_to_be_one(ur_emulator: EmulatedController) -> None:
    with RtdeClient(ur_emulator.host) as foreign:
        foreign.claim([COMMANDS])
        error = claimed(ur_emulator.host)
        assert error.commander is None and "no cell" in str(error)
    eventually_free(ur_emulator.host)


def test_a_second_arm_is_refused_and_the_first_goes_on(
    ur_emulator: EmulatedController, ur_options: UrOptions
) -> None:
    """It was refused by ur-rtde, with the advice to look at the network."""
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")
    eventually_free(ur_emulator.host)
    first, second = UrArm(ur_options), UrArm(ur_options)
    first.connect()
    before = begun(ur_emulator)
    try:
        with pytest.raises(ConnectError) as refused:
            second.connect()
        assert f"commanded already: by process {os.getpid()} on this computer" in str(refused.value)
        assert "end that program" in refused.value.remedy
        assert begun(ur_emulator) == before
    finally:
        second.close()
        first.close()
    eventually_free(ur_emulator.host)
