"""The wrench at the clamp as two further points of a study's markers, in units of length.

Noise, mesh error and gripper-log error of forces are then treated like those of markers.  The
coordinates of the first point are the force.  Those of the second are the moment and an unused
coordinate, which is always nan.  The unit makes their noise equal to that of the markers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.wrench import AS_POINTS, AXES, FEWEST_ROWS, Gauge, RowMeans, as_points
from cell.identify.noise import Noise
from cell.identify.whitener import Sensors
from cell.lab.data.noise_likelihood import RestFrames
from cell.lab.data.noise_model import (
    NoiseModel,
    NoiseUnknownError,
    noise_model_of_blocks,
    still_blocks,
)
from cell.study.data import Markers, Study, Trial, Wrench

#: Longest span of averaged rows of a wrench, s: forces change within it.
SPAN_S = 0.005
#: Times that differ by less are equal, s.
SAME_S = 1e-6
#: Uncertainty of the recorded time of a release, s.
LATE_S = 0.02


@dataclass(frozen=True, eq=False)
class JoinedTrial:
    """A trial with its wrench as `AS_POINTS` further points after the markers, in newtons.

    wrench  all samples of the sensor; None if there are none
    frames, rows  (T,) whether a row has markers, and whether it has a wrench
    """

    trial: Trial
    wrench: Wrench | None
    frames: NDArray[np.bool_]
    rows: NDArray[np.bool_]

    @property
    def alone(self) -> Trial:
        """The trial with only the rows that have a wrench."""
        t_s, xy_m = self.trial.markers.t_s[self.rows], self.trial.markers.xy_m[self.rows]
        return replace(self.trial, markers=Markers(t_s, xy_m))

    @property
    def unaveraged(self) -> Trial:
        """The trial with each sample of its sensor as a row, and no markers."""
        if self.wrench is None:
            return self.alone
        markers = self.trial.markers.xy_m.shape[1] - AS_POINTS
        places = np.full((len(self.wrench.t_s), markers, 2), np.nan)
        shown = _points(self.wrench.values)
        rows = Markers(self.wrench.t_s, np.concatenate([places, shown], axis=1))
        return replace(self.trial, markers=rows)


def joined(trial: Trial, *, averaged: bool = True) -> JoinedTrial:
    """The trial with its wrench as further points after the markers.

    Only during the camera's record, and not while fingers hold the cable too.

    averaged  rows of a sensor that is much faster than the camera are replaced by their means
    """
    markers, times_s = trial.markers, trial.markers.t_s
    wrench, means = _while_filmed(trial), None
    t_s, values = np.empty(0), np.empty((0, AXES))
    if wrench is not None:
        t_s, values = _at_frames(wrench, times_s)
        at_s, span_s = _spans(times_s)
        if averaged and span_s >= FEWEST_ROWS * _step_s(wrench.t_s) * (1.0 - 1e-9):
            means = row_means(wrench, at_s, span_s)
            t_s, values = at_s, means.of(wrench.values)
            valid = np.flatnonzero(np.isfinite(values).any(axis=1))
            t_s, values, means = t_s[valid], values[valid], means.some(valid)
    all_s = np.union1d(times_s, t_s)
    places, rows = np.searchsorted(all_s, times_s), np.searchsorted(all_s, t_s)
    if means is not None:
        means = replace(means, among=rows)
    count = markers.xy_m.shape[1]
    xy_m = np.full((len(all_s), count + AS_POINTS, 2), np.nan)
    xy_m[places, :count] = markers.xy_m
    xy_m[rows, count:] = _points(values)
    frames, wrench_rows = np.zeros((2, len(all_s)), dtype=np.bool_)
    frames[places], wrench_rows[rows] = True, True
    all_markers = Markers(all_s, xy_m, markers.source)
    extended = replace(trial, markers=all_markers, wrench=None, row_means=means)
    return JoinedTrial(extended, trial.wrench, frames, wrench_rows)


def row_means(wrench: Wrench, at_s: FloatArray, span_s: float) -> RowMeans:
    """Means of the rows of a wrench within a span around each of some times (n,)."""
    first, last = (np.searchsorted(wrench.t_s, at_s + side * span_s) for side in (-0.5, 0.5))
    observed = np.isfinite(wrench.values)
    return RowMeans(wrench.t_s, observed, np.arange(len(at_s)), first, last)


def _while_filmed(trial: Trial) -> Wrench | None:
    """The rows of a trial's wrench during the camera's record; None if there are none."""
    if trial.wrench is None:
        return None
    t_s, times_s = trial.wrench.t_s, trial.markers.t_s
    free_s = -np.inf if trial.release_s is None else trial.release_s + LATE_S
    used = (t_s >= max(times_s[0], free_s)) & (t_s <= times_s[-1])
    used &= np.isfinite(trial.wrench.values).any(axis=1)
    return Wrench(t_s[used], trial.wrench.values[used]) if used.any() else None


def _at_frames(wrench: Wrench, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times and values of a wrench, the times of simultaneous frames replaced by theirs."""
    nearest = np.clip(np.searchsorted(times_s, wrench.t_s), 1, len(times_s) - 1)
    nearest -= wrench.t_s - times_s[nearest - 1] < times_s[nearest] - wrench.t_s
    same = np.abs(times_s[nearest] - wrench.t_s) < SAME_S
    t_s, first = np.unique(np.where(same, times_s[nearest], wrench.t_s), return_index=True)
    return t_s, wrench.values[first]


def _spans(times_s: FloatArray) -> tuple[FloatArray, float]:
    """Times of the frames, with intermediate ones if the rate is low, and the span of each, s."""
    frame_s = _step_s(times_s)
    parts = max(int(np.ceil(frame_s / SPAN_S - 1e-9)), 1)
    steps = np.append(np.diff(times_s), 0.0)
    return np.unique(times_s[:, None] + steps[:, None] * np.arange(parts) / parts), frame_s / parts


def _step_s(times_s: FloatArray) -> float:
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else np.inf


def _points(values: FloatArray) -> FloatArray:
    """(T, AS_POINTS, 2) points of a wrench (T, AXES); the last coordinate is always nan."""
    points = as_points(values)
    points[:, -1, -1] = np.nan
    return points


#: Prior standard deviation of a tare, in standard deviations of the noise: uninformative.
TARE = 1e4


@dataclass(frozen=True, eq=False)
class Gauges:
    """How a study's wrenches are represented as points: scale, noise and gain.

    markers     number of points that are markers
    force, moment  noise of one value, N and N·m: of a row, or of a mean of rows
    std_m       noise of the points, equal to the markers'
    inflation   factor on it, if a model's error replaces the noise
    gain_std    of a sensor's gain in one trial, as if independent between trials: `whiteners_of`
    joined      per trial its rows of markers and of the wrench, and the measured wrench
    """

    gauge: Gauge
    markers: int
    force: NoiseModel
    moment: NoiseModel
    std_m: float
    joined: Mapping[str, JoinedTrial]
    inflation: float = 1.0
    gain_std: float = 0.0
    expected: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def scale(self) -> FloatArray:
        """(AS_POINTS, 2) lengths per newton, and per newton metre."""
        per_n, per_nm = (self.std_m / m.noise.std_m for m in (self.force, self.moment))
        return np.array([[per_n, per_n], [per_nm, 1.0]])

    @property
    def noises(self) -> tuple[Noise, ...]:
        """Noise of each of the points, with the tare as its bias."""
        return tuple(
            replace(m.noise, std_m=self.inflation * self.std_m, bias_m=TARE * self.std_m)
            for m in (self.force, self.moment)
        )

    def sensors(self, trial: Trial) -> Sensors | None:
        """Description of a trial's points for the whitener; None if it has none."""
        if not self.are_in(trial):
            return None
        trial_rows, expected = self.joined[trial.name], self.expected.get(trial.name)
        expected = None if expected is None else expected * self.scale
        return Sensors(self.noises, self.gain_std, trial_rows.frames, trial_rows.rows, expected)

    def as_expected(self, predicted: Mapping[str, FloatArray]) -> Gauges:
        """The same with the expected wrench from a model's points (T, all points, 2), by trial."""
        expected = {n: p[:, self.markers :] / self.scale for n, p in predicted.items()}
        return replace(self, expected={**self.expected, **expected})

    def with_planned(
        self, trials: Sequence[Trial], gain_std: float, *, averaged: bool = True
    ) -> tuple[tuple[Trial, ...], Gauges]:
        """Planned trials with their wrenches among the markers, and the gauges with these."""
        planned = {t.name: joined(t, averaged=averaged) for t in trials}
        gauges = replace(self, joined={**self.joined, **planned}, gain_std=gain_std)
        return tuple(j.trial for j in planned.values()), gauges

    def are_in(self, trial: Trial) -> bool:
        """Whether a trial has these points: a planned one has not."""
        return bool(trial.markers.xy_m.shape[1] == self.markers + AS_POINTS)

    def of_markers(self, name: str, rows: FloatArray) -> FloatArray:
        """(frames, markers, …) part of (T, markers + AS_POINTS, …) that belongs to markers."""
        return np.asarray(rows[self.joined[name].frames, : self.markers])

    def of_wrench(self, rows: FloatArray) -> FloatArray:
        """(T, 3) force, N, and moment, N·m, from (T, markers + AS_POINTS, 2)."""
        values = rows[:, self.markers :] / self.scale
        return np.asarray(values.reshape(len(rows), -1)[:, :3])


def with_gauges(
    study: Study, std_m: float, inflation: float, *, averaged: bool = True
) -> tuple[Study, Gauges | None]:
    """The study with its wrenches as further points of its markers, if any trial has one.

    std_m      noise of the markers
    inflation  see `Gauges`
    averaged   see `joined`
    raises     NoiseUnknownError: no still rows, and no stated level
    """
    if all(t.wrench is None for t in study.trials):
        return study, None
    by_name = {t.name: joined(t, averaged=averaged) for t in study.trials}
    trials, markers, sensor = list(by_name.values()), len(study.arc_length_m), study.sensor
    force = _noise_model(study.name, trials, markers, "force_std_n", sensor.force_std_n)
    moment = _noise_model(study.name, trials, markers + 1, "moment_std_nm", sensor.moment_std_nm)
    gain_std = sensor.gain_std * float(np.sqrt(sum(t.wrench is not None for t in study.trials)))
    gauges = Gauges(
        sensor.gauge, markers, force, moment, std_m, by_name, inflation=inflation, gain_std=gain_std
    )
    study = replace(study, trials=tuple(j.trial for j in trials))
    return scaled(study, gauges, gauges.scale), gauges


def scaled(study: Study, gauges: Gauges, factors: FloatArray) -> Study:
    """The study with its wrench points multiplied by factors (AS_POINTS, 2)."""

    def places(trial: Trial) -> FloatArray:
        xy_m = trial.markers.xy_m.copy()
        xy_m[:, gauges.markers :] *= factors if gauges.are_in(trial) else 1.0
        return xy_m

    return study.with_places(places)


def without_gauges(study: Study, gauges: Gauges) -> Study:
    """The study with its wrenches separate from the markers again, as the sensor's rows."""
    return replace(study, trials=tuple(_separated(t, gauges) for t in study.trials))


def _separated(trial: Trial, gauges: Gauges) -> Trial:
    if not gauges.are_in(trial):
        return trial
    joined_trial = gauges.joined[trial.name]
    if trial.row_means is not None:
        wrench = joined_trial.wrench
    else:
        values = gauges.of_wrench(trial.markers.xy_m)
        valid = np.isfinite(values).any(axis=1)
        wrench = Wrench(trial.markers.t_s[valid], values[valid]) if valid.any() else None
    places = replace(
        trial.markers,
        t_s=trial.markers.t_s[joined_trial.frames],
        xy_m=gauges.of_markers(trial.name, trial.markers.xy_m),
    )
    return replace(trial, markers=places, wrench=wrench, row_means=None)


def _noise_model(
    name: str, each: Sequence[JoinedTrial], point: int, key: str, stated: float | None
) -> NoiseModel:
    """Noise of a point's coordinates in their unit; `stated`: that of one row of the sensor."""
    columns = slice(point, point + 1)
    trials = [j.alone for j in each]
    series = [v for t in trials for v in t.markers.xy_m[:, point].T if np.isfinite(v).any()]
    if not series:
        return NoiseModel(Noise(1.0), np.inf)
    blocks = [block for t in trials for block in still_blocks(t, columns)]
    if stated is not None:
        stated *= np.sqrt(_share_of_means(each, point))
    model = noise_model_of_blocks(blocks, series, stated)
    if model is None:
        raise NoiseUnknownError(
            f"study {name}: no trial has still rows of the wrench before the gripper moves, so its "
            f"noise is unknown; give wrench.{key} in study.yaml"
        )
    return model


def _share_of_means(each: Sequence[JoinedTrial], point: int) -> float:
    """Variance of a mean of rows over that of one row, by the autocorrelation at rest."""
    counts = [m.rows.max(axis=1) for j in each if (m := j.trial.row_means) is not None]
    if not counts:
        return 1.0
    rows = int(np.median(np.concatenate(counts)))
    blocks = [b for j in each for b in still_blocks(j.unaveraged, slice(point, point + 1))]
    ar1 = RestFrames.of(blocks, 0.0).likeliest()[0].ar1 if blocks else 0.0
    lags = np.arange(1, rows)
    return float(1.0 + 2.0 * np.sum((1.0 - lags / rows) * ar1**lags)) / rows
