"""A logged signal as a C² function of time: natural cubic spline that smooths the noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.compiling import compiled, inline
from cell.cable.outliers import (
    ADJACENT,
    GLITCH,
    bridged,
    fourth_differences,
    glitches,
    interpolate_outliers,
    isolated_outliers,
    longest_run,
    off_curve,
)

#: White noise below this is not smoothed: it moves a cable's tip by less than a micrometre.
NEGLIGIBLE_NOISE = 1e-7

#: Time over which the curve's bending is averaged to set the local penalty, s; rounds of that;
#: least bending that counts, as a share of the greatest; random vectors for the trace.
_CALM_S = 0.03
_ROUNDS = 3
#: An axis does not move if medians of blocks of this length differ by less than so many of their
#: standard deviations; fewest blocks.
_BLOCK, _APART, _LEAST_BLOCKS = 16, 4.5, 4
#: The minimum of C_p sometimes follows the noise: in all rounds but the last, the strongest
#: smoothing within so many standard deviations of the minimum is used.
_CHANCE = 1.0
_LEAST = 1e-6
_PROBES = 3


#: Multiples of a penalty that are tried for a similar curve.
_NEAR = np.geomspace(10.0**-1.5, 10.0**1.5, 7)


class Steps(NamedTuple):
    """Equal steps in time; their equation holds at `collocation`, a share of a step."""

    start_s: float
    step_s: float
    number: int
    collocation: float


@dataclass(frozen=True, eq=False)
class Spline:
    """Cubic pieces over `t_s` (T,): values and second derivatives at the knots; held outside.

    noise_std  estimated standard deviation of the noise that was smoothed, 0 = interpolated
    root       (T,) √penalty on curvature with which it was smoothed; None = interpolated
    wrong      indices of outliers in the log, which were interpolated from their neighbours
    """

    t_s: FloatArray
    value: FloatArray
    bend: FloatArray
    noise_std: float
    root: FloatArray | None = None
    wrong: tuple[int, ...] = ()

    @cached_property
    def pieces(self) -> tuple[FloatArray, FloatArray]:
        """(T,) knots and (T, 4) coefficients of the pieces after them, for compiled functions."""
        return self.t_s, _cubic(self.t_s, self.value, self.bend)

    @cached_property
    def constant(self) -> bool:
        """Whether the signal never changes."""
        return not np.any(self.value != self.value[0])

    def __call__(self, t_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Value (0) or first derivative (1) at times of any shape."""
        t = np.asarray(t_s, dtype=np.float64)
        if self.constant:
            return np.full(t.shape, 0.0 if derivative else self.value[0])
        flat = np.ascontiguousarray(t).ravel()
        out = _evaluate(*self.pieces, flat, derivative)
        return np.asarray(out.reshape(t.shape))


def fit(t_s: FloatArray, value: FloatArray, *, checked: bool = False) -> Spline:
    """Interpolating spline of `value`, or a smoothing spline if it has white noise.

    checked  the values have no outliers: none are searched for

    The noise is taken from the median fourth divided difference.  The penalty on curvature is the
    one with the least expected error of the curve (Mallows' C_p), so a jerk is followed as closely
    as the noise allows; cross-validation, which does not know the noise, now and then follows all
    of it.
    The penalty is then raised where the curve bends little, so that a gripper at rest is still.
    Outliers are interpolated from their neighbours first: the curve would seem to bend there.  An
    axis that never moves is smoothed as a gripper at rest is: it has no bend from which rest could
    be detected, and would follow an outlier at its end.
    Source: Green & Silverman, Nonparametric Regression and Generalized Linear Models, 1994, ch. 2
    (Reinsch's algorithm); Pintore et al., Biometrika 93 (2006) 113, for local penalties.
    """
    t = np.ascontiguousarray(t_s, dtype=np.float64)
    y = np.ascontiguousarray(value, dtype=np.float64)
    if len(t) < 3 or np.ptp(y) == 0.0:
        return Spline(t, y, np.zeros_like(y), 0.0)
    noise, alone = 0.0, tuple[int, ...]()
    if len(t) >= 16:
        noise = _noise(t, y)
        alone = () if checked else isolated_outliers(t, y, noise)
        y = interpolate_outliers(t, y, alone)
    if noise < NEGLIGIBLE_NOISE:
        return Spline(t, y, _natural(t, y), 0.0, wrong=tuple(sorted(alone)))
    spacing = (t[-1] - t[0]) / (len(t) - 1)
    half = min(int(_CALM_S / spacing) + 1, (len(t) - 1) // 2)
    window = np.hanning(2 * half + 3)[1:-1]
    local = np.ones_like(t)
    signals, wrong, turns_slowly = _with_probes(y), np.zeros(len(t), dtype=bool), not checked
    multiples, rounds = np.geomspace(1e-3, 1e7, 18) * spacing**3, _ROUNDS
    if _never_moves(y, noise):
        multiples, rounds = multiples[-1:] / _LEAST, 1
    for round_ in range(rounds):
        # the bending is estimated from a curve that does not follow the noise
        chance = _CHANCE if round_ < rounds - 1 else 0.0
        smooth, root = _least_error(signals, t, noise, local, multiples, chance)
        while turns_slowly and np.any(more := glitches(signals[:, 0] - smooth, noise) & ~wrong):
            more = off_curve(t, y, more, wrong, noise)
            if not more.any():
                break
            wrong |= more
            turns_slowly = longest_run(wrong) <= ADJACENT
            wrong &= turns_slowly
            signals[:, 0] = bridged(t, y, wrong)
            smooth, root = _least_error(signals, t, noise, local, multiples, chance)
        energy = np.convolve(_natural(t, smooth) ** 2, window / window.sum(), "same")
        if energy.max() == 0.0:
            break
        local = 1.0 / np.maximum(energy / energy.max(), _LEAST)
    left_out = tuple(sorted({*alone, *np.flatnonzero(wrong).tolist()}))
    return Spline(t, smooth, _natural(t, smooth), noise, root, left_out)


def _never_moves(y: FloatArray, noise: float) -> bool:
    """Whether the signal is constant but for its noise and a few outliers.

    The last block overlaps the one before: a motion may begin in the last few values.
    """
    count = len(y) // _BLOCK
    if count < _LEAST_BLOCKS:
        return False
    blocks = [*y[: count * _BLOCK].reshape(count, _BLOCK), y[-_BLOCK:]]
    middles = np.median(blocks, axis=1)
    std = noise * math.sqrt(0.5 * math.pi / _BLOCK)  # of a median
    away = np.abs(y - np.median(middles)) > GLITCH * noise
    alike = bool(np.max(np.abs(middles - np.median(middles))) < _APART * std)
    return alike and longest_run(away) <= ADJACENT


def refit(spline: Spline, values: FloatArray) -> list[Spline]:
    """Splines of other values (signals, T) at the same times, with settings near this spline's.

    Noise and penalty are re-estimated near those of `spline`, and the local penalties are taken
    from it, which is far less work than `fit`.
    """
    t = spline.t_s
    splines = []
    for value in values:
        y = np.ascontiguousarray(value, dtype=np.float64)
        if spline.root is None:
            splines.append(fit(t, y))
            continue
        noise = _noise(t, y)
        smooth, root = _least_error(_with_probes(y), t, noise, spline.root**2, _NEAR, 0.0)
        splines.append(Spline(t, smooth, _natural(t, smooth), noise, root))
    return splines


def _with_probes(y: FloatArray) -> FloatArray:
    """(T, 1 + probes) values and random signs."""
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (_PROBES, len(y)))
    return np.ascontiguousarray(np.vstack([y, probes]).T)


def _noise(t: FloatArray, y: FloatArray) -> float:
    """Standard deviation of white noise from fourth divided differences, robustly."""
    return float(np.median(np.abs(fourth_differences(t, y)))) / 0.6745


@compiled
def _least_error(
    signals: FloatArray,
    t: FloatArray,
    noise: float,
    local: FloatArray,
    multiples: FloatArray,
    chance: float,
) -> tuple[FloatArray, FloatArray]:
    """The smoothed values for the best multiple of the local penalties, and these penalties' √.

    signals    (T, 1 + probes) values, and random signs for Hutchinson's estimate of the trace
    multiples  increasing
    chance     the strongest of those is taken that are no worse than the best by more than so many
               standard deviations of what chance makes between the two, σ²·√(2 Δtrace)
    """
    scores, traces = np.empty(multiples.size), np.empty(multiples.size)
    best = 0
    for i in range(multiples.size):
        smooth = _smooth(t, signals, np.sqrt(multiples[i] * local))
        square, trace = 0.0, 0.0
        for j in range(t.size):
            square += (signals[j, 0] - smooth[j, 0]) ** 2
            for k in range(1, signals.shape[1]):
                trace += signals[j, k] * smooth[j, k]
        traces[i] = trace / (signals.shape[1] - 1)
        scores[i] = square + 2.0 * noise**2 * traces[i]
        if scores[i] < scores[best]:
            best = i
    chosen = best
    for i in range(best + 1, multiples.size):
        by_chance = noise**2 * math.sqrt(2.0 * max(traces[best] - traces[i], 0.0))
        if scores[i] <= scores[best] + chance * by_chance:
            chosen = i
    root = np.sqrt(multiples[chosen] * local)
    return _smooth(t, signals[:, :1].copy(), root)[:, 0].copy(), root


@compiled
def _natural(t: FloatArray, y: FloatArray) -> FloatArray:
    """Second derivatives at the knots of the natural spline through y."""
    bend: FloatArray = _solve(t, y.copy().reshape(-1, 1), np.zeros(t.size), False)[:, 0].copy()
    return bend


@inline
def _smooth(t: FloatArray, y: FloatArray, root: FloatArray) -> FloatArray:
    """Minimise Σ(y − g)² + ∫penalty·g″², root (T,) = √penalty at the knots: g at the knots.

    y  (T, signals), each on its own
    """
    n = t.size
    u = _solve(t, y, root, True)
    smooth = y.copy()
    for j in range(n):
        for k in range(y.shape[1]):
            if j > 0:
                h = t[j] - t[j - 1]
                smooth[j, k] -= (root[j - 1] * u[j - 1, k] - root[j] * u[j, k]) / h
            if j < n - 1:
                h = t[j + 1] - t[j]
                smooth[j, k] -= (root[j + 1] * u[j + 1, k] - root[j] * u[j, k]) / h
    return smooth


@inline
def _solve(t: FloatArray, y: FloatArray, root: FloatArray, scaled: bool) -> FloatArray:
    """(R + DQᵀQD) u = Qᵀy, or = DQᵀy if scaled, D = diag(root): pentadiagonal, by LDLᵀ.

    y, u  (T, signals)
    """
    n, signals = y.shape
    h = t[1:] - t[:-1]
    d = np.zeros(n)
    below = np.zeros(n)
    below2 = np.zeros(n)
    u = np.zeros((n, signals))
    for j in range(1, n - 1):
        a = 1.0 / h[j - 1]
        c = 1.0 / h[j]
        b = -a - c
        r = root[j]
        diag = (h[j - 1] + h[j]) / 3.0 + r * r * (a * a + b * b + c * c)
        off, off2 = 0.0, 0.0
        if j < n - 2:
            e = 1.0 / h[j + 1]
            off = h[j] / 6.0 + r * root[j + 1] * (b * c - c * (c + e))
            if j < n - 3:
                off2 = r * root[j + 2] * c * e
        before = below[j - 1] if j > 1 else 0.0
        before2 = below2[j - 2] if j > 2 else 0.0
        if j > 1:
            diag -= d[j - 1] * before**2
            off -= d[j - 1] * before * below2[j - 1]
        if j > 2:
            diag -= d[j - 2] * before2**2
        d[j] = diag
        below[j] = off / diag
        below2[j] = off2 / diag
        size = r if scaled else 1.0
        for k in range(signals):
            rhs = ((y[j + 1, k] - y[j, k]) * c - (y[j, k] - y[j - 1, k]) * a) * size
            if j > 1:
                rhs -= before * u[j - 1, k]
            if j > 2:
                rhs -= before2 * u[j - 2, k]
            u[j, k] = rhs
    for j in range(n - 2, 0, -1):
        for k in range(signals):
            u[j, k] /= d[j]
            if j + 1 < n - 1:
                u[j, k] -= below[j] * u[j + 1, k]
            if j + 2 < n - 1:
                u[j, k] -= below2[j] * u[j + 2, k]
    return u


@compiled
def _cubic(t: FloatArray, y: FloatArray, bend: FloatArray) -> FloatArray:
    """(T, 4) coefficients of every piece, by the time since its knot; behind the last, at rest."""
    pieces = np.zeros((t.size, 4))
    for j in range(t.size):
        pieces[j, 0] = y[j]
    for j in range(t.size - 1):
        h = t[j + 1] - t[j]
        pieces[j, 1] = (y[j + 1] - y[j]) / h - h * (2.0 * bend[j] + bend[j + 1]) / 6.0
        pieces[j, 2] = 0.5 * bend[j]
        pieces[j, 3] = (bend[j + 1] - bend[j]) / (6.0 * h)
    return pieces


@inline
def _piece(t: FloatArray, x: float, j: int) -> int:
    """Index of the piece with x, 0 before the first; searched from piece j on, knot by knot.

    Times come in order: to search all knots took six times as long.
    """
    while j + 1 < t.size and x >= t[j + 1]:
        j += 1
    while j > 0 and x < t[j]:
        j -= 1
    return j


@inline
def _value(t: FloatArray, pieces: FloatArray, x: float, j: int) -> float:
    """Value at x in piece j."""
    u = max(x - t[j], 0.0) if j + 1 < t.size else 0.0
    return float(pieces[j, 0] + u * (pieces[j, 1] + u * (pieces[j, 2] + u * pieces[j, 3])))


@inline
def _slope(t: FloatArray, pieces: FloatArray, x: float, j: int) -> float:
    """First derivative at x in piece j."""
    u = x - t[j]
    slope = pieces[j, 1] + u * (2.0 * pieces[j, 2] + u * 3.0 * pieces[j, 3])
    return float(slope) if x > t[0] else 0.0


@compiled
def _evaluate(t: FloatArray, pieces: FloatArray, at: FloatArray, derivative: int) -> FloatArray:
    out = np.empty(at.size)
    j = 0
    for k in range(at.size):
        x = at[k]
        j = _piece(t, x, j)
        out[k] = _value(t, pieces, x, j) if derivative == 0 else _slope(t, pieces, x, j)
    return out


@compiled
def spread_values(
    t: FloatArray,
    pieces: FloatArray,
    at: FloatArray,
    lanes: NDArray[np.int64],
    out: FloatArray,
    axis: int,
) -> None:
    """Write a spline's values at times (N,) to an axis and some lanes of `out` (N, axes, LANES)."""
    j = 0
    for k in range(at.size):
        x = at[k]
        j = _piece(t, x, j)
        value = _value(t, pieces, x, j)
        for w in lanes:
            out[k, axis, w] = value


@compiled
def spread_steps(
    t: FloatArray, pieces: FloatArray, steps: Steps, lanes: NDArray[np.int64], out: FloatArray
) -> None:
    """Write a spline at the collocation times to some lanes of `out` (steps, 3, LANES).

    Value, rate, and the change of the rate over a step's length around that time, per second.
    """
    start_s, step_s, count, collocation = steps
    per_s = 1.0 / step_s
    i, j = 0, 0
    before = 0.0
    for k in range(-1, count):
        edge = start_s + step_s * (k + collocation + 0.5)
        j = _piece(t, edge, j)
        after = _slope(t, pieces, edge, j)
        if k >= 0:
            x = start_s + step_s * (k + collocation)
            i = _piece(t, x, i)
            value = _value(t, pieces, x, i)
            rate = _slope(t, pieces, x, i)
            change = (after - before) * per_s
            for n in range(lanes.size):
                w = lanes[n]
                out[k, 0, w] = value
                out[k, 1, w] = rate
                out[k, 2, w] = change
        before = after
