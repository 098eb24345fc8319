"""Whitening of a trial's residuals: noise, uncertain arc lengths, gripper drift, tares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.identify.innovations import coloured, innovations, whiten, whiten_constant
from cell.identify.noise import Noise, across

#: Shortest half period of a smooth residual, frames; number of polynomials along the cable.
SLOW_FRAMES, ALONG = 8, 3

#: Rows of the moving mean that estimates a sensor's signal.
SHOWN_ROWS = 5


@dataclass(frozen=True, eq=False)
class Sensors:
    """The last points of a trial that are values of a sensor, scaled to lengths, not markers.

    noises    of each of these points; the bias is that of a tare
    gain_std  standard deviation of the sensor's gain, which is 1 on average
    frames    (T,) whether a row is one of the markers', rows: whether it is one of the sensor's
    shown_m   (T, gauges, 2) the sensor's signal by a model; None = by smoothing the measurement
    """

    noises: tuple[Noise, ...]
    gain_std: float
    frames: NDArray[np.bool_]
    rows: NDArray[np.bool_]
    shown_m: FloatArray | None = None


class Whitener:
    """Turns predicted markers of one trial into white residuals of unit size.

    A channel (x or y of a marker, or its place across the cable) has an AR(1) error over the
    frames in which it was observed, optionally white noise as well (then its innovations are those
    of a Kalman filter), and a constant of known variance, which is integrated out.  So are
    uncertain arc lengths of the markers, and common shifts of all markers of a trial.

    The last markers may be those of a sensor with its own noise (`cell.lab.data.gauges`).  Their
    constant is a tare with a flat prior, not an error; their common gain is uncertain too.

    seen  (T, markers, channels) whether a channel was observed: some markers have one coordinate
    """

    def __init__(
        self,
        markers_m: FloatArray,
        noise: Noise,
        shift_m: FloatArray | None = None,
        together_m: FloatArray | None = None,
        sensors: Sensors | None = None,
        levels: FloatArray | None = None,
    ) -> None:
        """`markers_m` (T, markers, 2) as measured, nan where not observed.

        shift_m  (T, markers, 2) shift of a marker by one standard deviation of its arc length
        together_m  (shapes, T, markers, 2) independent common shifts, one standard deviation each
        sensors  of the last markers, if these are a sensor's; they have two axes
        levels   (markers without the sensor's,) noise relative to `noise`; None = 1
        """
        gauges = () if sensors is None else sensors.noises
        self.noise, self._gauges, self._sensors = noise, len(gauges), sensors
        finite = np.isfinite(markers_m)
        self.frames, markers = finite.shape[:2]
        if noise.across_only:
            self._axes = np.ascontiguousarray(across(markers_m)[:, :, None])
            self.observed = np.asarray(finite.all(axis=-1, keepdims=True), dtype=np.bool_)
            measured = self.observed
        else:
            self._axes = np.broadcast_to(np.eye(2), (self.frames, markers, 2, 2)).copy()
            self.observed = measured = finite
        self.measured = np.where(measured, markers_m, 0.0)
        self.channels = self._axes.shape[2]
        self.rows = markers * self.channels * self.frames
        tares = self.observed[:, markers - len(gauges) :].any(axis=0)
        self.count = int(self.observed.sum()) - int(tares.sum())
        each = [noise] * (markers - len(gauges)) + list(gauges)
        self._memory, self._weight, self._gain = self._innovations(each)
        if levels is not None:
            self._weight[: len(levels)] /= levels[:, None, None]
        # whitened constant, and the factor on a residual's component along it
        self._ones = self._weight.copy()
        if any(n.white > 0.0 for n in each):
            whiten_constant(self._memory, self._weight, self._gain, self._ones)
        else:
            self._ones[..., 1:] *= 1.0 - self._memory[..., 1:]
        size = np.sum(self._ones**2, axis=-1)
        bias_m = np.array([n.bias_m for n in each])[:, None]
        self._constant_factor = 1.0 / np.sqrt(1.0 + bias_m**2 * size)
        self._size = np.where(size > 0.0, size, 1.0)
        self._shift_m, self._shift = shift_m, None
        if shift_m is not None:
            self._shift = self._white(-shift_m[None], np.zeros_like(self.measured))[0]
            self._shift_size = np.maximum(np.sum(self._shift**2, axis=(1, 2)), 1e-300)
        self._gain_change: FloatArray | None = None
        if sensors is not None and sensors.gain_std > 0.0:
            change_m = sensors.gain_std * self._shown_by(sensors)
            self._gain_change = self._white(-change_m[None], np.zeros_like(self.measured))[0]
        self._together_m, self._together = together_m, None
        if together_m is not None and len(together_m):
            white = self._whiten_shifts(self._white(-together_m, np.zeros_like(self.measured)))
            self._together = white.reshape(len(white), self.rows)
            _, sizes, self._modes = np.linalg.svd(self._together, full_matrices=False)
            self._mode_pull = 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)

    def _shown_by(self, sensors: Sensors) -> FloatArray:
        """(T, markers, 2) the sensor's signal, with little of its noise; 0 for markers."""
        shown = np.zeros_like(self.measured)
        if sensors.shown_m is not None:
            shown[:, -self._gauges :] = sensors.shown_m
            return shown
        for marker in range(-self._gauges, 0):
            for axis in range(2):
                observed = self.observed[:, marker, axis] & sensors.rows
                if observed.any():
                    values = self.measured[observed, marker, axis]
                    shown[observed, marker, axis] = _moving_mean(values - values.mean())
        return shown

    def own_rows(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Parts of (markers, …, T): the markers' and the sensor's, each with its own rows only."""
        if self._sensors is None:
            return [values]
        first = len(values) - self._gauges
        frames, rows = self._sensors.frames, self._sensors.rows
        return [values[:first][..., frames], values[first:][..., rows]]

    def _innovations(self, each: Sequence[Noise]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Arrays of `innovations`, (markers, channels, T), each series in its own rows."""
        shape, sensors = (len(each), self.channels, self.frames), self._sensors
        if sensors is None:
            noise, series = self.noise, self.observed.reshape(self.frames, -1)
            memory, weight, gain = (
                v.reshape(shape) for v in innovations(series, noise.std_m, noise.ar1, noise.white)
            )
            return memory, weight, gain
        memory, weight, gain = np.zeros(shape), np.zeros(shape), np.ones(shape)
        for marker, noise in enumerate(each):
            own = sensors.frames if marker < len(each) - self._gauges else sensors.rows
            parts = innovations(self.observed[own, marker], noise.std_m, noise.ar1, noise.white)
            for full, part in zip((memory, weight, gain), parts, strict=True):
                full[marker][:, own] = part
        return memory, weight, gain

    def __call__(self, predicted_m: FloatArray) -> FloatArray:
        """White residuals (measured − predicted).

        predicted_m  (lanes, T, markers, 2), m
        returns      (lanes, rows) ordered marker, channel, frame; 0 where not observed
        """
        out = self._white(predicted_m, self.measured)
        return self._whiten_together(self._whiten_shifts(out).reshape(len(predicted_m), self.rows))

    def _white(self, predicted_m: FloatArray, measured_m: FloatArray) -> FloatArray:
        """(lanes, markers, channels, T) white residuals for exact arc lengths, no common shifts."""
        out = np.empty((len(predicted_m), *self._memory.shape))
        pull = (1.0 - self._constant_factor) / self._size
        whiten(
            predicted_m,
            measured_m,
            self._axes,
            self._memory,
            self._weight,
            self._gain,
            self._ones,
            pull,
            out,
        )
        return out

    def _whiten_shifts(self, white: FloatArray) -> FloatArray:
        """Residuals (lanes, markers, channels, T) whitened also for arc lengths and gain.

        A vector h of variance 1 in addition to white noise is whitened by (I + h hᵀ)^−½.  Applied
        twice, this gives the residual at the most probable arc lengths and gain.
        """
        if self._gain_change is not None:
            change = self._gain_change
            size = max(float(np.sum(change**2)), 1e-300)
            share = np.einsum("lmct,mct->l", white, change) * (1.0 - (1.0 + size) ** -0.5) / size
            white = white - share[:, None, None, None] * change
        if self._shift is None:
            return white
        along = np.einsum("lmct,mct->lm", white, self._shift)
        factor = 1.0 / np.sqrt(1.0 + self._shift_size)
        pull = along * (1.0 - factor) / self._shift_size
        return np.asarray(white - pull[..., None, None] * self._shift)

    def _whiten_together(self, rows: FloatArray) -> FloatArray:
        """Residuals (lanes, rows) whitened also for common shifts, as above."""
        if self._together is None:
            return rows
        return np.asarray(rows - (rows @ self._modes.T * self._mode_pull) @ self._modes)

    def residual_m(self, predicted_m: FloatArray) -> FloatArray:
        """(T, markers, 2) measured − predicted, nan where not observed, m.

        At the most probable arc lengths, common shifts, and tare and gain of a sensor.
        """
        if self._together is not None and self._together_m is not None:
            rows = self._whiten_shifts(self._white(predicted_m[None], self.measured)).ravel()
            gram = np.eye(len(self._together)) + self._together @ self._together.T
            sizes = np.linalg.solve(gram, self._together @ rows)
            predicted_m = predicted_m + np.einsum("k,ktmc->tmc", sizes, self._together_m)
        error_m = np.where(self.observed, self.measured - predicted_m, np.nan)
        if self._gauges:
            white = self(predicted_m[None])
            error_m[:, -self._gauges :] = self.error_m(white)[:, -self._gauges :]
        if self._shift is None or self._shift_m is None:
            return error_m
        white = self._white(predicted_m[None], self.measured)[0]
        moved = np.einsum("mct,mct->m", white, self._shift) / (1.0 + self._shift_size)
        return np.asarray(error_m - moved[:, None] * self._shift_m)

    @cached_property
    def smooth_modes(self) -> tuple[FloatArray, ...]:
        """Per channel (markers × frames, modes) orthonormal smooth functions of observed frames.

        Cosines in time and polynomials along the cable span them.  They hold a model's misfit, but
        only a few per cent of the noise.
        """
        first = self.observed.shape[1] - self._gauges
        return tuple(_smooth_modes(self.observed[..., c], first) for c in range(self.channels))

    def error_m(self, white: FloatArray) -> FloatArray:
        """(T, markers, channels) measurement errors from white residuals (rows,), m; nan if unseen.

        At the most probable arc lengths, common shifts, and tare and gain of a sensor.
        """
        fresh = self._whiten_together(white[None]).reshape(1, *self._memory.shape)
        fresh = self._whiten_shifts(fresh)[0]
        along = np.sum(fresh * self._ones, axis=-1)
        back = (1.0 / self._constant_factor - 1.0) / self._size
        back[len(back) - self._gauges :] = 0.0
        fresh = fresh + (back * along)[..., None] * self._ones
        error = np.full(self.observed.shape, np.nan)
        coloured(np.ascontiguousarray(fresh), self._memory, self._weight, self._gain, error)
        return error


def _smooth_modes(valid: NDArray[np.bool_], first: int) -> FloatArray:
    """(markers × frames, modes) smooth functions over the observed (frames, markers) of a channel.

    first  marker of the gauges, each of which has its own functions
    """
    parts = [valid[:, :first], *(valid[:, i : i + 1] for i in range(first, valid.shape[1]))]
    if len(parts) > 1:
        from scipy.linalg import block_diag  # only studies with a sensor need it

        return np.asarray(block_diag(*(_smooth_modes(part, part.shape[1]) for part in parts)))
    frames, markers = valid.shape
    slow = max(2, frames // SLOW_FRAMES)
    in_time = np.cos(np.pi * np.outer(np.arange(frames) + 0.5, np.arange(slow)) / frames)
    along = np.vander(np.linspace(-1.0, 1.0, markers), min(markers, ALONG))
    functions = np.einsum("mk,tj->mtkj", along, in_time).reshape(markers * frames, -1)
    functions = functions * valid.T.reshape(-1, 1)
    values, vectors = np.linalg.eigh(functions.T @ functions)
    good = values > 1e-9 * max(values[-1], 1e-300)
    return np.asarray(functions @ (vectors[:, good] / np.sqrt(values[good])))


def _moving_mean(values: FloatArray) -> FloatArray:
    """(n,) means over `SHOWN_ROWS` neighbours, fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    rows, half = np.arange(len(values)), SHOWN_ROWS // 2
    first, last = np.maximum(rows - half, 0), np.minimum(rows + half + 1, len(values))
    return np.asarray((total[last] - total[first]) / (last - first))
