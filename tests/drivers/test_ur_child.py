"""What the process of a UR arm makes of what it is told."""

from __future__ import annotations

import tempfile
import time

import pytest

from drivers.interfaces import ArmMode
from drivers.ur_child import _Child
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
