"""What stands where a marker was not seen is told from its places, and from those of a hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.choosing import choose
from cell.study.imports.contents import contents
from tests.cell.study.imports.made import made


def a_file(places_mm: np.ndarray) -> Capture:
    """Time, hand and markers (rows, points, 2) of a file."""
    names = [f"{n} {a} [mm]" for n in ("hand", "m1", "m2", "m3", "m4", "tip") for a in "xy"]
    values = np.column_stack([np.arange(len(places_mm)) / 200.0, places_mm.reshape(-1, 12)])
    columns = (CapturedColumn("t [s]"), *map(CapturedColumn, names))
    return Capture(Path("a.csv"), columns, values, np.arange(len(values)) + 2)


def places() -> np.ndarray:
    """A hand that rests at the origin, exactly, and the markers of its cable, mm."""
    m = made()
    return np.concatenate([m.hand_m[:, None], m.markers_m], axis=1) * 1e3


def lost(*captures: Capture) -> tuple[float, ...]:
    return choose(captures[0], contents(captures[0]), False, captures[1:])[0].lost


@pytest.mark.parametrize("rows", [1, 3, 6, 20])
@pytest.mark.parametrize("point", [1, 3, 5])
def test_zeros_to_which_a_marker_jumps_mean_that_it_was_not_seen(rows: int, point: int) -> None:
    """Six zeros of a marker 20 mm from the origin were kept as its places, without a word."""
    seen = places()
    seen[75 : 75 + rows, point] = 0.0
    assert lost(a_file(seen)) == (0.0,)


def test_zeros_in_the_file_of_another_trial_are_seen_too() -> None:
    other = places()
    other[75:81, 1] = 0.0
    assert lost(a_file(places()), a_file(other)) == (0.0,)


def test_an_origin_at_which_a_point_rests_or_that_it_passes_is_a_place() -> None:
    """The hand rests at the origin before its motion, or after it, or comes back to it."""
    stays = places()
    assert lost(a_file(stays)) == ()
    returns = stays - stays[:, :1]
    swing = np.sin(np.linspace(0.0, 6.0 * np.pi, len(stays)))[:, None, None]
    for moved in (returns + 40.0 * np.round(swing, 1), stays[::-1], stays - stays[-1, 0]):
        assert lost(a_file(moved)) == ()
