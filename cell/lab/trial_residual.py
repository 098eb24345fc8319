"""A trial's residual by time, place, phase and frequency, and the signals it correlates with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf
from scipy.special import ndtr as normal_cdf

from cell.cable.geometry import Motion
from cell.cable.still import moves_from_s
from cell.identify.noise import Noise, still_frames
from cell.study.data import Trial

FloatArray = NDArray[np.float64]

TIME_BINS = 24
LAGS = 10
#: The swing is `early` for this long after the hand has stopped, then `late`.
EARLY_SWING_S = 0.3
PHASES = ("still", "moving", "early swing", "late swing")
#: Wider than the gaps of a lost marker, narrower than the slowest swing.
MAX_FREQUENCIES = 200


@dataclass(frozen=True)
class Profile:
    """rms residual over groups: `centre`, `rms_m` (groups,); nan where nothing was seen."""

    centre: FloatArray
    rms_m: FloatArray


@dataclass(frozen=True)
class Spectrum:
    """Residual and noise power per coordinate, m²/Hz, at `frequency_hz`."""

    frequency_hz: FloatArray
    residual: FloatArray
    noise: FloatArray


@dataclass(frozen=True)
class Correlation:
    """Correlation of the tip's residual with a signal, and its two-sided p-value."""

    signal: str
    correlation: float
    p_value: float


@dataclass(frozen=True)
class TrialResidual:
    """Size of one trial's residual by time, place, phase and frequency.

    by_time     over `TIME_BINS` equal spans; by_arc_length over markers; by_phase over `PHASES`
    tip_m       (TIME_BINS,) largest distance between tip seen and predicted, m
    whiteness   p-value of Ljung and Box over all markers: small = the residual has a pattern
    correlations   of the tip's residual with signals, strongest first
    """

    trial: str
    rms_m: float
    by_time: Profile
    by_arc_length: Profile
    by_phase: dict[str, float]
    spectrum: Spectrum
    whiteness_p_value: float
    correlations: tuple[Correlation, ...]


def trial_residual(
    trial: Trial,
    predicted_m: FloatArray,
    white: FloatArray,
    arc_length_m: FloatArray,
    noise: Noise,
) -> TrialResidual:
    """Residual statistics of a trial.

    predicted_m  (times, markers, 2), m
    white        (times, markers, 2) whitened residual, nan where not seen
    """
    t_s = trial.markers.t_s
    residual = trial.markers.xy_m - predicted_m
    edges = np.linspace(t_s[0], t_s[-1], min(TIME_BINS, len(t_s)) + 1)
    bins = np.clip(np.searchsorted(edges, t_s, "right") - 1, 0, len(edges) - 2)
    by_time = [rms(residual[bins == b]) for b in range(len(edges) - 1)]
    names = phase_of(trial)
    return TrialResidual(
        trial=trial.name,
        rms_m=rms(residual),
        by_time=Profile(0.5 * (edges[1:] + edges[:-1]), np.array(by_time)),
        by_arc_length=Profile(
            arc_length_m, np.array([rms(residual[:, m]) for m in range(residual.shape[1])])
        ),
        by_phase={p: rms(residual[names == p]) for p in PHASES},
        spectrum=spectrum(t_s, residual, noise),
        whiteness_p_value=ljung_box(white.reshape(len(t_s), -1)),
        correlations=correlations(trial, predicted_m, white),
    )


def unsimulated_trial(trial: Trial, arc_length_m: FloatArray, noise: Noise) -> TrialResidual:
    """Of a trial that the model cannot be simulated in: an infinite error, and no place for it."""
    t_s, markers = trial.markers.t_s, len(arc_length_m)
    blank = spectrum(t_s, np.full((len(t_s), markers, 2), np.nan), noise)
    bins = min(TIME_BINS, len(t_s))
    edges = np.linspace(t_s[0], t_s[-1], bins + 1)
    return TrialResidual(
        trial=trial.name,
        rms_m=float("inf"),
        by_time=Profile(0.5 * (edges[1:] + edges[:-1]), np.full(bins, np.nan)),
        by_arc_length=Profile(arc_length_m, np.full(markers, np.nan)),
        by_phase=dict.fromkeys(PHASES, float("nan")),
        spectrum=blank,
        whiteness_p_value=float("nan"),
        correlations=(),
    )


def displacement(seen: FloatArray, model: FloatArray) -> FloatArray:
    """(…, 2) from model to what was seen: along one coordinate alone where the other was not."""
    away = seen - model
    lost = np.isnan(away)
    return np.where(lost & ~lost.all(axis=-1, keepdims=True), 0.0, away)


def distance(seen: FloatArray, model: FloatArray) -> FloatArray:
    """(…) of `displacement`, nan where neither coordinate was seen."""
    return np.asarray(np.linalg.norm(displacement(seen, model), axis=-1))


def largest(values: FloatArray) -> float:
    """The 99th percentile of what is finite; 0 if nothing is."""
    some = values[np.isfinite(values)]
    return float(np.percentile(some, 99)) if some.size else 0.0


def rms(residual_m: FloatArray) -> float:
    """Root mean square over what is not nan; nan if nothing is."""
    seen = residual_m[np.isfinite(residual_m)]
    return float(np.sqrt(np.mean(seen**2))) if seen.size else float("nan")


def phase_of(trial: Trial) -> NDArray[np.str_]:
    """(times,) the phase of the motion, one of `PHASES`, at each marker time."""
    t_s = trial.markers.t_s
    still = still_frames(t_s, trial.grip, trial.rests_until_s)
    start_s = float(t_s[still.stop]) if still.stop < len(t_s) else np.inf
    stop_s = max(_stop_s(trial.grip), start_s)
    limits = [start_s, stop_s, stop_s + EARLY_SWING_S]
    return np.array(PHASES)[np.searchsorted(limits, t_s, "right")]


def _stop_s(motion: Motion) -> float:
    """When the hand comes to rest for good: the onset of the motion run backwards."""
    t_s = motion.t_s
    mirrored = t_s[0] + t_s[-1]
    backward = Motion(
        mirrored - t_s[::-1], motion.x_m[::-1], motion.y_m[::-1], motion.angle_rad[::-1]
    )
    onset_s = moves_from_s(backward)
    return float(mirrored - onset_s) if np.isfinite(onset_s) else float(t_s[0])


def spectrum(t_s: FloatArray, residual_m: FloatArray, noise: Noise) -> Spectrum:
    """Mean power over all coordinates against that of the noise (Lomb and Scargle: any stamps)."""
    span_s = float(t_s[-1] - t_s[0])
    highest = 0.5 / float(np.median(np.diff(t_s)))
    count = int(min(MAX_FREQUENCIES, max(3, highest * span_s)))
    frequency = np.arange(1, count) * highest / count  # short of Nyquist, where phase is lost
    series = residual_m.reshape(len(t_s), -1)
    seen = np.isfinite(series)
    power, used = np.zeros(len(frequency)), 0
    for frames in np.unique(seen, axis=1).T:
        alike = series[frames][:, np.all(frames == seen.T, axis=1)]
        if len(alike) < 4:
            continue
        power += lomb_scargle(t_s[frames], alike - alike.mean(axis=0), frequency).sum(axis=1)
        used += alike.shape[1]
    power *= 2.0 * float(np.median(np.diff(t_s))) / max(used, 1)
    frame_s = float(np.median(np.diff(t_s)))
    colour = noise.colour
    shape = noise.white + (1.0 - noise.white) * (1.0 - colour**2) / (
        1.0 - 2.0 * colour * np.cos(2.0 * np.pi * frequency * frame_s) + colour**2
    )
    return Spectrum(frequency, power, 2.0 * noise.std_m**2 * frame_s * shape)


def lomb_scargle(t_s: FloatArray, values: FloatArray, frequency_hz: FloatArray) -> FloatArray:
    """(frequencies, series) periodogram of values (times, series) at any times.

    Half the square that a sine of this frequency takes off; scipy's takes half a second to import.
    source  Scargle 1982, Astrophys. J. 263, 835
    """
    phase = 2.0 * np.pi * frequency_hz[:, None] * t_s
    phase -= 0.5 * np.arctan2(np.sin(2.0 * phase).sum(1), np.cos(2.0 * phase).sum(1))[:, None]
    parts = (np.cos(phase), np.sin(phase))
    squares = [(wave @ values) ** 2 / np.sum(wave**2, axis=1)[:, None] for wave in parts]
    return np.asarray(0.5 * (squares[0] + squares[1]))


def ljung_box(white: FloatArray, lags: int = LAGS) -> float:
    """p-value that white series (times, series), nan = unseen, are white: Ljung and Box 1978."""
    statistic, freedom = 0.0, 0
    for values in white.T:
        seen = values[np.isfinite(values)]
        n = len(seen)
        if n <= 2 * lags:
            continue
        centred = seen - seen.mean()
        power = float(centred @ centred)
        if power <= 0.0:
            continue
        for lag in range(1, lags + 1):
            r = float(centred[lag:] @ centred[:-lag]) / power
            statistic += n * (n + 2) * r * r / (n - lag)
        freedom += lags
    return float(chi2_sf(freedom, statistic)) if freedom else float("nan")


def correlations(
    trial: Trial, predicted_m: FloatArray, white: FloatArray
) -> tuple[Correlation, ...]:
    """Signals that the residual of the outermost marker is correlated with, strongest first.

    The whitened residual along the cable's normal is correlated with each signal at that marker;
    its p-value counts only the independent values of the two series (Bartlett 1935).
    """
    t_s = trial.markers.t_s
    if len(t_s) < 2 * LAGS:
        return ()
    grip = _hand(trial)
    normal = across_tip(trial, predicted_m)
    velocity = np.sum(np.gradient(predicted_m[:, 0], t_s, axis=0) * normal, axis=1)
    smooth = min(len(t_s) - (1 - len(t_s) % 2), 11)
    hand = smoothed(grip, smooth)
    acceleration = np.gradient(np.gradient(hand, t_s, axis=0), t_s, axis=0)
    chord = np.unwrap(np.arctan2(-normal[:, 0], normal[:, 1]))
    signals = {
        "base acceleration, x": acceleration[:, 0],
        "base acceleration, y": acceleration[:, 1],
        "tip velocity": velocity,
        "|v|v of the tip": np.abs(velocity) * velocity,
        "curvature rate": np.gradient(chord - trial_angle(trial, t_s), t_s),
    }
    # of a marker of which one coordinate is seen, as much as that shows
    seen = np.isfinite(white[:, 0])
    error = np.sum(np.where(seen, white[:, 0], 0.0) * normal, axis=1)
    error = np.where(seen.any(axis=1), error, np.nan)
    found = [Correlation(name, *_correlation(error, values)) for name, values in signals.items()]
    return tuple(sorted(found, key=lambda f: -abs(f.correlation)))


def smoothed(values: FloatArray, window: int) -> FloatArray:
    """Values (times, series) by cubics fitted to windows of an odd number of neighbours.

    At either end by the cubic of the first and last window; scipy's takes half a second to import.
    source  Savitzky & Golay 1964, Anal. Chem. 36, 1627
    """
    half = window // 2
    design = np.vander(np.arange(-half, half + 1) / half, 4, increasing=True)
    fit = design @ np.linalg.pinv(design)
    around = np.lib.stride_tricks.sliding_window_view(values, window, axis=0)
    first, last = fit[:half] @ values[:window], fit[half + 1 :] @ values[-window:]
    return np.concatenate([first, around @ fit[half], last])


def across_tip(trial: Trial, predicted_m: FloatArray) -> FloatArray:
    """(times, 2) unit vector across the cable at the outermost marker."""
    # the grip stands in as second marker where there is only one
    points = np.concatenate([predicted_m, _hand(trial)[:, None]], axis=1)
    along = points[:, 0] - points[:, 1]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    return np.column_stack([-along[:, 1], along[:, 0]])


def _hand(trial: Trial) -> FloatArray:
    """(times, 2) logged gripping point at the markers' times, m."""
    t_s, grip = trial.markers.t_s, trial.grip
    return np.column_stack([np.interp(t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])


def trial_angle(trial: Trial, t_s: FloatArray) -> FloatArray:
    """Logged clamp angle at times, rad."""
    return np.asarray(np.interp(t_s, trial.grip.t_s, trial.grip.angle_rad))


def _correlation(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return 0.0, 1.0
    a, b = a[both] - a[both].mean(), b[both] - b[both].mean()
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
    """rms over several residual arrays together."""
    return rms(np.concatenate([p.ravel() for p in parts])) if parts else float("nan")
