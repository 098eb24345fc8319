"""Facts of a trial, computed from its measurements without a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, away_from, moves_from_s
from cell.files.plain import plain
from cell.files.words import counted
from cell.study.data import Trial
from cell.study.rest_shape import ClampedEnd, SwingScale, clamped_end, swing_scale
from cell.study.root_motion import RootMotion, root_motion
from cell.study.series import noise_m, span_m

#: Least number of swings and frames after the gripper has stopped for a frequency.
FEWEST_SWINGS, FEWEST_FRAMES = 1.5, 16
#: Spectra are drawn on a grid this much finer than their resolution.
_FINER = 8
#: Reported frequencies: least amplitude, share of the largest; their largest number; least distance
#: in resolutions: nearer ones are side lobes.
_SHARE, MOST_FREQUENCIES, _APART = 0.1, 3, 2.0
EARTH = (0.0, -9.81)
#: A record of white noise shows a peak with this probability.
_BY_CHANCE = 1e-3


@dataclass(frozen=True, eq=False)
class SwingSpectrum:
    """Amplitude of the tip's motion after the gripper has stopped: (n,) Hz, (n,) m.

    resolution_hz  least distance of distinguishable frequencies
    """

    frequency_hz: FloatArray
    amplitude_m: FloatArray
    peaks_hz: tuple[float, ...]
    resolution_hz: float


@dataclass(frozen=True, eq=False)
class TrialFacts:
    """Facts of a trial.  Times in s, lengths in m.

    rate_hz       frames a second, by the usual step; irregular: share of steps 20 % off it
    hand_m        span of the gripper's places, and hand_rad of its angle
    moves_s       times at which the gripper begins to move and has stopped; None = it never moves
    rest_frames   frames before anything moves
    noise_m       of one coordinate in one frame, by frames at rest; nan = too few
    tip           number of the detected marker farthest from the gripper
    tip_m         span of the tip's places
    seen          share of detected values, of the coordinates that are detected at all
    spectrum      of the tip; None = too short
    sensors       further sensors besides log and markers: see `sensors_of`
    swings        to test units of time and length; None = no gravity, or no arc length
    clamped_end   to test place and angle of the clamp; None = no marker is near it
    root_motion   to test units, frames and rates; None = too little motion or too few detections
    """

    name: str
    role: str
    start: str
    frames: int
    from_s: float
    to_s: float
    rate_hz: float
    irregular: float
    hand_m: float
    hand_rad: float
    moves_s: tuple[float, float] | None
    rest_frames: int
    noise_m: float
    tip: int
    tip_m: float
    seen: float
    spectrum: SwingSpectrum | None
    sensors: tuple[str, ...] = ()
    swings: SwingScale | None = None
    clamped_end: ClampedEnd | None = None
    root_motion: RootMotion | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data; the spectrum by its frequencies, None for unknown values."""
        shown = set(vars(self)) - {"spectrum", "swings", "clamped_end", "root_motion"}
        data = {k: v for k, v in vars(self).items() if k in shown}
        peaks_hz = () if self.spectrum is None else self.spectrum.peaks_hz
        return {**plain(data), "frequencies_hz": plain(peaks_hz)}


def trial_facts(
    trial: Trial, arc_length_m: FloatArray, gravity_m_per_s2: tuple[float, float] = EARTH
) -> TrialFacts:
    """The facts of a trial.

    arc_length_m  (markers,) from the gripping point; nan = unknown, then they are ordered tip first
    """
    markers, grip = trial.markers, trial.grip
    t_s, xy_m = markers.t_s, markers.xy_m
    steps = np.diff(t_s)
    step_s = float(np.median(steps))
    moves = _moves_s(trial)
    let_go_s = trial.release_s
    until_s = min(moves[0] if moves else np.inf, np.inf if let_go_s is None else let_go_s)
    rest = int(np.searchsorted(t_s, until_s))
    rest = 0 if trial.start == "moving" else rest
    tip, still_noise_m = _tip(xy_m, arc_length_m), noise_m(xy_m[:rest])
    shown, measured = np.isfinite(xy_m), np.isfinite(xy_m).any(axis=0)
    # the cable swings without the fingers that held it
    swings_s = max(moves[1] if moves else -np.inf, -np.inf if let_go_s is None else let_go_s)
    return TrialFacts(
        trial.name,
        trial.role,
        trial.start,
        len(t_s),
        float(t_s[0]),
        float(t_s[-1]),
        1.0 / step_s,
        float(np.mean(np.abs(steps / step_s - 1.0) > 0.2)),
        span_m(np.column_stack([grip.x_m, grip.y_m])),
        float(np.ptp(grip.angle_rad)),
        moves,
        rest,
        still_noise_m,
        tip,
        span_m(xy_m[:, tip]),
        float(shown[:, measured].mean()) if measured.any() else 0.0,
        swing_spectrum(t_s, xy_m[:, tip], swings_s, still_noise_m),
        sensors_of(trial),
        swing_scale(trial, rest, tip, float(arc_length_m[tip]), gravity_m_per_s2),
        clamped_end(trial, rest, arc_length_m),
        root_motion(trial, arc_length_m, still_noise_m),
    )


def sensors_of(trial: Trial) -> tuple[str, ...]:
    """Sensors of a trial: of the gripper's position with its own error, of a wrench."""
    drift = trial.hand_drift
    hand = () if drift is None else (f"gripper by {drift.sensor}",)
    return hand if trial.wrench is None else (*hand, "wrench")


def sensors_in_words(trials: Sequence[Trial]) -> str:
    """Text of the trials' sensors, each with the number of trials; empty if there are none."""
    names = [sensor for trial in trials for sensor in sensors_of(trial)]
    return ", ".join(
        f"{sensor} ({names.count(sensor)} of {counted(len(trials), 'trial')})"
        for sensor in dict.fromkeys(names)
    )


def facts_of(
    trials: Sequence[Trial], arc_length_m: FloatArray, gravity_m_per_s2: tuple[float, float]
) -> tuple[TrialFacts, ...]:
    """The facts of several trials."""
    return tuple(trial_facts(trial, arc_length_m, gravity_m_per_s2) for trial in trials)


def swing_spectrum(
    t_s: FloatArray, tip_m: FloatArray, from_s: float, noise_m: float = np.nan
) -> SwingSpectrum | None:
    """Spectrum of a point's free swing along its main direction; None if it is too short.

    tip_m    (T, 2), nan = not detected
    noise_m  of one coordinate; peaks of white noise do not count; nan = unknown
    """
    detected = np.isfinite(tip_m).any(axis=0)
    good = (t_s >= from_s) & np.isfinite(tip_m[:, detected]).all(axis=1)
    if np.count_nonzero(good) < FEWEST_FRAMES or not detected.any():
        return None
    at_s, at_m = t_s[good], tip_m[good][:, detected]
    at_m = at_m - at_m.mean(axis=0)
    along = at_m @ np.linalg.svd(at_m, full_matrices=False)[2][0]
    count = len(at_s)
    even_s = np.linspace(at_s[0], at_s[-1], count)
    series = np.interp(even_s, at_s, along)
    series = series - np.polyval(np.polyfit(even_s - even_s[0], series, 1), even_s - even_s[0])
    window = np.hanning(count)
    raw = np.fft.rfft(series * window, _FINER * count)
    amplitude = 2.0 * np.abs(raw) / window.sum()
    step_s = (at_s[-1] - at_s[0]) / (count - 1)
    frequency = np.fft.rfftfreq(_FINER * count, step_s)
    resolution = 1.0 / float(at_s[-1] - at_s[0])
    chance_m = np.nan_to_num(noise_m) * _by_chance(window)
    peaks = _peaks(frequency, amplitude, FEWEST_SWINGS * resolution)
    if amplitude.max() <= chance_m:
        peaks = ()
    return SwingSpectrum(frequency, amplitude, peaks, resolution)


def _by_chance(window: FloatArray) -> float:
    """Amplitude that white noise of size 1 exceeds at any frequency with `_BY_CHANCE`."""
    mean_square = 4.0 * np.sum(window**2) / np.sum(window) ** 2
    return float(np.sqrt(mean_square * np.log(len(window) / 2 / _BY_CHANCE)))


def _peaks(frequency: FloatArray, amplitude: FloatArray, lowest_hz: float) -> tuple[float, ...]:
    """Frequencies of the largest peaks, the largest first."""
    inner = amplitude[1:-1]
    tops = np.flatnonzero((inner > amplitude[:-2]) & (inner >= amplitude[2:])) + 1
    tops = tops[frequency[tops] >= lowest_hz]
    if not len(tops):
        return ()
    order = tops[np.argsort(-amplitude[tops])]
    if amplitude[frequency < lowest_hz].max(initial=0.0) > amplitude[order[0]]:
        return ()  # most of the motion is slower than the record can resolve
    resolution = _FINER * frequency[1]
    peaks_hz: list[float] = []
    for top in order[amplitude[order] >= _SHARE * amplitude[order[0]]]:
        if all(abs(frequency[top] - f) > _APART * resolution for f in peaks_hz):
            peaks_hz.append(float(frequency[top]))
    return tuple(peaks_hz[:MOST_FREQUENCIES])


def _moves_s(trial: Trial) -> tuple[float, float] | None:
    grip = trial.grip
    begins = moves_from_s(grip, ROUGHLY_STILL)
    if not np.isfinite(begins):
        return None
    last = int(np.flatnonzero(away_from(grip, slice(-10, None), ROUGHLY_STILL))[-1])
    return begins, float(grip.t_s[min(last + 1, len(grip.t_s) - 1)])


def _tip(xy_m: FloatArray, arc_length_m: FloatArray) -> int:
    detected = np.isfinite(xy_m).any(axis=(0, 2))
    if not np.isfinite(arc_length_m).all():
        return int(np.argmax(detected))
    return int(np.argmax(np.where(detected, arc_length_m, -1.0)))
