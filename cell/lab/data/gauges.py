"""The wrench at a clamp among the markers of a study: as two further points, in lengths.

So whatever the lab knows of markers, their noise, their mesh's error or the hand's, it knows of
forces too.  The first point has the force as its coordinates.  The second has the moment, and
another that is never seen.  Their unit is such that their noise is as large as the markers'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.wrench import AS_POINTS, Gauge, as_points
from cell.identify.noise import Noise
from cell.identify.whitener import Sensors
from cell.lab.data.noise_model import (
    NoiseModel,
    NoiseUnknownError,
    noise_model_of_blocks,
    still_blocks,
)
from cell.study.data import Markers, Study, Trial, Wrench

FloatArray = NDArray[np.float64]

#: A tare is anything up to so many standard deviations of the noise: nothing is known of it.
TARE = 1e4
#: Rows of a wrench that are farther apart than this are not averaged: forces change within it, s.
SPAN_S = 0.005
#: Times that differ by less are one, s.
SAME_S = 1e-6
#: A sensor has so many rows in each of these spans, or is taken as it is.
FEWEST_IN_SPAN = 2
#: A cable that is let go is let go of some time beside what was noted, s.
LATE_S = 0.02


@dataclass(frozen=True, eq=False)
class Gauges:
    """How a study's wrenches are told as points.

    markers     how many points are places
    force, moment  noise of one row, N and N·m
    std_m       noise that the points have, as the markers'
    inflation   by how much more they are doubted: a model's error that takes the noise's place
    gain_std    of a sensor's gain in one trial, were it another in each: see `whiteners_of`
    frames, rows  per trial (T,) whether a row is one of the markers', and of the wrench
    """

    gauge: Gauge
    markers: int
    force: NoiseModel
    moment: NoiseModel
    std_m: float
    frames: Mapping[str, NDArray[np.bool_]]
    rows: Mapping[str, NDArray[np.bool_]]
    inflation: float = 1.0
    gain_std: float = 0.0

    @property
    def scale(self) -> FloatArray:
        """(AS_POINTS, 2) lengths per newton, and per newton metre."""
        per_n, per_nm = (self.std_m / m.noise.std_m for m in (self.force, self.moment))
        return np.array([[per_n, per_n], [per_nm, 1.0]])

    @property
    def noises(self) -> tuple[Noise, ...]:
        """Of each of the points, with the tare as its bias."""
        return tuple(
            replace(m.noise, std_m=self.inflation * self.std_m, bias_m=TARE * self.std_m)
            for m in (self.force, self.moment)
        )

    def sensors(self, trial: Trial) -> Sensors | None:
        """What a whitener is told of a trial's points; None if they are not there."""
        if not self.are_in(trial):
            return None
        name = trial.name
        return Sensors(self.noises, self.gain_std, self.frames[name], self.rows[name])

    def with_planned(
        self, trials: Sequence[Trial], gain_std: float
    ) -> tuple[tuple[Trial, ...], Gauges]:
        """Trials that are not recorded yet with their wrenches among the markers, and where."""
        joined = [_joined(t) for t in trials]
        frames, rows = ({t.name: part[i] for t, *part in joined} for i in (0, 1))
        known = replace(
            self,
            frames={**self.frames, **frames},
            rows={**self.rows, **rows},
            gain_std=gain_std,
        )
        return tuple(t for t, *_ in joined), known

    def are_in(self, trial: Trial) -> bool:
        """Whether a trial has these points: one that is planned has not."""
        return bool(trial.markers.xy_m.shape[1] == self.markers + AS_POINTS)

    def of_markers(self, name: str, rows: FloatArray) -> FloatArray:
        """(frames, markers, …) of (T, markers + AS_POINTS, …): what is of places."""
        return np.asarray(rows[self.frames[name], : self.markers])

    def of_wrench(self, rows: FloatArray) -> FloatArray:
        """(T, 3) force, N, and moment, N·m, of (T, markers + AS_POINTS, 2)."""
        values = rows[:, self.markers :] / self.scale
        return np.asarray(values.reshape(len(rows), -1)[:, :3])


def with_gauges(study: Study, std_m: float, inflation: float) -> tuple[Study, Gauges | None]:
    """The study with its wrenches among the markers, if any trial has one.

    std_m      noise of the markers
    inflation  see `Gauges`
    raises     NoiseUnknownError: no still rows, and no stated level
    """
    if all(t.wrench is None for t in study.trials):
        return study, None
    joined = [_joined(t) for t in study.trials]
    trials = [t for t, *_ in joined]
    frames, rows = ({t.name: part[i] for t, *part in joined} for i in (0, 1))
    markers, sensor = len(study.arc_length_m), study.sensor
    alone = [_of_rows(t, rows[t.name]) for t in trials]
    force = _noise_model(study.name, alone, markers, "force_std_n", sensor.force_std_n)
    moment = _noise_model(study.name, alone, markers + 1, "moment_std_nm", sensor.moment_std_nm)
    gain_std = sensor.gain_std * float(np.sqrt(sum(t.wrench is not None for t in study.trials)))
    noise = force, moment, std_m
    gauges = Gauges(sensor.gauge, markers, *noise, frames, rows, inflation, gain_std)
    return scaled(replace(study, trials=tuple(trials)), gauges, gauges.scale), gauges


def scaled(study: Study, gauges: Gauges, factors: FloatArray) -> Study:
    """The study with the coordinates of its wrenches multiplied by (AS_POINTS, 2)."""
    return replace(study, trials=tuple(_scaled(t, gauges, factors) for t in study.trials))


def without_gauges(study: Study, gauges: Gauges) -> Study:
    """The study with its wrenches beside the markers again, in their units."""
    return replace(study, trials=tuple(_parted(t, gauges) for t in study.trials))


def _scaled(trial: Trial, gauges: Gauges, factors: FloatArray) -> Trial:
    if not gauges.are_in(trial):
        return trial
    xy_m = trial.markers.xy_m.copy()
    xy_m[:, gauges.markers :] *= factors
    return replace(trial, markers=replace(trial.markers, xy_m=xy_m))


def _parted(trial: Trial, gauges: Gauges) -> Trial:
    if not gauges.are_in(trial):
        return trial
    t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
    values = gauges.of_wrench(xy_m)
    there = np.isfinite(values).any(axis=1)
    places = replace(
        trial.markers,
        t_s=t_s[gauges.frames[trial.name]],
        xy_m=gauges.of_markers(trial.name, xy_m),
    )
    wrench = Wrench(t_s[there], values[there]) if there.any() else None
    return replace(trial, markers=places, wrench=wrench)


def _of_rows(trial: Trial, rows: NDArray[np.bool_]) -> Trial:
    """A trial as some of its rows show it."""
    t_s, xy_m = trial.markers.t_s[rows], trial.markers.xy_m[rows]
    return replace(trial, markers=Markers(t_s, xy_m))


def _joined(trial: Trial) -> tuple[Trial, NDArray[np.bool_], NDArray[np.bool_]]:
    """A trial with its wrench among the markers, in its units; the rows of each of both.

    Only while markers were looked for, and not while fingers hold the cable too.
    """
    markers, times_s = trial.markers, trial.markers.t_s
    t_s, values = _on_frames(trial.wrench, times_s)
    free_s = -np.inf if trial.release_s is None else trial.release_s + LATE_S
    kept = (t_s >= max(times_s[0], free_s)) & (t_s <= times_s[-1])
    kept &= np.isfinite(values).any(axis=1)
    t_s, values = t_s[kept], values[kept]
    all_s = np.union1d(times_s, t_s)
    places, rows = np.searchsorted(all_s, times_s), np.searchsorted(all_s, t_s)
    count = markers.xy_m.shape[1]
    xy_m = np.full((len(all_s), count + AS_POINTS, 2), np.nan)
    xy_m[places, :count] = markers.xy_m
    shown = as_points(values)
    shown[:, -1, -1] = np.nan
    xy_m[rows, count:] = shown
    frames, own = np.zeros((2, len(all_s)), dtype=np.bool_)
    frames[places], own[rows] = True, True
    told = Markers(all_s, xy_m, markers.source)
    return replace(trial, markers=told, wrench=None), frames, own


def _on_frames(wrench: Wrench | None, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times and values of a wrench: those of the markers' frames, and between them if they are few.

    Of a sensor that is much faster each is what a line through the rows around that time has there;
    of any other they are its own, moved to a frame that is at the same time.
    """
    if wrench is None:
        return np.empty(0), np.empty((0, 3))
    frame_s, row_s = (float(np.median(np.diff(t))) for t in (times_s, wrench.t_s))
    parts = int(np.ceil(frame_s / SPAN_S - 1e-9))
    span_s = frame_s / max(parts, 1)
    if span_s < FEWEST_IN_SPAN * row_s * (1.0 - 1e-9):
        near = np.clip(np.searchsorted(times_s, wrench.t_s), 1, len(times_s) - 1)
        near -= wrench.t_s - times_s[near - 1] < times_s[near] - wrench.t_s
        same = np.abs(times_s[near] - wrench.t_s) < SAME_S
        t_s, first = np.unique(np.where(same, times_s[near], wrench.t_s), return_index=True)
        return t_s, wrench.values[first]
    between = np.arange(parts) / parts
    steps = np.append(np.diff(times_s), 0.0)
    t_s = np.unique(times_s[:, None] + steps[:, None] * between)
    return t_s, np.stack([_lines(wrench.t_s, v, t_s, span_s) for v in wrench.values.T], axis=1)


def _lines(t_s: FloatArray, values: FloatArray, at_s: FloatArray, span_s: float) -> FloatArray:
    """(n,) at times, of lines fitted to the values (T,) within a span around each; nan if few."""
    seen = np.isfinite(values)
    t_s, values = t_s[seen], values[seen]
    first, last = (np.searchsorted(t_s, at_s + side * 0.5 * span_s) for side in (-1.0, 1.0))

    def sums(of: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(of)])
        return np.asarray(total[last] - total[first])

    middle, level = (float(np.mean(v)) if len(v) else 0.0 for v in (t_s, values))
    x, y = t_s - middle, values - level
    n = np.maximum(last - first, 1)
    mean_x, mean_y = sums(x) / n, sums(y) / n
    square = np.maximum(sums(x * x) / n - mean_x**2, 1e-18)
    slope = np.where(last - first > FEWEST_IN_SPAN, (sums(x * y) / n - mean_x * mean_y) / square, 0)
    found = level + mean_y + slope * (at_s - middle - mean_x)
    return np.asarray(np.where(last - first >= FEWEST_IN_SPAN, found, np.nan))


def _noise_model(
    name: str, trials: Sequence[Trial], point: int, key: str, stated: float | None
) -> NoiseModel:
    """Of the coordinates of a point, in their unit."""
    columns = slice(point, point + 1)
    series = [v for t in trials for v in t.markers.xy_m[:, point].T if np.isfinite(v).any()]
    if not series:
        return NoiseModel(Noise(1.0), np.inf)
    blocks = [block for t in trials for block in still_blocks(t, columns)]
    found = noise_model_of_blocks(blocks, series, stated)
    if found is None:
        raise NoiseUnknownError(
            f"study {name}: no trial has still rows of the wrench before the hand moves, so its "
            f"noise is unknown; give wrench.{key} in study.yaml"
        )
    return found
