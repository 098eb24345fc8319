"""Checks whether a trial is of the cable described: coordinate frame, reach, clock, units.

A model can be fitted to mirrored or reversed markers too, with intervals and all.  A `refused`
check fails for data that no cable and no effect of the library explains: the study is not read.
A `noted` check fails for data of a rare cable or a rare effect: the reader decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, Cable, moves_from_s
from cell.files.input_error import Problem
from cell.study.check import Failure, failures, noted, refused
from cell.study.clocks import (
    AWAY,
    FIRST_MOTION,
    MEDIAN_OF,
    WITHIN,
    WITHIN_S,
    CutOff,
    Gap,
    Offset,
    at_rest,
    cut_off,
    first_motion,
    gap,
    offset,
)
from cell.study.data import Source, Trial
from cell.study.reach import LARGEST_OFFSET, Reach
from cell.study.rest_shape import WEAK_M_PER_S2
from cell.study.series import interpolated, span_m
from cell.study.tracks import FROZEN_ROWS, NEARER, exchanges, frozen

#: Room for noise, a slipping grip and a camera whose scale is off, as a share of the free length.
SLACK = 0.1
#: Steepest clamp for which the side of the cable is defined, rad.
SIDEWAYS_RAD = np.pi / 3
#: Both ends are held if the farthest marker stays within this share of what the gripper, or the
#: cable between, moves: a bead on a thread follows by more, unless it is shaken seven times as fast
#: as it swings.  What moves must do so by a share of the cable, for what hardly moves shows
#: nothing.  The marker must be in the outer half, and detected in this number of rows.
HELD_STAYS, HELD_MOVES, OUTER, HELD_ROWS = 0.02, 0.1, 0.5, 20
#: Of the earth.
GRAVITY_M_PER_S2 = 9.81
#: A cable that hangs swings about like a rod of its length, in 5.1 √(L/g), or as a bead at the end
#: of a thread in 6.3 √(L/g); bending makes it faster.
SLOWEST = 2.0 * np.pi
#: Ratio of the motions of gripper and markers above which their units differ.
OTHER_UNIT = 30.0
#: A lost marker is in the outer part of the cable, and the gripper or another one moves by this
#: share of the free length: a cable that is held at its clamp moves there by 1 % of it.
OUTER_SHARE, MOVES_SHARE = 0.3, 0.1

_CLOCK_LIMIT = f"{WITHIN_S:g} s or {WITHIN:g} √(L/g), and two frames"


@dataclass(frozen=True, eq=False)
class TrialEvidence:
    """A trial, with cable and gravity of its study.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    across_m      (T, markers) coordinate across the plane; None = the file has two coordinates
    """

    trial: Trial
    cable: Cable
    arc_length_m: FloatArray
    gravity_m_per_s2: tuple[float, float]
    across_m: FloatArray | None = None

    @property
    def weight(self) -> float:
        """Size of gravity in the plane, m/s²."""
        return float(np.hypot(*self.gravity_m_per_s2))

    @property
    def slack_m(self) -> float:
        """Tolerance of every place, m."""
        return SLACK * self.cable.length_m

    @cached_property
    def source(self) -> Source:
        """Place of the markers in files, or in files as they would be written."""
        return self.trial.source

    @cached_property
    def poses(self) -> FloatArray:
        """(T, 4) t, x, y, angle of the gripper's log."""
        grip = self.trial.grip
        return np.column_stack([grip.t_s, grip.x_m, grip.y_m, grip.angle_rad])

    @cached_property
    def hand_m(self) -> FloatArray:
        """(T, 2) gripping point at the times of the markers."""
        return self.trial.gripper_m(self.trial.markers.t_s)

    @cached_property
    def from_grip_m(self) -> FloatArray:
        """(T, markers, 2) from the gripping point."""
        return np.asarray(self.trial.markers.xy_m - self.hand_m[:, None], dtype=np.float64)

    @cached_property
    def at_rest(self) -> NDArray[np.bool_]:
        """(T,) frames before the gripper moves, of a cable that is neither held nor swinging."""
        return at_rest(self.trial)

    @cached_property
    def offset(self) -> Offset | None:
        """Start times of gripper and cable, if far apart; else None."""
        return offset(self.trial, self.cable, self.weight)

    @cached_property
    def reach(self) -> Reach:
        """Distances of the markers from the gripping point, and the largest possible."""
        return Reach(self.trial, self.arc_length_m, self.cable.length_m)

    @cached_property
    def is_far(self) -> NDArray[np.bool_]:
        """(T, markers) farther from the gripper than any of this cable can be."""
        return self.reach.distance_m > self.reach.limit_m

    @cached_property
    def log_gap(self) -> Gap | None:
        """The longest gap in the gripper's log within which it moves."""
        return gap(self.poses)

    @cached_property
    def log_cut_off(self) -> CutOff | None:
        """An end of the log in motion, with later markers; none if it has gaps."""
        markers = self.trial.markers
        if self.log_gap is not None:
            return None
        detected_s = markers.t_s[np.isfinite(markers.xy_m).any(axis=(1, 2))]
        return cut_off(self.poses, float(detected_s[0]), float(detected_s[-1]))

    def tip(self, detected: NDArray[np.bool_]) -> int:
        """The marker farthest along the cable among those detected (markers,)."""
        return int(np.argmax(np.where(detected, self.arc_length_m, -1.0)))


@refused(
    "span of the gripper's places over that of markers and cable",
    f"{OTHER_UNIT:g}",
    "the gripper's places are up to {hand_m:.3g} m apart, those of the markers {reach_m:.3g} m;",
    "give metres, not millimetres",
)
def hand_unit(e: TrialEvidence) -> Failure | None:
    """Is the gripper given in metres, as its markers are?"""
    reach_m = _widest_m(e.trial.markers.xy_m[:, e.is_far.any(axis=0)])
    hand_m = _widest_m(e.hand_m)
    if not e.is_far.any() or hand_m <= OTHER_UNIT * max(reach_m, e.cable.length_m):
        return None
    values = {"hand_m": hand_m, "reach_m": reach_m}
    return Failure(values, 0, "x_m, y_m", "grip.csv")


def _widest_m(xy_m: FloatArray) -> float:
    """Largest span of the detected places (…, 2) along either axis."""
    axes = [v[np.isfinite(v)] for v in xy_m.reshape(-1, 2).T]
    return max(float(np.ptp(v)) if v.size else 0.0 for v in axes)


@refused(
    "time from the gripper's first motion to the cable's, s",
    _CLOCK_LIMIT,
    "the cable rests until {cable_s:.3g} s, yet its gripper moves at {hand_s:.3g} s, and no cable "
    "waits so long: the clocks differ by {late_s:.2g} s;",
    "subtract this from t_s of markers.csv",
)
def cable_waits(e: TrialEvidence) -> Failure | None:
    """Does the cable move soon after its gripper?"""
    return None if e.offset is None or e.offset.late_s <= 0.0 else _of_clocks(e, e.offset)


@noted(
    "time from the cable's first motion to the gripper's, s",
    f"{_CLOCK_LIMIT}; refused if a marker is too far from the gripper too",
    "the cable moves at {cable_s:.3g} s, its gripper only at {hand_s:.3g} s; if both are one "
    "motion the clocks differ:",
    "add {late_s:.2g} s to t_s of markers.csv; if the cable was let go, give `start: held` with "
    "release_s: {cable_s:.3g} in study.yaml",
)
def cable_ahead(e: TrialEvidence) -> Failure | None:
    """Does the cable rest until its gripper moves?"""
    return None if e.offset is None or e.offset.late_s > 0.0 else _of_clocks(e, e.offset)


def _cable_ahead_and_far(e: TrialEvidence) -> Failure | None:
    """The same for a cable out of the gripper's reach."""
    return cable_ahead.failure(e) if e.is_far.any() else None


def _cable_ahead_and_too_far(e: TrialEvidence) -> Failure | None:
    """The same for a cable farther from the gripper than its length."""
    return None if _beyond(e, e.reach.limits_m) is None else cable_ahead.failure(e)


def _of_clocks(e: TrialEvidence, apart: Offset) -> Failure:
    row = int(np.searchsorted(e.trial.markers.t_s, apart.cable_s))
    values = {"cable_s": apart.cable_s, "hand_s": apart.hand_s, "late_s": abs(apart.late_s)}
    return Failure(values, row, "t_s")


@refused(
    "largest distance of a marker from the gripping point, free lengths",
    f"{LARGEST_OFFSET:g} beyond the scale between markers, at most that of an effect",
    "{x_m:g} lies more than {limit_m:.4g} m ({limit:.3g} free lengths) from the gripping point;",
    "give metres, in the frame of grip.csv",
)
def out_of_reach(e: TrialEvidence) -> Failure | None:
    """Is every marker within the gripper's reach?"""
    if not e.is_far.any():
        return None
    row = int(np.argmax(e.is_far.any(axis=1)))
    marker = int(min(np.flatnonzero(e.is_far[row]), key=lambda m: int(e.source.numbers[m])))
    limit_m = e.reach.limit_m
    values = {"x_m": e.trial.markers.xy_m[row, marker, 0], "limit_m": limit_m}
    values["limit"] = limit_m / e.cable.length_m
    return Failure(values, row, e.source.column(marker, 0))


@refused(
    "distance to its own place over that to another's",
    f"{NEARER:g}, for both of two markers",
    "{first} is where {second} was in the row before, and {second} where {first} was{more};",
    "exchange the columns of the two in the rows from here to line {last}",
)
def exchanged(e: TrialEvidence) -> Failure | None:
    """Does every marker stay in its own columns?"""
    pairs = exchanges(e.trial.markers.xy_m)
    if not pairs:
        return None
    first = pairs[0]
    more = f", as do {len(pairs) - 1} more pairs in the file" if len(pairs) > 1 else ""
    values = {
        "first": e.source.marker(first.first),
        "second": e.source.marker(first.second),
        "more": more,
        "last": e.trial.markers.line(first.until - 1),
    }
    return Failure(values, first.row, e.source.column(first.first, 0))


@refused(
    "span of the outermost marker over that of what moves",
    f"{HELD_STAYS:g}",
    "the marker at arc length {arc_m:g} m stays within {tip_mm:.2g} mm while {what} by "
    "{most_mm:.3g} mm: both ends of this cable are held, and only a cable with a free tip can be "
    "modelled;",
    "let the tip go",
)
def both_ends_held(e: TrialEvidence) -> Failure | None:
    """Is the tip free?"""
    trial, length_m = e.trial, e.cable.length_m
    t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
    visible = np.array([np.isfinite(_spread_m(xy_m[:, m])) for m in range(xy_m.shape[1])])
    if not visible.any():
        return None
    tip = e.tip(visible)
    axes = np.isfinite(xy_m[:, tip]).any(axis=0)  # those in which the tip is visible
    # a free tip follows within a quarter of a swing: motions before that must show in a frame
    follows_s = 0.25 * SLOWEST * np.sqrt(length_m / GRAVITY_M_PER_S2)
    shown_s = t_s[np.isfinite(xy_m[:, tip][:, axes]).all(axis=1)] - follows_s
    shown_s = shown_s[shown_s >= t_s[0]]
    hand_m = _spread_m(trial.gripper_m(shown_s)[:, axes])
    others = np.delete(xy_m[..., axes], tip, axis=1).swapaxes(0, 1)
    inner = [_spread_m(interpolated(shown_s, t_s, other_m)) for other_m in others]
    inner_m = float(np.max(np.nan_to_num(inner), initial=0.0))
    tip_m = _spread_m(xy_m[:, tip, axes])
    most_m = max(np.nan_to_num(hand_m), inner_m)
    if e.arc_length_m[tip] < OUTER * length_m or most_m < HELD_MOVES * length_m:
        return None
    if tip_m > HELD_STAYS * most_m:
        return None
    mover = "the gripper moves" if hand_m >= inner_m else "the cable between moves"
    values = {"what": mover, "tip_mm": tip_m * 1e3, "most_mm": most_m * 1e3}
    return Failure({"arc_m": e.arc_length_m[tip], **values}, 0)


def _spread_m(xy_m: FloatArray) -> float:
    """Span of the middle 90 % of a point's places; nan where too few rows show it."""
    good = xy_m[:, np.isfinite(xy_m).any(axis=0)]
    if not good.size or np.isfinite(good).all(axis=1).sum() < HELD_ROWS:
        return float("nan")
    return span_m(xy_m, 0.05)


@refused(
    "rows in which it stays",
    f"{FROZEN_ROWS}, while another moves by {MOVES_SHARE:g} free lengths",
    "the marker at arc length {arc_m:g} m stays at ({x_m:g}, {y_m:g}) m up to line {last}, while "
    "the cable moves by {moved_mm:.3g} mm: it was lost;",
    "leave its values empty there",
)
def frozen_marker(e: TrialEvidence) -> Failure | None:
    """Does no marker stay exactly in place while the cable moves?"""
    markers, length_m = e.trial.markers, e.cable.length_m
    outer = np.flatnonzero(e.arc_length_m >= OUTER_SHARE * length_m)
    stays = frozen(markers.xy_m, e.reach.delayed_m, outer, MOVES_SHARE * length_m)
    if stays is None:
        return None
    x_m, y_m = markers.xy_m[stays.first, stays.marker]
    values = {"arc_m": e.arc_length_m[stays.marker], "x_m": x_m, "y_m": y_m}
    values |= {"last": markers.line(stays.last), "moved_mm": stays.moved_m * 1e3}
    return Failure(values, stays.first)


_BEYOND_ARC = "median distance of a marker from the gripper beyond its arc length, free lengths"
_AWAY = "the marker at arc length {arc_m:g} m is {away_m:.3g} m from the gripping point, "


@refused(
    _BEYOND_ARC,
    f"{SLACK:g} beyond the scale between markers, but not if counted from the other end",
    f"{_AWAY}farther than any cable lets it;",
    "the markers fit when counted from the other end: turn markers.arc_length_m round",
)
def reversed_arcs(e: TrialEvidence) -> Failure | None:
    """Are arc lengths counted from the gripping point?"""
    distance_m, scale = e.reach.usual_m, e.reach.scale
    detected = np.isfinite(distance_m)
    distance_m, arcs = distance_m[detected], e.arc_length_m[detected]
    # With an effect, the apparent distance still grows along the cable.
    if len(arcs) < 2 or distance_m[np.argmax(arcs)] >= distance_m[np.argmin(arcs)]:
        return None
    # A scale moves the clamp, too, about a centre half a free length away.
    clamp_m = e.slack_m + 0.5 * (scale - 1.0) * e.cable.length_m
    listed_m = np.sort(arcs)[::-1][np.argsort(np.argsort(arcs))]
    turned = any(
        np.all(distance_m <= scale * turned_m + clamp_m)
        for turned_m in (e.cable.length_m - arcs, listed_m)
    )
    return _beyond(e, scale * e.arc_length_m + e.slack_m) if turned else None


@refused(
    _BEYOND_ARC,
    f"{LARGEST_OFFSET:g} beyond the scale between markers, at most that of an effect",
    f"{_AWAY}farther than any cable lets it, even if the camera's scale or angle is off;",
    "check arc_length_m, the metres of both files, and that both have the same frame",
)
def too_far(e: TrialEvidence) -> Failure | None:
    """Is no marker farther from the gripper than its arc length and an effect let it?"""
    return _beyond(e, e.reach.limits_m)


@noted(
    _BEYOND_ARC,
    f"{SLACK:g}",
    f"{_AWAY}farther than any cable lets it; camera_scale, camera_roll or grip_slip may show it "
    "so, as may a free length that is too short;",
    "check arc_length_m, free_length_m, the metres of both files, and that both have the same "
    "frame",
)
def beyond_arc(e: TrialEvidence) -> Failure | None:
    """Is no marker farther from the gripper than its arc length?"""
    return _beyond(e, e.arc_length_m + e.slack_m)


def _beyond(e: TrialEvidence, limits_m: FloatArray) -> Failure | None:
    """The marker that exceeds its limit (markers,) most, if any."""
    farthest = e.reach.beyond(limits_m)
    if farthest is None:
        return None
    marker, row = farthest
    away_m = np.nanmedian(np.linalg.norm(e.from_grip_m[:, marker], axis=1))
    return Failure({"arc_m": e.arc_length_m[marker], "away_m": away_m}, row)


@refused(
    "place of a resting marker behind the clamp, free lengths",
    f"{SLACK:g}, if the outermost marker is farther behind it than the innermost",
    "at rest the marker at arc length {arc_m:g} m is {beyond_m:.3g} m {side} of the gripping "
    "point; with angle_rad = {angle_rad:g} the cable leaves it to the other side:",
    "change the sign of x_m in both files, or give the clamp angle as π − angle",
)
def wrong_side(e: TrialEvidence) -> Failure | None:
    """Does the cable leave the clamp on the side that the clamp angle states?"""
    angle_rad = e.trial.grip.angle_rad[0]
    cosine = float(np.cos(angle_rad))
    at_rest = e.from_grip_m[e.at_rest]
    detected = np.isfinite(at_rest[:, :, 0]).any(axis=0)
    detected &= np.isfinite(e.trial.markers.xy_m).all(axis=2).any(axis=0)
    if not detected.any() or abs(cosine) < np.cos(SIDEWAYS_RAD):
        return None
    arcs, beyond_m = e.arc_length_m[detected], np.nanmedian(at_rest[:, detected, 0], axis=0)
    beyond_m = beyond_m * np.sign(cosine)
    worst = int(np.argmax(beyond_m))
    # An offset of the picture moves all markers; the tip of a correct cable is still the farthest
    # on its side.
    goes = len(arcs) == 1 or beyond_m[np.argmax(arcs)] > beyond_m[np.argmin(arcs)]
    if beyond_m[worst] <= e.slack_m or not goes:
        return None
    side = "right" if cosine > 0.0 else "left"
    values = {"arc_m": arcs[worst], "beyond_m": beyond_m[worst], "side": side}
    return Failure({**values, "angle_rad": angle_rad}, 0)


@refused(
    "usual step of time over the period 2π √(L/g)",
    "0.5",
    "frames are {step_s:.3g} s apart, yet a cable of {length_m:g} m swings to and fro within "
    "{slowest_s:.2g} s;",
    "give t_s in seconds, with several frames per swing",
)
def frame_rate(e: TrialEvidence) -> Failure | None:
    """Are there enough frames to show the slowest swing?"""
    detected = np.isfinite(e.trial.markers.xy_m).all(axis=2).any()
    if e.weight < WEAK_M_PER_S2 or not detected:
        return None
    slowest_s = SLOWEST * np.sqrt(e.cable.length_m / e.weight)
    step_s = float(np.median(np.diff(e.trial.markers.t_s)))
    values = {"step_s": step_s, "length_m": e.cable.length_m, "slowest_s": slowest_s}
    return None if step_s <= 0.5 * slowest_s else Failure(values, 0)


@noted(
    "height of the tip above the clamp's direction, free lengths",
    f"{SLACK:g}",
    "at rest the cable rises {lift_mm:.3g} mm above the clamp's direction, against gravity;",
    "unless it is naturally curved, check the signs of y_m (up), angle_rad (positive = pointing "
    "down) and gravity_m_per_s2",
)
def rises(e: TrialEvidence) -> Failure | None:
    """Does the cable droop at rest?"""
    angle = e.trial.grip.angle_rad[0]
    steep = abs(np.cos(angle)) < np.cos(SIDEWAYS_RAD)
    if not e.at_rest.any() or e.weight < WEAK_M_PER_S2 or steep:
        return None
    along = -e.arc_length_m[:, None] * np.array([np.cos(angle), np.sin(angle)])
    down = np.array(e.gravity_m_per_s2) / e.weight
    sag_m = (e.from_grip_m[e.at_rest] - along) @ down
    detected = np.isfinite(sag_m).any(axis=0)
    if not detected.any():
        return None
    lift_m = -float(np.nanmedian(sag_m[:, e.tip(detected)]))
    return None if lift_m <= e.slack_m else Failure({"lift_mm": lift_m * 1e3})


@noted(
    "way of a marker before the gripper moves, free lengths",
    f"{FIRST_MOTION:g}",
    "before the gripper moves the cable does, by {reach_mm:.3g} mm, yet it is said to begin in "
    "equilibrium;",
    "give {meant} in study.yaml",
)
def moves_first(e: TrialEvidence) -> Failure | None:
    """Is a cable that begins in equilibrium at rest?"""
    motion = first_motion(e.trial, e.cable)
    if motion is None:
        return None
    meant = "`start: moving`"
    if not motion.from_first:
        let_go_s = e.trial.markers.t_s[e.at_rest][motion.row + MEDIAN_OF // 2]
        meant = f"`start: held` with release_s: {let_go_s:.3g}"
    return Failure({"reach_mm": motion.reach_m * 1e3, "meant": meant})


@noted(
    "way of the gripper in a trial with a release, free lengths",
    f"{AWAY:g}",
    "the cable is said to be let go at {release_s:.3g} s, yet its gripper moves by {moved_mm:.3g} "
    "mm from {hand_s:.3g} s on;",
    "if this motion begins the swing, give `start: equilibrium` without release_s; else check both "
    "clocks",
)
def moves_when_let_go(e: TrialEvidence) -> Failure | None:
    """Does the gripper stay where a cable is let go?"""
    moved_m, release_s = span_m(e.poses[:, 1:3]), e.trial.release_s
    if release_s is None or moved_m < AWAY * e.cable.length_m:
        return None
    hand_s = moves_from_s(e.trial.grip, ROUGHLY_STILL)
    return Failure({"release_s": release_s, "hand_s": hand_s, "moved_mm": moved_m * 1e3})


#: Checks of every trial; only the first failure is reported.
TRIAL_REFUSALS = (
    hand_unit,
    cable_waits,
    replace(cable_ahead, failure=_cable_ahead_and_far),
    out_of_reach,
    exchanged,
    both_ends_held,
    frozen_marker,
    replace(cable_ahead, failure=_cable_ahead_and_too_far),
    reversed_arcs,
    too_far,
    wrong_side,
    frame_rate,
)
TRIAL_NOTES = (beyond_arc, rises, cable_ahead, moves_first, moves_when_let_go)


def trial_problems(
    trial: Trial, cable: Cable, arc_length_m: FloatArray, gravity_m_per_s2: tuple[float, float]
) -> tuple[list[Problem], list[str]]:
    """Problems for which a trial is refused, and notes on unusual but possible data.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    """
    evidence = TrialEvidence(trial, cable, arc_length_m, gravity_m_per_s2)
    file, line = evidence.source.file, trial.markers.line
    for failure, sentence in failures(TRIAL_REFUSALS, evidence):
        table, row = failure.table, failure.row or 0
        place = (file.with_name(table), 2) if table else (file, line(row))
        return [Problem(*place, None, failure.column, sentence)], []
    for failure, sentence in failures(TRIAL_NOTES, evidence):
        where = "" if failure.row is None else f"line {line(failure.row)}: "
        return [], [f"{file}: {where}{sentence}"]
    return [], []
