"""What is wrong in a trial's files, with its line: times, gaps of a log, markers exchanged."""

from __future__ import annotations

import numpy as np

from cell.files.input_error import Problem
from cell.files.words import counted
from cell.study.clocks import GAP_S, GAP_STEPS, cut_off, gap
from cell.study.data import Markers
from cell.study.exchanged import exchanges
from cell.study.table import Table

#: Beyond this a number is taken for a mistaken unit.
MAX_TRIAL_S = 30.0
#: Angles one after another that differ by a turn, within so much, are one in two counts, rad.
AS_A_TURN_RAD = 0.5


def check_times(table: Table) -> None:
    """Raise InputError unless every row has its time, the last soon after the first."""
    t_s = table.values[:, 0]
    if len(t_s) < 2:
        raise table.error(1, None, f"has {counted(len(t_s), 'row')}, needs at least 2")
    if not np.isfinite(t_s).all():
        row = int(np.argmin(np.isfinite(t_s)))
        raise table.error(table.lines[row], "t_s", f"is {t_s[row]}; every row needs its time")
    step = np.diff(t_s)
    if (step <= 0.0).any():
        row = int(np.argmax(step <= 0.0)) + 1
        word = "repeats" if t_s[row] == t_s[row - 1] else "comes after"
        raise table.error(
            table.lines[row],
            "t_s",
            f"{t_s[row]:g} s {word} {t_s[row - 1]:g} s of the row before; "
            "sort the rows by time and keep one row per time",
        )
    if t_s[-1] - t_s[0] > MAX_TRIAL_S:
        raise table.error(
            table.lines[-1],
            "t_s",
            f"{t_s[-1]:g} s is {t_s[-1] - t_s[0]:g} s after the first row, limit "
            f"{MAX_TRIAL_S:g} s; give seconds, not milliseconds, and cut the record to the motion "
            "and the swing after it",
        )


def check_whole(log: Table) -> None:
    """Raise InputError if a hand moves while nothing is logged, or its angle jumps by a turn."""
    angle_rad = log.values[:, 3]
    jumps = np.abs(np.abs(np.diff(angle_rad)) - 2.0 * np.pi) < AS_A_TURN_RAD
    if jumps.any():
        row = int(np.argmax(jumps)) + 1
        raise log.error(
            log.lines[row],
            "angle_rad",
            f"{angle_rad[row]:.4g} comes after {angle_rad[row - 1]:.4g} of the row before, a whole "
            "turn away; write angles that go on over ±π, within ±2π",
        )
    found = gap(log.values)
    if found is None:
        return
    limit_s = max(GAP_S, GAP_STEPS * found.usual_s)
    raise log.error(
        log.lines[found.row],
        "t_s",
        f"{found.to_s:g} s is {found.to_s - found.from_s:.2g} s after the row before, limit "
        f"{limit_s:.2g} s while the hand moves: {found.moved_m * 1e3:.3g} mm and "
        f"{found.turned_rad:.2g} rad in between, nobody knows how; log the whole motion, or cut "
        "the trial before it or after it",
    )


def check_reaches(log: Table, markers: Markers) -> None:
    """Raise InputError if a hand's log ends or begins in motion, and its cable is seen beyond."""
    seen_s = markers.t_s[np.isfinite(markers.xy_m).any(axis=(1, 2))]
    found = cut_off(log.values, float(seen_s[0]), float(seen_s[-1]))
    if found is not None:
        raise log.error(log.lines[-1 if found.at_end else 0], "t_s", str(found))


def check_finite(table: Table) -> None:
    """Raise InputError where a value is missing."""
    table.check(np.isfinite(table.values), lambda _: "is not a number; the grip is always known")


def exchanged(markers: Markers) -> Problem | None:
    """The first two markers that change places, and until where."""
    found, source = exchanges(markers.xy_m), markers.source
    if not found or source is None:
        return None
    first = found[0]
    names = [source.marker(m) for m in (first.first, first.second)]
    last = markers.line(first.until - 1)
    more = f", as do {len(found) - 1} more pairs in the file" if len(found) > 1 else ""
    return Problem(
        source.file,
        markers.line(first.row),
        None,
        source.column(first.first, 0),
        f"{names[0]} is where {names[1]} was in the row before, and {names[1]} where {names[0]} "
        f"was{more}; exchange the columns of the two in the rows from here to line {last}",
    )
