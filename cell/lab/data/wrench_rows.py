"""The rows of a wrench among a trial's frames: as they are, or as means over spans of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.wrench import AS_POINTS, AXES, FEWEST_ROWS, RowMeans, as_points
from cell.study.data import Markers, Trial, Wrench

#: Rows of a wrench that are farther apart than this are not averaged: forces change within it, s.
SPAN_S = 0.005
#: Times that differ by less are one, s.
SAME_S = 1e-6
#: A cable that is let go is let go of some time beside what was noted, s.
LATE_S = 0.02


@dataclass(frozen=True, eq=False)
class JoinedTrial:
    """A trial with its wrench among the markers, as `AS_POINTS` more, in newtons.

    wrench  all that the sensor showed, if it showed anything
    frames, rows  (T,) whether a row is one of the markers', and of the wrench
    """

    trial: Trial
    wrench: Wrench | None
    frames: NDArray[np.bool_]
    rows: NDArray[np.bool_]

    @property
    def alone(self) -> Trial:
        """The trial as the rows of its wrench show it."""
        t_s, xy_m = self.trial.markers.t_s[self.rows], self.trial.markers.xy_m[self.rows]
        return replace(self.trial, markers=Markers(t_s, xy_m))

    @property
    def unaveraged(self) -> Trial:
        """The trial as each row of its sensor shows it; no markers are seen."""
        if self.wrench is None:
            return self.alone
        markers = self.trial.markers.xy_m.shape[1] - AS_POINTS
        places = np.full((len(self.wrench.t_s), markers, 2), np.nan)
        shown = _points(self.wrench.values)
        seen = Markers(self.wrench.t_s, np.concatenate([places, shown], axis=1))
        return replace(self.trial, markers=seen)


def joined(trial: Trial, *, averaged: bool = True) -> JoinedTrial:
    """A trial with its wrench among the markers.

    Only while markers were looked for, and not while fingers hold the cable too.

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
            there = np.flatnonzero(np.isfinite(values).any(axis=1))
            t_s, values, means = t_s[there], values[there], means.some(there)
    all_s = np.union1d(times_s, t_s)
    places, rows = np.searchsorted(all_s, times_s), np.searchsorted(all_s, t_s)
    if means is not None:
        means = replace(means, among=rows)
    count = markers.xy_m.shape[1]
    xy_m = np.full((len(all_s), count + AS_POINTS, 2), np.nan)
    xy_m[places, :count] = markers.xy_m
    xy_m[rows, count:] = _points(values)
    frames, own = np.zeros((2, len(all_s)), dtype=np.bool_)
    frames[places], own[rows] = True, True
    shown = Markers(all_s, xy_m, markers.source)
    told = replace(trial, markers=shown, wrench=None, row_means=means)
    return JoinedTrial(told, trial.wrench, frames, own)


def row_means(wrench: Wrench, at_s: FloatArray, span_s: float) -> RowMeans:
    """Means of the rows of a wrench within a span around each of some times (n,)."""
    first, last = (np.searchsorted(wrench.t_s, at_s + side * span_s) for side in (-0.5, 0.5))
    seen = np.isfinite(wrench.values)
    return RowMeans(wrench.t_s, seen, np.arange(len(at_s)), first, last)


def _while_filmed(trial: Trial) -> Wrench | None:
    """The rows of a trial's wrench that count; None if there are none."""
    if trial.wrench is None:
        return None
    t_s, times_s = trial.wrench.t_s, trial.markers.t_s
    free_s = -np.inf if trial.release_s is None else trial.release_s + LATE_S
    kept = (t_s >= max(times_s[0], free_s)) & (t_s <= times_s[-1])
    kept &= np.isfinite(trial.wrench.values).any(axis=1)
    return Wrench(t_s[kept], trial.wrench.values[kept]) if kept.any() else None


def _at_frames(wrench: Wrench, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times and values of a wrench, moved to a frame that is at the same time."""
    near = np.clip(np.searchsorted(times_s, wrench.t_s), 1, len(times_s) - 1)
    near -= wrench.t_s - times_s[near - 1] < times_s[near] - wrench.t_s
    same = np.abs(times_s[near] - wrench.t_s) < SAME_S
    t_s, first = np.unique(np.where(same, times_s[near], wrench.t_s), return_index=True)
    return t_s, wrench.values[first]


def _spans(times_s: FloatArray) -> tuple[FloatArray, float]:
    """Times of the frames, and between them if they are few, and the span around each, s."""
    frame_s = _step_s(times_s)
    parts = max(int(np.ceil(frame_s / SPAN_S - 1e-9)), 1)
    steps = np.append(np.diff(times_s), 0.0)
    return np.unique(times_s[:, None] + steps[:, None] * np.arange(parts) / parts), frame_s / parts


def _step_s(times_s: FloatArray) -> float:
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else np.inf


def _points(values: FloatArray) -> FloatArray:
    """(T, AS_POINTS, 2) of a wrench (T, AXES): the last coordinate is never seen."""
    shown = as_points(values)
    shown[:, -1, -1] = np.nan
    return shown
