from __future__ import annotations

import tempfile

import numpy as np
import pytest

from drivers.ur_shared import COLUMNS, RING, SIZE_BYTES, SharedState, Slot


@pytest.fixture
def ends():
    with tempfile.TemporaryFile() as file:
        file.truncate(SIZE_BYTES)
        yield SharedState(file.fileno()), SharedState(file.fileno())


def test_one_end_sees_what_the_other_writes(ends) -> None:
    one, other = ends
    one.put(Slot.MODE, 3.0)
    one.add(Slot.STOPS)
    one.add(Slot.STOPS)
    assert (other.get(Slot.MODE), other.get(Slot.STOPS)) == (3.0, 2.0)


def test_samples_come_oldest_first_and_no_more_than_there_are(ends) -> None:
    one, other = ends
    assert other.samples().shape == (0, COLUMNS)
    for k in range(5):
        one.write_sample(np.full(COLUMNS, float(k)))
    assert other.samples()[:, 0] == pytest.approx([0, 1, 2, 3, 4])
    assert other.samples(2)[:, 0] == pytest.approx([3, 4])


def test_a_full_ring_keeps_the_newest(ends) -> None:
    one, other = ends
    for k in range(RING + 10):
        one.write_sample(np.full(COLUMNS, float(k)))
    kept = other.samples()
    assert len(kept) == RING // 2
    assert kept[-1, 0] == RING + 9
    assert np.all(np.diff(kept[:, 0]) == 1.0)


def test_of_a_long_log_only_what_is_asked_for_is_copied(ends, monkeypatch) -> None:
    """After every hold the arm's log is asked for: two minutes of samples were copied each time."""
    one, other = ends
    for k in range(RING + 10):
        one.write_sample(np.full(COLUMNS, 0.002 * k))
    copied, array = [], np.array

    def noted(values, *others):
        copied.append(np.size(values))
        return array(values, *others)

    monkeypatch.setattr("drivers.ur_shared.np.array", noted)
    late = other.samples_since(0.002 * RING - 1e-6)
    assert late[:, 0] == pytest.approx(0.002 * (RING + np.arange(10)))
    assert sum(copied) == 10 * COLUMNS
    assert len(other.samples_since(0.0)) == RING // 2
    assert len(other.samples_since(1e9)) == 0
