"""What of a study makes a fit weak or wrong, as sentences, from what the measurements show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.files.words import counted
from cell.study.facts import TrialFacts

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
    return [*found, *_of_swing(facts)]


def _of_swing(facts: TrialFacts) -> list[str]:
    """What the frequency seen says of rate and length of the record."""
    after_s = facts.to_s - (facts.from_s if facts.moves_s is None else facts.moves_s[1])
    spectrum = facts.spectrum
    if after_s <= 0.0:
        return ["the hand still moves when the record of the markers ends; record the swing too"]
    if spectrum is None or not spectrum.peaks_hz:
        return [f"the record ends {after_s:.2g} s after the hand stops, too soon to show a swing"]
    first_hz, found = spectrum.peaks_hz[0], []
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
