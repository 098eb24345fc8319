"""Warnings about a fit: far from the noise, in a wrong minimum or before it, at a bound."""

from __future__ import annotations

import numpy as np

from cell.cable.effects.base import after_number
from cell.lab.data.prepared import ERRS
from cell.lab.data.results import Doubt
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel

#: A model that leaves this share of what the markers move (rms) is no model of the cable.
HOPELESS_SHARE = 0.5
#: One that leaves more than this many times as much is not of this cable in this frame; an effect
#: beside it is not looked for.  Cables in need of an effect have left 1.2 times as much, mirrored
#: ones 3 to 12.
NO_MODEL = 2.0
#: Error over noise from which a fit's intervals rest on the model's own error.
BEYOND_NOISE = 3.0
#: A cable of which EI differs by more than this factor from place to place is none, if its model
#: leaves that much; the prior's random walk gives it 7 standard deviations.
UNLIKE_ANY = 20.0
#: Two fits are different minima if EI differs by more than this factor anywhere.
APART = 2.0
#: Or if a parameter of an effect differs by more than so many standard deviations.
APART_STD = 3.0
#: An amplitude is at its bound within this share of the way there from none of the effect.
NEAR_BOUND = 0.01


#: Warnings of a fit whose parameters mean nothing; beside it no effect is called absent.
MEANINGLESS = frozenset({"hopeless", "implausible", "starts_disagree"})


def is_meaningless(fits: FitCache, candidate: FittedModel) -> bool:
    """Whether the parameters of a fit mean nothing, so that no effect can be excluded beside it."""
    return bool(MEANINGLESS & {doubt.code for doubt in fit_doubts(fits, candidate)})


def fit_doubts(fits: FitCache, candidate: FittedModel) -> tuple[Doubt, ...]:
    """Warnings of a fit: hopeless, far beyond the noise, no minimum, at a bound, or diverging."""
    fit, noise_model = candidate.fit, fits.prepared.noise_model
    to_all = "" if fits.prepared.study.role("validate") else " to all trials"
    found = []
    moved_m = _moved_m(fits)
    worst_m = max(fit.rms_m, candidate.heldout.rms_m if candidate.heldout else 0.0)
    if is_hopeless(fits, fit):
        found.append(
            Doubt(
                "hopeless",
                f"the fit{to_all} misses {fit.rms_m * 1e3:.3g} mm of markers that move by "
                f"{moved_m * 1e3:.3g} mm (rms): its parameters are meaningless; check the "
                "study's frame, times and datasheet",
            )
        )
    elif np.isfinite(worst_m) and worst_m > BEYOND_NOISE * noise_model.noise.std_m:
        found.append(
            Doubt(
                "beyond_noise",
                f"the model misses {worst_m * 1e3:.3g} mm, {worst_m / noise_model.noise.std_m:.0f} "
                "times the noise: it lacks an effect; `cell diagnose STUDY` finds out which",
            )
        )
    found += _wrong_minimum(fits, candidate)
    found += not_converged(fit)
    found += [
        Doubt(
            "at_bound",
            f"{name} is at its bound, {value:.4g} {unit}: the value comes from the bound, not from "
            "the measurement",
        )
        for name, value, unit in at_bound(fit)
    ]
    if candidate.heldout is not None:
        found += [
            Doubt(
                "diverges",
                f"the model cannot be simulated in trial {name}, which it was not fitted to",
            )
            for name, predicted in candidate.heldout.predicted_m.items()
            if not np.isfinite(predicted).all()
        ]
    return tuple(found)


def _wrong_minimum(fits: FitCache, candidate: FittedModel) -> list[Doubt]:
    """Of a model that leaves far more than noise: EI of no cable, or another from another start."""
    noise_m, fit = fits.prepared.noise_model.noise.std_m, candidate.fit
    left_m = max(fit.rms_m, candidate.heldout.rms_m if candidate.heldout else 0.0)
    if not left_m > BEYOND_NOISE * noise_m:
        second = fits.second
        as_good = second is not None and second.rms_m <= ERRS * fit.rms_m
        return starts_disagree(fits) if as_good else []
    found = []
    rigidity = fit.model.rigidity_n_m2
    differs = float(rigidity.max() / rigidity.min())
    if differs > UNLIKE_ANY:
        found.append(
            Doubt(
                "implausible",
                f"EI differs {differs:.0f}-fold along the cable and the model misses "
                f"{fit.rms_m * 1e3:.3g} mm: this is not plausible for a cable, and the parameters "
                "are meaningless; the search is in a wrong minimum, or the study is wrong (frame, "
                "datasheet, how trials begin)",
            )
        )
    found += starts_disagree(fits)
    return found


def not_converged(fit: Fit) -> list[Doubt]:
    """Of a fit that was left before its minimum."""
    if fit.arrived:
        return []
    distance = np.sqrt(fit.solution.promised / fit.widening)
    return [
        Doubt(
            "not_converged",
            f"the fit was left before its minimum, about {distance:.0f} standard deviations away: "
            "its parameters can hardly be told apart; the intervals allow for that; add a motion "
            "that tells them apart, as `cell suggest STUDY` finds",
        )
    ]


def starts_disagree(fits: FitCache) -> list[Doubt]:
    """Of a baseline that a second start leads to another minimum, in EI or in its effects."""
    base, other = fits.baseline().fit, fits.second_start()
    if other is None:
        return []
    apart = np.log(other.model.rigidity_n_m2) - np.log(base.model.rigidity_n_m2)
    factor = float(np.exp(np.abs(apart).max()))
    found = [f"EI up to {factor:.1f}-fold apart"] if factor >= APART else []
    found += _effects_apart(base, other)
    if not found:
        return []
    return [
        Doubt(
            "starts_disagree",
            f"from two starts the fit ends in different places: one misses {base.rms_m * 1e3:.3g} "
            f"mm, the other {other.rms_m * 1e3:.3g} mm, with {' and '.join(found)}; there may be a "
            "better minimum",
        )
    ]


def _effects_apart(base: Fit, other: Fit) -> list[str]:
    """Parameters of effects in which two fits differ by more than what is left of either allows."""
    values, others = base.space.natural(base.q), other.space.natural(other.q)
    found = []
    for i, name in enumerate(base.space.names):
        if "." not in name:
            continue
        variance = sum(fit.widening * fit.covariance[i, i] for fit in (base, other))
        if abs(other.q[i] - base.q[i]) > APART_STD * np.sqrt(variance):
            unit = after_number(base.space.units[i])
            found.append(f"{name} {values[i]:.3g} and {others[i]:.3g}{unit}")
    return found


def is_hopeless(fits: FitCache, fit: Fit) -> bool:
    """Whether the error of a fit is more than half of the markers' motion."""
    return fit.rms_m > HOPELESS_SHARE * _moved_m(fits)


def is_no_model(fits: FitCache, fit: Fit) -> bool:
    """Whether the error is so much larger than the markers' motion that no effect explains it."""
    return fit.rms_m > NO_MODEL * _moved_m(fits)


def _moved_m(fits: FitCache) -> float:
    """rms distance of the fit trials' markers from their own means, per coordinate, m."""
    square, count = 0.0, 0
    for trial in fit_trials(fits.prepared):
        for series in trial.markers.xy_m.reshape(len(trial.markers.t_s), -1).T:
            seen = series[np.isfinite(series)]
            if seen.size:
                square += float(np.sum((seen - seen.mean()) ** 2))
                count += seen.size
    return float(np.sqrt(square / max(count, 1)))


def at_bound(fit: Fit) -> list[tuple[str, float, str]]:
    """Fitted parameters that lie at a bound, except amplitudes that are absent there.

    An amplitude that is all but there is there: the last of the way costs a search nothing.
    """
    space, q = fit.space, fit.q
    absent = {
        f"{e.name}.{p.name}": p.default for e in space.effects for p in e.parameters if p.amplitude
    }
    values = space.natural(q)
    found = []
    for i, name in enumerate(space.names):
        default = absent.get(name)
        ends = space.natural(space.low)[i], space.natural(space.high)[i]
        near = [0.0 if default is None else NEAR_BOUND * abs(end - default) for end in ends]
        outside = values[i] <= ends[0] + near[0] or values[i] >= ends[1] - near[1]
        if space.low[i] < space.high[i] and outside and default != values[i]:
            found.append((name, float(values[i]), space.units[i]))
    return found
