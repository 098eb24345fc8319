"""Which versions of a controller the driver runs with, and what is said of those it refuses."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from itertools import pairwise

import pytest

from drivers import ur_dashboard, ur_versions
from drivers.emulators.launch import EmulatedController
from drivers.rtde_client import RtdeClient, RtdeError
from drivers.ur_versions import RANGES, SupportLevel, identify, is_proved, refusal

#: Emulated version; which is allowed in the settings; what is said, None = it runs.
TABLE = [
    ("5.5.1.0", None, "5.5, known not to work: its dashboard server tells neither"),
    ("5.5.1.0", (5, 5), "5.5, known not to work"),
    ("5.6.0.0", None, None),
    ("5.12.2.0", None, None),
    ("5.21.3.0", None, None),
    ("5.21.3.0", (5, 26), None),
    ("5.22.0.0", None, "5.22, unknown: ur-rtde once could not start its program on 5.22"),
    ("5.22.1.0", (5, 22), None),
    ("5.23.0.0", None, "5.23, expected to work: ur-rtde 1.6.5 has the registers"),
    ("5.23.0.0", (5, 23), None),
    ("5.24.0.0", None, "5.24, unknown: ur-rtde 1.6.5 treats it as 5.23"),
    ("5.25.0.0", (5, 25), None),
    ("5.26.0.0", None, "5.26, expected to work: ur-rtde 1.6.5 has lines of its program for 5.26"),
    ("5.26.0.0", (5, 2), "arm.allow_version allows 5.2"),
    ("5.26.0.0", (5, 25), "arm.allow_version allows 5.25"),
    ("5.26.0.0", (5, 26), None),
    ("5.27.0.0", None, "5.27, unknown: it is newer"),
    ("5.27.0.0", (5, 27), None),
    ("10.7.0.0", None, "10.7, known not to work: ur-rtde 1.6.5 starts its program"),
    ("10.9.0.0", (10, 9), "10.9, known not to work"),
    ("10.10.0.0", None, "10.10, expected to work: .*without a dashboard server"),
    ("10.10.0.0", (10, 10), None),
    ("10.13.0.0", None, "10.13, expected to work"),
    ("10.13.0.0", (10, 1), "arm.allow_version allows 10.1"),
    ("10.13.0.0", (10, 13), None),
    ("10.14.0.0", None, "10.14, unknown: it is newer"),
    ("11.0.0.0", (11, 0), None),
]


@pytest.fixture(scope="module")
def changeable(free_loopback) -> Iterator[EmulatedController]:
    with EmulatedController(free_loopback()) as emulator:
        yield emulator


@pytest.mark.parametrize(("version", "allowed", "said"), TABLE)
def test_a_version_is_allowed_or_refused_with_what_is_known(
    changeable: EmulatedController, version: str, allowed: tuple[int, int] | None, said: str | None
) -> None:
    changeable.request("version", version=version)
    found = identify(changeable.host)
    assert found.version_text == version
    refused = refusal(found.release, allowed)
    if said is None:
        assert refused is None
        return
    assert refused is not None
    assert re.search(said, refused.cause), refused.cause
    assert "install PolyScope" in refused.remedy
    name = ".".join(version.split(".")[:2])
    permitted = "known not to work" not in refused.cause
    assert (f'allow_version: "{name}"' in refused.remedy) is permitted
    assert ("--dry-run --speed 0.1" in refused.remedy) is permitted


def test_the_ranges_are_in_order_and_leave_no_gap() -> None:
    assert RANGES[0].first == (0, 0)
    for before, after in pairwise(RANGES):
        assert before.first <= before.last < after.first
        assert after.first in {(before.last[0], before.last[1] + 1), (before.last[0] + 1, 0)}
    assert [r for r in RANGES if r.known is SupportLevel.PROVED] == [RANGES[1]]
    assert is_proved((5, 21)) and not is_proved((5, 22))


def test_only_a_controller_with_a_dashboard_tells_its_serial_number(changeable) -> None:
    changeable.request("version", version="5.26.0.7")
    assert identify(changeable.host).serial_number == "20225500001"
    changeable.request("version", version="10.13.0.7")
    assert identify(changeable.host).serial_number is None


def test_nobody_at_the_address_is_said_soon(free_loopback) -> None:
    with pytest.raises(OSError, match="refused"):
        identify(free_loopback(), 0.5)


def test_a_silent_controller_is_given_up(changeable) -> None:
    changeable.request("freeze", seconds=1.0)
    with pytest.raises(RtdeError, match=r"no answer to protocol_version within 0\.2 s"):
        identify(changeable.host, 0.2)
    changeable.request("freeze", seconds=0.0)


def test_inputs_are_reported_and_outputs_written_by_one_client_alone(changeable) -> None:
    names = ["standard_digital_output_mask", "standard_digital_output"]
    bits = ["actual_digital_input_bits", "actual_digital_output_bits"]
    with RtdeClient(changeable.host) as one, RtdeClient(changeable.host) as other:
        one.report(bits, 125.0)
        recipe = one.claim(names)
        one.start()
        changeable.request("inputs", bits=0b101)
        one.write(recipe, [0b11, 0b10])
        while one.newest(1.0) != {bits[0]: 0b101, bits[1]: 0b10}:
            pass
        with pytest.raises(RtdeError, match="standard_digital_output_mask is in use by another"):
            other.claim(names)
        with pytest.raises(RtdeError, match="knows no nonsense"):
            other.claim(["nonsense"])
        with pytest.raises(RtdeError, match="knows no nonsense"):
            other.report(["nonsense"], 10.0)
    assert changeable.request("outputs")["bits"] == 0b10


def test_a_connection_that_ends_is_noticed(changeable) -> None:
    with RtdeClient(changeable.host) as client:
        client.report(["timestamp"], 10.0)
        client.start()
        client.newest(1.0)
        changeable.request("drop")
        with pytest.raises(OSError, match=r"closed|reset"):
            while True:
                client.newest(1.0)


@pytest.mark.parametrize(
    "answer", [b"", b"\n", b"could not understand: 'get serial number'\n", b"\xff\n"]
)
def test_what_is_no_serial_number_is_none(monkeypatch, answer) -> None:
    """A controller that starts up: two of them would pass for the same one."""
    ours, theirs = socket.socketpair()
    theirs.sendall(b"Connected: Universal Robots Dashboard Server\n" + answer)
    theirs.shutdown(socket.SHUT_WR)
    monkeypatch.setattr(ur_dashboard.socket, "create_connection", lambda *_: ours)
    with theirs, pytest.raises(OSError, match=r"tells no serial number|has closed"):
        ur_versions._serial_number("127.0.0.1", 1.0)
