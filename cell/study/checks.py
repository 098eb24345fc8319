"""What is wrong or odd in a trial, with its line: times, gaps, markers exchanged, out of reach."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.files.input_error import Problem
from cell.files.words import counted
from cell.study.clocks import GAP_S, GAP_STEPS, cut_off, gap
from cell.study.data import Markers, Source, Trial
from cell.study.plausible import clocks_differ, doubt, impossible
from cell.study.table import Table

#: Two have changed places if each is nearer to where the other was, or was going, than to its own
#: by this factor, and if they were farther apart than this many times what they usually move beside
#: one another within a row, noise included.
NEARER, APART = 4.0, 4.0
#: Pairs that are compared at once.
_AT_ONCE = 100_000


@dataclass(frozen=True)
class Exchange:
    """Two markers that are exchanged from a row on, until another or the end (exclusive)."""

    first: int
    second: int
    row: int
    until: int


def exchanges(xy_m: FloatArray) -> list[Exchange]:
    """Markers of a trial that change places, in the order of rows.

    A marker is compared with where it was seen last, and with where it was going.

    xy_m  (T, markers, 2), nan = not seen
    """
    there = _last_detected(xy_m)
    events: dict[tuple[int, int], list[int]] = {}
    for row in _exchange_candidates(there):
        before, goes_on = there[row - 1], 2.0 * there[row - 1] - there[max(row - 2, 0)]
        for pair in {*_changed(before, there[row]), *_changed(goes_on, there[row])}:
            if _are_distinguishable(there, *pair):
                events.setdefault(pair, []).append(row)
                there[row:, pair] = there[row:, pair[::-1]]
    found = []
    for (first, second), rows in events.items():
        ends = [*rows[1::2], len(there)]
        found += [Exchange(first, second, a, b) for a, b in zip(rows[::2], ends, strict=False)]
    return sorted(found, key=lambda e: e.row)


def _last_detected(xy_m: FloatArray) -> FloatArray:
    """(T, markers, 2) where each was seen last; nan before it is seen at all."""
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(xy_m).all(axis=2))
    rows = np.arange(len(xy_m))[:, None]
    last = np.maximum.accumulate(np.where(seen, rows, 0), axis=0)
    return np.array(xy_m[last, np.arange(xy_m.shape[1])])


def _exchange_candidates(there: FloatArray) -> list[int]:
    """Rows in which any two may have changed places."""
    goes_on = 2.0 * there[:-1] - np.concatenate([there[:1], there[:-2]])
    found: list[int] = []
    together = max(1, _AT_ONCE // there.shape[1] ** 2)
    for first in range(0, len(goes_on), together):
        some = slice(first, first + together)
        now_m = there[1:][some]
        any_of = [_both_nearer(b[some], now_m).any(axis=(1, 2)) for b in (there[:-1], goes_on)]
        found += (np.flatnonzero(any_of[0] | any_of[1]) + first + 1).tolist()
    return found


def _changed(before_m: FloatArray, now_m: FloatArray) -> list[tuple[int, int]]:
    """Pairs of markers (markers, 2) that have changed places."""
    both = _both_nearer(before_m[None], now_m[None])[0]
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(both, 1))]


def _both_nearer(before_m: FloatArray, now_m: FloatArray) -> NDArray[np.bool_]:
    """(rows, markers, markers) which of two, (rows, markers, 2), are where the other was."""
    moved_m = np.linalg.norm(now_m[:, None] - before_m[:, :, None], axis=3)  # (from, to)
    own_m = np.diagonal(moved_m, axis1=1, axis2=2)
    nearer = NEARER * moved_m < own_m[:, :, None]
    return np.asarray(nearer & nearer.swapaxes(1, 2))


def _are_distinguishable(there: FloatArray, first: int, second: int) -> bool:
    """Whether two markers are told apart by more than they move beside one another."""
    between = there[:, first] - there[:, second]
    usual_m = np.nanmedian(np.linalg.norm(np.diff(between, axis=0), axis=1))
    return bool(np.nanmedian(np.linalg.norm(between, axis=1)) > APART * usual_m)


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


def check_continuous(log: Table) -> None:
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


def check_covers(log: Table, markers: Markers) -> None:
    """Raise InputError if a hand's log ends or begins in motion, and its cable is seen beyond."""
    seen_s = markers.t_s[np.isfinite(markers.xy_m).any(axis=(1, 2))]
    found = cut_off(log.values, float(seen_s[0]), float(seen_s[-1]))
    if found is not None:
        raise log.error(log.lines[-1 if found.at_end else 0], "t_s", str(found))


def check_finite(table: Table) -> None:
    """Raise InputError where a value is missing."""
    table.check(np.isfinite(table.values), lambda _: "is not a number; the grip is always known")


def exchange_problem(markers: Markers) -> Problem | None:
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


#: A marker cannot be farther from the hand than the cable is long; half as far again leaves
#: room for noise, a slipping grip and a clock that is off, and none for millimetres.
FARTHEST = 1.5
#: A hand that moves so many times as far as its markers is given in another unit.
OTHER_UNIT = 30.0


def trial_problems(
    trial: Trial,
    cable: Cable,
    arc_length_m: FloatArray,
    gravity_m_per_s2: tuple[float, float],
) -> tuple[list[Problem], list[str]]:
    """What of a trial is refused, and what is odd and yet possible, each with its line.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    """
    source = _source(trial)
    if far := _out_of_reach(trial, cable, gravity_m_per_s2, source):
        return [far], []
    if places := exchange_problem(trial.markers):
        return [places], []
    looked_at = (trial, cable, arc_length_m, gravity_m_per_s2)
    if found := impossible(*looked_at):
        return [Problem(source.file, trial.markers.line(found.row), None, "", found.cause)], []
    odd = doubt(*looked_at)
    return [], [] if odd is None else [f"{source.file}: {odd}"]


def _source(trial: Trial) -> Source:
    """Where a trial's markers stand, or would as written."""
    frames, markers = trial.markers.xy_m.shape[:2]
    file = Path(trial.name) / "markers.csv"
    return trial.markers.source or Source(file, np.arange(frames) + 2, np.arange(markers))


def _out_of_reach(
    trial: Trial, cable: Cable, gravity_m_per_s2: tuple[float, float], source: Source
) -> Problem | None:
    """That a marker is farther from the hand than any of this cable can be."""
    grip, markers = trial.grip, trial.markers
    at_m = np.column_stack([np.interp(markers.t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])
    # A coordinate that was not seen adds nothing: what is left is the least that it can be.
    away_m = np.nan_to_num(markers.xy_m - at_m[:, None])
    far = np.hypot(away_m[..., 0], away_m[..., 1]) > FARTHEST * cable.length_m
    if not far.any():
        return None
    reach_m, hand_m = _reach_m(markers.xy_m[:, far.any(axis=0)]), _reach_m(at_m)
    if hand_m > OTHER_UNIT * max(reach_m, cable.length_m):
        file = source.file.with_name("grip.csv")
        message = (
            f"the hand's places are up to {hand_m:.3g} m apart, those of the markers "
            f"{reach_m:.3g} m; give metres, not millimetres"
        )
        return Problem(file, 2, None, "x_m, y_m", message)
    shifted = clocks_differ(trial, cable, gravity_m_per_s2)
    if shifted is not None:
        line = int(source.lines[shifted.row])
        return Problem(source.file, line, None, "t_s", shifted.cause)
    row = int(np.argmax(far.any(axis=1)))
    marker = min(np.flatnonzero(far[row]), key=lambda m: int(source.numbers[m]))
    return Problem(
        source.file,
        int(source.lines[row]),
        None,
        source.column(int(marker), 0),
        f"{markers.xy_m[row, marker, 0]:g} lies more than {FARTHEST * cable.length_m:g} m "
        f"({FARTHEST:g} free lengths) from the gripping point; "
        "give metres, in the frame of grip.csv",
    )


def _reach_m(xy_m: FloatArray) -> float:
    """How far apart places (…, 2) are along either axis, what was seen of them."""
    axes = [v[np.isfinite(v)] for v in xy_m.reshape(-1, 2).T]
    return max(float(np.ptp(v)) if v.size else 0.0 for v in axes)
