"""What every clock keeps."""

from __future__ import annotations

import pytest

from drivers.interfaces import Clock


def test_is_a_clock(clock) -> None:
    assert isinstance(clock, Clock)


def test_sleeping_lets_at_least_that_time_pass(clock) -> None:
    began = clock.now_s()
    clock.sleep_s(0.01)
    assert clock.now_s() - began >= 0.01 - 1e-9


def test_never_goes_back(clock) -> None:
    times = []
    for _ in range(100):
        times.append(clock.now_s())
        clock.sleep_s(0.0)
    assert times == sorted(times)


@pytest.mark.parametrize("duration_s", [-1e-9, float("nan"), float("inf")])
def test_refuses_impossible_sleeps(clock, duration_s) -> None:
    with pytest.raises(ValueError, match="must be finite and >= 0"):
        clock.sleep_s(duration_s)
