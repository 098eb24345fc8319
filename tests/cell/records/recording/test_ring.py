"""The ring gives back what was put in, in order, and refuses what it has no room for."""

from __future__ import annotations

import os
from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.records.recording.ring import RingReader, RingWriter, shared_memory

SIZE = 4096


@pytest.fixture
def ring():
    memory, file = shared_memory(SIZE)
    yield RingWriter(memory), RingReader(memory)
    os.close(memory)
    if file is not None:
        file.unlink()


@given(st.lists(st.one_of(st.none(), st.integers(0, 1500)), max_size=80))
def test_it_is_a_queue(sizes):
    memory, file = shared_memory(SIZE)
    if file is not None:
        file.unlink()
    writer, reader = RingWriter(memory), RingReader(memory)
    expected: deque[tuple[int, bytes]] = deque()
    for number, size in enumerate(sizes):
        if size is None:
            taken = reader.take()
            assert (taken is None) == (not expected)
            if taken is not None:
                header, payload = taken
                wanted, data = expected.popleft()
                assert header == ("frame", wanted)
                assert payload[: len(data)] == data
                assert len(payload) - len(data) < 8
            continue
        data = np.random.default_rng(number).integers(0, 256, size, dtype=np.uint8)
        if writer.put(("frame", number), data):
            expected.append((number, data.tobytes()))
        else:
            assert writer.waiting_bytes + size + 100 > SIZE / 2
    assert writer.waiting_bytes == 0 or expected
    os.close(memory)


def test_an_empty_ring_takes_what_fits_and_nothing_larger(ring):
    writer, reader = ring
    assert writer.put(("small",), np.zeros(SIZE // 2, np.uint8))
    assert not writer.put(("large",), np.zeros(SIZE // 2, np.uint8))
    assert reader.take()[0] == ("small",)
    assert writer.put(("large",), np.zeros(SIZE // 2, np.uint8))


def test_what_must_stay_free_stays_free(ring):
    writer, _ = ring
    assert not writer.put(("frame",), np.zeros(1000, np.uint8), spare=SIZE - 1000)
    assert writer.put(("event",), np.zeros(1000, np.uint8))


def test_a_pause_is_seen_by_the_reader(ring):
    writer, reader = ring
    assert reader.pause_until_s == 0.0
    writer.pause(12.5)
    assert reader.pause_until_s == 12.5
