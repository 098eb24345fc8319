"""Statistics of series in time: size, spectrum, whiteness, correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import ndtr as normal_cdf

from cell.cable.arrays import FloatArray
from cell.identify.noise import Noise, rms

LAGS = 10
#: Equal spans of a trial's time over which a residual is shown.
TIME_BINS = 24
#: Most frequencies of a spectrum.
MAX_FREQUENCIES = 200


def rms_by_time(t_s: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middle (spans,) of up to `TIME_BINS` equal spans of time, and rms (spans,) of the residual.

    residual  (times, …), nan where nothing was measured
    """
    edges = np.linspace(t_s[0], t_s[-1], min(TIME_BINS, len(t_s)) + 1)
    spans = np.clip(np.searchsorted(edges, t_s, "right") - 1, 0, len(edges) - 2)
    sizes = [rms(residual[spans == i]) for i in range(len(edges) - 1)]
    return 0.5 * (edges[1:] + edges[:-1]), np.array(sizes)


@dataclass(frozen=True)
class PowerSpectrum:
    """Residual and noise power per coordinate at `frequency_hz`."""

    frequency_hz: FloatArray
    residual_m2_per_hz: FloatArray
    noise_m2_per_hz: FloatArray


def spectrum(t_s: FloatArray, residual_m: FloatArray, noise: Noise) -> PowerSpectrum:
    """Mean power over all coordinates, and the noise's (Lomb and Scargle: any timestamps)."""
    span_s = float(t_s[-1] - t_s[0])
    highest = 0.5 / float(np.median(np.diff(t_s)))
    count = int(min(MAX_FREQUENCIES, max(3, highest * span_s)))
    frequency = np.arange(1, count) * highest / count  # below Nyquist, where phase is lost
    series = residual_m.reshape(len(t_s), -1)
    observed = np.isfinite(series)
    power, used = np.zeros(len(frequency)), 0
    for frames in np.unique(observed, axis=1).T:
        group = series[frames][:, np.all(frames == observed.T, axis=1)]
        if len(group) < 4:
            continue
        power += lomb_scargle(t_s[frames], group - group.mean(axis=0), frequency).sum(axis=1)
        used += group.shape[1]
    power *= 2.0 * float(np.median(np.diff(t_s))) / max(used, 1)
    frame_s = float(np.median(np.diff(t_s)))
    ar1 = noise.ar1
    shape = noise.white + (1.0 - noise.white) * (1.0 - ar1**2) / (
        1.0 - 2.0 * ar1 * np.cos(2.0 * np.pi * frequency * frame_s) + ar1**2
    )
    return PowerSpectrum(frequency, power, 2.0 * noise.std_m**2 * frame_s * shape)


def lomb_scargle(t_s: FloatArray, values: FloatArray, frequency_hz: FloatArray) -> FloatArray:
    """(frequencies, series) periodogram of values (times, series) at any times.

    Half the square explained by a sine of this frequency; importing scipy's takes half a second.
    source  Scargle 1982, Astrophys. J. 263, 835
    """
    phase = 2.0 * np.pi * frequency_hz[:, None] * t_s
    phase -= 0.5 * np.arctan2(np.sin(2.0 * phase).sum(1), np.cos(2.0 * phase).sum(1))[:, None]
    parts = (np.cos(phase), np.sin(phase))
    squares = [(wave @ values) ** 2 / np.sum(wave**2, axis=1)[:, None] for wave in parts]
    return np.asarray(0.5 * (squares[0] + squares[1]))


def ljung_box(white: FloatArray) -> float:
    """p-value that white series (times, series), nan = missing, are white: Ljung and Box 1978."""
    statistic, dof = 0.0, 0
    for values in white.T:
        observed = values[np.isfinite(values)]
        n = len(observed)
        if n <= 2 * LAGS:
            continue
        centred = observed - observed.mean()
        power = float(centred @ centred)
        if power <= 0.0:
            continue
        for lag in range(1, LAGS + 1):
            r = float(centred[lag:] @ centred[:-lag]) / power
            statistic += n * (n + 2) * r * r / (n - lag)
        dof += LAGS
    return float(chi2_sf(dof, statistic)) if dof else float("nan")


def smoothed(values: FloatArray, window: int) -> FloatArray:
    """Values (times, series) by cubics fitted to windows of an odd number of neighbours.

    At either end by the cubic of the first and last window; importing scipy's takes half a second.
    source  Savitzky & Golay 1964, Anal. Chem. 36, 1627
    """
    half = window // 2
    design = np.vander(np.arange(-half, half + 1) / half, 4, increasing=True)
    fit = design @ np.linalg.pinv(design)
    around = np.lib.stride_tricks.sliding_window_view(values, window, axis=0)
    first, last = fit[:half] @ values[:window], fit[half + 1 :] @ values[-window:]
    return np.concatenate([first, around @ fit[half], last])


def correlation(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Correlation of two series, nan = missing, and its two-sided p-value given autocorrelation.

    source  Bartlett 1935, J. R. Stat. Soc. 98, 536
    """
    valid = np.isfinite(a) & np.isfinite(b)
    if not valid.any():
        return 0.0, 1.0
    a, b = a[valid] - a[valid].mean(), b[valid] - b[valid].mean()
    power = float(np.sqrt((a @ a) * (b @ b)))
    n = len(a)
    if power <= 0.0 or n < 2 * LAGS:
        return 0.0, 1.0
    r = float(a @ b) / power
    lags = range(1, n // 4)
    shared = sum(_auto(a, k) * _auto(b, k) for k in lags)
    independent = float(np.clip(n / max(1.0 + 2.0 * shared, 1.0), 4.0, n))
    z = np.arctanh(np.clip(r, -0.999999, 0.999999)) * np.sqrt(max(independent - 3.0, 1.0))
    return r, float(2.0 * normal_cdf(-abs(z)))


def _auto(values: FloatArray, lag: int) -> float:
    return float(values[lag:] @ values[:-lag]) / float(values @ values)


def overall(parts: Sequence[FloatArray]) -> float:
    """Root mean square over several residual arrays; nan if there are none."""
    return rms(np.concatenate([p.ravel() for p in parts])) if parts else float("nan")


def rms_over(rows: Sequence[Sequence[float] | FloatArray]) -> FloatArray:
    """(n,) root mean square over rows (rows, n), nan ignored; nan where a column is empty."""
    square = np.array(rows) ** 2
    used = np.isfinite(square)
    total = np.sum(np.where(used, square, 0.0), axis=0)
    return np.asarray(np.sqrt(np.where(used.any(axis=0), total, np.nan) / used.sum(axis=0).clip(1)))
