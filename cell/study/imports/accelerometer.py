"""Gripper position by double integration of its acceleration between two rests.

The gripper's velocity is 0 at both rests.  For white noise and a constant offset of the sensor, the
maximum-likelihood acceleration is the measured one minus its mean over the motion: the
zero-velocity update (ZUPT) of inertial navigation.
Source: Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2013,
ch. 15.3 (zero velocity updates).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from cell.cable.arrays import FloatArray
from cell.study.hand_drift import HandDrift

#: Minimum number of rows and duration of a rest.
REST_ROWS, REST_S = 10, 0.05
#: Motion: the mean over so many seconds differs by so many standard deviations from that at rest.
_MEAN_S, _MOTION_SIGMAS = 0.02, 7.0
#: Margin before the detected start, shares of the motion: constant, and per limit/acceleration.
_MARGIN, _MARGIN_PER_LIMIT = 0.02, 0.3
#: Limit of a significant difference, standard deviations.
SIGNIFICANT = 4.0
#: Saturation: so many consecutive equal rows at an end of the range, after a step of so many digits
#: and of this share of the range.
SATURATED_ROWS, _SATURATED_STEP, _STEP_SHARE = 4, 3.0, 1e-3
#: Largest gap between samples of a motion, in median sampling intervals.
_MAX_GAP = 3.0
#: Low-frequency noise is estimated from the means of so many blocks of a rest.
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
    measured        whether each of the two is measured
    angle_rad       (T,) rotation of the sensor
    gravity         (x, y) in the study's frame, m/s²
    """

    t_s: FloatArray
    specific_force: FloatArray
    measured: tuple[bool, bool]
    angle_rad: FloatArray
    gravity: tuple[float, float]

    @property
    def step_s(self) -> float:
        """Median sampling interval."""
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
    """Path of a gripper from (0, 0): (T, 2), m, and its error model; None = it did not move."""

    path_m: FloatArray
    drift: HandDrift | None


def turned_by(angle_rad: FloatArray, vectors: FloatArray) -> FloatArray:
    """(T, 2) vectors rotated anticlockwise by angles (T,), as a clamp that turns downwards."""
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

    limit_m   largest position error allowed for each error source of a sensor
    ends_m    end of the path relative to its start; None = unknown
    gain_std  standard deviation of the sensor's sensitivity
    raises    NotIntegrableError: no rest before or after, rests that differ, saturation, too few
              samples, an end that differs by more than the noise explains
    """
    inner = sensed.accelerations()
    rows = _motion_rows(sensed, inner)
    if rows is None:
        return Integrated(np.zeros_like(inner), None)
    moved = _SensedMotion(sensed, inner, *rows, limit_m)
    moved.check_saturation()
    moved.check_gaps()
    moved.check_rests()
    moved.check_velocity()
    moved.check_rate()
    angle_rad = sensed.angle_rad[moved.begin]
    c, s = np.cos(angle_rad) ** 2, np.sin(angle_rad) ** 2
    x, y = np.sqrt(np.array([[c, s], [s, c]]) @ moved.noise**2).tolist()
    times = float(sensed.t_s[moved.begin]), float(sensed.t_s[moved.end])
    drift = HandDrift(*times, (x, y), gain_std, ends_known=ends_m is not None)
    if ends_m is None:
        return Integrated(moved.path_m, drift)
    return Integrated(moved.closed(drift, np.array(ends_m)), drift)


def _motion_rows(sensed: AccelerometerSamples, inner: FloatArray) -> tuple[int, int] | None:
    """First row of the motion, and first of the rest after it; None if there is no motion.

    raises  NotIntegrableError: there is no rest before or after it
    """
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
    white_std = 1.4826 * np.median(np.abs(np.diff(inner, 2, axis=0)), axis=0) / np.sqrt(6.0)
    ends = mean[:rest], mean[-rest:]
    spread = np.minimum(*(np.std(part, axis=0) for part in ends))
    limit = np.maximum(_MOTION_SIGMAS * white_std / np.sqrt(2 * half + 1), 5.0 * spread)
    limit = np.maximum(limit, 1.01 * sensed.digit) + 1e-6
    exceeds = [np.any(np.abs(mean - np.median(part, axis=0)) > limit, axis=1) for part in ends]
    if not exceeds[0].any() and not exceeds[1].any():
        return None
    begin = int(np.argmax(exceeds[0])) if exceeds[0].any() else count
    end = count - int(np.argmax(exceeds[1][::-1])) if exceeds[1].any() else 0
    if begin >= end:
        raise NotIntegrableError(
            min(begin, count - 1), "differs at rest between the record's begin and its end, with "
            "no motion in between; let the sensor warm up and fasten it"
        )  # fmt: skip
    largest = np.abs(mean[begin:end] - np.median(ends[0], axis=0)).max(axis=0, initial=0.0)
    share = float(np.min(limit / np.maximum(largest, limit)))
    margin = 5 + int((_MARGIN + _MARGIN_PER_LIMIT * share) * max(0, end - begin))
    for row, n_rest, where in (
        (begin, begin - margin, "before"),
        (end, count - end - margin, "after"),
    ):
        if n_rest < rest:
            at = min(row, count - 1)
            raise NotIntegrableError(
                at, f"the acceleration changes {max(n_rest, 0) * step_s:.2g} s from the end of the "
                f"record: there is no rest {where} the motion, limit {rest * step_s:.2g} s; record "
                "the gripper at rest there, for only then its velocity is known"
            )  # fmt: skip
    return begin - margin, end + margin


@dataclass(frozen=True, eq=False)
class _SensedMotion:
    """A motion between two rests, as measured by a sensor.

    inner    (T, 2) acceleration in the sensor's axes, with its offset, m/s²
    begin    first row of the motion
    end      first row of the rest after it
    limit_m  largest position error allowed for each error source of a sensor

    All checks raise NotIntegrableError.
    """

    sensed: AccelerometerSamples
    inner: FloatArray
    begin: int
    end: int
    limit_m: float

    @property
    def _rests(self) -> tuple[FloatArray, FloatArray]:
        """Accelerations before the motion and after it."""
        return self.inner[: self.begin], self.inner[self.end :]

    @property
    def _motion_s(self) -> float:
        return float(self.sensed.t_s[self.end] - self.sensed.t_s[self.begin])

    @cached_property
    def noise(self) -> FloatArray:
        """(2,) one-sided density of the noise at rest along the sensor's axes, m/s²/√Hz.

        From means over tenths of both rests if they vary more than white noise explains.
        """
        variance, blocks, sizes = np.zeros(2), np.zeros(2), 0
        for part in self._rests:
            size = len(part) // _BLOCKS
            means = part[: size * _BLOCKS].reshape(_BLOCKS, size, 2).mean(axis=1)
            variance += np.sum((part - part.mean(axis=0)) ** 2, axis=0)
            blocks += size * np.sum((means - means.mean(axis=0)) ** 2, axis=0) / (2 * _BLOCKS - 2)
            sizes += len(part) - 1
        variance = np.maximum(variance / sizes, self.sensed.digit**2 / 12.0)
        return np.asarray(np.sqrt(2.0 * self.sensed.step_s * np.maximum(variance, blocks)))

    @cached_property
    def _acceleration(self) -> FloatArray:
        """(T, 2) acceleration in the study's frame, without the sensor's offset, m/s²."""
        seconds = [len(part) * self.sensed.step_s for part in self._rests]
        means = [part.mean(axis=0) for part in self._rests]
        offset = (means[0] * seconds[0] + means[1] * seconds[1]) / sum(seconds)
        return turned_by(self.sensed.angle_rad, (self.inner - offset) * self.sensed.measured)

    @cached_property
    def path_m(self) -> FloatArray:
        """(T, 2) path from (0, 0) on, m."""
        return self._path(1)

    def _path(self, every: int) -> FloatArray:
        """(T, 2) path from every n-th sample, velocity 0 at both ends of the motion."""
        t_s = self.sensed.t_s
        at_s = t_s[self.begin : self.end + 1 : every]
        if at_s[-1] < t_s[self.end]:
            at_s = np.append(at_s, t_s[self.end])
        rows = np.searchsorted(t_s, at_s)
        velocity = CubicSpline(at_s, self._acceleration[rows]).antiderivative()
        mean = velocity(at_s[-1]) / (at_s[-1] - at_s[0])
        within_s = np.clip(t_s, at_s[0], at_s[-1])
        since_s = within_s - at_s[0]
        return np.asarray(velocity.antiderivative()(within_s) - 0.5 * since_s[:, None] ** 2 * mean)

    def check_saturation(self) -> None:
        """Check that no axis stays at an end of its range while the gripper moves."""
        for axis in range(2):
            values = self.sensed.specific_force[self.begin : self.end, axis]
            steps, span = np.abs(np.diff(values)), float(np.ptp(values))
            if not self.sensed.measured[axis] or span < 1e-6:
                continue
            for extreme in (values.max(), values.min()):
                at = np.flatnonzero(values == extreme)
                runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
                longest = max(runs, key=len)
                within = longest[0] > 0 and longest[-1] < len(values) - 1  # else it may be the rest
                before = steps[longest[0] - 1] if within else 0.0
                steep = before > max(_SATURATED_STEP * self.sensed.digit[axis], _STEP_SHARE * span)
                if len(longest) >= SATURATED_ROWS and steep:
                    raise NotIntegrableError(
                        self.begin + int(longest[0]),
                        f"shows {extreme:.6g} m/s², an end of its range, in {len(longest)} rows "
                        f"one after the other, limit {SATURATED_ROWS - 1}: the sensor is "
                        "saturated; move the gripper more slowly, or take a wider range",
                    )

    def check_gaps(self) -> None:
        """Check that no samples of the motion are missing."""
        steps_s = np.diff(self.sensed.t_s[self.begin : self.end + 1])
        longest = int(np.argmax(steps_s))
        if steps_s[longest] > _MAX_GAP * self.sensed.step_s:
            raise NotIntegrableError(
                self.begin + longest + 1,
                f"comes {steps_s[longest]:.3g} s after the sample before, limit "
                f"{_MAX_GAP * self.sensed.step_s:.3g} s while the gripper moves; record it again "
                "without gaps",
            )

    def check_rests(self) -> None:
        """Check that both rests show the same offset."""
        means = [part.mean(axis=0) for part in self._rests]
        seconds = [len(part) * self.sensed.step_s for part in self._rests]
        differ = np.abs(means[1] - means[0])
        std = self.noise * np.sqrt(0.5 * (1.0 / seconds[0] + 1.0 / seconds[1]))
        allowed = np.maximum(SIGNIFICANT * std, 8.0 * self.limit_m / self._motion_s**2)
        worst = int(np.argmax(differ / np.maximum(allowed, 1e-12)))
        if differ[worst] > allowed[worst]:
            raise NotIntegrableError(
                self.end,
                f"is {means[1][worst]:.4g} m/s² at rest after the motion, {means[0][worst]:.4g} "
                f"m/s² before it, gravity taken out; limit {allowed[worst]:.2g} m/s² apart, for a "
                f"motion of {self._motion_s:.2g} s: let the sensor warm up and fasten it, and if "
                "the clamp turns give its angle",
            )

    def check_velocity(self) -> None:
        """Check that the final velocity is 0 within the noise."""
        rows, moved_s = slice(self.begin, self.end + 1), self._motion_s
        ends = np.trapezoid(self._acceleration[rows], self.sensed.t_s[rows], axis=0)
        rest_s = (len(self._acceleration) - self.end + self.begin) * self.sensed.step_s
        std = float(np.max(self.noise)) * np.sqrt(0.5 * moved_s * (1.0 + moved_s / rest_s))
        allowed = max(SIGNIFICANT * std, 8.0 * self.limit_m / moved_s)
        speed = float(np.linalg.norm(ends))
        if speed > allowed:
            raise NotIntegrableError(
                self.end,
                f"the acceleration leaves the gripper with {speed:.3g} m/s after the motion, where "
                f"it rests; limit {allowed:.2g} m/s: give the sensor's axes, the clamp's angle if "
                "it turns, and a sensor whose range is wide enough",
            )

    def check_rate(self) -> None:
        """Check that every second sample gives the same path."""
        count, moved_s, difference_m = self.end - self.begin, self._motion_s, np.inf
        if count >= 8:
            difference_m = float(np.abs(self._path(2) - self.path_m).max())
        std_m = float(np.max(self.noise)) * np.sqrt(moved_s**3 / 24.0)
        allowed_m = max(self.limit_m, SIGNIFICANT * std_m)
        if difference_m > allowed_m:
            raise NotIntegrableError(
                self.begin,
                f"the motion of {moved_s:.2g} s has {count} samples, "
                f"{1.0 / self.sensed.step_s:.4g} a second; the path from half of them differs by "
                f"{difference_m * 1e3:.3g} mm, limit {allowed_m * 1e3:.2g} mm: take a higher rate",
            )

    def closed(self, drift: HandDrift, ends_m: FloatArray) -> FloatArray:
        """The maximum-likelihood path with the known end.  Raises NotIntegrableError."""
        last_m, moved_s = self.path_m[-1], self._motion_s
        end_error_m = ends_m - last_m
        noise_m2 = np.array(drift.noise_m_per_s2_per_rt_hz) ** 2 * moved_s**3 / 24.0
        gain_m2 = (drift.gain_std * last_m) ** 2
        std_m = np.sqrt(noise_m2 + gain_m2)
        worst = int(np.argmax(np.abs(end_error_m) / np.maximum(std_m, 1e-12)))
        if abs(end_error_m[worst]) > SIGNIFICANT * std_m[worst] + 1e-9:
            raise NotIntegrableError(
                self.end,
                f"the path ends {abs(end_error_m[worst]) * 1e3:.3g} mm from hand_ends_at_m along "
                f"{'xy'[worst]}, limit {SIGNIFICANT * std_m[worst] * 1e3:.2g} mm by its noise"
                f"{' and gain_std' if drift.gain_std else ''}; measure the end anew, or give "
                "gain_std of the sensor",
            )
        share = np.clip((self.sensed.t_s - drift.from_s) / moved_s, 0.0, 1.0)[:, None]
        by_noise = 3.0 * share**2 - 2.0 * share**3
        ends = np.where(last_m == 0.0, 1.0, last_m)
        total = np.where(std_m > 0.0, std_m**2, 1.0)
        closed = end_error_m * (noise_m2 * by_noise + gain_m2 * self.path_m / ends) / total
        return np.asarray(self.path_m + closed)
