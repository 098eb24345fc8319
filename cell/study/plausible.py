"""Statistics of a trial that show whether it is of the cable described: frame, reach, clock, units.

A model can be fitted to mirrored or reversed markers too, with intervals and all.  Each function
returns the numbers of a check that fails, None if all is well; `cell.study.checks` has the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, Cable, moves_from_s
from cell.study.check import Failure
from cell.study.clocks import CutOff, Gap, Offset, cut_off, gap, offset
from cell.study.data import Source, Trial
from cell.study.rest_shape import WEAK_M_PER_S2
from cell.study.series import span_m
from cell.study.table import MAX_TRIAL_S
from cell.study.tracks import exchanges, frozen, identical, repeated_rows

#: Room for noise, a slipping grip and a camera whose scale is off, as a share of the free length.
SLACK = 0.1
#: Of a clamp steeper than this nobody can say to which side the cable leaves it, rad.
SIDEWAYS_RAD = np.pi / 3
#: A cable at rest does not move by this share of its free length while its gripper is still, and no
#: noise that a study may have does so in medians of so many frames.
MOVES = 0.05
MEDIAN_OF = 5
FEWEST_STILL = 10
#: Both ends are held if the farthest marker stays within this share of what the gripper, or the
#: cable between, moves: a bead on a thread follows by more, unless it is shaken seven times as fast
#: as it swings.  What moves must do so by a share of the cable, for what hardly moves shows
#: nothing.  The marker must be in the outer half, and seen in so many rows.
HELD_STAYS, HELD_MOVES, OUTER, HELD_ROWS = 0.02, 0.1, 0.5, 20
#: Of the earth.
GRAVITY_M_PER_S2 = 9.81
#: A cable that hangs swings about like a rod of its length, in 5.1 √(L/g), or as a bead at the end
#: of a thread in 6.3 √(L/g); bending makes it faster.
SLOWEST = 2.0 * np.pi
#: A marker cannot be farther from the gripper than the cable is long; half as far again leaves
#: room for noise, a slipping grip and a clock that is off, and none for millimetres.
FARTHEST = 1.5
#: A gripper that moves so many times as far as its markers is given in another unit.
OTHER_UNIT = 30.0
#: A lost marker is in the outer part of the cable, and the gripper or another one moves by this
#: share of the free length: a cable that is held at its clamp moves there by 1 % of it.
OUTER_SHARE, MOVES_SHARE = 0.3, 0.1
#: A marker is on no moving cable if it stays within this share of what the others move.
STAYS = 1e-3
#: In so many rows a distance along the cable may be too long before it is no single slip.
MOST_SLIPS = 0.02
#: Out of the plane a cable may be by so much of its length: noted, and refused.
NOTED_ACROSS, REFUSED_ACROSS = 0.02, 0.2
#: The marker next to the gripper follows it, by how well their paths agree, and moves by no more
#: than so many times as far, in so many rows.
MOVES_ALIKE, TIMES_FARTHER, FEWEST_ROWS = 0.8, 8.0, 20


@dataclass(frozen=True, eq=False)
class TrialEvidence:
    """A trial, and what its study says of cable and gravity.

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
        """Room for what may be off in every place."""
        return SLACK * self.cable.length_m

    @cached_property
    def source(self) -> Source:
        """Where the markers stand, or would as written."""
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
        """(T,) frames before the gripper moves, of a cable that nothing else holds or swings."""
        return _at_rest(self.trial)

    @cached_property
    def offset(self) -> Offset | None:
        """That gripper and cable begin to move far apart in time."""
        return offset(self.trial, self.cable, self.weight)

    @cached_property
    def is_far(self) -> NDArray[np.bool_]:
        """(T, markers) farther from the gripper than any of this cable can be."""
        # A coordinate that was not seen adds nothing: what is left is the least that it can be.
        away_m = np.nan_to_num(self.from_grip_m)
        return np.hypot(away_m[..., 0], away_m[..., 1]) > FARTHEST * self.cable.length_m

    @cached_property
    def log_gap(self) -> Gap | None:
        """The longest gap in the gripper's log within which it moves."""
        return gap(self.poses)

    @cached_property
    def log_cut_off(self) -> CutOff | None:
        """An end of the log in motion, while markers are seen beyond; none if it has gaps."""
        markers = self.trial.markers
        if self.log_gap is not None:
            return None
        seen_s = markers.t_s[np.isfinite(markers.xy_m).any(axis=(1, 2))]
        return cut_off(self.poses, float(seen_s[0]), float(seen_s[-1]))

    def tip(self, seen: NDArray[np.bool_]) -> int:
        """The marker farthest along the cable among those seen (markers,)."""
        return int(np.argmax(np.where(seen, self.arc_length_m, -1.0)))


def hand_unit(e: TrialEvidence) -> Failure | None:
    """A gripper whose places span far more than the markers and the cable do."""
    reach_m = _widest_m(e.trial.markers.xy_m[:, e.is_far.any(axis=0)])
    hand_m = _widest_m(e.hand_m)
    if not e.is_far.any() or hand_m <= OTHER_UNIT * max(reach_m, e.cable.length_m):
        return None
    values = {"hand_m": hand_m, "reach_m": reach_m}
    return Failure(values, 0, "x_m, y_m", "grip.csv")


def _widest_m(xy_m: FloatArray) -> float:
    """How far apart places (…, 2) are along either axis, what was seen of them."""
    axes = [v[np.isfinite(v)] for v in xy_m.reshape(-1, 2).T]
    return max(float(np.ptp(v)) if v.size else 0.0 for v in axes)


def cable_waits(e: TrialEvidence) -> Failure | None:
    """A cable that stays at rest long after its gripper has moved."""
    return None if e.offset is None or e.offset.late_s <= 0.0 else _of_clocks(e, e.offset)


def cable_ahead(e: TrialEvidence) -> Failure | None:
    """A cable at rest that moves long before its gripper does."""
    return None if e.offset is None or e.offset.late_s > 0.0 else _of_clocks(e, e.offset)


def cable_ahead_and_far(e: TrialEvidence) -> Failure | None:
    """The same of one that is out of the gripper's reach."""
    return cable_ahead(e) if e.is_far.any() else None


def cable_ahead_and_too_far(e: TrialEvidence) -> Failure | None:
    """The same of one that is farther from the gripper than its length."""
    return None if reversed_arcs(e) is None and too_far(e) is None else cable_ahead(e)


def _of_clocks(e: TrialEvidence, found: Offset) -> Failure:
    row = int(np.searchsorted(e.trial.markers.t_s, found.cable_s))
    late_s = abs(found.late_s)
    values = {"cable_s": found.cable_s, "hand_s": found.hand_s, "late_s": late_s}
    return Failure(values, row, "t_s")


def out_of_reach(e: TrialEvidence) -> Failure | None:
    """The first marker that is farther from the gripper than any of this cable can be."""
    if not e.is_far.any():
        return None
    row = int(np.argmax(e.is_far.any(axis=1)))
    marker = int(min(np.flatnonzero(e.is_far[row]), key=lambda m: int(e.source.numbers[m])))
    values = {"x_m": e.trial.markers.xy_m[row, marker, 0], "limit_m": FARTHEST * e.cable.length_m}
    return Failure(values, row, e.source.column(marker, 0))


def exchanged(e: TrialEvidence) -> Failure | None:
    """The first two markers that change places, and until where."""
    found = exchanges(e.trial.markers.xy_m)
    if not found:
        return None
    first = found[0]
    more = f", as do {len(found) - 1} more pairs in the file" if len(found) > 1 else ""
    values = {
        "first": e.source.marker(first.first),
        "second": e.source.marker(first.second),
        "more": more,
        "last": e.trial.markers.line(first.until - 1),
    }
    return Failure(values, first.row, e.source.column(first.first, 0))


def both_ends_held(e: TrialEvidence) -> Failure | None:
    """The marker farthest from the gripper stays in place while gripper or cable move."""
    trial, length_m = e.trial, e.cable.length_m
    t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
    seen = np.array([np.isfinite(_spread_m(xy_m[:, m])) for m in range(xy_m.shape[1])])
    if not seen.any():
        return None
    tip = e.tip(seen)
    axes = np.isfinite(xy_m[:, tip]).any(axis=0)  # those in which the tip is not seen say nothing
    # a free tip follows within a quarter of a swing: a frame tells of what moves before that
    follows_s = 0.25 * SLOWEST * np.sqrt(length_m / GRAVITY_M_PER_S2)
    told_s = t_s[np.isfinite(xy_m[:, tip][:, axes]).all(axis=1)] - follows_s
    told_s = told_s[told_s >= t_s[0]]
    hand_m = _spread_m(trial.gripper_m(told_s)[:, axes])
    others = [_at(told_s, t_s, xy_m[:, m, axes]) for m in range(xy_m.shape[1]) if m != tip]
    inner_m = float(np.max(np.nan_to_num([_spread_m(other) for other in others]), initial=0.0))
    tip_m = _spread_m(xy_m[:, tip, axes])
    most_m = max(np.nan_to_num(hand_m), inner_m)
    if e.arc_length_m[tip] < OUTER * length_m or most_m < HELD_MOVES * length_m:
        return None
    if tip_m > HELD_STAYS * most_m:
        return None
    what = "the gripper moves" if hand_m >= inner_m else "the cable between moves"
    values = {"what": what, "tip_mm": tip_m * 1e3, "most_mm": most_m * 1e3}
    return Failure({"arc_m": e.arc_length_m[tip], **values}, 0)


def _at(at_s: FloatArray, t_s: FloatArray, places_m: FloatArray) -> FloatArray:
    """(at, axes) a point's places at other times, between those at which it was seen."""
    found = np.full((len(at_s), places_m.shape[1]), np.nan)
    for axis, series_m in enumerate(places_m.T):
        seen = np.isfinite(series_m)
        if seen.any():
            found[:, axis] = np.interp(at_s, t_s[seen], series_m[seen])
    return found


def _spread_m(xy_m: FloatArray) -> float:
    """How far apart the middle 90 % of a point's places are; nan where too few rows show it."""
    good = xy_m[:, np.isfinite(xy_m).any(axis=0)]
    if not good.size or np.isfinite(good).all(axis=1).sum() < HELD_ROWS:
        return float("nan")
    return span_m(xy_m, 0.05)


def frozen_marker(e: TrialEvidence) -> Failure | None:
    """A marker that was lost, and whose place went on to be written."""
    markers, length_m = e.trial.markers, e.cable.length_m
    outer = np.flatnonzero(e.arc_length_m >= OUTER_SHARE * length_m)
    found = frozen(markers.xy_m, e.hand_m, outer, MOVES_SHARE * length_m)
    if found is None:
        return None
    x_m, y_m = markers.xy_m[found.first, found.marker]
    values = {"arc_m": e.arc_length_m[found.marker], "x_m": x_m, "y_m": y_m}
    values |= {"last": markers.line(found.last), "moved_mm": found.moved_m * 1e3}
    return Failure(values, found.first)


def reversed_arcs(e: TrialEvidence) -> Failure | None:
    """Markers that are too far from the gripper, but not if they are counted from the other end."""
    found = _farther_than_arc(e)
    if found is None:
        return None
    failure, distance_m, arcs = found
    turned = np.all(distance_m <= e.cable.length_m - arcs + e.slack_m) and len(arcs) > 1
    return failure if turned else None


def too_far(e: TrialEvidence) -> Failure | None:
    """The marker that is farthest beyond its arc length from the gripper."""
    found = _farther_than_arc(e)
    return None if found is None else found[0]


def _farther_than_arc(e: TrialEvidence) -> tuple[Failure, FloatArray, FloatArray] | None:
    """That marker, and distances and arc lengths (markers,) of all that are seen."""
    seen = np.isfinite(e.trial.markers.xy_m).all(axis=2).any(axis=0)
    if not seen.any():
        return None
    arcs, each_m = e.arc_length_m[seen], np.linalg.norm(e.from_grip_m[:, seen], axis=2)
    distance_m = np.nanmedian(each_m, axis=0)
    excess_m = distance_m - arcs
    worst = int(np.nanargmax(excess_m))
    if excess_m[worst] <= e.slack_m:
        return None
    far = each_m[:, worst] > arcs[worst] + e.slack_m
    # From the first row on that half of the rows after it agree with: noise may be far once.
    among_rest = np.cumsum(far[::-1])[::-1] / np.cumsum(np.isfinite(each_m[::-1, worst]))[::-1]
    row = int(np.argmax(far & (among_rest > 0.5)))
    values = {"arc_m": arcs[worst], "away_m": distance_m[worst]}
    return Failure(values, row), distance_m, arcs


def wrong_side(e: TrialEvidence) -> Failure | None:
    """A marker at rest behind its clamp: gravity bends a cable down, never back over it."""
    angle_rad = e.trial.grip.angle_rad[0]
    cosine = float(np.cos(angle_rad))
    at_rest = e.from_grip_m[e.at_rest]
    seen = np.isfinite(at_rest[:, :, 0]).any(axis=0)
    seen &= np.isfinite(e.trial.markers.xy_m).all(axis=2).any(axis=0)
    if not seen.any() or abs(cosine) < np.cos(SIDEWAYS_RAD):
        return None
    arcs, beyond_m = e.arc_length_m[seen], np.nanmedian(at_rest[:, seen, 0], axis=0)
    beyond_m = beyond_m * np.sign(cosine)
    worst = int(np.argmax(beyond_m))
    if beyond_m[worst] <= e.slack_m:
        return None
    side = "right" if cosine > 0.0 else "left"
    values = {"arc_m": arcs[worst], "beyond_m": beyond_m[worst], "side": side}
    return Failure({**values, "angle_rad": angle_rad}, 0)


def frame_rate(e: TrialEvidence) -> Failure | None:
    """Frames that are farther apart than half a swing; without gravity nothing tells that."""
    seen = np.isfinite(e.trial.markers.xy_m).all(axis=2).any()
    if e.weight < WEAK_M_PER_S2 or not seen:
        return None
    slowest_s = SLOWEST * np.sqrt(e.cable.length_m / e.weight)
    step_s = float(np.median(np.diff(e.trial.markers.t_s)))
    values = {"step_s": step_s, "length_m": e.cable.length_m, "slowest_s": slowest_s}
    return None if step_s <= 0.5 * slowest_s else Failure(values, 0)


def rises(e: TrialEvidence) -> Failure | None:
    """A tip that is above the clamp's direction at rest."""
    angle = e.trial.grip.angle_rad[0]
    steep = abs(np.cos(angle)) < np.cos(SIDEWAYS_RAD)
    if not e.at_rest.any() or e.weight < WEAK_M_PER_S2 or steep:
        return None
    along = -e.arc_length_m[:, None] * np.array([np.cos(angle), np.sin(angle)])
    down = np.array(e.gravity_m_per_s2) / e.weight
    sag_m = (e.from_grip_m[e.at_rest] - along) @ down
    seen = np.isfinite(sag_m).any(axis=0)
    if not seen.any():
        return None
    lift_m = -float(np.nanmedian(sag_m[:, e.tip(seen)]))
    return None if lift_m <= e.slack_m else Failure({"lift_mm": lift_m * 1e3})


@dataclass(frozen=True)
class FirstMotion:
    """How far a cable moves before its gripper does, and from which of its frames on."""

    reach_m: float
    row: int

    @property
    def from_first(self) -> bool:
        """Whether it moves from the first frame on: it is not let go later."""
        return self.row < FEWEST_STILL


def first_motion(trial: Trial, cable: Cable) -> FirstMotion | None:
    """That a cable said to begin in equilibrium moves, by a share of it, before its gripper
    does."""
    still = _at_rest(trial)
    if trial.start != "equilibrium" or np.count_nonzero(still) < FEWEST_STILL:
        return None
    markers = trial.markers
    away_m = (markers.xy_m - trial.gripper_m(markers.t_s)[:, None])[still]
    # Medians of five: a glitch of two frames is none of the cable's.  What is lost sorts last.
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(away_m, MEDIAN_OF, axis=0), axis=-1)
    smooth_m = windows[..., MEDIAN_OF // 2]
    from_first_m = np.nan_to_num(np.linalg.norm(smooth_m - smooth_m[:1], axis=2))
    reach_m = float(from_first_m.max())
    if reach_m < MOVES * cable.length_m:
        return None
    return FirstMotion(reach_m, int(np.argmax(np.any(from_first_m > 0.1 * reach_m, axis=1))))


def moves_first(e: TrialEvidence) -> Failure | None:
    """The cable moves before the gripper does, though it is said to begin in equilibrium."""
    found = first_motion(e.trial, e.cable)
    if found is None:
        return None
    meant = "`start: moving`"
    if not found.from_first:
        let_go_s = e.trial.markers.t_s[e.at_rest][found.row + MEDIAN_OF // 2]
        meant = f"`start: held` with release_s: {let_go_s:.3g}"
    return Failure({"reach_mm": found.reach_m * 1e3, "meant": meant})


def _at_rest(trial: Trial) -> NDArray[np.bool_]:
    if trial.bent:
        return np.zeros(len(trial.markers.t_s), dtype=bool)
    return trial.markers.t_s < moves_from_s(trial.grip, ROUGHLY_STILL)


def too_long(e: TrialEvidence) -> Failure | None:
    """A record that lasts longer than any trial."""
    t_s = e.trial.markers.t_s
    lasts_s = float(t_s[-1] - t_s[0])
    return None if lasts_s <= MAX_TRIAL_S else Failure({"lasts_s": lasts_s}, len(t_s) - 1)


def log_gap(e: TrialEvidence) -> Failure | None:
    """A gripper that moves while nothing is known of it."""
    if e.log_gap is None:
        return None
    row = int(np.searchsorted(e.trial.markers.t_s, e.log_gap.to_s))
    return Failure(e.log_gap.values, min(row, len(e.trial.markers.t_s) - 1), "hand")


def log_ends(e: TrialEvidence) -> Failure | None:
    """A gripper that moves where its log ends, and markers that are seen after it."""
    found = e.log_cut_off
    return None if found is None or not found.at_end else _of_log(e, found)


def log_begins(e: TrialEvidence) -> Failure | None:
    """A gripper that moves where its log begins, and markers that are seen before it."""
    found = e.log_cut_off
    return None if found is None or found.at_end else _of_log(e, found)


def _of_log(e: TrialEvidence, found: CutOff) -> Failure:
    t_s = e.trial.markers.t_s
    row = int(np.searchsorted(t_s, found.log_s, side="right" if found.at_end else "left"))
    return Failure(found.values, min(row, len(t_s) - 1), "hand")


def same_marker(e: TrialEvidence) -> Failure | None:
    """Two markers that are one: the same numbers in all rows."""
    for first, second, both in identical(e.trial.markers.xy_m):
        names = {"first": e.source.names[first], "second": e.source.names[second]}
        return Failure({**names, "rows": np.count_nonzero(both)}, int(np.argmax(both)))
    return None


def not_on_cable(e: TrialEvidence) -> Failure | None:
    """A marker that does not move while the others and the gripper do."""
    xy_m = e.trial.markers.xy_m
    moved_m = np.array([span_m(xy_m[:, m]) for m in range(xy_m.shape[1])])
    hand_m = span_m(e.poses[:, 1:3])
    usual_m = max(hand_m, float(np.nanmax(moved_m)))
    stays = np.flatnonzero((moved_m <= STAYS * usual_m) & (hand_m > 0.1 * usual_m))
    if not len(stays):
        return None
    values = {"moved_mm": moved_m[stays[0]] * 1e3, "hand_mm": hand_m * 1e3}
    return Failure({"name": e.source.names[int(stays[0])], **values}, 0)


def hand_scale(e: TrialEvidence) -> Failure | None:
    """A gripper that moves as the marker next to it does, but many times less or more."""
    nearest = int(np.argmin(e.arc_length_m))
    marker = e.trial.markers.xy_m[:, nearest]
    seen = np.isfinite(marker).all(axis=1)
    if np.count_nonzero(seen) < FEWEST_ROWS:
        return None
    hand, marker = e.hand_m[seen], marker[seen]
    hand, marker = hand - hand.mean(axis=0), marker - marker.mean(axis=0)
    sizes = float(np.linalg.norm(hand)), float(np.linalg.norm(marker))
    if min(sizes) == 0.0 or float(np.sum(hand * marker)) < MOVES_ALIKE * sizes[0] * sizes[1]:
        return None
    if 1.0 / TIMES_FARTHER < sizes[1] / sizes[0] < TIMES_FARTHER:
        return None
    values = {"hand_m": span_m(hand), "marker_m": span_m(marker)}
    return Failure({"name": e.source.names[nearest], **values}, 0, "hand")


def longer_than_cable(e: TrialEvidence) -> Failure | None:
    """Two markers that are farther apart than the cable between them is long."""
    names, worst_share, worst = e.source.names, MOST_SLIPS, None
    for first, second in combinations(range(len(names)), 2):
        apart_m = np.linalg.norm(np.diff(e.trial.markers.xy_m[:, [second, first]], axis=1), axis=2)
        between_m = abs(e.arc_length_m[first] - e.arc_length_m[second])
        far = np.nan_to_num(apart_m[:, 0]) > between_m + e.slack_m
        share = float(far.sum()) / max(int(np.isfinite(apart_m).sum()), 1)
        if share > worst_share:
            row = int(np.argmax(far))
            values = {"apart_m": apart_m[row, 0], "between_m": between_m, "share": share}
            values |= {"limit_m": between_m + e.slack_m}
            worst_share = share
            worst = Failure({"first": names[first], "second": names[second], **values}, row)
    return worst


def out_of_plane(e: TrialEvidence) -> Failure | None:
    """A cable that leaves the plane in more rows than may slip."""
    away_m, limit_m = _out_of_plane_m(e), REFUSED_ACROSS * e.cable.length_m
    if away_m is None:
        return None
    far = np.nan_to_num(away_m).max(axis=1) > limit_m
    if np.count_nonzero(far) <= MOST_SLIPS * len(far):
        return None
    row = int(np.argmax(far))
    return Failure({"away_mm": np.nanmax(away_m[row]) * 1e3, "limit_mm": limit_m * 1e3}, row)


def wide(e: TrialEvidence) -> Failure | None:
    """A cable that is a little out of the plane."""
    away_m = _out_of_plane_m(e)
    rms_m = 0.0 if away_m is None else float(np.sqrt(np.nanmean(away_m**2)))
    return None if rms_m < NOTED_ACROSS * e.cable.length_m else Failure({"rms_mm": rms_m * 1e3})


def _out_of_plane_m(e: TrialEvidence) -> FloatArray | None:
    """(T, markers) distance from the plane of all markers."""
    across_m = e.across_m
    if across_m is None or not np.isfinite(across_m).any():
        return None
    return np.asarray(np.abs(across_m - np.nanmedian(across_m)))


def held(e: TrialEvidence) -> Failure | None:
    """Rows in which every marker has exactly its last values, and a jump after them."""
    found = repeated_rows(e.trial.markers.xy_m)
    return None if found is None else Failure({"rows": found[1]}, found[0])
