"""Checks of an imported trial: its log, its markers, its plane.

They precede those of every trial, see `trial_checks`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from cell.study.check import Failure, noted, refused
from cell.study.clocks import GAP_S, GAP_STEPS, CutOff
from cell.study.series import span_m
from cell.study.table import MAX_TRIAL_S
from cell.study.tracks import HELD_ROWS, identical, repeated_rows
from cell.study.trial_checks import TrialEvidence, cable_ahead, cable_waits, exchanged

#: Least motion of a marker on a moving cable, share of the motion of the others.
STAYS = 1e-3
#: Rows in which a distance along the cable may be too long, as a single slip.
MOST_SLIPS = 0.02
#: Limits of the distance out of the plane, share of the length: noted, and refused.
NOTED_ACROSS, REFUSED_ACROSS = 0.02, 0.2
#: The marker next to the gripper: least agreement of its path with the gripper's, largest ratio of
#: their motions, least number of rows.
MOVES_ALIKE, TIMES_FARTHER, FEWEST_ROWS = 0.8, 8.0, 20
#: A hundred times gravity: no gripper's motion, but that of a wrong unit; fewer rows are a slip.
MOST_M_PER_S2, FEWEST_STEPS = 1000.0, 5

_LOG_LIMIT = f"{GAP_S:g} s or {GAP_STEPS:g} usual steps"


@refused(
    "time from the first row to the last, s",
    f"{MAX_TRIAL_S:g}",
    f"is {{lasts_s:.4g}} s after the first row, limit {MAX_TRIAL_S:g} s;",
    "correct time.seconds_per_unit of the mapping, or cut the file to one motion and its swing",
)
def too_long(e: TrialEvidence) -> Failure | None:
    """Is it one motion and its swing?"""
    t_s = e.trial.markers.t_s
    lasts_s = float(t_s[-1] - t_s[0])
    return None if lasts_s <= MAX_TRIAL_S else Failure({"lasts_s": lasts_s}, len(t_s) - 1)


@refused(
    "the gripper's way over the square of its time from a tenth of it to nine tenths, m/s²",
    f"{MOST_M_PER_S2:g}, in {FEWEST_STEPS} rows or more",
    "the gripper moves by {moved_mm:.3g} mm within {within_s:.2g} s, limit "
    f"{MOST_M_PER_S2:g} m/s²;",
    "correct time.seconds_per_unit of the mapping",
)
def too_fast(e: TrialEvidence) -> Failure | None:
    """Can a gripper move so fast?"""
    axis = int(np.argmax(np.ptp(e.poses[:, 1:3], axis=0)))
    t_s, way_m = e.poses[:, 0], np.abs(e.poses[:, 1 + axis] - e.poses[0, 1 + axis])
    moved_m = float(way_m.max())
    end = int(np.argmax(way_m > 0.9 * moved_m))
    begin = int(np.flatnonzero(way_m[: end + 1] <= 0.1 * moved_m)[-1])
    within_s = float(t_s[end] - t_s[begin])
    known = moved_m > e.slack_m and end - begin >= FEWEST_STEPS
    if not known or moved_m < MOST_M_PER_S2 * within_s**2:
        return None
    row = min(int(np.searchsorted(e.trial.markers.t_s, t_s[end])), len(e.trial.markers.t_s) - 1)
    return Failure({"moved_mm": moved_m * 1e3, "within_s": within_s}, row, "hand")


@refused(
    "longest step within which the gripper moves, s",
    _LOG_LIMIT,
    "the gripper is not seen from {from_s:.6g} to {to_s:.6g} s, limit {limit_s:.2g} s while it "
    "moves: {moved_mm:.3g} mm and {turned_rad:.2g} rad in between;",
    "log the whole motion, or cut the trial before it or after it",
)
def log_gap(e: TrialEvidence) -> Failure | None:
    """Is the gripper log complete while the gripper moves?"""
    if e.log_gap is None:
        return None
    row = int(np.searchsorted(e.trial.markers.t_s, e.log_gap.to_s))
    return Failure(e.log_gap.values, min(row, len(e.trial.markers.t_s) - 1), "hand")


@refused(
    "time in which markers are seen after it, s",
    _LOG_LIMIT,
    "the log ends at {log_s:.6g} s, while the gripper moves at {speed:.2g} {unit}/s, yet the "
    "markers are seen until {film_s:.6g} s;",
    "log the gripper until it rests, or cut the frames after the log's end",
)
def log_ends(e: TrialEvidence) -> Failure | None:
    """Does the gripper rest where its log ends?"""
    end = e.log_cut_off
    return None if end is None or not end.at_end else _of_log(e, end)


@refused(
    "time in which markers are seen before it, s",
    _LOG_LIMIT,
    "the log begins at {log_s:.6g} s, while the gripper moves at {speed:.2g} {unit}/s, yet the "
    "markers are seen from {film_s:.6g} s on;",
    "log the gripper from its rest on, or cut the frames before the log's beginning and give "
    "`start: moving`",
)
def log_begins(e: TrialEvidence) -> Failure | None:
    """Does the gripper rest where its log begins?"""
    end = e.log_cut_off
    return None if end is None or end.at_end else _of_log(e, end)


def _of_log(e: TrialEvidence, end: CutOff) -> Failure:
    t_s = e.trial.markers.t_s
    row = int(np.searchsorted(t_s, end.log_s, side="right" if end.at_end else "left"))
    return Failure(end.values, min(row, len(t_s) - 1), "hand")


@refused(
    "rows in which two markers differ",
    "0",
    "{first!r} and {second!r} have the same places in all {rows} rows that show both;",
    "remove one from markers",
)
def same_marker(e: TrialEvidence) -> Failure | None:
    """Is no marker listed twice?"""
    for first, second, both in identical(e.trial.markers.xy_m):
        names = {"first": e.source.names[first], "second": e.source.names[second]}
        return Failure({**names, "rows": np.count_nonzero(both)}, int(np.argmax(both)))
    return None


@refused(
    "span of a marker over the largest of all",
    f"{STAYS:g}, while the gripper moves",
    "{name!r} moves by {moved_mm:.2g} mm in all rows, the gripper by {hand_mm:.3g} mm: it is "
    "not on the cable;",
    "remove it from markers",
)
def not_on_cable(e: TrialEvidence) -> Failure | None:
    """Does every marker move?"""
    xy_m = e.trial.markers.xy_m
    moved_m = np.array([span_m(xy_m[:, m]) for m in range(xy_m.shape[1])])
    hand_m = span_m(e.poses[:, 1:3])
    usual_m = max(hand_m, float(np.nanmax(moved_m)))
    stays = np.flatnonzero((moved_m <= STAYS * usual_m) & (hand_m > 0.1 * usual_m))
    if not len(stays):
        return None
    values = {"moved_mm": moved_m[stays[0]] * 1e3, "hand_mm": hand_m * 1e3}
    return Failure({"name": e.source.names[int(stays[0])], **values}, 0)


@refused(
    "span of the marker next to the hand over that of the gripper",
    f"{TIMES_FARTHER:g} or its inverse, where both move alike",
    "the gripper moves by {hand_m:.3g} m, and {name!r} next to it as it does by {marker_m:.3g} "
    "m: its unit is another one;",
    "correct metres_per_unit of hand in the mapping",
)
def hand_scale(e: TrialEvidence) -> Failure | None:
    """Do gripper and markers have the same unit?"""
    nearest = int(np.argmin(e.arc_length_m))
    marker = e.trial.markers.xy_m[:, nearest]
    detected = np.isfinite(marker).all(axis=1)
    if np.count_nonzero(detected) < FEWEST_ROWS:
        return None
    hand, marker = e.hand_m[detected], marker[detected]
    hand, marker = hand - hand.mean(axis=0), marker - marker.mean(axis=0)
    sizes = float(np.linalg.norm(hand)), float(np.linalg.norm(marker))
    if min(sizes) == 0.0 or float(np.sum(hand * marker)) < MOVES_ALIKE * sizes[0] * sizes[1]:
        return None
    if 1.0 / TIMES_FARTHER < sizes[1] / sizes[0] < TIMES_FARTHER:
        return None
    values = {"hand_m": span_m(hand), "marker_m": span_m(marker)}
    return Failure({"name": e.source.names[nearest], **values}, 0, "hand")


@refused(
    "share of the rows in which they are, by a tenth of the free length",
    f"{MOST_SLIPS:g}",
    "{first!r} and {second!r} are {apart_m:.4g} m apart, with {between_m:.4g} m of cable "
    "between them, limit {limit_m:.4g} m, as in {share:.0%} of the rows: a marker jumps or is "
    "named wrongly;",
    "correct the columns or arc_length_m of the two in the mapping",
)
def longer_than_cable(e: TrialEvidence) -> Failure | None:
    """Are two markers no farther apart than the cable between them is long?"""
    names, worst_share, worst = e.source.names, MOST_SLIPS, None
    for first, second in combinations(range(len(names)), 2):
        apart_m = np.linalg.norm(np.diff(e.trial.markers.xy_m[:, [second, first]], axis=1), axis=2)
        between_m = abs(e.arc_length_m[first] - e.arc_length_m[second])
        limit_m = e.reach.scale * between_m + e.slack_m
        far = np.nan_to_num(apart_m[:, 0]) > limit_m
        share = float(far.sum()) / max(int(np.isfinite(apart_m).sum()), 1)
        if share > worst_share:
            row = int(np.argmax(far))
            values = {"apart_m": apart_m[row, 0], "between_m": between_m, "share": share}
            values |= {"limit_m": limit_m}
            worst_share = share
            worst = Failure({"first": names[first], "second": names[second], **values}, row)
    return worst


@refused(
    "distance of a marker from the plane of all, free lengths",
    f"{REFUSED_ACROSS:g} in {MOST_SLIPS:g} of the rows",
    "the cable is {away_mm:.3g} mm out of the plane, limit {limit_mm:.3g} mm;",
    "correct `axes` in the mapping, or move the gripper within one plane",
)
def out_of_plane(e: TrialEvidence) -> Failure | None:
    """Does the cable move in one plane?"""
    across_m, limit_m = e.across_m, REFUSED_ACROSS * e.cable.length_m
    if across_m is None or not np.isfinite(across_m).any():
        return None
    away_m = np.abs(across_m - np.nanmedian(across_m))
    far = np.nan_to_num(away_m).max(axis=1) > limit_m
    if np.count_nonzero(far) <= MOST_SLIPS * len(far):
        return None
    row = int(np.argmax(far))
    return Failure({"away_mm": np.nanmax(away_m[row]) * 1e3, "limit_mm": limit_m * 1e3}, row)


@noted(
    "rms motion of markers out of the plane, free lengths",
    f"{NOTED_ACROSS:g}",
    "the cable moves {rms_mm:.3g} mm rms out of the plane; the model moves within it",
    "",
)
def wide(e: TrialEvidence) -> Failure | None:
    """Is the motion flat enough for a model in one plane?"""
    if e.across_m is None or not (seen := np.isfinite(e.across_m).any(axis=0)).any():
        return None
    across_m = e.across_m[:, seen]  # a marker may lie beside the plane of the others
    rms_m = float(np.sqrt(np.nanmean((across_m - np.nanmedian(across_m, axis=0)) ** 2)))
    return None if rms_m < NOTED_ACROSS * e.cable.length_m else Failure({"rms_mm": rms_m * 1e3})


@noted(
    "rows that repeat the row before, then jump",
    f"{HELD_ROWS}",
    "{rows} rows from here repeat the row before, then the cable jumps;",
    "empty them if the tracker held what it had lost",
)
def held_rows(e: TrialEvidence) -> Failure | None:
    """Does no tracker repeat the last position of a lost marker?"""
    repeated = repeated_rows(e.trial.markers.xy_m)
    return None if repeated is None else Failure({"rows": repeated[1]}, repeated[0])


#: Remedies for clocks that differ, by entries of a trial in the mapping.
_WAITS = "add this to clock_offset_s of the trial, 0 if it has none"
_AHEAD = "subtract {late_s:.2g} s from clock_offset_s of the trial, 0 if it has none; if the cable "
_AHEAD += "was let go, give `start: held` with release_s: {cable_s:.3g}; if it swings already, "
_AHEAD += "`start: moving`"
#: All failures are reported.
IMPORT_REFUSALS = (too_long, too_fast, log_gap, log_ends, log_begins, same_marker, not_on_cable)
#: Evaluated if none of these fails; only the first failure is reported.
IMPORT_SHAPE = (
    hand_scale,
    replace(cable_waits, remedy=_WAITS),
    replace(cable_ahead, outcome="refused", remedy=_AHEAD),
    exchanged,
    longer_than_cable,
    out_of_plane,
)
IMPORT_NOTES = (wide, held_rows)
