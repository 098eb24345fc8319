"""What is wrong or odd in a file of measurements, with line, value, limit and remedy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.files.input_error import Problem
from cell.study.checks import MAX_TRIAL_S, exchange_problem
from cell.study.clocks import GAP_S, GAP_STEPS, cut_off, gap
from cell.study.data import Source, Study, Trial
from cell.study.imports.capture import Capture
from cell.study.independence import without_copies
from cell.study.left_out import without_outliers
from cell.study.plausible import SLACK

Flags = NDArray[np.bool_]

#: A marker is on no moving cable if it stays within this share of what the others move.
STAYS = 1e-3
#: In so many rows a distance along the cable may be too long before it is no single slip.
MOST_SLIPS = 0.02
#: Out of the plane a cable may be by so much of its length: told, and refused.
TOLD_ACROSS, REFUSED_ACROSS = 0.02, 0.2
#: The marker next to the hand follows it, by how well their paths agree, and moves by no more than
#: so many times as far, in so many rows.
MOVES_ALIKE, TIMES_FARTHER, FEWEST_ROWS = 0.8, 8.0, 20
#: Rows that repeat the one before in all numbers are told from so many in a row on, if the step
#: after them is so many usual ones: a cable at rest, rounded, repeats itself too.
HELD_ROWS, HELD_JUMP = 3, 2.0


@dataclass(frozen=True)
class Measured:
    """A trial, and the file that its markers come from.

    seen      (rows of the file,) rows of frames
    across_m  (T, markers) coordinate across the plane; None = the file has two coordinates
    notes     on how the hand is known, one sentence each
    """

    trial: Trial
    capture: Capture
    detected: Flags
    across_m: FloatArray | None
    notes: tuple[str, ...] = ()

    @property
    def source(self) -> Source:
        """Names and lines of the markers."""
        source = self.trial.markers.source
        assert source is not None
        return source

    def problem(self, row: int, message: str, key: str = "") -> Problem:
        """A complaint about a row of the trial."""
        return self.capture.problem(int(np.flatnonzero(self.detected)[row]), message, key)


def examined(
    measured: Measured, cable: Cable, arc_length_m: FloatArray
) -> tuple[list[Problem], list[str]]:
    """What is refused, and what is told.

    arc_length_m  (markers,) from the gripping point, as in the trial
    """
    problems = [
        problem
        for check in (_too_long, _gripper_gap, _same_values, _stays)
        if (problem := check(measured)) is not None
    ]
    if not problems and (unit := _gripper_unit(measured, arc_length_m)):
        problems.append(unit)
    if not problems and (places := exchange_problem(measured.trial.markers)):
        problems.append(places)
    if not problems and (longer := _longer_than_cable(measured, cable, arc_length_m)):
        problems.append(longer)
    if not problems and (across := _across(measured, cable)):
        problems.append(across)
    if problems:
        return problems, []
    told = [_width_text(measured, cable), _held(measured)]
    return [], [sentence for sentence in told if sentence]


def slips(study: Study) -> list[str]:
    """What is told of single wrong samples, and of trials that are one recording.

    raises  InputError: too many samples are wrong
    """
    before = len(study.notes)
    return list(without_copies(without_outliers(study)).notes[before:])


def _too_long(measured: Measured) -> Problem | None:
    t_s = measured.trial.markers.t_s
    lasts_s = float(t_s[-1] - t_s[0])
    if lasts_s <= MAX_TRIAL_S:
        return None
    return measured.problem(
        len(t_s) - 1,
        f"is {lasts_s:.4g} s after the first row, limit {MAX_TRIAL_S:g} s; correct "
        "time.seconds_per_unit of the mapping, or cut the file to one motion and its swing",
    )


def _gripper_gap(measured: Measured) -> Problem | None:
    """A hand that moves while nothing is known of it."""
    grip = measured.trial.grip
    poses = np.column_stack([grip.t_s, grip.x_m, grip.y_m, grip.angle_rad])
    found = gap(poses)
    if found is None:
        return _markers_beyond_log(measured, poses)
    limit_s = max(GAP_S, GAP_STEPS * found.usual_s)
    row = int(np.searchsorted(measured.trial.markers.t_s, found.to_s))
    return measured.problem(
        min(row, len(measured.trial.markers.t_s) - 1),
        f"the hand is not seen from {found.from_s:.6g} to {found.to_s:.6g} s, limit "
        f"{limit_s:.2g} s while it moves: {found.moved_m * 1e3:.3g} mm and "
        f"{found.turned_rad:.2g} rad in between; "
        "cut the trial before it or after it",
        "hand",
    )


def _markers_beyond_log(measured: Measured, poses: FloatArray) -> Problem | None:
    """A hand that moves where its log ends or begins, and markers that are seen beyond."""
    markers = measured.trial.markers
    rows = np.flatnonzero(np.isfinite(markers.xy_m).any(axis=(1, 2)))
    found = cut_off(poses, float(markers.t_s[rows[0]]), float(markers.t_s[rows[-1]]))
    if found is None:
        return None
    row = int(np.searchsorted(markers.t_s, found.log_s, side="right" if found.at_end else "left"))
    return measured.problem(min(row, len(markers.t_s) - 1), str(found), "hand")


def _same_values(measured: Measured) -> Problem | None:
    """Two markers that are one: the same numbers in all rows."""
    xy_m = measured.trial.markers.xy_m
    for first in range(xy_m.shape[1]):
        for second in range(first + 1, xy_m.shape[1]):
            both = np.isfinite(xy_m[:, [first, second]]).all(axis=(1, 2))
            if np.count_nonzero(both) < HELD_ROWS:
                continue
            if np.array_equal(xy_m[both, first], xy_m[both, second]):
                names = [measured.source.names[m] for m in (first, second)]
                message = f"{names[0]!r} and {names[1]!r} have the same places in all "
                message += f"{np.count_nonzero(both)} rows that show both; remove one from markers"
                return measured.problem(int(np.argmax(both)), message)
    return None


def _stays(measured: Measured) -> Problem | None:
    """A marker that does not move while the others and the hand do: it is on no cable."""
    xy_m, grip = measured.trial.markers.xy_m, measured.trial.grip
    moved_m = np.array([_reach(xy_m[:, m]) for m in range(xy_m.shape[1])])
    hand_m = _reach(np.column_stack([grip.x_m, grip.y_m]))
    usual_m = max(hand_m, float(np.nanmax(moved_m)))
    stays = np.flatnonzero((moved_m <= STAYS * usual_m) & (hand_m > 0.1 * usual_m))
    if not len(stays):
        return None
    name = measured.source.names[int(stays[0])]
    return measured.problem(
        0,
        f"{name!r} moves by {moved_m[stays[0]] * 1e3:.2g} mm in all rows, the hand by "
        f"{hand_m * 1e3:.3g} mm: it is not on the cable; remove it from markers",
    )


def _gripper_unit(measured: Measured, arc_length_m: FloatArray) -> Problem | None:
    """A hand that moves as the marker next to it does, but many times less or more."""
    grip, markers = measured.trial.grip, measured.trial.markers
    nearest = int(np.argmin(arc_length_m))
    seen = np.isfinite(markers.xy_m[:, nearest]).all(axis=1)
    if np.count_nonzero(seen) < FEWEST_ROWS:
        return None
    t_s = markers.t_s[seen]
    hand = np.column_stack([np.interp(t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])
    marker = markers.xy_m[seen, nearest]
    hand, marker = hand - hand.mean(axis=0), marker - marker.mean(axis=0)
    sizes = float(np.linalg.norm(hand)), float(np.linalg.norm(marker))
    if min(sizes) == 0.0 or float(np.sum(hand * marker)) < MOVES_ALIKE * sizes[0] * sizes[1]:
        return None
    times = sizes[1] / sizes[0]
    if 1.0 / TIMES_FARTHER < times < TIMES_FARTHER:
        return None
    reach_m = [_reach(v) for v in (hand, marker)]
    return measured.problem(
        0,
        f"the hand moves by {reach_m[0]:.3g} m, and {measured.source.names[nearest]!r} next to it "
        f"as it does by {reach_m[1]:.3g} m: its unit is another one; correct metres_per_unit of "
        "hand in the mapping",
        "hand",
    )


def _reach(xy_m: FloatArray) -> float:
    """How far apart a point's places are, m; nan where it is not seen."""
    seen = np.isfinite(xy_m).any(axis=0)
    if not seen.any():
        return float("nan")
    span = np.nanmax(xy_m[:, seen], axis=0) - np.nanmin(xy_m[:, seen], axis=0)
    return float(np.linalg.norm(span))


def _longer_than_cable(
    measured: Measured, cable: Cable, arc_length_m: FloatArray
) -> Problem | None:
    """Two markers that are farther apart than the cable between them is long."""
    markers, names = measured.trial.markers, measured.source.names
    slack_m = SLACK * cable.length_m
    worst: tuple[float, int, int, Flags] | None = None
    for first in range(len(names)):
        for second in range(first + 1, len(names)):
            apart_m = np.linalg.norm(markers.xy_m[:, first] - markers.xy_m[:, second], axis=1)
            between_m = abs(arc_length_m[first] - arc_length_m[second])
            far = np.nan_to_num(apart_m) > between_m + slack_m
            seen = int(np.isfinite(apart_m).sum())
            share = float(far.sum()) / max(seen, 1)
            if share > MOST_SLIPS and (worst is None or share > worst[0]):
                worst = share, first, second, far
    if worst is None:
        return None
    share, first, second, far = worst
    row = int(np.argmax(far))
    apart_m = float(np.linalg.norm(markers.xy_m[row, first] - markers.xy_m[row, second]))
    between_m = abs(arc_length_m[first] - arc_length_m[second])
    return measured.problem(
        row,
        f"{names[first]!r} and {names[second]!r} are {apart_m:.4g} m apart, with "
        f"{between_m:.4g} m of cable between them, limit {between_m + slack_m:.4g} m, as in "
        f"{share:.0%} of the rows: a marker jumps or is named wrongly; correct the columns or "
        "arc_length_m of the two in the mapping",
    )


def _across(measured: Measured, cable: Cable) -> Problem | None:
    away_m = _out_of_plane_m(measured)
    if away_m is None:
        return None
    limit_m = REFUSED_ACROSS * cable.length_m
    far = np.nan_to_num(away_m).max(axis=1) > limit_m
    if np.count_nonzero(far) <= MOST_SLIPS * len(far):
        return None
    row = int(np.argmax(far))
    return measured.problem(
        row,
        f"the cable is {np.nanmax(away_m[row]) * 1e3:.3g} mm out of the plane, limit "
        f"{limit_m * 1e3:.3g} mm; correct `axes` in the mapping, or move the hand within one plane",
    )


def _width_text(measured: Measured, cable: Cable) -> str:
    away_m = _out_of_plane_m(measured)
    if away_m is None:
        return ""
    rms_m = float(np.sqrt(np.nanmean(away_m**2)))
    if rms_m < TOLD_ACROSS * cable.length_m:
        return ""
    return (
        f"{measured.capture.path}: the cable is {rms_m * 1e3:.3g} mm rms out of the plane; the "
        "model moves within it"
    )


def _out_of_plane_m(measured: Measured) -> FloatArray | None:
    """(T, markers) distance from the plane of all markers."""
    across_m = measured.across_m
    if across_m is None or not np.isfinite(across_m).any():
        return None
    return np.asarray(np.abs(across_m - np.nanmedian(across_m)))


def _held(measured: Measured) -> str:
    """Rows in which every marker has exactly its last values, and jumps after them."""
    xy_m = measured.trial.markers.xy_m.reshape(len(measured.trial.markers.t_s), -1)
    both = np.isfinite(xy_m[1:]) & np.isfinite(xy_m[:-1])
    steps_m = np.where(both, np.abs(xy_m[1:] - xy_m[:-1]), 0.0).max(axis=1)
    same = (steps_m == 0.0) & both.any(axis=1)
    usual_m = float(np.median(steps_m[~same])) if not same.all() else np.inf
    ends = np.flatnonzero(same[:-1] & (steps_m[1:] > HELD_JUMP * usual_m))
    for end in map(int, ends):
        begin = end
        while begin > 0 and same[begin - 1]:
            begin -= 1
        # A cable that rests until it is moved repeats itself too, but did not move before.
        if end - begin + 1 >= HELD_ROWS and begin > 0 and steps_m[begin - 1] > 0.5 * usual_m:
            where = measured.problem(begin + 1, "").line
            return (
                f"{measured.capture.path}:{where}: {end - begin + 1} rows from here repeat the row "
                "before, then the cable jumps; empty them if the tracker held what it had lost"
            )
    return ""
