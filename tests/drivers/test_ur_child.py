"""What the process of a UR arm makes of what it is told."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.interfaces import ArmMode
from drivers.ur_child import ControllerClock, _Child
from drivers.ur_shared import SIZE_BYTES, SharedState, Slot


@pytest.mark.parametrize(("late_s", "taken"), [(None, True), (-60.0, True), (0.02, False)])
def test_a_path_is_begun_at_its_start_or_not_at_all(line, late_s, taken) -> None:
    """Begun late, its first command would be a jump to where the arm is to be by then."""
    child = object.__new__(_Child)
    with tempfile.TemporaryFile() as file:
        file.truncate(SIZE_BYTES)
        child._shared = SharedState(file.fileno())
    child._mode, child._motion = ArmMode.READY, None
    child._follow(line(), 0.0, None if late_s is None else time.monotonic() - late_s)
    assert (child._motion is not None) is taken
    told = [child._shared.get(slot) for slot in (Slot.PATHS, Slot.FOLLOWED, Slot.STREAMING)]
    assert told == [1.0, float(taken), float(taken)]


PERIOD_S, POLL_S, EARLY_S = 2e-3, 1e-4, 1e-4


def cycles(
    clock: ControllerClock, arrivals_s: np.ndarray, begin_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) deadlines of whoever waits for states as the arm's process does, and seen times."""
    stamps_s = PERIOD_S * np.arange(len(arrivals_s))
    due_s, due, seen = begin_s, [], []
    for number in range(len(arrivals_s) - 5):
        learns = number < 50
        look_s = due_s - (PERIOD_S if learns else clock.lead_s + EARLY_S)
        awaited_s = clock.robot_s if learns else clock.state_before(due_s)
        while True:
            came = np.count_nonzero(arrivals_s <= look_s)
            newest_s = stamps_s[came - 1] if came else -1.0
            if newest_s > awaited_s or look_s >= due_s:
                break
            look_s = min(look_s + POLL_S, due_s)
        if came and newest_s != clock.robot_s:
            seen.append(clock.observe(newest_s, look_s))
        due.append(due_s)
        due_s = clock.in_step(due_s + PERIOD_S)
    return np.array(due), np.array(seen)


@given(
    begin=st.floats(0.0, 1.0),
    drift=st.floats(-40e-6, 40e-6),
    delay_s=st.floats(0.0, 5.0),
    jitter_s=st.floats(1e-5, 2e-4),
    seed=st.integers(0, 2**32 - 1),
)
def test_commands_are_sent_far_from_where_the_controller_looks(
    begin: float, drift: float, delay_s: float, jitter_s: float, seed: int
) -> None:
    late_s = np.minimum(np.random.default_rng(seed).exponential(jitter_s, 1500), 1.5e-3)
    earliest_s = delay_s + PERIOD_S * np.arange(1500) * (1.0 + drift)
    due_s, seen_s = cycles(
        ControllerClock(PERIOD_S), earliest_s + late_s, delay_s + begin * PERIOD_S
    )
    settled_s = due_s[400:]
    phase = ((settled_s - delay_s) / (1.0 + drift) / PERIOD_S) % 1.0
    assert np.all(np.abs(phase - 0.4) < 0.1)
    assert np.ptp(np.diff(due_s)) <= 0.0200001 * PERIOD_S
    # stamps are those of the earliest arrivals, wherever the first look fell in a period
    number = np.round((seen_s[400:] - delay_s) / PERIOD_S).astype(int)
    assert np.all(np.abs(seen_s[400:] - earliest_s[number]) < 2e-4)


def test_a_deadline_stays_where_it_is_until_a_state_came() -> None:
    assert ControllerClock(PERIOD_S).in_step(7.0) == 7.0


def test_a_deadline_is_moved_the_shorter_way() -> None:
    clock = ControllerClock(PERIOD_S)
    assert clock.observe(1.0, 5.0) == 5.0
    there_s = 5.0 + clock.lead_s
    assert clock.in_step(there_s + 3 * PERIOD_S) == pytest.approx(there_s + 3 * PERIOD_S)
    assert clock.in_step(there_s + 5e-4) == pytest.approx(there_s + 5e-4 - 2e-5)
    assert clock.in_step(there_s - 5e-4) == pytest.approx(there_s - 5e-4 + 2e-5)
    assert clock.in_step(there_s + 5e-6) == pytest.approx(there_s)


def test_the_child_starts_without_the_compiler() -> None:
    """It takes longer to load than everything else, while the arm is connected."""
    program = "import sys, drivers.ur_child; print('numba' in sys.modules, 'scipy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False False\n", done.stderr
