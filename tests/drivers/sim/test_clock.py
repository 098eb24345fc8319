from __future__ import annotations

import threading
import time

import pytest

from drivers.sim.clock import SimClock


def test_sleeping_costs_no_real_time() -> None:
    clock = SimClock()
    began = time.perf_counter()
    clock.sleep_s(3600.0)
    assert clock.now_s() == 3600.0
    assert time.perf_counter() - began < 1.0


def test_events_happen_in_order_at_their_own_time() -> None:
    clock, seen = SimClock(), []
    clock.call_at(2.0, lambda: seen.append(("b", clock.now_s())))
    clock.call_at(1.0, lambda: seen.append(("a", clock.now_s())))
    clock.call_at(9.0, lambda: seen.append(("c", clock.now_s())))
    clock.sleep_s(5.0)
    assert seen == [("a", 1.0), ("b", 2.0)]
    assert clock.now_s() == 5.0


def test_an_event_may_plan_another() -> None:
    clock, seen = SimClock(), []
    clock.call_at(1.0, lambda: clock.call_at(2.0, lambda: seen.append(clock.now_s())))
    clock.sleep_s(3.0)
    assert seen == [2.0]


def test_time_does_not_go_back() -> None:
    clock = SimClock(start_s=5.0)
    clock.forward_to_s(1.0)
    assert clock.now_s() == 5.0


def test_real_time_factor_takes_its_time() -> None:
    clock = SimClock(real_time_factor=10.0)
    began = time.perf_counter()
    clock.sleep_s(0.2)
    assert time.perf_counter() - began >= 0.02


def test_in_real_time_the_computers_own_work_passes_too() -> None:
    clock = SimClock(real_time_factor=1.0)
    clock.sleep_s(0.01)
    time.sleep(0.05)  # stands for work of the computer
    began = time.perf_counter()
    clock.sleep_s(0.04)
    assert time.perf_counter() - began < 0.03


def test_in_real_time_others_see_the_clock_go_on() -> None:
    """They saw it stand still for as long as somebody slept, and then jump."""
    clock, seen = SimClock(real_time_factor=1.0), []
    sleeper = threading.Thread(target=clock.sleep_s, args=(0.2,))
    sleeper.start()
    time.sleep(0.05)
    clock.call_at(0.1, lambda: seen.append(clock.now_s()))
    while sleeper.is_alive():
        assert clock.now_s() <= 0.2
        seen.append(clock.now_s())
        time.sleep(0.001)
    assert seen == sorted(seen)
    assert len({t for t in seen if 0.0 < t < 0.2}) > 5
    assert 0.1 in seen  # the event, at its own time
    assert clock.now_s() == 0.2


def test_real_time_factor_must_be_positive() -> None:
    with pytest.raises(ValueError, match=r"real_time_factor = 0.0"):
        SimClock(real_time_factor=0.0)
