"""Warnings about a diagnosis: a code for programs and a sentence for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.cable.effects.base import after_number
from cell.files.words import first_of
from cell.lab.data.check import Reading
from cell.lab.data.prepared import ERROR_RATIO
from cell.lab.data.results import Doubt
from cell.lab.fit.fitting import Fit
from cell.lab.fit.systematic_error import of_all_trials
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import (
    FittedModel,
    at_bound,
    is_hopeless,
    is_no_model,
    marker_motion_m,
)
from cell.lab.verdict.evidence import Evidence

#: Ratio of error to noise above which the model's own error determines a fit's intervals.
BEYOND_NOISE = 3.0
#: A poorly fitting model whose EI varies by more than this factor along the cable is implausible;
#: under the prior's random walk that is 7 standard deviations.
UNLIKE_ANY = 20.0
#: Two fits are different minima if EI differs by more than this factor anywhere.
APART = 2.0
#: Or if a parameter of an effect differs by more than this many standard deviations.
APART_STD = 3.0
#: Warnings of a fit whose parameters mean nothing; given it no effect is called absent.
MEANINGLESS = frozenset({"hopeless", "implausible", "starts_disagree"})


def is_meaningless(fits: FitCache, candidate: FittedModel) -> bool:
    """Whether a fit is so poor that its parameters, and limits given it, have no meaning."""
    return bool(MEANINGLESS & {doubt.code for doubt in fit_doubts(fits, candidate)})


def fit_doubts(fits: FitCache, candidate: FittedModel) -> tuple[Doubt, ...]:
    """Warnings of a fit: hopeless, far beyond the noise, no minimum, at a bound, or diverging."""
    fit, noise_model = candidate.fit, fits.prepared.noise_model
    to_all = "" if fits.prepared.study.role("validate") else " to all trials"
    warnings = []
    moved_m = marker_motion_m(fits.prepared)
    worst_m = max(fit.rms_m, candidate.heldout.rms_m if candidate.heldout else 0.0)
    if is_hopeless(fits.prepared, fit):
        warnings.append(
            Doubt(
                "hopeless",
                f"the fit{to_all} misses {fit.rms_m * 1e3:.3g} mm of markers that move by "
                f"{moved_m * 1e3:.3g} mm (rms): its parameters are meaningless; check the "
                "study's frame, times and datasheet",
            )
        )
    elif np.isfinite(worst_m) and worst_m > BEYOND_NOISE * noise_model.noise.std_m:
        misses = f"the model misses {worst_m * 1e3:.3g} mm, "
        misses += f"{worst_m / noise_model.noise.std_m:.0f} times the noise: "
        cause = "it lacks an effect; `cell diagnose STUDY` finds out which"
        if fits.prior_q is not None:
            cause = "the prior is that of another cable, or the model lacks an effect; a fit "
            cause += "without --prior shows which"
        warnings.append(Doubt("beyond_noise", misses + cause))
    warnings += _wrong_minimum(fits, candidate)
    warnings += not_converged(fit)
    warnings += [
        Doubt(
            "at_bound",
            f"{name} is at its bound, {value:.4g} {unit}: the value comes from the bound, not from "
            "the measurement",
        )
        for name, value, unit in at_bound(fit)
    ]
    if candidate.heldout is not None:
        warnings += [
            Doubt(
                "diverges",
                f"the model cannot be simulated in trial {name}, which it was not fitted to",
            )
            for name, predicted in candidate.heldout.predicted_m.items()
            if not np.isfinite(predicted).all()
        ]
    return tuple(warnings)


def _wrong_minimum(fits: FitCache, candidate: FittedModel) -> list[Doubt]:
    """Warnings of a model far above the noise: implausible EI, or two starts that disagree."""
    noise_m, fit = fits.prepared.noise_model.noise.std_m, candidate.fit
    error_m = max(fit.rms_m, candidate.heldout.rms_m if candidate.heldout else 0.0)
    if not error_m > BEYOND_NOISE * noise_m:
        second = fits.second
        as_good = second is not None and second.rms_m <= ERROR_RATIO * fit.rms_m
        return starts_disagree(fits) if as_good else []
    rigidity = fit.model.rigidity_n_m2
    differs = float(rigidity.max() / rigidity.min())
    implausible = Doubt(
        "implausible",
        f"EI differs {differs:.0f}-fold along the cable and the model misses "
        f"{fit.rms_m * 1e3:.3g} mm: this is not plausible for a cable, and the parameters "
        "are meaningless; the search is in a wrong minimum, or the study is wrong (frame, "
        "datasheet, how trials begin)",
    )
    return [*([implausible] if differs > UNLIKE_ANY else []), *starts_disagree(fits)]


def not_converged(fit: Fit) -> list[Doubt]:
    """Warning of a fit that stopped before it reached its minimum."""
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
    """Warning of a baseline whose second start leads to another minimum, in EI or effects."""
    base, second = fits.base.fit, fits.second_start()
    if second is None:
        return []
    log_ratio = np.log(second.model.rigidity_n_m2) - np.log(base.model.rigidity_n_m2)
    factor = float(np.exp(np.abs(log_ratio).max()))
    differences = [f"EI up to {factor:.1f}-fold apart"] if factor >= APART else []
    differences += _effects_apart(base, second)
    if not differences:
        return []
    return [
        Doubt(
            "starts_disagree",
            f"from two starts the fit ends in different places: one misses {base.rms_m * 1e3:.3g} "
            f"mm, the other {second.rms_m * 1e3:.3g} mm, with {' and '.join(differences)}; there "
            "may be a better minimum",
        )
    ]


def _effects_apart(base: Fit, second: Fit) -> list[str]:
    """Parameters of effects in which two fits differ by more than their uncertainties allow."""
    values, second_values = base.space.natural(base.q), second.space.natural(second.q)
    differences = []
    for i, name in enumerate(base.space.names):
        if "." not in name:
            continue
        variance = sum(fit.widening * fit.covariance[i, i] for fit in (base, second))
        if abs(second.q[i] - base.q[i]) > APART_STD * np.sqrt(variance):
            unit = after_number(base.space.units[i])
            differences.append(f"{name} {values[i]:.3g} and {second_values[i]:.3g}{unit}")
    return differences


#: Maximum number of effects that a warning names.
MOST = 3
#: Warnings that are not from a check, by code: the finding, and the verdict it causes, if any.
MEANINGS = {
    "hopeless": ("the error is more than half of the markers' motion", ""),
    "not_searched": ("the error is more than twice the markers' motion", "unexplained"),
    "beyond_noise": ("the error of a fit is more than 3 times the noise", ""),
    "implausible": ("EI differs more than 20-fold along the cable", ""),
    "starts_disagree": ("a second start ends at another minimum", ""),
    "not_converged": ("a fit ended over one standard deviation off its minimum", ""),
    "at_bound": ("a parameter is at its bound", ""),
    "diverges": ("a held-out trial cannot be simulated", ""),
    "unsimulated": ("the search ended where nothing can be simulated", "cannot_tell"),
    "cut_short": ("the limit of work left something out", ""),
    "interrupted": ("a person stopped the command", "cannot_tell"),
    "lacks": ("effects of the library explain the residual of a fit", ""),
}


def lacking_doubt(lacks: Sequence[str]) -> tuple[Doubt, ...]:
    """Warning of a fit that lacks these effects; empty if there are none."""
    if not lacks:
        return ()
    return (
        Doubt(
            "lacks",
            f"the residual is not noise, and {' and '.join(lacks)} in the model would explain most "
            "of it: the intervals include the parameters of that model; `cell diagnose STUDY` "
            "shows more",
        ),
    )


#: Warning of a diagnosis that did not search for effects.
NO_MODEL = Doubt(
    "not_searched",
    "no effect was looked for: a model whose error is larger than the motion of the markers is "
    "not a model of this cable; correct the study first (the signs of y_m and angle_rad, "
    "gravity, the order of the markers, the datasheet, one clock for both files)",
)
#: Warning of a diagnosis that ended early: it has the results until then.
UNSIMULATED_SEARCH = Doubt(
    "unsimulated",
    "the search ended at a model that cannot be simulated; the fits until then are shown, and "
    "nothing is confirmed; check the study's frame, datasheet and clock, because the error of "
    "the baseline is so large",
)


def check_model(fits: FitCache) -> None:
    """Raises ValueError: the baseline is no model of the study's cable."""
    if is_no_model(fits.prepared, fits.base.fit):
        raise ValueError(f"study {fits.prepared.study.name}: {NO_MODEL.message}")


def doubts(fits: FitCache, final_fits: FitCache, final: FittedModel) -> tuple[Doubt, ...]:
    """Warnings of a diagnosis: about its final model, and about omissions by its budget.

    final_fits  the fits that contain the final model
    """
    warnings = fit_doubts(final_fits, final)
    codes = {w.code for w in warnings}
    if "beyond_noise" in codes and "starts_disagree" not in codes:  # not tested yet
        warnings += tuple(starts_disagree(fits))
    if final_fits.added(final) and "not_converged" not in codes:
        joint = of_all_trials(final_fits.prepared, final.fit)  # behind the intervals
        warnings += () if joint is None else tuple(not_converged(joint.fit))
    if left_out := fits.work.left_out:
        warnings += (ended_doubt(True, f"left out: {first_of(left_out, MOST)}"),)
    return tuple(w for w in warnings if w.code != "beyond_noise")


def ended_doubt(spent: bool, detail: str) -> Doubt:
    """Warning of a computation that ended early: budget of work spent, or stopped by the user."""
    if spent:
        return Doubt("cut_short", f"the limit of work was reached: {detail}")
    return Doubt("interrupted", f"interrupted: {detail}")


def noise_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warning that frames at rest are too few, or rounding too coarse, to determine the noise."""
    noise_model = evidence.prepared.noise_model
    low_m, high_m = noise_model.range_m or (noise_model.noise.std_m, noise_model.noise.std_m)
    remedy = f"record at least {noise_model.frames_needed} frames at rest before each motion"
    if noise_model.hidden:
        remedy = "write the markers with more digits, because the rounding is larger than the noise"
    return (
        Doubt(
            "noise_unknown",
            f"the frames at rest give the noise only as {low_m * 1e3:.2g} … {high_m * 1e3:.2g} mm: "
            f"an error as large as the noise could not be distinguished from it; {remedy}, or "
            "give noise_std_m in study.yaml",
        ),
    )


def weak_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warnings of effects that would not be detected at half their size."""
    least = evidence.rules.heldout_gain
    weak = [e for e in evidence.added if e.name in reading.effects]
    if evidence.final.heldout is not None:
        weak = [e for e in weak if evidence.fits.heldout_log_lr(evidence.final, e) >= least]
    return tuple(
        Doubt(
            "weakly_identified",
            f"the signal of {effect.name} is weak: half of the effect could remain undetected, "
            "so the cause may be an effect outside the library; add a motion that shows more of "
            "it, as `cell suggest STUDY` finds, or repeat these with less noise",
        )
        for effect in weak
    )


def omitted_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warning of effects that all trials together show but the held-out trials do not confirm."""
    return (
        Doubt(
            "possibly_omitted",
            f"all trials together show {first_of(reading.effects, MOST, ' or ')} beyond chance, "
            "but the held-out trials do not confirm it: it remains open whether more is missing; "
            "add a motion that decides, as `cell suggest STUDY` finds",
        ),
    )


def wider_law_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warnings of effects that explain most, but whose law does not hold."""
    return tuple(
        Doubt(
            "wider_law",
            f"{effect.name} explains most, but its law does not hold: the more general `--with "
            f"{effect.wider.name}` explains more; the cause is similar to it, but not in the "
            "library",
        )
        for effect in evidence.final.effects
        if effect.wider is not None and effect.name in reading.effects
    )
