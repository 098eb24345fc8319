"""Warnings about a diagnosis: a code for programs and a sentence for people."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from cell.identify.gauss_newton import UNSIMULATED
from cell.lab.data.check import Reading
from cell.lab.data.results import Doubt
from cell.lab.fit.all_trials_fit import of_all_trials
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.fit_doubts import fit_doubts, not_converged, starts_disagree

#: Effects that a warning names, at most.
TOLD = 3
#: Warnings that come of no check, by code: what was found, and what verdict it brings, if any.
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
    """Warning of a fit given which effects are detected; empty if there are none."""
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


def no_model_doubt() -> Doubt:
    """Warning of a diagnosis that looked for no effect."""
    return Doubt(
        "not_searched",
        "no effect was looked for: a model whose error is larger than the motion of the markers is "
        "not a model of this cable; correct the study first (the signs of y_m and angle_rad, "
        "gravity, the order of the markers, the datasheet, one clock for both files)",
    )


def unsimulated_doubt() -> Doubt:
    """Warning of a diagnosis that ended early: it has the results until then."""
    return Doubt(
        "unsimulated",
        "the search ended at a model that cannot be simulated; the fits until then are shown, and "
        "nothing is confirmed; check the study's frame, datasheet and clock, because the error of "
        "the baseline is so large",
    )


def doubts(fits: FitCache, whole: FitCache, final: FittedModel) -> tuple[Doubt, ...]:
    """Warnings of a diagnosis: about its final model, and what its budget has left out.

    whole  what the final model was fitted with
    """
    found = fit_doubts(whole, final)
    codes = {w.code for w in found}
    if "beyond_noise" in codes and "starts_disagree" not in codes:  # `whole` has looked at no other
        found += tuple(starts_disagree(fits))
    if whole.added(final):
        found += _of_estimate(whole, final, codes)
    if left_out := fits.work.left_out:
        more = f" and {len(left_out) - TOLD} more" if len(left_out) > TOLD else ""
        found += (cut_short_doubt(f"left out: {', '.join(left_out[:TOLD])}{more}"),)
    return tuple(w for w in found if w.code != "beyond_noise")


def _of_estimate(fits: FitCache, final: FittedModel, codes: Collection[str]) -> tuple[Doubt, ...]:
    """Warning of the fit to all trials that the intervals come from, if none of the first is."""
    if "not_converged" in codes:
        return ()
    try:
        return tuple(not_converged(of_all_trials(fits.prepared, final.fit).fit))
    except UNSIMULATED:
        return ()


def cut_short_doubt(what: str) -> Doubt:
    """Warning of a result of which the budget of work has left something out."""
    return Doubt("cut_short", f"the limit of work was reached: {what}")


def interrupted_doubt(what: str) -> Doubt:
    """Warning of a result that was interrupted."""
    return Doubt("interrupted", f"interrupted: {what}")


def ended_doubt(spent: bool, what: str) -> Doubt:
    """Warning of what ended early, because its budget was spent or a person stopped it."""
    return cut_short_doubt(what) if spent else interrupted_doubt(what)


def insensitive_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warnings of effects that only the fit trials support."""
    return tuple(
        Doubt(
            "heldout_insensitive",
            f"the held-out trials cannot show {effect}: it explains the trials fitted to, but it "
            "is not confirmed; hold out a trial that can show it",
        )
        for effect in reading.effects
    )


def noise_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warning of a model that leaves noise, if the rest is too short to determine the noise."""
    noise_model = evidence.noise_model
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
    """Warnings of effects with a signal too weak to identify their cause."""
    least = evidence.rules.heldout_gain
    seen = [e for e in evidence.added if e.name in reading.effects]
    if evidence.final.heldout is not None:
        seen = [e for e in seen if evidence.fits.heldout_log_lr(evidence.final, e) >= least]
    return tuple(
        Doubt(
            "weakly_identified",
            f"the signal of {effect.name} is weak: half of the effect could remain undetected, "
            "so the cause may be an effect outside the library; add a motion that shows more of "
            "it, as `cell suggest STUDY` finds, or repeat these with less noise",
        )
        for effect in seen
    )


def omitted_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warning of effects that all trials together show but the held-out trials do not confirm."""
    effects = reading.effects
    more = f" and {len(effects) - TOLD} more" if len(effects) > TOLD else ""
    return (
        Doubt(
            "possibly_omitted",
            f"all trials together show {' or '.join(effects[:TOLD])}{more} beyond chance, but "
            "the held-out trials do not confirm it: it remains open whether more is missing; add "
            "a motion that decides, as `cell suggest STUDY` finds",
        ),
    )


def wider_law_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warnings of effects that explain most, but whose law does not hold."""
    broken = [e for e in evidence.final.effects if e.name in reading.effects]
    return tuple(
        Doubt(
            "wider_law",
            f"{effect.name} explains most, but its law does not hold: the more general `--with "
            f"{'' if effect.wider is None else effect.wider.name}` explains more; the cause is "
            "similar to it, but not in the library",
        )
        for effect in broken
    )


def prior_doubts(evidence: Evidence, reading: Reading) -> tuple[Doubt, ...]:
    """Warnings of effects that are not needed, or explain nothing, without the prior."""
    return tuple(
        Doubt(
            "prior_driven",
            f"{effect} is needed only because of the prior: without the prior, as for another "
            f"cable, the study does not confirm {effect}; give the prior of this cable, or none",
        )
        for effect in reading.effects
    )
