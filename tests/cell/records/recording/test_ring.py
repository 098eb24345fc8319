"""The ring gives back what was put in, in order, and refuses what it has no room for."""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path

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


class BetweenTwoLooks:
    """Numbers of a ring, between two looks at which the other end goes on once."""

    def __init__(self, numbers, act):
        self._numbers, self._act = numbers, act

    def __getitem__(self, at):
        found = self._numbers[at]
        act, self._act = self._act, lambda: None
        act()
        return found

    def __iter__(self):
        return iter([self[0], self[1]])

    def __setitem__(self, at, number):
        self._numbers[at] = number


def test_nothing_is_taken_twice_while_an_empty_ring_begins_anew(ring):
    """The writer begins anew between the reader's looks at what was written and what was read."""
    writer, reader = ring
    assert writer.put(("first",), np.zeros(100, np.uint8))
    assert reader.take()[0] == ("first",)

    def begin_anew():
        assert not writer.put(("too large",), np.zeros(SIZE, np.uint8))

    reader._memory.count = BetweenTwoLooks(reader._memory.count, begin_anew)
    assert reader.take() is None
    assert writer.put(("second",))
    assert reader.take()[0] == ("second",)


def test_memory_that_the_system_cannot_give_is_refused(monkeypatch):
    """As in a container with 64 MB of it: to write beyond that would end the cell's process."""
    free_bytes = 2**20

    class Small:
        f_bavail, f_frsize = free_bytes, 1

    monkeypatch.setattr("cell.records.recording.ring.os.fstatvfs", lambda descriptor: Small)
    before = set(Path("/proc/self/fd").iterdir())
    with pytest.raises(OSError, match="No space left"):
        shared_memory(2 * free_bytes)
    assert set(Path("/proc/self/fd").iterdir()) == before
    assert not list(Path("/dev/shm").glob(f"cable-cell-{os.getpid()}-*"))


def test_where_memory_files_have_no_room_another_place_is_taken(monkeypatch):
    places = []

    class Free:
        f_frsize = 1

        def __init__(self, descriptor):
            places.append(descriptor)
            self.f_bavail = 0 if len(places) == 1 else 2**40

    monkeypatch.setattr("cell.records.recording.ring.os.fstatvfs", Free)
    memory, file = shared_memory(SIZE)
    assert file is None
    assert RingWriter(memory).put(("first",))
    os.close(memory)
