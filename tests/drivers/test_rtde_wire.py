from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.rtde_wire import (
    INPUTS,
    OUTPUTS,
    TYPES,
    PackageType,
    Packet,
    Recipe,
    Splitter,
    WireError,
    names_in,
)

packets = st.builds(Packet, st.integers(0, 255), st.binary(max_size=300))

_ELEMENTS = {
    "?": st.booleans(),
    "B": st.integers(0, 2**8 - 1),
    "I": st.integers(0, 2**32 - 1),
    "Q": st.integers(0, 2**64 - 1),
    "i": st.integers(-(2**31), 2**31 - 1),
    "d": st.floats(allow_nan=False),
}


def value_of(kind: str) -> st.SearchStrategy:
    form, count = TYPES[kind]
    element = _ELEMENTS[form[-1]]
    return element if count == 1 else st.tuples(*[element] * count)


@st.composite
def filled_recipes(draw):
    types = draw(st.lists(st.sampled_from(sorted(TYPES)), min_size=1, max_size=8))
    names = tuple(f"v{i}" for i in range(len(types)))
    values = [draw(value_of(t)) for t in types]
    return Recipe(draw(st.integers(1, 255)), names, tuple(types)), values


@given(st.lists(packets, max_size=6), st.data())
def test_packets_survive_any_division_of_the_stream(sent, data) -> None:
    stream = b"".join(p.encoded() for p in sent)
    splitter, received, at = Splitter(), [], 0
    while at < len(stream):
        piece = data.draw(st.integers(1, len(stream) - at))
        received += splitter.feed(stream[at : at + piece])
        at += piece
    assert received == sent


@given(filled_recipes())
def test_what_a_recipe_encodes_it_decodes(filled) -> None:
    recipe, values = filled
    payload = recipe.encoded(values)
    assert payload[0] == recipe.number
    assert list(recipe.decoded(payload).values()) == values


@given(filled_recipes(), st.data())
def test_a_short_packet_gives_what_is_whole(filled, data) -> None:
    recipe, values = filled
    payload = recipe.encoded(values)
    cut = data.draw(st.integers(1, len(payload)))
    decoded = recipe.decoded(payload[:cut])
    assert list(decoded.values()) == values[: len(decoded)]
    assert len(decoded) < len(values) or cut == len(payload)


@given(st.binary(max_size=64))
def test_garbage_is_packets_or_a_wire_error_never_another(data) -> None:
    try:
        for packet in Splitter().feed(data):
            assert isinstance(packet, Packet)
    except WireError as error:
        assert "at least 3" in str(error)


def test_bytes_of_the_guide() -> None:
    assert Packet(PackageType.PROTOCOL_VERSION, b"\x00\x02").encoded() == bytes([0, 5, 86, 0, 2])
    payload = Recipe(1, ("timestamp",), ("DOUBLE",)).encoded([1.5])
    assert payload == b"\x01" + struct.pack(">d", 1.5)


def test_a_packet_longer_than_its_size_field_is_refused() -> None:
    with pytest.raises(WireError, match="65536 bytes; at most 65535"):
        Packet(PackageType.DATA, bytes(65533)).encoded()


def test_names_may_end_with_a_comma() -> None:
    assert names_in(b"timestamp,actual_q,") == ("timestamp", "actual_q")


def test_every_variable_has_a_known_type() -> None:
    assert {*OUTPUTS.values(), *INPUTS.values()} <= set(TYPES)
