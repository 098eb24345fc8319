"""What a trial shows before any model, and what of it makes a fit weak or wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, moves_from_s
from cell.files.plain import plain
from cell.files.words import counted
from cell.study.data import Trial
from cell.study.rest_shape import ClampedEnd, SwingScale, clamped_end, swing_scale

#: A frequency is told of at least so many swings and frames after the hand has stopped.
FEWEST_SWINGS, FEWEST_FRAMES = 1.5, 16
#: Spectra are drawn on a grid this much finer than their resolution.
_FINER = 8
#: Frequencies are told whose amplitude is this share of the largest, at most so many, and so many
#: resolutions apart: nearer ones are side lobes of one.
_SHARE, MOST_FREQUENCIES, _APART = 0.1, 3, 2.0
EARTH = (0.0, -9.81)
#: Of 384 trials of real and simulated cables the slowest swing had 0.44 to 1.67 times the frequency
#: that the droop tells, and all were faster than a hanging chain.
_OF_DROOP, _OF_CHAIN = 2.5, 0.8
#: Of 331 trials of whatever effects none begins at rest by this share of its length from its
#: gripping point, has a marker so far from a smooth curve, or leaves by this angle from the stated.
_AWAY, _OFF, _TURNED_RAD = 0.03, 0.015, np.radians(20.0)
#: A record of white noise shows a peak with this probability.
_BY_CHANCE = 1e-3


@dataclass(frozen=True, eq=False)
class SwingSpectrum:
    """Amplitude of the tip's motion after the hand has stopped: (n,) Hz, (n,) m.

    resolution_hz  frequencies nearer than this are not told apart
    """

    frequency_hz: FloatArray
    amplitude_m: FloatArray
    peaks_hz: tuple[float, ...]
    resolution_hz: float


@dataclass(frozen=True, eq=False)
class TrialFacts:
    """What a trial shows.  Times in s, lengths in m.

    rate_hz       frames a second, by the usual step; irregular: share of steps 20 % off it
    hand_m        how far apart the hand's places are, and hand_rad how far it turns
    moves_s       when the hand begins to move and when it has stopped; None = it never moves
    rest_frames   frames before anything moves
    noise_m       of one coordinate in one frame, by frames at rest; nan = too few
    tip           number of the marker farthest from the hand that is seen
    tip_m         how far apart the tip's places are
    seen          share of values that were seen, of the coordinates that are seen at all
    spectrum      of the tip; None = too short
    sensors       by which more is told than by a log and markers: see `sensors_of`
    swings        by what units of time and length are tested; None = no gravity, or no arc length
    clamped_end   by what place and angle of the clamp are tested; None = no marker is near it
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

    def to_json(self) -> dict[str, Any]:
        """Plain data; the spectrum by its frequencies, None for what is not known."""
        shown = set(vars(self)) - {"spectrum", "swings", "clamped_end"}
        data = {k: v for k, v in vars(self).items() if k in shown}
        peaks_hz = () if self.spectrum is None else self.spectrum.peaks_hz
        return {**plain(data), "frequencies_hz": plain(peaks_hz)}


def trial_facts(
    trial: Trial, arc_length_m: FloatArray, gravity_m_per_s2: tuple[float, float] = EARTH
) -> TrialFacts:
    """What a trial shows.

    arc_length_m  (markers,) from the gripping point; nan = unknown, then they stand tip first
    """
    markers, grip = trial.markers, trial.grip
    t_s, xy_m = markers.t_s, markers.xy_m
    steps = np.diff(t_s)
    step_s = float(np.median(steps))
    moves = _moves_s(trial)
    rest = int(np.searchsorted(t_s, min(moves[0] if moves else np.inf, _let_go(trial))))
    rest = 0 if trial.start == "moving" else rest
    tip, still_noise_m = _tip(xy_m, arc_length_m), noise_m(xy_m[:rest])
    swings_s = max(moves[1] if moves else -np.inf, _swings_from(trial))
    return TrialFacts(
        trial.name,
        trial.role,
        trial.start,
        len(t_s),
        float(t_s[0]),
        float(t_s[-1]),
        1.0 / step_s,
        float(np.mean(np.abs(steps / step_s - 1.0) > 0.2)),
        _reach(np.column_stack([grip.x_m, grip.y_m])),
        float(np.ptp(grip.angle_rad)),
        moves,
        rest,
        still_noise_m,
        tip,
        _reach(xy_m[:, tip]),
        _detected_share(xy_m),
        swing_spectrum(t_s, xy_m[:, tip], swings_s, still_noise_m),
        sensors_of(trial),
        swing_scale(trial, rest, tip, float(arc_length_m[tip]), gravity_m_per_s2),
        clamped_end(trial, rest, arc_length_m),
    )


def sensors_of(trial: Trial) -> tuple[str, ...]:
    """What a trial states of sensors: of the hand's place with an error of its own, of a wrench."""
    drift = trial.hand_drift
    hand = () if drift is None else (f"hand by {drift.sensor}",)
    return hand if trial.wrench is None else (*hand, "wrench")


def sensors_in_words(trials: Sequence[Trial]) -> str:
    """The same of several trials, with how many state it; empty if none does."""
    said = [sensor for trial in trials for sensor in sensors_of(trial)]
    return ", ".join(
        f"{sensor} ({said.count(sensor)} of {counted(len(trials), 'trial')})"
        for sensor in dict.fromkeys(said)
    )


def facts_of(
    trials: Sequence[Trial], arc_length_m: FloatArray, gravity_m_per_s2: tuple[float, float]
) -> tuple[TrialFacts, ...]:
    """The same of several trials."""
    return tuple(trial_facts(trial, arc_length_m, gravity_m_per_s2) for trial in trials)


def noise_m(still_m: FloatArray) -> float:
    """Noise of one coordinate in one frame (T, …) at rest, by second differences; nan = too few.

    Slow errors do not show in it.
    """
    bends = np.abs(np.diff(still_m, 2, axis=0)) / np.sqrt(6.0)
    if len(bends) < 3 or not np.isfinite(bends).any():
        return float("nan")
    return 1.4826 * float(np.nanmedian(bends))


def swing_spectrum(
    t_s: FloatArray, tip_m: FloatArray, from_s: float, noise_m: float = np.nan
) -> SwingSpectrum | None:
    """Spectrum of a point's free swing along its main direction; None if it is too short.

    tip_m    (T, 2), nan = not seen
    noise_m  of one coordinate; what white noise shows is no peak; nan = unknown
    """
    seen = np.isfinite(tip_m).any(axis=0)
    good = (t_s >= from_s) & np.isfinite(tip_m[:, seen]).all(axis=1)
    if np.count_nonzero(good) < FEWEST_FRAMES or not seen.any():
        return None
    at_s, at_m = t_s[good], tip_m[good][:, seen]
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
    """Amplitude that white noise of size 1 reaches at no frequency, but with `_BY_CHANCE`."""
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
        return ()  # most of the motion is slower than what the record can show
    resolution = _FINER * frequency[1]
    found: list[float] = []
    for top in order[amplitude[order] >= _SHARE * amplitude[order[0]]]:
        if all(abs(frequency[top] - f) > _APART * resolution for f in found):
            found.append(float(frequency[top]))
    return tuple(found[:MOST_FREQUENCIES])


def _moves_s(trial: Trial) -> tuple[float, float] | None:
    """When the hand begins to move and when it has stopped."""
    grip = trial.grip
    begins = moves_from_s(grip, ROUGHLY_STILL)
    if not np.isfinite(begins):
        return None
    away = np.zeros(len(grip.t_s), dtype=bool)
    for name, limit in ROUGHLY_STILL.by_axis().items():
        value = getattr(grip, name)
        away |= np.abs(value - np.median(value[-10:])) > limit
    last = int(np.flatnonzero(away)[-1])
    return begins, float(grip.t_s[min(last + 1, len(grip.t_s) - 1)])


def _let_go(trial: Trial) -> float:
    return np.inf if trial.release_s is None else trial.release_s


def _swings_from(trial: Trial) -> float:
    """From when on the cable swings without the fingers that held it."""
    return -np.inf if trial.release_s is None else trial.release_s


def _detected_share(xy_m: FloatArray) -> float:
    measured = np.isfinite(xy_m).any(axis=0)
    return float(np.isfinite(xy_m[:, measured]).mean()) if measured.any() else 0.0


def _tip(xy_m: FloatArray, arc_length_m: FloatArray) -> int:
    seen = np.isfinite(xy_m).any(axis=(0, 2))
    if not np.isfinite(arc_length_m).all():
        return int(np.argmax(seen))
    return int(np.argmax(np.where(seen, arc_length_m, -1.0)))


def _reach(xy_m: FloatArray) -> float:
    """How far apart places (T, 2) are, whatever of them was seen."""
    seen = np.isfinite(xy_m).any(axis=0)
    if not seen.any():
        return float("nan")
    return float(np.linalg.norm(np.nanmax(xy_m[:, seen], 0) - np.nanmin(xy_m[:, seen], 0)))


#: Frames at rest with which the level of a noise is known to a fifth, at two coordinates.
_STILL = 12
#: Frames of a swing below which its shape is lost between them.
_PER_SWING = 8.0
#: Swings after the hand has stopped with which damping is told.
_SWINGS = 3.0
#: Less than this share of the values seen, and more than this share of steps uneven, is told.
_SEEN, _UNEVEN = 0.9, 0.05
#: The first frequency of one cable differs less between trials: a nonlinear swing of twice the size
#: changes it by some percent.
_FREQUENCY = 0.15
#: Trials that are named in a sentence.
NAMED = 3
#: Stated noise over that from frame to frame at rest: less cannot be, for that is a part of it;
#: more may be, as of a camera that filters or a lens that is not straightened, but not by so much.
_STATED = (1.0 / 3.0, 20.0)
#: A tip that moves by less than so many times the noise shows nothing.
_OF_NOISE = 20.0


def oddities(facts: Sequence[TrialFacts], noise_std_m: float | None) -> list[str]:
    """What should be better, of every trial and of all together.

    noise_std_m  that the study states; None = it states none
    """
    of_trials: dict[str, list[str]] = {}
    for f in facts:
        for sentence in _of_trial(f, noise_std_m is not None):
            of_trials.setdefault(sentence, []).append(f.name)
    found = [f"{_listed(names)}: {sentence}" for sentence, names in of_trials.items()]
    stated = stated_oddly(facts, noise_std_m)
    return [*found, *([] if stated is None else [stated]), *_between(facts)]


def stated_oddly(facts: Sequence[TrialFacts], noise_std_m: float | None) -> str | None:
    """That the noise of a study is stated much larger, or smaller, than it is at rest."""
    seen_m = [f.noise_m for f in facts if np.isfinite(f.noise_m) and f.noise_m > 0.0]
    if noise_std_m is None or not seen_m:
        return None
    at_rest_m = float(np.median(seen_m))
    if _STATED[0] * at_rest_m <= noise_std_m <= _STATED[1] * at_rest_m:
        return None
    what = "hides what the model lacks" if noise_std_m > at_rest_m else "no model can be as right"
    return (
        f"noise_std_m states {noise_std_m * 1e3:.2g} mm, the frames at rest show "
        f"{at_rest_m * 1e3:.2g} mm: {what}; correct it, or leave it out"
    )


def _listed(names: Sequence[str]) -> str:
    """Names of trials, not all of many."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _of_trial(facts: TrialFacts, stated_noise: bool) -> list[str]:
    found = []
    if facts.moves_s is None and facts.start == "equilibrium":
        found.append("the hand never moves, and the cable is not let go; record a motion")
        if facts.spectrum is None or not facts.spectrum.peaks_hz:
            return found  # and what a swing should be is of no interest
    if facts.rest_frames < _STILL and facts.start != "moving" and not stated_noise:
        found.append(
            f"{counted(facts.rest_frames, 'frame shows', 'frames show')} the cable at rest; "
            f"record {_STILL} or more before "
            "the motion, for the noise is known from these"
        )
    if facts.seen < _SEEN:
        found.append(f"{facts.seen:.0%} of the values were seen; see which markers are lost when")
    if facts.irregular > _UNEVEN:
        found.append(f"{facts.irregular:.0%} of the steps of time are uneven; are frames missing?")
    if np.isfinite(facts.noise_m) and facts.tip_m < _OF_NOISE * facts.noise_m:
        found.append(
            f"the tip moves by {facts.tip_m * 1e3:.2g} mm, only {facts.tip_m / facts.noise_m:.2g} "
            "times the noise; move the hand farther or faster"
        )
    return [*found, *_of_clamped_end(facts), *_of_swing(facts)]


def _of_swing(facts: TrialFacts) -> list[str]:
    """What the frequency seen says of rate and length of the record."""
    after_s = facts.to_s - (facts.from_s if facts.moves_s is None else facts.moves_s[1])
    spectrum = facts.spectrum
    if after_s <= 0.0:
        return ["the hand still moves when the record of the markers ends; record the swing too"]
    if spectrum is None or not spectrum.peaks_hz:
        return [f"the record ends {after_s:.2g} s after the hand stops, too soon to show a swing"]
    first_hz, found = spectrum.peaks_hz[0], _of_scale(facts, min(spectrum.peaks_hz))
    if facts.rate_hz < _PER_SWING * first_hz:
        found.append(
            f"{facts.rate_hz:.3g} frames a second are {facts.rate_hz / first_hz:.2g} in a swing of "
            f"{first_hz:.3g} Hz; {_PER_SWING:.0f} or more are needed"
        )
    if after_s * first_hz < _SWINGS:
        found.append(
            f"the record ends {after_s:.2g} s after the hand stops, {after_s * first_hz:.2g} "
            f"swings of {first_hz:.3g} Hz; {_SWINGS:.0f} or more show the damping"
        )
    return found


def _of_clamped_end(facts: TrialFacts) -> list[str]:
    """That the cable at rest does not begin where, or as, the clamp is said to be."""
    begins = facts.clamped_end
    if begins is None:
        return []
    found = []
    if begins.away_m > _AWAY * begins.length_m:
        found.append(
            f"at rest the curve through the markers begins {begins.away_m * 1e3:.2g} mm from the "
            f"gripping point, limit {_AWAY * begins.length_m * 1e3:.2g} mm; check the hand's "
            "place, arc lengths and both frames"
        )
    if begins.worst_m > _OFF * begins.length_m:
        found.append(
            f"at rest the marker at arc length {begins.worst_arc_m:g} m is "
            f"{begins.worst_m * 1e3:.2g} mm from a smooth curve, limit "
            f"{_OFF * begins.length_m * 1e3:.2g} mm; check its arc length and the order of markers"
        )
    if abs(begins.turned_rad) > _TURNED_RAD:
        found.append(
            f"at rest the cable leaves the clamp {np.degrees(begins.turned_rad):+z.0f}° from its "
            f"angle, limit {np.degrees(_TURNED_RAD):.0f}°; check angle_rad (positive = pointing "
            "down) and the axes"
        )
    return found


def _of_scale(facts: TrialFacts, slowest_hz: float) -> list[str]:
    """That a swing is not as fast as gravity and the droop at rest say."""
    scale = facts.swings
    if scale is None:
        return []
    seen = f"the cable swings at {slowest_hz:.3g} Hz"
    remedy = "check the units of time and length"
    if slowest_hz < _OF_CHAIN * scale.slowest_hz:
        return [
            f"{seen}, and none of its length is slower than {scale.slowest_hz:.3g} Hz; {remedy}"
        ]
    ratio = slowest_hz / scale.droops_hz
    if not np.isfinite(ratio) or 1.0 / _OF_DROOP < ratio < _OF_DROOP:
        return []
    return [
        f"{seen}, yet one that its weight bends by {scale.droop_m * 1e3:.3g} mm swings at about "
        f"{scale.droops_hz:.3g} Hz; {remedy}, unless it is naturally curved"
    ]


def _between(facts: Sequence[TrialFacts]) -> list[str]:
    """Trials whose first frequencies are not of one cable."""
    seen = [
        (f.spectrum.peaks_hz[0], f.spectrum.resolution_hz, f.name)
        for f in facts
        if f.spectrum is not None and f.spectrum.peaks_hz
    ]
    if len(seen) < 2:
        return []
    (low_hz, rough_hz, low), (high_hz, also_hz, high) = min(seen), max(seen)
    if high_hz - low_hz < max(_FREQUENCY * low_hz, rough_hz, also_hz):
        return []
    return [
        f"the strongest swing has {low_hz:.3g} Hz in {low} and {high_hz:.3g} Hz in {high}: are "
        "they of one cable, held at the same place?"
    ]
