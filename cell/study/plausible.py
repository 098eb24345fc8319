"""Whether a trial can be of the cable that its study describes: frame, order of markers, clock.

A model can be fitted to mirrored or reversed markers too, with intervals and all.  What no cable
does is refused here; what only a rare cable does is a doubt that is told and left to the reader.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, Cable, moves_from_s
from cell.study.clocks import Offset, offset
from cell.study.data import Trial
from cell.study.rest_shape import WEAK_M_PER_S2

Gravity = tuple[float, float]

#: Room for noise, a slipping grip and a camera whose scale is off, as a share of the free length.
SLACK = 0.1
#: Of a clamp steeper than this nobody can say to which side the cable leaves it, rad.
SIDEWAYS_RAD = np.pi / 3
#: A cable at rest does not move by this share of its free length while its hand is still, and no
#: noise that a study may have does so in medians of so many frames.
MOVES = 0.05
MEDIAN_OF = 5
FEWEST_STILL = 10
#: Both ends are held if the farthest marker stays within this share of what the hand, or the cable
#: between, moves: a bead on a thread follows by more, unless it is shaken seven times as fast as it
#: swings.  What moves must do so by a share of the cable, for what hardly moves shows nothing.  The
#: marker must be in the outer half, and seen in so many rows.
HELD_STAYS, HELD_MOVES, OUTER, HELD_ROWS = 0.02, 0.1, 0.5, 20
#: Of the earth.
GRAVITY_M_PER_S2 = 9.81
#: A cable that hangs swings about like a rod of its length, in 5.1 √(L/g), or as a bead at the end
#: of a thread in 6.3 √(L/g); bending makes it faster.
SLOWEST = 2.0 * np.pi


@dataclass(frozen=True)
class Impossible:
    """What no cable does: from which row of the markers on, and what is likely meant."""

    row: int
    cause: str


def impossible(
    trial: Trial, cable: Cable, arc_length_m: FloatArray, gravity_m_per_s2: Gravity
) -> Impossible | None:
    """Why no cable looks like this; None if one may.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    """
    size = float(np.hypot(*gravity_m_per_s2))
    shifted = offset(trial, cable, size)
    if shifted is not None and shifted.late_s > 0.0:
        return Impossible(_row(trial, shifted), _waits(shifted))
    grip, t_s = trial.grip, trial.markers.t_s
    seen = np.isfinite(trial.markers.xy_m).all(axis=2).any(axis=0)
    if not seen.any():
        return None
    arcs, from_grip = arc_length_m[seen], _from_grip(trial)[:, seen]
    length_m = cable.length_m
    if held := _both_ends_held(trial, arc_length_m, length_m):
        return Impossible(0, held)
    if stays := _frozen(trial, arc_length_m, length_m):
        return stays
    if found := _too_far(arcs, length_m, from_grip):
        return found if shifted is None else Impossible(_row(trial, shifted), _ahead(shifted))
    at_rest = from_grip[_at_rest(trial)]
    cause = _on_the_wrong_side(arcs, length_m, grip.angle_rad[0], at_rest)
    cause = cause or _clock(length_m, size, t_s)
    return Impossible(0, cause) if cause else None


def clocks_differ(trial: Trial, cable: Cable, gravity_m_per_s2: Gravity) -> Impossible | None:
    """That a cable moves long before or after its hand, for one that is too far from it."""
    found = offset(trial, cable, float(np.hypot(*gravity_m_per_s2)))
    if found is None:
        return None
    return Impossible(_row(trial, found), _waits(found) if found.late_s > 0.0 else _ahead(found))


def doubt(
    trial: Trial, cable: Cable, arc_length_m: FloatArray, gravity_m_per_s2: Gravity
) -> str | None:
    """What a cable hardly does, and what may be meant; None if all is as usual."""
    if rises := _rises(trial, cable, arc_length_m, gravity_m_per_s2):
        return rises
    if shifted := clocks_differ(trial, cable, gravity_m_per_s2):
        return f"line {trial.markers.line(shifted.row)}: {shifted.cause}"
    return _moves_first(trial, cable)


def _rises(
    trial: Trial, cable: Cable, arc_length_m: FloatArray, gravity_m_per_s2: Gravity
) -> str | None:
    grip, size = trial.grip, float(np.hypot(*gravity_m_per_s2))
    still = _at_rest(trial)
    angle = grip.angle_rad[0]
    if not still.any() or size < WEAK_M_PER_S2 or abs(np.cos(angle)) < np.cos(SIDEWAYS_RAD):
        return None
    along = -arc_length_m[:, None] * np.array([np.cos(angle), np.sin(angle)])
    sag_m = (_from_grip(trial)[still] - along) @ (np.array(gravity_m_per_s2) / size)
    seen = np.isfinite(sag_m).any(axis=0)
    if not seen.any():
        return None
    tip = int(np.argmax(np.where(seen, arc_length_m, -1.0)))
    lift_m = -float(np.nanmedian(sag_m[:, tip]))
    if lift_m <= SLACK * cable.length_m:
        return None
    return (
        f"at rest the cable rises {lift_m * 1e3:.3g} mm above the clamp's direction, against "
        "gravity; unless it is naturally curved, check the signs of y_m (up), angle_rad "
        "(positive = pointing down) and gravity_m_per_s2"
    )


def _both_ends_held(trial: Trial, arc_length_m: FloatArray, free_length_m: float) -> str | None:
    """That the marker farthest from the hand stays in place while hand or cable move."""
    xy_m, grip = trial.markers.xy_m, trial.grip
    seen = np.array([np.isfinite(_spread_m(xy_m[:, m])) for m in range(xy_m.shape[1])])
    if not seen.any():
        return None
    tip = int(np.argmax(np.where(seen, arc_length_m, -1.0)))
    axes = np.isfinite(xy_m[:, tip]).any(axis=0)  # those in which the tip is not seen say nothing
    # a free tip follows within a quarter of a swing: a frame tells of what moves before that
    follows_s = 0.25 * SLOWEST * np.sqrt(free_length_m / GRAVITY_M_PER_S2)
    t_s = trial.markers.t_s
    told_s = t_s[np.isfinite(xy_m[:, tip][:, axes]).all(axis=1)] - follows_s
    told_s = told_s[told_s >= t_s[0]]
    hand_m = _spread_m(_at(told_s, grip.t_s, np.column_stack([grip.x_m, grip.y_m])[:, axes]))
    others = [_at(told_s, t_s, xy_m[:, m, axes]) for m in range(xy_m.shape[1]) if m != tip]
    inner_m = float(np.max(np.nan_to_num([_spread_m(other) for other in others]), initial=0.0))
    tip_m = _spread_m(xy_m[:, tip, axes])
    most_m = max(np.nan_to_num(hand_m), inner_m)
    if arc_length_m[tip] < OUTER * free_length_m or most_m < HELD_MOVES * free_length_m:
        return None
    if tip_m > HELD_STAYS * most_m:
        return None
    what = "the hand moves" if hand_m >= inner_m else "the cable between moves"
    return (
        f"the marker at arc length {arc_length_m[tip]:g} m stays within {tip_m * 1e3:.2g} mm "
        f"while {what} by {most_m * 1e3:.3g} mm: both ends of this cable are held, and only a "
        "cable with a free tip can be modelled; let the tip go"
    )


def _frozen(trial: Trial, arc_length_m: FloatArray, free_length_m: float) -> Impossible | None:
    """That a marker was lost, and its place went on to be written."""
    found = frozen(trial, arc_length_m, free_length_m)
    if found is None:
        return None
    markers = trial.markers
    x_m, y_m = markers.xy_m[found.first, found.marker]
    return Impossible(
        found.first,
        f"the marker at arc length {arc_length_m[found.marker]:g} m stays at ({x_m:g}, {y_m:g}) m "
        f"up to line {markers.line(found.last)}, while the cable moves by "
        f"{found.moved_m * 1e3:.3g} mm: it was lost; leave its values empty there",
    )


def _at(at_s: FloatArray, t_s: FloatArray, places_m: FloatArray) -> FloatArray:
    """(at, axes) a point's places at other times, between those at which it was seen."""
    found = np.full((len(at_s), places_m.shape[1]), np.nan)
    for axis, series_m in enumerate(places_m.T):
        seen = np.isfinite(series_m)
        if seen.any():
            found[:, axis] = np.interp(at_s, t_s[seen], series_m[seen])
    return found


def _spread_m(xy_m: FloatArray) -> float:
    """How far apart the middle 90 % of a point's places are: single wrong ones do not count.

    nan where it is seen in fewer than `HELD_ROWS` rows.
    """
    good = xy_m[:, np.isfinite(xy_m).any(axis=0)]
    if not good.size or np.isfinite(good).all(axis=1).sum() < HELD_ROWS:
        return float("nan")
    low, high = np.nanquantile(good, [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))


def _row(trial: Trial, found: Offset) -> int:
    """In which row the cable begins to move."""
    return int(np.searchsorted(trial.markers.t_s, found.cable_s))


def _waits(found: Offset) -> str:
    """Of a cable that stays at rest long after its hand has moved."""
    return (
        f"the cable rests until {found.cable_s:.3g} s, yet its hand moves at {found.hand_s:.3g} s, "
        f"and no cable waits so long: the clocks differ by {found.late_s:.2g} s; subtract this "
        "from t_s of markers.csv"
    )


def _ahead(found: Offset) -> str:
    """Of a cable at rest that moves long before its hand does."""
    return (
        f"the cable moves at {found.cable_s:.3g} s, its hand only at {found.hand_s:.3g} s; if both "
        f"are one motion the clocks differ: add {-found.late_s:.2g} s to t_s of markers.csv; if "
        f"the cable was let go, give `start: held` with release_s: {found.cable_s:.3g} in "
        "study.yaml"
    )


@dataclass(frozen=True)
class FirstMotion:
    """How far a cable moves before its hand does, and from which of its frames on."""

    reach_m: float
    row: int

    @property
    def from_first(self) -> bool:
        """Whether it moves from the first frame on: it is not let go later."""
        return self.row < FEWEST_STILL


def first_motion(trial: Trial, cable: Cable) -> FirstMotion | None:
    """That a cable said to begin in equilibrium moves, by a share of it, before its hand does."""
    still = _at_rest(trial)
    if trial.start != "equilibrium" or np.count_nonzero(still) < FEWEST_STILL:
        return None
    away_m = _from_grip(trial)[still]
    # Medians of five: a glitch of two frames is none of the cable's.  What is lost sorts last.
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(away_m, MEDIAN_OF, axis=0), axis=-1)
    smooth_m = windows[..., MEDIAN_OF // 2]
    from_first_m = np.nan_to_num(np.linalg.norm(smooth_m - smooth_m[:1], axis=2))
    reach_m = float(from_first_m.max())
    if reach_m < MOVES * cable.length_m:
        return None
    return FirstMotion(reach_m, int(np.argmax(np.any(from_first_m > 0.1 * reach_m, axis=1))))


def _moves_first(trial: Trial, cable: Cable) -> str | None:
    found = first_motion(trial, cable)
    if found is None:
        return None
    meant = "`start: moving`"
    if not found.from_first:
        let_go_s = trial.markers.t_s[_at_rest(trial)][found.row + MEDIAN_OF // 2]
        meant = f"`start: held` with release_s: {let_go_s:.3g}"
    return (
        f"before the hand moves the cable does, by {found.reach_m * 1e3:.3g} mm, yet it is said to "
        f"begin in equilibrium; give {meant} in study.yaml"
    )


def _from_grip(trial: Trial) -> FloatArray:
    """(T, markers, 2) from the gripping point, m."""
    grip, markers = trial.grip, trial.markers
    at_m = np.column_stack([np.interp(markers.t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])
    return np.asarray(markers.xy_m - at_m[:, None], dtype=np.float64)


def _at_rest(trial: Trial) -> NDArray[np.bool_]:
    """(T,) frames before the hand moves, of a cable that nothing else holds or swings."""
    if trial.bent:
        return np.zeros(len(trial.markers.t_s), dtype=bool)
    return trial.markers.t_s < moves_from_s(trial.grip, ROUGHLY_STILL)


def _too_far(arcs: FloatArray, free_length_m: float, from_grip: FloatArray) -> Impossible | None:
    each_m = np.linalg.norm(from_grip, axis=2)
    distance_m = np.nanmedian(each_m, axis=0)
    slack_m = SLACK * free_length_m
    excess_m = distance_m - arcs
    worst = int(np.nanargmax(excess_m))
    if excess_m[worst] <= slack_m:
        return None
    turned = np.all(distance_m <= free_length_m - arcs + slack_m)
    remedy = (
        "the markers fit when counted from the other end: turn markers.arc_length_m round"
        if turned and len(arcs) > 1
        else "check arc_length_m, the metres of both files, and that both have the same frame"
    )
    far = each_m[:, worst] > arcs[worst] + slack_m
    # From the first row on that half of the rows after it agree with: noise may be far once.
    among_rest = np.cumsum(far[::-1])[::-1] / np.cumsum(np.isfinite(each_m[::-1, worst]))[::-1]
    row = int(np.argmax(far & (among_rest > 0.5)))
    return Impossible(
        row,
        f"the marker at arc length {arcs[worst]:g} m is {distance_m[worst]:.3g} m from the "
        f"gripping point, farther than any cable lets it; {remedy}",
    )


def _on_the_wrong_side(
    arcs: FloatArray, free_length_m: float, angle_rad: float, at_rest: FloatArray
) -> str | None:
    cosine = float(np.cos(angle_rad))
    seen = np.isfinite(at_rest[:, :, 0]).any(axis=0)
    if not seen.any() or abs(cosine) < np.cos(SIDEWAYS_RAD):
        return None
    # Gravity is upright: it bends a cable down, never back over its clamp.
    arcs, beyond_m = arcs[seen], np.nanmedian(at_rest[:, seen, 0], axis=0) * np.sign(cosine)
    worst = int(np.argmax(beyond_m))
    if beyond_m[worst] <= SLACK * free_length_m:
        return None
    side = "right" if cosine > 0.0 else "left"
    return (
        f"at rest the marker at arc length {arcs[worst]:g} m is {beyond_m[worst]:.3g} m {side} of "
        f"the gripping point; with angle_rad = {angle_rad:g} the cable leaves it to the "
        "other side: change the sign of x_m in both files, or give the clamp angle as π − angle"
    )


def _clock(free_length_m: float, gravity_m_per_s2: float, t_s: FloatArray) -> str | None:
    if gravity_m_per_s2 < WEAK_M_PER_S2:
        return None  # nothing tells beforehand how slowly the cable swings
    slowest_s = SLOWEST * np.sqrt(free_length_m / gravity_m_per_s2)
    step_s = float(np.median(np.diff(t_s)))
    if step_s <= 0.5 * slowest_s:
        return None
    return (
        f"frames are {step_s:.3g} s apart, yet a cable of {free_length_m:g} m swings to and fro "
        f"within {slowest_s:.2g} s; give t_s in seconds, with several frames per swing"
    )


#: Places are the same within this; cameras measure less well, m.
SAME_M = 1e-7
#: It stays in so many rows, of the outer part of the cable, while the hand or another marker moves
#: by this share of the free length: a cable that is held at its clamp moves there by 1 % of it.
ROWS, OUTER_SHARE, MOVES_SHARE = 6, 0.3, 0.1
#: Steps of rounded values, of which one that only turns goes no more from row to row.
STEPS = 3.0


@dataclass(frozen=True)
class Frozen:
    """The rows, first and last, in which a marker stays, and by how much others move meanwhile."""

    marker: int
    first: int
    last: int
    moved_m: float


def frozen(trial: Trial, arc_length_m: FloatArray, free_length_m: float) -> Frozen | None:
    """A marker that stays exactly in place while the cable moves; None if there is none.

    Rounded values of a marker that changes direction may stay, too; then they go on by one step.
    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    """
    t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
    grip = trial.grip
    hand_m = np.column_stack([np.interp(t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])
    points_m = np.concatenate([xy_m, hand_m[:, None]], axis=1)
    for marker in np.flatnonzero(arc_length_m >= OUTER_SHARE * free_length_m):
        for first, last in _stays(xy_m[:, marker]):
            rows = points_m[first : last + 1]
            moved_m = max(_reach_m(rows[:, other]) for other in range(rows.shape[1]))
            several_m = STEPS * _step_m(xy_m[:, marker])
            jumps = _jump_m(xy_m[:, marker], first, last) > several_m
            if jumps and moved_m > max(MOVES_SHARE * free_length_m, several_m):
                return Frozen(int(marker), first, last, moved_m)
    return None


def _stays(xy_m: FloatArray) -> list[tuple[int, int]]:
    """First and last row of runs of a point (T, 2) in which it stays; rows without it are none.

    One coordinate alone may stay, rounded, while the cable moves along the other.
    """
    seen = np.flatnonzero(np.isfinite(xy_m).all(axis=1))
    steps_m = np.abs(np.diff(xy_m[seen], axis=0))
    same = np.concatenate([[False], steps_m.max(axis=1) <= SAME_M, [False]])
    edges = np.flatnonzero(np.diff(same.astype(int)))
    runs = zip(edges[::2], edges[1::2], strict=True)
    return [(int(seen[a]), int(seen[b])) for a, b in runs if b - a + 1 >= ROWS]


def _step_m(xy_m: FloatArray) -> float:
    """Smallest difference of two values of a point's coordinates (T, 2): their step, if rounded."""
    steps = [np.diff(np.unique(v[np.isfinite(v)])) for v in xy_m.T]
    return float(min((s.min() for s in steps if s.size), default=0.0))


def _jump_m(xy_m: FloatArray, first: int, last: int) -> float:
    """How far a point (T, 2) comes from before some rows, or goes after them; inf if it never does.

    Along one coordinate.
    """
    seen = np.flatnonzero(np.isfinite(xy_m).all(axis=1))
    if last == seen[-1]:
        return np.inf
    before = int(seen[max(int(np.searchsorted(seen, first)) - 1, 0)])
    after = int(seen[int(np.searchsorted(seen, last)) + 1])
    return float(np.abs(xy_m[[before, after]] - xy_m[[first, last]]).max())


def _reach_m(xy_m: FloatArray) -> float:
    """How far apart the middle 90 % of places (T, 2) are: single wrong ones do not count."""
    good = xy_m[:, np.isfinite(xy_m).any(axis=0)]
    if not good.size:
        return 0.0
    low, high = np.nanquantile(good, [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))
