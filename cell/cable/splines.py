"""A logged signal as a C² function of time: natural cubic spline, smoothing what is noise in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.compiling import compiled

FloatArray = NDArray[np.float64]

#: White noise below this is left in: its spline moves a cable's tip by less than a micrometre.
NEGLIGIBLE_NOISE = 1e-7

#: Time over which the curve's bending is averaged to set the local penalty, s; rounds of that;
#: least bending that counts, as a share of the greatest; random vectors for the trace.
_CALM_S = 0.03
_ROUNDS = 3
_LEAST = 1e-6
_PROBES = 3


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

    The noise is taken from the median fourth divided difference.  The penalty on curvature is the
    one with the least expected error of the curve (Mallows' C_p), so a jerk is followed as closely
    as the noise allows; cross-validation, which does not know the noise, now and then follows all
    of it.
    The penalty is then raised where the curve bends little, so that a hand at rest is still: one
    penalty for all leaves 20 µm of a 10 µm log's noise at the tip of a cable, this 5 µm.
    Source: Green & Silverman, Nonparametric Regression and Generalized Linear Models, 1994, ch. 2
    (Reinsch's algorithm); Pintore et al., Biometrika 93 (2006) 113, for local penalties.
    """
    t = np.ascontiguousarray(t_s, dtype=np.float64)
    y = np.ascontiguousarray(value, dtype=np.float64)
    if len(t) < 3 or np.ptp(y) == 0.0:
        return Spline(t, y, np.zeros_like(y), 0.0)
    noise = _noise(t, y) if len(t) >= 16 else 0.0
    if noise < NEGLIGIBLE_NOISE:
        return Spline(t, y, _natural(t, y), 0.0)
    spacing = (t[-1] - t[0]) / (len(t) - 1)
    half = min(int(_CALM_S / spacing) + 1, (len(t) - 1) // 2)
    window = np.hanning(2 * half + 3)[1:-1]
    local = np.ones_like(t)
    for _ in range(_ROUNDS):
        smooth = _least_error(t, y, noise, local, spacing)
        energy = np.convolve(_natural(t, smooth) ** 2, window / window.sum(), "same")
        if energy.max() == 0.0:
            break
        local = 1.0 / np.maximum(energy / energy.max(), _LEAST)
    return Spline(t, smooth, _natural(t, smooth), noise)


def _noise(t: FloatArray, y: FloatArray) -> float:
    """Standard deviation of white noise from fourth divided differences, robustly."""
    near = np.lib.stride_tricks.sliding_window_view(t, 5)
    gaps = near[:, :, None] - near[:, None, :] + np.eye(5)
    weights = 1.0 / gaps.prod(axis=2)
    weights /= np.sqrt(np.sum(weights**2, axis=1, keepdims=True))
    differences = np.sum(weights * np.lib.stride_tricks.sliding_window_view(y, 5), axis=1)
    return float(np.median(np.abs(differences))) / 0.6745


def _least_error(
    t: FloatArray, y: FloatArray, noise: float, local: FloatArray, spacing: float
) -> FloatArray:
    """The smoothed values for the best multiple of the local penalties."""
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (_PROBES, len(t)))
    best, chosen = np.inf, y
    for multiple in np.geomspace(1e-3, 1e7, 18) * spacing**3:
        root = np.sqrt(multiple * local)
        smooth: FloatArray = _smooth(t, y, root)
        trace = np.mean([z @ _smooth(t, z, root) for z in probes])  # Hutchinson's estimate
        score = float(np.mean((y - smooth) ** 2) + 2.0 * noise**2 * trace / len(t))
        if score < best:
            best, chosen = score, smooth
    return chosen


@compiled
def _natural(t: FloatArray, y: FloatArray) -> FloatArray:
    """Second derivatives at the knots of the natural spline through y."""
    return _solve(t, y, np.zeros(t.size), False)


@compiled
def _smooth(t: FloatArray, y: FloatArray, root: FloatArray) -> FloatArray:
    """Minimise Σ(y − g)² + ∫penalty·g″², root (T,) = √penalty at the knots: g at the knots."""
    n = t.size
    u = _solve(t, y, root, True)
    smooth = y.copy()
    for j in range(n):
        if j > 0:
            h = t[j] - t[j - 1]
            smooth[j] -= (root[j - 1] * u[j - 1] - root[j] * u[j]) / h
        if j < n - 1:
            h = t[j + 1] - t[j]
            smooth[j] -= (root[j + 1] * u[j + 1] - root[j] * u[j]) / h
    return smooth


@compiled
def _solve(t: FloatArray, y: FloatArray, root: FloatArray, scaled: bool) -> FloatArray:
    """(R + DQᵀQD) u = Qᵀy, or = DQᵀy if scaled, D = diag(root): pentadiagonal, by LDLᵀ."""
    n = t.size
    h = t[1:] - t[:-1]
    d = np.zeros(n)
    below = np.zeros(n)
    below2 = np.zeros(n)
    u = np.zeros(n)
    for j in range(1, n - 1):
        a = 1.0 / h[j - 1]
        c = 1.0 / h[j]
        b = -a - c
        r = root[j]
        diag = (h[j - 1] + h[j]) / 3.0 + r * r * (a * a + b * b + c * c)
        rhs = ((y[j + 1] - y[j]) * c - (y[j] - y[j - 1]) * a) * (r if scaled else 1.0)
        off, off2 = 0.0, 0.0
        if j < n - 2:
            e = 1.0 / h[j + 1]
            off = h[j] / 6.0 + r * root[j + 1] * (b * c - c * (c + e))
            if j < n - 3:
                off2 = r * root[j + 2] * c * e
        if j > 1:
            diag -= d[j - 1] * below[j - 1] ** 2
            off -= d[j - 1] * below[j - 1] * below2[j - 1]
            rhs -= below[j - 1] * u[j - 1]
        if j > 2:
            diag -= d[j - 2] * below2[j - 2] ** 2
            rhs -= below2[j - 2] * u[j - 2]
        d[j] = diag
        below[j] = off / diag
        below2[j] = off2 / diag
        u[j] = rhs
    for j in range(n - 2, 0, -1):
        u[j] /= d[j]
        if j + 1 < n - 1:
            u[j] -= below[j] * u[j + 1]
        if j + 2 < n - 1:
            u[j] -= below2[j] * u[j + 2]
    return u


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
