"""A logged signal as a C² function of time: natural cubic spline, smoothing what is noise in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.compiling import compiled

FloatArray = NDArray[np.float64]

#: White noise below this is left in: its spline moves a cable's tip by less than a micrometre.
NEGLIGIBLE_NOISE = 1e-7


@dataclass(frozen=True)
class Spline:
    """Cubic pieces over `t_s` (T,): values and second derivatives at the knots; held outside.

    noise_std  estimated standard deviation of the noise that was smoothed, 0 = interpolated
    """

    t_s: FloatArray
    value: FloatArray
    bend: FloatArray
    noise_std: float

    @property
    def constant(self) -> bool:
        """Whether the signal never changes."""
        return not np.any(self.value != self.value[0])

    def __call__(self, t_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Value (0) or first derivative (1) at times of any shape."""
        t = np.asarray(t_s, dtype=np.float64)
        flat = np.ascontiguousarray(t).ravel()
        out = _evaluate(self.t_s, self.value, self.bend, flat, derivative)
        return np.asarray(out.reshape(t.shape))


def fit(t_s: FloatArray, value: FloatArray) -> Spline:
    """Spline through `value`, or near it if white noise is found in it.

    The noise is taken from the median fourth difference.  The smoothing is the one with the least
    expected error of the curve (Mallows' C_p), so a jerk is followed as closely as the noise
    allows; cross-validation, which does not know the noise, now and then follows all of it.
    Source: Green & Silverman, Nonparametric Regression and Generalized Linear Models, 1994, ch. 2
    (Reinsch's algorithm); the trace is that of equal spacing.
    """
    t = np.ascontiguousarray(t_s, dtype=np.float64)
    y = np.ascontiguousarray(value, dtype=np.float64)
    if len(t) < 3 or np.ptp(y) == 0.0:
        return Spline(t, y, np.zeros_like(y), 0.0)
    noise = 0.0
    if len(t) >= 16:
        noise = float(np.median(np.abs(np.diff(y, 4)))) / (0.6745 * np.sqrt(70.0))
    if noise < NEGLIGIBLE_NOISE:
        smooth, bend = _reinsch(t, y, 0.0)
        return Spline(t, smooth, bend, 0.0)
    n = len(t)
    spacing = (t[-1] - t[0]) / (n - 1)
    wave = (np.pi * np.arange(n) / (n * spacing)) ** 4 * spacing
    best = np.inf
    chosen = 0.0
    for smoothing in np.geomspace(1e-3, 1e7, 41) * spacing**3:
        smooth, _ = _reinsch(t, y, float(smoothing))
        trace = float(np.sum(1.0 / (1.0 + smoothing * wave)))
        score = float(np.mean((y - smooth) ** 2)) + 2.0 * noise**2 * trace / n
        if score < best:
            best, chosen = score, float(smoothing)
    smooth, bend = _reinsch(t, y, chosen)
    return Spline(t, smooth, bend, noise)


@compiled
def _reinsch(t: FloatArray, y: FloatArray, smoothing: float) -> tuple[FloatArray, FloatArray]:
    """Minimise Σ(y − g)² + smoothing·∫g″² : values g and g″ at the knots."""
    n = t.size
    h = t[1:] - t[:-1]
    # (R + smoothing·QᵀQ) γ = Qᵀy, pentadiagonal, by LDLᵀ
    d = np.zeros(n)
    u = np.zeros(n)
    v = np.zeros(n)
    z = np.zeros(n)
    for j in range(1, n - 1):
        a = 1.0 / h[j - 1]
        c = 1.0 / h[j]
        b = -a - c
        diag = (h[j - 1] + h[j]) / 3.0 + smoothing * (a * a + b * b + c * c)
        rhs = (y[j + 1] - y[j]) * c - (y[j] - y[j - 1]) * a
        off1 = 0.0
        off2 = 0.0
        if j < n - 2:
            e = 1.0 / h[j + 1]
            off1 = h[j] / 6.0 + smoothing * (b * c - c * (c + e))
            if j < n - 3:
                off2 = smoothing * c * e
        if j > 1:
            diag -= d[j - 1] * u[j - 1] ** 2
            off1 -= d[j - 1] * u[j - 1] * v[j - 1]
            rhs -= u[j - 1] * z[j - 1]
        if j > 2:
            diag -= d[j - 2] * v[j - 2] ** 2
            rhs -= v[j - 2] * z[j - 2]
        d[j] = diag
        u[j] = off1 / diag
        v[j] = off2 / diag
        z[j] = rhs
    bend = np.zeros(n)
    for j in range(n - 2, 0, -1):
        bend[j] = z[j] / d[j]
        if j + 1 < n - 1:
            bend[j] -= u[j] * bend[j + 1]
        if j + 2 < n - 1:
            bend[j] -= v[j] * bend[j + 2]
    smooth = y.copy()
    if smoothing > 0.0:
        for j in range(n):
            q = 0.0
            if j > 0:
                q += (bend[j - 1] - bend[j]) / h[j - 1]
            if j < n - 1:
                q += (bend[j + 1] - bend[j]) / h[j]
            smooth[j] -= smoothing * q
    return smooth, bend


@compiled
def _evaluate(
    t: FloatArray, y: FloatArray, bend: FloatArray, at: FloatArray, derivative: int
) -> FloatArray:
    out = np.empty(at.size)
    last = t.size - 2
    j = 0
    for k in range(at.size):
        x = at[k]
        if x <= t[0] or x >= t[last + 1]:
            edge = y[0] if x <= t[0] else y[last + 1]
            out[k] = edge if derivative == 0 else 0.0
            continue
        if x < t[j]:
            j = 0
        if x >= t[j + 1]:
            if j < last and x < t[j + 2]:
                j += 1
            else:
                j = min(np.searchsorted(t, x, side="right") - 1, last)
        h = t[j + 1] - t[j]
        b = (x - t[j]) / h
        a = 1.0 - b
        if derivative == 0:
            out[k] = (
                a * y[j]
                + b * y[j + 1]
                + ((a**3 - a) * bend[j] + (b**3 - b) * bend[j + 1]) * h * h / 6.0
            )
        else:
            out[k] = (y[j + 1] - y[j]) / h + (
                (3.0 * b * b - 1.0) * bend[j + 1] - (3.0 * a * a - 1.0) * bend[j]
            ) * h / 6.0
    return out
