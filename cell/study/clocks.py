"""Checks of time: gripper log and frames share one clock, and the log has no gap or cut-off.

Offsets of clocks are estimated by `cell.study.imports.trials`; a small one that remains is the
effect `camera_latency`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, Cable, moves_from_s
from cell.study.data import Study, Trial
from cell.study.facts import trial_facts
from cell.study.rest_shape import WEAK_M_PER_S2
from cell.study.series import first_lasting, forward_filled

#: ω² = 12.362 EI/(ρ L⁴) of a uniform clamped strip (β₁L = 1.8751), and the initial rigidity of a
#: fit, 0.4 ρ a L³, for a cable under an acceleration a.
_FIRST_MODE, _SUPPOSED = 12.362, 0.4


def with_pull(study: Study) -> Study:
    """The study with the acceleration that sets the scale of its cable's stiffness.

    raises  ValueError: gravity is weak, and no trial shows a swing
    """
    return replace(study, pull_m_per_s2=pull_m_per_s2(study))


def pull_m_per_s2(study: Study) -> float | None:
    """Equivalent gravity: a cable of this size would swing at the observed frequency, m/s².

    None if gravity in the plane is not weak: then gravity itself is the scale.
    raises  ValueError: gravity is weak, and no trial shows a swing
    """
    if float(np.hypot(*study.gravity_m_per_s2)) >= WEAK_M_PER_S2:
        return None
    spectra = [trial_facts(t, study.arc_length_m).spectrum for t in study.trials]
    strongest_hz = [s.peaks_hz[0] for s in spectra if s is not None and s.peaks_hz]
    if not strongest_hz:
        raise ValueError(
            "gravity in the plane is weak, and no trial shows a swing after the gripper has "
            "stopped: nothing tells the rigidity; record three swings after the motion"
        )
    swing_hz = float(np.median(strongest_hz))
    return (2.0 * np.pi * swing_hz) ** 2 * study.cable.free_length_m / (_SUPPOSED * _FIRST_MODE)


#: Longest permitted gap of a gripper's log while it moves, in usual steps and in seconds.
GAP_STEPS, GAP_S = 5.0, 0.1
#: Rows of a running median, against single wrong rows; rows of the shortest piece for a speed, and
#: s; noise up to this many standard deviations is no motion.
_MEDIAN_OF, _PIECE, _PIECE_S, _CHANCE = 5, 3, 0.01, 4.0
#: Largest deceleration of a gripper over that of the means over pieces.
_SHARPER = 1.5
#: A cable begins to move with its gripper, or within this many √(L/g) of it, and s: in 506
#: simulated strokes of all kinds from −0.2 to 0.6.  A camera's latency is less, and can be fitted.
WITHIN, WITHIN_S = 1.0, 0.15
#: Distance at which a motion has begun: share of the free length, and multiple of the noise.
AWAY, OF_NOISE = 0.02, 8.0
#: Shares of that distance at each of which gripper and cable must differ in time.
SHARES = 1.0, 0.4, 0.1
#: Frames in which it must be at rest before, and away afterwards.
_REST, _STAYS = 6, 3


@dataclass(frozen=True)
class Gap:
    """Two rows of a gripper's log, the second numbered, that are far apart while the gripper
    moves."""

    row: int
    from_s: float
    to_s: float
    usual_s: float
    moved_m: float
    turned_rad: float

    @property
    def values(self) -> dict[str, object]:
        """As a sentence of a check names them."""
        limit_s = max(GAP_S, GAP_STEPS * self.usual_s)
        return {**asdict(self), "moved_mm": self.moved_m * 1e3, "limit_s": limit_s}


@dataclass(frozen=True)
class CutOff:
    """An end of a gripper's log at which the gripper moves, while the frames of its cable go on.

    log_s, film_s  end, or beginning, of the log and of the frames
    speed          m/s, or rad/s if it `turns`
    """

    at_end: bool
    log_s: float
    film_s: float
    speed: float
    turns: bool

    @property
    def values(self) -> dict[str, object]:
        """As a sentence of a check names them."""
        return {**asdict(self), "unit": "rad" if self.turns else "m"}


@dataclass(frozen=True)
class Offset:
    """Times at which a gripper and its cable begin to move, on their clocks, s."""

    hand_s: float
    cable_s: float

    @property
    def late_s(self) -> float:
        """Lead of the pictures' clock over the gripper's, s; negative: it lags."""
        return self.cable_s - self.hand_s


def gap(poses: FloatArray) -> Gap | None:
    """The longest gap in a gripper's log within which it moves; None if there is none.

    poses  (T, 4) t, x, y, angle
    """
    t_s = poses[:, 0]
    step_s = np.diff(t_s)
    usual_s = float(np.median(step_s))
    change = np.abs(np.diff(poses[:, 1:], axis=0))
    moved_m = np.hypot(change[:, 0], change[:, 1])
    moves = (moved_m > ROUGHLY_STILL["x_m"]) | (change[:, 2] > ROUGHLY_STILL["angle_rad"])
    harmful_s = np.where(moves & (step_s > max(GAP_S, GAP_STEPS * usual_s)), step_s, 0.0)
    i = int(np.argmax(harmful_s))
    if harmful_s[i] == 0.0:
        return None
    return Gap(
        i + 1, float(t_s[i]), float(t_s[i + 1]), usual_s, float(moved_m[i]), float(change[i, 2])
    )


def cut_off(poses: FloatArray, from_s: float, to_s: float) -> CutOff | None:
    """The end of a gripper's log at which it still moves; None if there is none.

    poses         (T, 4) t, x, y, angle
    from_s, to_s  times of the first and the last frame that shows a marker
    """
    usual_s = float(np.median(np.diff(poses[:, 0])))
    limit_s = max(GAP_S, GAP_STEPS * usual_s)
    for at_end, film_s in ((True, to_s), (False, from_s)):
        # The beginning of a log is tested as the end of the time-reversed log.
        log = poses if at_end else poses[::-1] * [-1.0, 1.0, 1.0, 1.0]
        missing_s = (film_s if at_end else -film_s) - float(log[-1, 0])
        if missing_s <= limit_s:
            continue
        for series, still, turns in (
            (log[:, 1:3], ROUGHLY_STILL["x_m"], False),
            (log[:, 3:], ROUGHLY_STILL["angle_rad"], True),
        ):
            speed = _unfinished(log[:, 0], series, still, (limit_s, missing_s))
            if speed is not None:
                return CutOff(at_end, float(poses[-at_end, 0]), film_s, speed, turns)
    return None


def _unfinished(
    t_s: FloatArray, series: FloatArray, still: float, within_s: tuple[float, float]
) -> float | None:
    """Speed at the end of a series (T, d) that would move on by more than `still`; else None.

    From the middle of its last piece on, its deceleration is bounded by its largest acceleration.

    within_s  duration in which it has moved by more than that, and in which it would move on
    """
    step_s, (before_s, after_s) = float(np.median(np.diff(t_s))), within_s
    first = int(np.searchsorted(t_s, t_s[-1] - before_s))
    if first < _MEDIAN_OF or len(t_s) < 2 * _MEDIAN_OF:
        return None
    ends = [np.median(series[rows], axis=0) for rows in (
        slice(first - _MEDIAN_OF, first), slice(-_MEDIAN_OF, None)
    )]  # fmt: skip
    if np.linalg.norm(ends[1] - ends[0]) <= still:
        return None
    noise, most = _rough(series), max(_PIECE, (len(t_s) - first + 1) // 2)
    rows = min(max(_PIECE, int(_PIECE_S / step_s) + 1), most)
    while rows < most and _CHANCE * _std_per_s(noise, rows, step_s) * before_s > still:
        rows += 1
    speeds = _velocities(t_s, _without_single(series), rows)
    lasts_s = (rows - 1) * step_s
    changes = np.linalg.norm(speeds[rows - 1 :] - speeds[: 1 - rows], axis=1) / lasts_s
    slows = _SHARPER * float(np.max(changes, initial=0.0))
    end_speed = float(np.linalg.norm(speeds[-1]))
    speed = end_speed - 0.5 * slows * lasts_s
    if speed <= _CHANCE * _std_per_s(noise, rows, step_s):
        return None
    goes_on = min(speed * after_s, 0.5 * speed**2 / slows if slows > 0.0 else np.inf)
    return end_speed if goes_on > still else None


def _without_single(series: FloatArray) -> FloatArray:
    """Running median of three of rows (T, d), which removes single wrong rows."""
    inner = np.median(np.lib.stride_tricks.sliding_window_view(series, 3, axis=0), axis=-1)
    return np.concatenate([series[:1], inner, series[-1:]])


def _velocities(t_s: FloatArray, series: FloatArray, rows: int) -> FloatArray:
    """(T − rows + 1, d) slopes of the lines through `rows` successive rows."""
    times_s = np.lib.stride_tricks.sliding_window_view(t_s, rows)
    away_s = times_s - times_s.mean(axis=1, keepdims=True)
    values = np.lib.stride_tricks.sliding_window_view(series, rows, axis=0)
    slopes = np.einsum("tr,tdr->td", away_s, values) / np.sum(away_s**2, axis=1)[:, None]
    return np.asarray(slopes, dtype=np.float64)


def _rough(series: FloatArray) -> float:
    """Standard deviation of rows (T, d) from a smooth path: noise, and the last digit."""
    steps = np.abs(np.diff(series, axis=0))
    digit = float(np.min(steps[steps > 0.0], initial=np.inf))
    return max(_noise_m(series), digit / np.sqrt(12.0) if np.isfinite(digit) else 0.0)


def _std_per_s(noise: float, rows: int, step_s: float) -> float:
    """Standard deviation of the slope of a line through `rows` rows."""
    return float(noise / (step_s * np.sqrt(rows * (rows**2 - 1) / 12.0)))


def offset(trial: Trial, cable: Cable, gravity_m_per_s2: float) -> Offset | None:
    """Start times of cable and gripper if they differ by much, for a cable at rest; else None."""
    detected = np.isfinite(trial.markers.xy_m).any(axis=(1, 2))
    t_s = trial.markers.t_s[detected]
    series_m = trial.markers.xy_m[detected].reshape(len(t_s), -1)
    halves = np.isfinite(series_m[: _REST // 2]), np.isfinite(series_m[_REST // 2 : _REST])
    series_m = series_m[:, halves[0].any(axis=0) & halves[1].any(axis=0)]
    if trial.start != "equilibrium" or len(t_s) < 2 * _REST or not series_m.size:
        return None
    moved_by_m = series_m - np.nanmedian(series_m[:_REST], axis=0)
    away_m = max(AWAY * cable.length_m, OF_NOISE * _noise_m(moved_by_m[:_REST]))
    halves_m = np.split(moved_by_m[:_REST], 2)
    moved_m = np.nanmedian(halves_m[1], axis=0) - np.nanmedian(halves_m[0], axis=0)
    if np.nan_to_num(np.abs(moved_m)).max() > away_m:
        return None  # the film begins in a swing
    pace_s = _pace_s(trial, cable, gravity_m_per_s2)
    if pace_s is None:
        return None
    within_s = max(WITHIN_S, WITHIN * pace_s) + 2.0 * float(np.median(np.diff(t_s)))
    shown = np.asarray(np.isfinite(series_m).any(axis=1))
    # with alternating cameras no marker is visible in every row
    reach_m = np.nan_to_num(np.abs(forward_filled(moved_by_m, np.isfinite(moved_by_m)))).max(axis=1)
    least_m = OF_NOISE * _noise_m(moved_by_m[:_REST])
    # an oscillation that grows passes one distance, of the gripper or the cable, half a period late
    offsets = [
        _beyond_search(trial, cable, t_s, (reach_m, shown), within_s, max(share * away_m, least_m))
        for share in SHARES
    ]
    return None if None in offsets else offsets[0]


def _beyond_search(
    trial: Trial,
    cable: Cable,
    t_s: FloatArray,
    shown: tuple[FloatArray, NDArray[np.bool_]],
    within_s: float,
    away_m: float,
) -> Offset | None:
    """Start times of gripper and cable at a distance `away_m`, if too far apart; else None.

    shown  (frames,) distance of the cable from its place, m, and whether a marker is visible
    """
    reach_m, visible = shown
    cable_s = _begins(t_s, reach_m > away_m)
    hand_s = _gripper_start_s(trial, away_m, -np.inf)
    if cable_s is None or hand_s is None or cable_s <= t_s[_REST - 1]:
        return None
    if hand_s < t_s[0] and cable_s - t_s[0] < within_s:
        return None  # the film begins in the swing after a stroke: a turning point is no rest
    rests_s = float(t_s[visible & (t_s < cable_s)][-1])
    # The record may begin at a rest between two strokes.
    next_s = _gripper_start_s(trial, away_m, float(t_s[0]))
    strokes = [hand_s, *([next_s] if next_s is not None and next_s > t_s[_REST - 1] else [])]
    turned_s = _gripper_start_s(trial, away_m, -np.inf, cable.length_m)
    strokes += [] if turned_s is None else [turned_s]
    if any(rests_s - within_s <= begins <= cable_s + within_s for begins in strokes):
        return None
    return Offset(hand_s, cable_s)


def _pace_s(trial: Trial, cable: Cable, gravity_m_per_s2: float) -> float | None:
    """1/ω of the slowest swing: of a thread with a bead, or as observed where gravity is weak.

    None where no swing is observed either.
    """
    if gravity_m_per_s2 >= WEAK_M_PER_S2:
        return float(np.sqrt(cable.length_m / gravity_m_per_s2))
    unknown = np.full(trial.markers.xy_m.shape[1], np.nan)
    spectrum = trial_facts(trial, unknown).spectrum
    if spectrum is None or not spectrum.peaks_hz:
        return None
    return 1.0 / (2.0 * np.pi * min(spectrum.peaks_hz))


def _noise_m(series_m: FloatArray) -> float:
    """Noise of frames (T, coordinates), nan = not detected, independent of steady motion."""
    valid = [values[np.isfinite(values)] for values in series_m.T]
    bends_m = np.concatenate([np.zeros(0), *(np.abs(np.diff(v, 2)) for v in valid)]) / np.sqrt(6.0)
    return 1.4826 * float(np.median(bends_m)) if bends_m.size else 0.0


def _begins(t_s: FloatArray, away: NDArray[np.bool_]) -> float | None:
    """Time from which `away` lasts; None if it never does."""
    row = first_lasting(away, _STAYS)
    return None if row is None else float(t_s[row])


def _gripper_start_s(
    trial: Trial, away_m: float, after_s: float, lever_m: float = 0.0
) -> float | None:
    """When the gripper has left its place of a time, in the coordinates in which its cable is
    measured.

    If one coordinate is observed, a stroke along the other one shows late, or not at all.
    lever_m  lever arm of a turn of the gripper
    """
    grip, measured = trial.grip, np.isfinite(trial.markers.xy_m).any(axis=(0, 1))
    later = grip.t_s >= after_s
    if np.count_nonzero(later) < _STAYS:
        return None
    x_m, y_m = grip.x_m[later], grip.y_m[later]
    moved_m = np.stack([x_m - x_m[0], y_m - y_m[0]])[measured]
    turned_m = lever_m * np.abs(grip.angle_rad[later] - grip.angle_rad[later][0])
    return _begins(grip.t_s[later], np.linalg.norm(moved_m, axis=0) + turned_m > away_m)


#: Displacement that a cable at rest does not reach while its gripper is still, share of the free
#: length, and frames of a median that keeps permitted noise below it.
FIRST_MOTION = 0.05
MEDIAN_OF = 5
FEWEST_STILL = 10


def at_rest(trial: Trial) -> NDArray[np.bool_]:
    """(T,) whether a frame is before the gripper's motion, with the cable hanging at rest."""
    if trial.bent:
        return np.zeros(len(trial.markers.t_s), dtype=bool)
    return trial.markers.t_s < moves_from_s(trial.grip, ROUGHLY_STILL)


@dataclass(frozen=True)
class FirstMotion:
    """Motion of a cable before its gripper moves: its size, and its first frame."""

    reach_m: float
    row: int

    @property
    def from_first(self) -> bool:
        """Whether it moves from the first frame on, so that it is not released later."""
        return self.row < FEWEST_STILL


def first_motion(trial: Trial, cable: Cable) -> FirstMotion | None:
    """Motion of a cable before its gripper moves, in a trial that states equilibrium; else None."""
    still = at_rest(trial)
    if trial.start != "equilibrium" or np.count_nonzero(still) < FEWEST_STILL:
        return None
    markers = trial.markers
    away_m = (markers.xy_m - trial.gripper_m(markers.t_s)[:, None])[still]
    # Medians of five remove glitches of two frames.  Lost values sort last.
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(away_m, MEDIAN_OF, axis=0), axis=-1)
    smooth_m = windows[..., MEDIAN_OF // 2]
    from_first_m = np.nan_to_num(np.linalg.norm(smooth_m - smooth_m[:1], axis=2))
    reach_m = float(from_first_m.max())
    if reach_m < FIRST_MOTION * cable.length_m:
        return None
    return FirstMotion(reach_m, int(np.argmax(np.any(from_first_m > 0.1 * reach_m, axis=1))))
