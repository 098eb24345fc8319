from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators.robotiq import Jaws, crc16, frame_size, reply

ACTIVATE, GO = 0x0100, 0x0900


def active(object_count: float | None = 200.0) -> Jaws:
    jaws = Jaws(object_count)
    jaws.write(0x3E8, [ACTIVATE, 0, 0])
    for _ in range(40):
        jaws.advance(0.01)
    return jaws


def go(jaws: Jaws, count: int, seconds: float = 2.0) -> int:
    """Object status after a motion: 2 = stopped by something while closing, 3 = arrived."""
    jaws.write(0x3E8, [GO, count, 0xFFFF])
    for _ in range(round(seconds / 0.01)):
        jaws.advance(0.01)
    return jaws.read(0x7D0) >> 14


def test_checksum_of_the_manuals_activation_request() -> None:
    request = bytes.fromhex("0910 03E8 0003 06 0000 0000 0000".replace(" ", ""))
    assert crc16(request) == bytes.fromhex("7330")


def test_activation_takes_its_time() -> None:
    jaws = Jaws()
    jaws.write(0x3E8, [ACTIVATE, 0, 0])
    jaws.advance(0.1)
    assert jaws.read(0x7D0) >> 12 & 3 == 1
    jaws.advance(0.3)
    assert jaws.read(0x7D0) >> 12 & 3 == 3


def test_closes_on_the_object_and_on_itself_without_one() -> None:
    jaws = active(object_count=200.0)
    assert go(jaws, 255) == 2
    assert jaws.read(0x7D2) >> 8 == 200
    assert go(jaws, 0) == 3
    empty = active(object_count=None)
    assert go(empty, 255) == 3
    assert empty.read(0x7D2) >> 8 == 230


def test_an_object_pulled_out_lets_the_jaws_close() -> None:
    jaws = active()
    assert go(jaws, 255) == 2
    jaws.object_count = None
    jaws.advance(0.001)
    assert jaws.read(0x7D0) >> 14 == 0
    jaws.advance(1.0)
    assert jaws.read(0x7D0) >> 14 == 3


def test_a_new_request_is_not_answered_with_the_last_arrival() -> None:
    jaws = active()
    go(jaws, 255)
    jaws.write(0x3E8, [GO, 0, 0xFFFF])
    assert jaws.read(0x7D0) >> 14 == 0


@pytest.mark.parametrize("function", [3, 4])
def test_reads_status(function) -> None:
    answer = reply(active(), struct.pack(">BBHH", 9, function, 0x7D0, 3))
    assert answer[:3] == bytes([9, function, 6]) and len(answer) == 9


def test_writes_and_reads_in_one_request() -> None:
    jaws = active()
    request = struct.pack(">BBHHHHB3H", 9, 23, 0x7D0, 3, 0x3E8, 3, 6, GO, 128, 0xFFFF)
    assert reply(jaws, request)[:3] == bytes([9, 23, 6])
    assert jaws.command == [GO, 128, 0xFFFF]


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (struct.pack(">BBHH", 9, 3, 0x100, 1), 2),
        (struct.pack(">BBHH", 9, 6, 0x7D0, 1), 2),
        (struct.pack(">BBHHB4H", 9, 16, 0x3E8, 4, 8, 0, 0, 0, 0), 2),
        (struct.pack(">BBHH", 9, 8, 0, 0), 1),
    ],
)
def test_refuses_with_the_exception_code(request_, code) -> None:
    assert reply(active(), request_) == bytes([9, request_[1] | 0x80, code])


@given(st.binary(min_size=2, max_size=40))
def test_any_request_gets_an_answer_or_an_exception(data) -> None:
    answer = reply(Jaws(), data)
    assert answer[0] == data[0] and answer[1] & 0x7F == data[1] & 0x7F


@given(st.binary(max_size=40))
def test_a_frames_size_is_told_early_and_does_not_change(data) -> None:
    sizes = {frame_size(data[:n]) for n in range(len(data) + 1)} - {None}
    assert len(sizes) <= 1
