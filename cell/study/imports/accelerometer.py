"""A gripper's place, integrated twice from its acceleration between two rests.

The gripper's velocity is 0 at both rests.  Where noise is white and the sensor's offset constant,
the likeliest acceleration is the measured one less its own mean over the motion: the zero-velocity
update (ZUPT) of inertial navigation.
Source: Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2013,
ch. 15.3 (zero velocity updates).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from cell.cable.arrays import FloatArray
from cell.study.hand_drift import HandDrift

#: A rest is at least so many rows and so many seconds.
REST_ROWS, REST_S = 10, 0.05
#: A gripper moves where the mean over so many seconds is so many standard deviations from its rest.
_MEAN_S, _MOVES = 0.02, 7.0
#: Of a motion, what is before its beginning is seen: always, and by limit over acceleration.
_MARGIN, _LATE = 0.02, 0.3
#: What a rest must not differ by, in standard deviations.
SIGNIFICANT = 4.0
#: Equal rows in a row, at the end of what a sensor shows, with a step to them of so many digits and
#: of this share of what it shows.
SATURATED_ROWS, _SATURATED_STEP, _STEEP = 4, 3.0, 1e-3
#: Samples of a motion may be so many usual steps apart.
_GAP = 3.0
#: Noise that is slower than a sample's is looked for in so many parts of a rest.
_BLOCKS = 10


class NotIntegrableError(ValueError):
    """Acceleration that cannot be integrated to a position; `row` says where."""

    def __init__(self, row: int, message: str) -> None:
        super().__init__(message)
        self.row = row


@dataclass(frozen=True, eq=False)
class AccelerometerSamples:
    """Samples of an accelerometer.

    t_s             (T,)
    specific_force  (T, 2) along the sensor's right and up, m/s²; 0 where not measured
    measured        which of both is measured
    angle_rad       (T,) by which the sensor is turned
    gravity         (x, y) in the study's frame, m/s²
    """

    t_s: FloatArray
    specific_force: FloatArray
    measured: tuple[bool, bool]
    angle_rad: FloatArray
    gravity: tuple[float, float]

    @property
    def step_s(self) -> float:
        """The usual step of time."""
        return float(np.median(np.diff(self.t_s)))

    @property
    def digit(self) -> FloatArray:
        """(2,) smallest step between readings; 0 where nothing is measured."""
        steps = np.abs(np.diff(self.specific_force, axis=0))
        least = np.min(steps, axis=0, initial=np.inf, where=steps > 0.0)
        return np.where(np.isfinite(least), least, 0.0)

    def accelerations(self) -> FloatArray:
        """(T, 2) in the sensor's axes with the sensor's offset, without gravity's part, m/s²."""
        turned = turned_by(
            -self.angle_rad, np.broadcast_to(self.gravity, self.specific_force.shape)
        )
        return np.asarray((self.specific_force + turned) * self.measured)


@dataclass(frozen=True, eq=False)
class Integrated:
    """Path of a gripper from (0, 0) on: (T, 2), m, and what it may be wrong by; None = it
    rested."""

    path_m: FloatArray
    drift: HandDrift | None


@dataclass(frozen=True)
class _MotionRows:
    """First row of the motion, and first of the rest after it."""

    begin: int
    end: int

    @property
    def rows(self) -> tuple[slice, slice]:
        """Of both rests."""
        return slice(0, self.begin), slice(self.end, None)


def turned_by(angle_rad: FloatArray, vectors: FloatArray) -> FloatArray:
    """(T, 2) vectors turned by angles (T,) anticlockwise, as a clamp that comes to point down."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.column_stack([c * x - s * y, s * x + c * y])


def integrated(
    sensed: AccelerometerSamples,
    limit_m: float,
    ends_m: tuple[float, float] | None = None,
    gain_std: float = 0.0,
) -> Integrated:
    """The path of a gripper between two rests.

    limit_m   error of the place that is allowed for each thing that is wrong with a sensor
    ends_m    where the path ends, beside where it begins; None = that is not known
    gain_std  standard deviation of the sensor's sensitivity
    raises    NotIntegrableError: no rest before or after, a rest that differs from the other,
              saturation, too few samples, an end that is missed by more than noise explains
    """
    inner = sensed.accelerations()
    rests = _motion_rows(sensed, inner)
    if rests is None:
        return Integrated(np.zeros_like(inner), None)
    _check_saturation(sensed, rests)
    _check_gaps(sensed, rests)
    noise = _noise(sensed, inner, rests)
    offset = _offset(sensed, inner, rests, noise, limit_m)
    outer = turned_by(sensed.angle_rad, (inner - offset) * sensed.measured)
    path_m = _path(sensed.t_s, outer, rests, 1)
    _check_velocity(sensed, outer, rests, noise, limit_m)
    _check_rate(sensed, outer, path_m, rests, noise, limit_m)
    x, y = (float(v) for v in _turned_noise(noise, sensed.angle_rad[rests.begin]))
    times = float(sensed.t_s[rests.begin]), float(sensed.t_s[rests.end])
    drift = HandDrift(*times, (x, y), gain_std, ends_known=ends_m is not None)
    if ends_m is not None:
        path_m = _closed(sensed, path_m, rests, drift, np.array(ends_m))
    return Integrated(path_m, drift)


def _motion_rows(sensed: AccelerometerSamples, inner: FloatArray) -> _MotionRows | None:
    """Where the motion begins and ends; None if there is none.  Raises NotIntegrableError."""
    count, step_s = len(inner), sensed.step_s
    rest = max(REST_ROWS, int(np.ceil(REST_S / step_s)))
    if count < 3 * rest:
        raise NotIntegrableError(
            0, f"shows acceleration in {count} rows, limit {3 * rest}; record a rest before the "
            "motion, the motion, and a rest after it"
        )  # fmt: skip
    half = round(0.5 * _MEAN_S / step_s)
    mean = uniform_filter1d(inner, 2 * half + 1, axis=0, mode="nearest")
    mean[:half], mean[count - half :] = mean[half], mean[count - 1 - half]  # of as many rows each
    white = 1.4826 * np.median(np.abs(np.diff(inner, 2, axis=0)), axis=0) / np.sqrt(6.0)
    ends = mean[:rest], mean[-rest:]
    spread = np.minimum(*(np.std(part, axis=0) for part in ends))
    limit = np.maximum(_MOVES * white / np.sqrt(2 * half + 1), 5.0 * spread)
    limit = np.maximum(limit, 1.01 * sensed.digit) + 1e-6
    away = [np.any(np.abs(mean - np.median(part, axis=0)) > limit, axis=1) for part in ends]
    if not away[0].any() and not away[1].any():
        return None
    begin = int(np.argmax(away[0])) if away[0].any() else count
    end = count - int(np.argmax(away[1][::-1])) if away[1].any() else 0
    if begin >= end:
        raise NotIntegrableError(
            min(begin, count - 1), "differs at rest between the record's begin and its end, with "
            "no motion in between; let the sensor warm up and fasten it"
        )  # fmt: skip
    largest = np.abs(mean[begin:end] - np.median(ends[0], axis=0)).max(axis=0, initial=0.0)
    share = float(np.min(limit / np.maximum(largest, limit)))
    margin = 5 + int((_MARGIN + _LATE * share) * max(0, end - begin))
    for row, kept, where in (
        (begin, begin - margin, "before"),
        (end, count - end - margin, "after"),
    ):
        if kept < rest:
            at = min(row, count - 1)
            raise NotIntegrableError(
                at, f"the acceleration changes {max(kept, 0) * step_s:.2g} s from the end of the "
                f"record: there is no rest {where} the motion, limit {rest * step_s:.2g} s; record "
                "the gripper at rest there, for only then its velocity is known"
            )  # fmt: skip
    return _MotionRows(begin - margin, end + margin)


def _check_saturation(sensed: AccelerometerSamples, rests: _MotionRows) -> None:
    for axis in range(2):
        values = sensed.specific_force[rests.begin : rests.end, axis]
        steps, span = np.abs(np.diff(values)), float(np.ptp(values))
        if not sensed.measured[axis] or span < 1e-6:
            continue
        for extreme in (values.max(), values.min()):
            at = np.flatnonzero(values == extreme)
            runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
            longest = max(runs, key=len)
            within = longest[0] > 0 and longest[-1] < len(values) - 1  # else it may be the rest
            before = steps[longest[0] - 1] if within else 0.0
            steep = before > max(_SATURATED_STEP * sensed.digit[axis], _STEEP * span)
            if len(longest) >= SATURATED_ROWS and steep:
                raise NotIntegrableError(
                    rests.begin + int(longest[0]),
                    f"shows {extreme:.6g} m/s², an end of its range, in {len(longest)} rows one "
                    f"after the other, limit {SATURATED_ROWS - 1}: the sensor is saturated; move "
                    "the gripper more slowly, or take a wider range",
                )


def _check_gaps(sensed: AccelerometerSamples, rests: _MotionRows) -> None:
    steps_s = np.diff(sensed.t_s[rests.begin : rests.end + 1])
    longest = int(np.argmax(steps_s))
    if steps_s[longest] > _GAP * sensed.step_s:
        raise NotIntegrableError(
            rests.begin + longest + 1,
            f"comes {steps_s[longest]:.3g} s after the sample before, limit "
            f"{_GAP * sensed.step_s:.3g} s while the gripper moves; record it again without gaps",
        )


def _noise(sensed: AccelerometerSamples, inner: FloatArray, rests: _MotionRows) -> FloatArray:
    """(2,) one-sided density of the noise at rest along the sensor's axes, m/s²/√Hz.

    Of means over tenths of both rests where these vary more than white noise makes them.
    """
    variance, blocks, sizes = np.zeros(2), np.zeros(2), 0
    for rows in rests.rows:
        part = inner[rows]
        size = len(part) // _BLOCKS
        means = part[: size * _BLOCKS].reshape(_BLOCKS, size, 2).mean(axis=1)
        variance += np.sum((part - part.mean(axis=0)) ** 2, axis=0)
        blocks += size * np.sum((means - means.mean(axis=0)) ** 2, axis=0) / (2 * _BLOCKS - 2)
        sizes += len(part) - 1
    variance = np.maximum(variance / sizes, sensed.digit**2 / 12.0)
    return np.asarray(np.sqrt(2.0 * sensed.step_s * np.maximum(variance, blocks)))


def _turned_noise(noise: FloatArray, angle_rad: float) -> FloatArray:
    """(2,) along the study's axes."""
    c, s = np.cos(angle_rad) ** 2, np.sin(angle_rad) ** 2
    return np.sqrt(np.array([[c, s], [s, c]]) @ noise**2)


def _offset(
    sensed: AccelerometerSamples,
    inner: FloatArray,
    rests: _MotionRows,
    noise: FloatArray,
    limit_m: float,
) -> FloatArray:
    """(2,) the sensor's offset, by both rests.  Raises NotIntegrableError: they differ."""
    parts = [inner[rows] for rows in rests.rows]
    means = [part.mean(axis=0) for part in parts]
    seconds = [len(part) * sensed.step_s for part in parts]
    differ = np.abs(means[1] - means[0])
    std = noise * np.sqrt(0.5 * (1.0 / seconds[0] + 1.0 / seconds[1]))
    moved_s = sensed.t_s[rests.end] - sensed.t_s[rests.begin]
    allowed = np.maximum(SIGNIFICANT * std, 8.0 * limit_m / moved_s**2)
    worst = int(np.argmax(differ / np.maximum(allowed, 1e-12)))
    if differ[worst] > allowed[worst]:
        raise NotIntegrableError(
            rests.end,
            f"is {means[1][worst]:.4g} m/s² at rest after the motion, {means[0][worst]:.4g} m/s² "
            f"before it, gravity taken out; limit {allowed[worst]:.2g} m/s² apart, for a motion of "
            f"{moved_s:.2g} s: let the sensor warm up and fasten it, and if the clamp turns give "
            "its angle",
        )
    return np.asarray((means[0] * seconds[0] + means[1] * seconds[1]) / sum(seconds))


def _path(t_s: FloatArray, outer: FloatArray, rests: _MotionRows, every: int) -> FloatArray:
    """(T, 2) path by every so many samples, velocity 0 at both ends of the motion."""
    at_s = t_s[rests.begin : rests.end + 1 : every]
    if at_s[-1] < t_s[rests.end]:
        at_s = np.append(at_s, t_s[rests.end])
    rows = np.searchsorted(t_s, at_s)
    velocity = CubicSpline(at_s, outer[rows]).antiderivative()
    mean = velocity(at_s[-1]) / (at_s[-1] - at_s[0])
    within_s = np.clip(t_s, at_s[0], at_s[-1])
    since_s = within_s - at_s[0]
    return np.asarray(velocity.antiderivative()(within_s) - 0.5 * since_s[:, None] ** 2 * mean)


def _check_velocity(
    sensed: AccelerometerSamples,
    outer: FloatArray,
    rests: _MotionRows,
    noise: FloatArray,
    limit_m: float,
) -> None:
    """Raise NotIntegrableError where the gripper would not stop by far more than noise explains."""
    rows = slice(rests.begin, rests.end + 1)
    moved_s = float(sensed.t_s[rests.end] - sensed.t_s[rests.begin])
    ends = np.trapezoid(outer[rows], sensed.t_s[rows], axis=0)
    rest_s = (len(outer) - rests.end + rests.begin) * sensed.step_s
    std = float(np.max(noise)) * np.sqrt(0.5 * moved_s * (1.0 + moved_s / rest_s))
    allowed = max(SIGNIFICANT * std, 8.0 * limit_m / moved_s)
    speed = float(np.linalg.norm(ends))
    if speed > allowed:
        raise NotIntegrableError(
            rests.end,
            f"the acceleration leaves the gripper with {speed:.3g} m/s after the motion, where it "
            f"rests; limit {allowed:.2g} m/s: give the sensor's axes, the clamp's angle if it "
            "turns, and a sensor whose range is wide enough",
        )


def _check_rate(
    sensed: AccelerometerSamples,
    outer: FloatArray,
    path_m: FloatArray,
    rests: _MotionRows,
    noise: FloatArray,
    limit_m: float,
) -> None:
    """Raise NotIntegrableError where half of the samples would make another path."""
    moved_s = float(sensed.t_s[rests.end] - sensed.t_s[rests.begin])
    if rests.end - rests.begin < 8:
        apart_m = np.inf
    else:
        apart_m = float(np.abs(_path(sensed.t_s, outer, rests, 2) - path_m).max())
    std_m = float(np.max(noise)) * np.sqrt(moved_s**3 / 24.0)
    allowed_m = max(limit_m, SIGNIFICANT * std_m)
    if apart_m > allowed_m:
        raise NotIntegrableError(
            rests.begin,
            f"the motion of {moved_s:.2g} s has {rests.end - rests.begin} samples, "
            f"{1.0 / sensed.step_s:.4g} a second; the path from half of them differs by "
            f"{apart_m * 1e3:.3g} mm, limit {allowed_m * 1e3:.2g} mm: take a higher rate",
        )


def _closed(
    sensed: AccelerometerSamples,
    path_m: FloatArray,
    rests: _MotionRows,
    drift: HandDrift,
    ends_m: FloatArray,
) -> FloatArray:
    """The likeliest path that ends where it is known to.  Raises NotIntegrableError."""
    missed_m = ends_m - path_m[-1]
    moved_s = drift.to_s - drift.from_s
    noise_m2 = np.array(drift.noise_m_per_s2_per_rt_hz) ** 2 * moved_s**3 / 24.0
    gain_m2 = (drift.gain_std * path_m[-1]) ** 2
    std_m = np.sqrt(noise_m2 + gain_m2)
    worst = int(np.argmax(np.abs(missed_m) / np.maximum(std_m, 1e-12)))
    if abs(missed_m[worst]) > SIGNIFICANT * std_m[worst] + 1e-9:
        raise NotIntegrableError(
            rests.end,
            f"the path ends {abs(missed_m[worst]) * 1e3:.3g} mm from hand_ends_at_m along "
            f"{'xy'[worst]}, limit {SIGNIFICANT * std_m[worst] * 1e3:.2g} mm by its noise"
            f"{' and gain_std' if drift.gain_std else ''}; measure the end anew, or give gain_std "
            "of the sensor",
        )
    share = np.clip((sensed.t_s - drift.from_s) / moved_s, 0.0, 1.0)[:, None]
    by_noise = 3.0 * share**2 - 2.0 * share**3
    ends = np.where(path_m[-1] == 0.0, 1.0, path_m[-1])
    total = np.where(std_m > 0.0, std_m**2, 1.0)
    closed = missed_m * (noise_m2 * by_noise + gain_m2 * path_m / ends) / total
    return np.asarray(path_m + closed)
