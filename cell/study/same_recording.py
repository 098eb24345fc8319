"""Test whether two recordings are copies of one, by their common noise.

Repetitions of a motion share their smooth course; their noise is independent.  Copies of one
recording share the noise too, even after processing: cropped, resampled, shifted in time, rotated,
mirrored, in a different unit, rounded, with reordered markers.  So the smooth course is subtracted
from both, and a linear map predicts the residual of one from that of the other.

A copy cannot be detected if the data do not show their noise: after a strong low-pass, at a rate
too low for the cable's swings, or rounded more coarsely than the noise.  Then trials count as
independent, unless they agree to a thousandth.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment
from scipy.special import betainc

from cell.cable.arrays import FloatArray
from cell.study.data import Markers
from cell.study.series import by_missing_pattern, interpolated

#: Rows of a block, from which polynomials of half as many degrees are subtracted: these follow
#: swings up to a tenth of the frame rate.
BLOCK = 24
#: Least overlap of two recordings: rows, and share of the shorter one.
LEAST_ROWS, LEAST_OVERLAP = 16, 0.25
#: Probability that independent noise is explained as well, over all tested alignments.
FALSE_ALARM = 1e-5
#: Least explained share of a copy's noise in nine of ten parts of the record: each a third of the
#: degrees of a block and marker.  Residuals of a smooth course are in few of them.
LEAST_SHARED, LOWEST, BANDS = 0.5, 0.1, 3
#: The same where rounding is half of the noise, because equal courses are rounded equally.
LEAST_SHARED_ROUNDED = 0.98
#: No alignment within half a row explains `LEAST_SHARED` where the symmetric filters at its middle
#: explain less than this share.  Of linear interpolation half a row away, the worst case, symmetric
#: filters explain 3/4 (white noise).
LEAST_FILTERED = 0.5 * LEAST_SHARED
#: Noise, white or of first order, differs by less between those thirds; a course that blocks do not
#: follow falls or rises by more, and repetitions share it.  They do not agree as well as this, but
#: where they were simulated without noise: in proportion to their motions, as linear cables swing.
STEEPEST, IDENTICAL = 5.0, 1e-6
#: Rows on both sides that a low-pass or an interpolation may have mixed.
TAPS = 6
#: Order of the differences by which recordings are aligned, number of markers for it, and number of
#: examined alignments.
ORDER, ALIGNED_BY, EXAMINED = 4, 3, 3
#: Least squared correlation of markers per row for an examined alignment, unless it exceeds that of
#: noise in any alignment.
CORRELATED, BY_CHANCE = 0.3, 50.0


def same_recordings(recordings: Sequence[Markers]) -> tuple[int, ...]:
    """For each recording, the index of its first copy among them; its own if it is the first."""
    prepared = [_Prepared.of(each) for each in recordings]
    first: list[int] = []
    for i, each in enumerate(prepared):
        originals = (j for j in range(i) if first[j] == j)
        first.append(next((j for j in originals if _same(prepared[j], each)), i))
    return tuple(first)


def originals(recordings: Sequence[Markers], known: Sequence[Markers]) -> tuple[int | None, ...]:
    """For each recording, the index of the first known one that it copies; None = none."""
    prepared = [_Prepared.of(each) for each in known]
    return tuple(
        next((i for i, candidate in enumerate(prepared) if _same(candidate, each)), None)
        for each in map(_Prepared.of, recordings)
    )


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Rows and markers of a recording with detections.

    t_s      (T,)
    xy       (T, markers, 2) in any unit, nan = not detected; 0 = a coordinate that never is
    rounded  whether rounding is half of its noise
    """

    t_s: FloatArray
    xy: FloatArray
    rounded: bool

    @classmethod
    def of(cls, markers: Markers) -> _Prepared:
        measured = np.isfinite(markers.xy_m).any(axis=0)
        xy = np.where(measured, markers.xy_m, 0.0)
        valid = np.logical_and(np.isfinite(xy).all(axis=2), np.logical_or.reduce(measured, axis=1))
        enough = valid.sum(axis=0) >= LEAST_ROWS
        rows = np.logical_or.reduce(valid[:, enough], axis=1)
        xy = np.where(valid[..., None], xy, np.nan)[rows][:, enough]
        return cls(markers.t_s[rows], xy, xy.size > 0 and _is_rounded(xy))

    @property
    def step_s(self) -> float:
        return float(np.median(np.diff(self.t_s)))

    @property
    def by_row(self) -> _Prepared:
        """The same with rows for time, in case one file states its rate wrongly."""
        return replace(self, t_s=np.arange(len(self.t_s), dtype=np.float64))

    def at(self, t_s: FloatArray, markers: NDArray[np.intp]) -> FloatArray:
        """(times, markers, 2) linear interpolation between rows; nan beyond them."""
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        share = (t_s - self.t_s[after - 1]) / (self.t_s[after] - self.t_s[after - 1])
        share = np.round(share, 6)[:, None, None]  # clocks are written to a microsecond
        before_xy, after_xy = self.xy[after - 1][:, markers], self.xy[after][:, markers]
        between = before_xy + share * (after_xy - before_xy)
        between = np.where(share == 0.0, before_xy, np.where(share == 1.0, after_xy, between))
        return np.asarray(np.where((share < 0.0) | (share > 1.0), np.nan, between))

    def spline(self, markers: NDArray[np.intp]) -> CubicSpline:
        """Cubic spline of (times, markers, 2) values, also over gaps; nan beyond the rows."""
        each = [interpolated(self.t_s, self.t_s, self.xy[:, marker]) for marker in markers]
        return CubicSpline(self.t_s, np.stack(each, axis=1), extrapolate=False)

    def differences(self, start_s: float, step_s: float) -> FloatArray:
        """(times, markers, 2) of high order at equal steps, of variance 1; 0 where missing."""
        count = int(np.floor((self.t_s[-1] - start_s) / step_s + 1e-6)) + 1
        t_s = np.asarray(start_s + step_s * np.arange(count), dtype=np.float64)
        xy = self.at(t_s, np.arange(self.xy.shape[1]))
        high = np.nan_to_num(np.diff(xy, ORDER, axis=0))
        size = np.sqrt(np.sum(high**2, axis=0) / max(len(high), 1))
        return np.asarray(high / np.where(size > 0.0, size, 1.0))


def _is_rounded(xy: FloatArray) -> bool:
    """Whether rounding is half of the noise of values (T, markers, 2), by the median column."""
    noise, rounding = [], []
    for column in xy.reshape(len(xy), -1).T:
        values = column[np.isfinite(column)]
        steps = np.diff(np.unique(values))
        steps = steps[steps > 1e-9 * np.abs(values).max()]
        if len(steps):
            spread = np.median(np.abs(np.diff(values, 4))) / 0.6745
            noise.append(float(spread**2) / 70.0)  # Σ of squares of 1 −4 6 −4 1
            rounding.append(float(steps.min() ** 2) / 12.0)
    return bool(noise) and float(np.median(noise)) < 2.0 * float(np.median(rounding))


def _same(first: _Prepared, second: _Prepared) -> bool:
    """Whether two are one recording, by their own times or else by rows."""
    if not (first.xy.size and second.xy.size):
        return False
    finer, coarser = sorted((first, second), key=lambda each: each.step_s)
    alike = coarser.step_s < 1.01 * finer.step_s
    if alike and np.any(np.all(finer.xy == 0.0, axis=(0, 1))):  # it lacks a coordinate
        finer, coarser = coarser, finer
    if _noise_is_shared(finer, coarser):
        return True
    return not alike and _noise_is_shared(finer.by_row, coarser.by_row)


def _noise_is_shared(finer: _Prepared, coarser: _Prepared) -> bool:
    """Whether a linear map explains the noise of the coarser of two by that of the finer."""
    least = LEAST_SHARED_ROUNDED if finer.rounded or coarser.rounded else LEAST_SHARED
    late, tried = _alignments(finer, coarser)
    for late_s in late:
        pairs = _matched_markers(finer, coarser, late_s)
        shifts = _shifts_near(finer, coarser, late_s)
        filtered = _regression(finer, coarser, late_s, pairs, TAPS)
        if filtered is not None and filtered.share < LEAST_FILTERED:
            continue
        others = [(shifts[0], TAPS), *((s, 0) for s in shifts)]
        each = (_regression(finer, coarser, s, pairs, taps) for s, taps in others)
        for explained in itertools.chain([filtered], each):
            if explained is None or explained.chance * tried >= FALSE_ALARM:
                continue
            noise = explained.share >= least and explained.steepness < STEEPEST
            if noise or (explained.unexplained < IDENTICAL and explained.rewritten):
                return True
    return False


def _alignments(finer: _Prepared, coarser: _Prepared) -> tuple[list[float], int]:
    """Candidates for the lead of the finer's clock, the likeliest first; number of tested ones.

    They maximise the correlation of differences of high order, for any matching of markers and any
    rotation of coordinates.
    """
    step_s, start_s = coarser.step_s, float(finer.t_s[0])
    b = coarser.differences(float(coarser.t_s[0]), step_s)
    phases = 2 * max(1, round(step_s / finer.step_s))
    offsets_s = step_s * np.arange(phases) / phases
    grids = [finer.differences(start_s + offset_s, step_s) for offset_s in offsets_s]
    if min(len(b), *map(len, grids)) < LEAST_ROWS - ORDER:
        return [], 0
    fewer = min(finer, coarser, key=lambda each: each.xy.shape[1])
    few = np.argsort(-np.isfinite(fewer.xy[..., 0]).sum(axis=0), kind="stable")[:ALIGNED_BY]
    if fewer is coarser:
        b = b[:, few]
    else:
        grids = [a[:, few] for a in grids]
    size = next_fast_len(len(b) + max(map(len, grids)))
    lags = np.concatenate([np.arange(size // 2), np.arange(size // 2 - size, 0)])
    of_b = np.conj(rfft(b, size, axis=0))[:, None, :, None, :]
    ranked: list[tuple[float, float]] = []
    for offset_s, a in zip(offsets_s, grids, strict=True):
        overlap = np.minimum(len(b), len(a) - lags) - np.maximum(0, -lags)
        least = max(LEAST_ROWS - ORDER, LEAST_OVERLAP * min(len(a), len(b)))
        sums = irfft(rfft(a, size, axis=0)[:, :, None, :, None] * of_b, size, axis=0)
        squares = np.sum(sums**2, axis=(3, 4))  # (lags, markers of one, of the other)
        squares = squares.max(axis=1 if fewer is coarser else 2).mean(axis=1)  # the likeliest pairs
        chi2 = np.where(overlap >= least, squares / np.maximum(overlap, 1), 0.0)
        chi2[chi2 < np.minimum(CORRELATED * overlap, BY_CHANCE)] = 0.0
        for k in np.argsort(-chi2)[:EXAMINED]:
            if chi2[k] > 0.0:
                late_s = start_s + offset_s + lags[k] * step_s - float(coarser.t_s[0])
                ranked.append((-float(chi2[k]), late_s))
    tried = len(lags) * phases * finer.xy.shape[1] * coarser.xy.shape[1]
    return [late_s for _, late_s in sorted(ranked)[:EXAMINED]], tried


def _matched_markers(finer: _Prepared, coarser: _Prepared, late_s: float) -> NDArray[np.intp]:
    """(pairs, 2) markers of the finer and of the coarser with the best correlated differences."""
    every = np.arange(finer.xy.shape[1])
    a, b = (
        np.nan_to_num(np.diff(xy, ORDER, axis=0))
        for xy in (finer.at(coarser.t_s + late_s, every), coarser.xy)
    )
    a, b = (d / np.maximum(np.linalg.norm(d, axis=0), 1e-300) for d in (a, b))
    products = np.tensordot(a, b, axes=(0, 0))  # (markers, 2, markers, 2)
    agree = np.sum(products**2, axis=(1, 3))
    return np.stack(linear_sum_assignment(-agree), axis=1)


def _shifts_near(finer: _Prepared, coarser: _Prepared, late_s: float) -> list[float]:
    """Shifts of the clock: that at which rows coincide, then a few within half a step."""
    t_s = coarser.t_s + late_s
    after = np.clip(np.searchsorted(finer.t_s, t_s), 1, len(finer.t_s) - 1)
    to_before_s, to_after_s = finer.t_s[after - 1] - t_s, finer.t_s[after] - t_s
    to_nearest_s = np.where(-to_before_s < to_after_s, to_before_s, to_after_s)
    common = to_nearest_s[np.abs(to_nearest_s) <= finer.step_s]
    meet_s = float(np.median(common)) if len(common) else 0.0
    eighths = np.arange(-4, 5) / 8.0
    return [late_s + meet_s, *(late_s + eighths * finer.step_s).tolist()]


@dataclass(frozen=True)
class _Explained:
    """The noise of one recording as a linear function of another's.

    share        explained share in the parts of the record with the least one
    unexplained  residual share of the record
    chance       probability of that for independent noise
    steepness    see `_steepness`; of the flatter recording
    rewritten    whether the function rotates, mirrors, or changes a unit by powers of ten
    """

    share: float
    unexplained: float
    chance: float
    steepness: float
    rewritten: bool


def _regression(
    finer: _Prepared, coarser: _Prepared, late_s: float, pairs: NDArray[np.intp], taps: int
) -> _Explained | None:
    """Regression of the coarser's noise on the finer's at a shift of clocks; None = too few rows.

    taps  rows on both sides that are regressors too
    """
    t_s, markers = coarser.t_s + late_s, pairs[:, 0]
    values = [coarser.xy[:, pairs[:, 1]], finer.at(t_s, markers)]
    if taps:
        smooth, detected = finer.spline(markers), np.isfinite(values[1])
        values.append(np.where(detected, smooth(t_s), np.nan))
        ways_s = finer.step_s * np.arange(1, taps + 1)
        values += [smooth(t_s + way_s) + smooth(t_s - way_s) for way_s in ways_s]
    parts = _high_degrees(t_s, np.concatenate(values, axis=2))
    if not parts:
        return None
    sizes = np.concatenate([np.full(len(part), part.shape[1]) for part in parts])
    starts = np.cumsum(sizes) - sizes
    rows = np.concatenate([part.reshape(-1, part.shape[2]) for part in parts])
    y, x = np.split(rows, [2], axis=1)
    columns, regressors = (int(np.count_nonzero(np.any(v, axis=0))) for v in (y, x))
    count = columns * len(y)
    if min(columns, regressors) == 0 or count < 2 * columns * regressors:
        return None
    solution = np.linalg.lstsq(x, y, rcond=1e-9)[0]
    residual, total, predictor = (  # of every part and coordinate
        np.add.reduceat(v**2, starts, axis=0) for v in (y - x @ solution, y, x[:, :2])
    )
    unexplained = float(residual.sum() / total.sum())
    by_chance = 0.5 * (count - columns * regressors), 0.5 * columns * regressors
    measured = total > 0.0
    return _Explained(
        share=float(np.quantile(1.0 - residual[measured] / total[measured], LOWEST)),
        unexplained=unexplained,
        chance=float(betainc(*by_chance, min(unexplained, 1.0))),
        steepness=min(_steepness(total, sizes), _steepness(predictor, sizes)),
        rewritten=taps == 0 and _is_rewriting(solution),
    )


def _is_rewriting(linear: FloatArray) -> bool:
    """Whether (2, 2) is an isometry up to a unit: swings of cables are not proportional so."""
    scale = np.linalg.svd(linear, compute_uv=False)
    decades = np.log10(scale[scale > 1e-3 * scale[0]])
    return bool(np.all(np.abs(decades - np.round(decades[0])) < 1e-3))


def _steepness(squares: FloatArray, sizes: NDArray[np.intp]) -> float:
    """Ratio of the largest and smallest mean square of a band, least over the coordinates."""
    bands = range(BANDS)
    level = np.array([squares[b::BANDS].sum(axis=0) / sizes[b::BANDS].sum() for b in bands])
    level = level[:, level.min(axis=0) > 0.0]
    return float(np.min(level.max(axis=0) / level.min(axis=0), initial=np.inf))


def _high_degrees(t_s: FloatArray, values: FloatArray) -> list[FloatArray]:
    """(parts, degrees, channels) coefficients of polynomials, orthonormal on the rows of a block.

    For every block of every marker, the higher half of the degrees in `BANDS` parts; one array for
    all markers that are detected in the same rows.
    values  (T, markers, channels), nan = not detected
    """
    good = np.logical_and.reduce(np.isfinite(values), axis=2)
    coefficients: list[FloatArray] = []
    for markers in by_missing_pattern(good):
        detected = good[:, markers[0]]
        times, channels = t_s[detected], values[detected][:, markers]
        if len(times) < LEAST_ROWS:
            continue
        blocks = max(1, round(len(times) / BLOCK))
        degrees = len(times) // blocks // (2 * BANDS) * BANDS
        size = 2 * degrees
        firsts = np.linspace(0, len(times) - size, blocks).astype(int)
        rows = firsts[:, None] + np.arange(size)
        within = times[rows]
        unit = 2.0 * (within - within[:, :1]) / (within[:, -1:] - within[:, :1]) - 1.0
        basis = np.linalg.qr(np.polynomial.chebyshev.chebvander(unit, size - 1))[0]
        flat = channels[rows].reshape(blocks, size, -1)
        high = np.swapaxes(basis[:, :, degrees:], 1, 2) @ flat  # (blocks, degrees, all channels)
        high = high.reshape(blocks, degrees, len(markers), -1).transpose(2, 0, 1, 3)
        coefficients.append(high.reshape(-1, degrees // BANDS, values.shape[2]))
    return coefficients
