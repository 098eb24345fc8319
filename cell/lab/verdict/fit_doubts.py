"""Warnings about a fit: far from the noise, in a wrong minimum or before it, at a bound."""

from __future__ import annotations

import numpy as np

from cell.cable.effects.base import after_number
from cell.lab.data.prepared import ERRS
from cell.lab.data.results import Doubt
from cell.lab.fit.fitting import Fit
from cell.lab.fit.plausibility import at_bound, is_hopeless, marker_motion_m
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel

#: Error over noise from which a fit's intervals rest on the model's own error.
BEYOND_NOISE = 3.0
#: A cable of which EI differs by more than this factor from place to place is none, if its model
#: leaves that much; the prior's random walk gives it 7 standard deviations.
UNLIKE_ANY = 20.0
#: Two fits are different minima if EI differs by more than this factor anywhere.
APART = 2.0
#: Or if a parameter of an effect differs by more than so many standard deviations.
APART_STD = 3.0
#: Warnings of a fit whose parameters mean nothing; given it no effect is called absent.
MEANINGLESS = frozenset({"hopeless", "implausible", "starts_disagree"})


def is_meaningless(fits: FitCache, candidate: FittedModel) -> bool:
    """Whether the parameters of a fit mean nothing, so that no effect can be excluded given it."""
    return bool(MEANINGLESS & {doubt.code for doubt in fit_doubts(fits, candidate)})


def fit_doubts(fits: FitCache, candidate: FittedModel) -> tuple[Doubt, ...]:
    """Warnings of a fit: hopeless, far beyond the noise, no minimum, at a bound, or diverging."""
    fit, noise_model = candidate.fit, fits.prepared.noise_model
    to_all = "" if fits.prepared.study.role("validate") else " to all trials"
    found = []
    moved_m = marker_motion_m(fits.prepared)
    worst_m = max(fit.rms_m, candidate.heldout.rms_m if candidate.heldout else 0.0)
    if is_hopeless(fits.prepared, fit):
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
    base, other = fits.base.fit, fits.second_start()
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
