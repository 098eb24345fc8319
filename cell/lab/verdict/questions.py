"""The statistics of the checks, as functions of the evidence: each returns one number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from cell.lab.data.check import Reading
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.statistics.score import holm
from cell.lab.strength.estimate import MODEL_ERROR
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.residual_summary import removed_share, residual_summary
from cell.lab.verdict.smooth_part import SmoothPart, of_a_finer_model
from cell.lab.verdict.specification import of_effects, parameter_constancy_of, wider_law_of
from cell.lab.verdict.stated import chance_of_stated


def within_stated(evidence: Evidence) -> Reading | None:
    """p-value of an error so far above what the study states; None if it states none."""
    prepared = evidence.prepared
    if not (prepared.noise_is_measured and prepared.noise_model.stated):
        return None
    return Reading(chance_of_stated(prepared, evidence.final, evidence.rules.most_over_noise))


def _judged_by_rest(evidence: Evidence) -> bool:
    """Whether the noise is told by the frames, or is an earlier model's error: not stated."""
    prepared = evidence.prepared
    return not (prepared.noise_is_measured and prepared.noise_model.stated)


def fitted_ratio(evidence: Evidence) -> Reading | None:
    """Error on the trials fitted to, over that of noise and the hand's log together."""
    if not _judged_by_rest(evidence):
        return None
    prepared, fit = evidence.prepared, evidence.final.fit
    trials = fit_trials(prepared)
    by_hand = evidence.fits.hand().square_left(trials, fit) / prepared.count(trials)
    return Reading(fit.rms_m / (prepared.expected_m("fit") * float(np.sqrt(1.0 + by_hand))))


def heldout_smooth(evidence: Evidence) -> Reading | None:
    """p-value of the slow part of the error on the held-out trials."""
    return _of_part(evidence, of_a_finer_model(evidence.prepared, evidence.final.fit))


def parameter_constancy(evidence: Evidence) -> Reading | None:
    """p-value of the changes of the parameters if each trial had parameters of its own."""
    if not _has_smooth_part(evidence):
        return None
    return _of_part(evidence, parameter_constancy_of(evidence.prepared, evidence.final.fit))


def wider_law(evidence: Evidence) -> Reading | None:
    """Smallest p-value of the wider laws of effects beyond a negligible part; those broken."""
    before, rules = evidence.smooth_before, evidence.rules
    if before is None or not _judged_by_rest(evidence):
        return None
    chances = {}
    for effect in evidence.final.effects:
        left = wider_law_of(evidence.prepared, evidence.final.fit, effect)
        if left is not None:
            # a right law, simulated by another converged simulator, leaves no more than this
            negligible = left.excess_of_all <= MODEL_ERROR**2 * before.excess_of_all
            chances[effect.name] = 1.0 if negligible else left.p_value
    broken = tuple(name for name, p in chances.items() if p < rules.residual_significance)
    return Reading(min(chances.values()), broken) if chances else None


def residual_level(evidence: Evidence) -> Reading | None:
    """p-value of the whole error, 1 where it is so little above noise that a model errs as much."""
    if not _judged_by_rest(evidence):
        return None
    prepared, final = evidence.prepared, evidence.final
    role: Literal["fit", "validate"] = "fit" if final.heldout is None else "validate"
    trials, hand = prepared.study.role(role), evidence.fits.hand()
    if final.heldout is not None:
        chi2, count, rms_m = final.heldout.chi2, final.heldout.count, final.heldout.rms_m
        by_hand = hand.square(trials)
    else:
        count = prepared.count(trials) - len(final.fit.q)
        chi2, rms_m = final.fit.chi2, final.fit.rms_m
        by_hand = hand.square_left(trials, final.fit)
    expected = 1.0 + by_hand / count
    chi2, rms_m = chi2 / expected, rms_m / float(np.sqrt(expected))
    ratio = max(rms_m / prepared.expected_m(role), float(np.sqrt(chi2 / count)))
    if ratio < evidence.rules.most_over_noise:
        return Reading(1.0)
    return Reading(_p_value(chi2, count, prepared.noise_model.dof_in(trials)))


def explained_of_earlier(evidence: Evidence) -> Reading | None:
    """Share that is gone of what an earlier cable's model misses here; 1 at the noise."""
    prepared = evidence.prepared
    if prepared.noise_is_measured:
        return None
    if evidence.over_noise < evidence.rules.most_over_noise:
        return Reading(1.0)
    if evidence.is_base:
        return Reading(0.0)
    before = residual_summary(prepared, evidence.fits.prior_candidate())
    after = residual_summary(prepared, evidence.final)
    return Reading(removed_share(prepared.noise_model.noise.std_m, before, after))


def without_heldout_trial(evidence: Evidence) -> Reading | None:
    """Number of effects found that no trial is held out to confirm; None where none was found."""
    if evidence.is_base:
        return None
    return Reading(float(len(evidence.added)) if evidence.final.heldout is None else 0.0)


def least_visible(evidence: Evidence) -> Reading | None:
    """Smallest ln likelihood ratio, on held-out trials, with and without an effect found."""
    if evidence.final.heldout is None or not evidence.added:
        return None
    seen = {e.name: evidence.fits.heldout_log_lr(evidence.final, e) for e in evidence.added}
    unseen = tuple(name for name, ln in seen.items() if ln < evidence.rules.heldout_gain)
    return Reading(min(seen.values()), unseen)


def most_tied(evidence: Evidence) -> Reading | None:
    """Largest number of effects that explain as much as one found, itself included."""
    if evidence.is_base:
        return None
    counts = {name: len(tied) + 1 for name, tied in evidence.tied.items()}
    return Reading(float(max(counts.values(), default=1)))


def half_seen(evidence: Evidence) -> Reading | None:
    """Largest p-value, over the effects found, that half of what each explains would have."""
    if not evidence.added:
        return None
    without = {e.name: evidence.fits.fit_reduced(evidence.final, e).fit for e in evidence.added}
    chances = {name: _chance_of_half(evidence, fit) for name, fit in without.items()}
    weak = tuple(name for name, p in chances.items() if p >= evidence.rules.significance)
    return Reading(max(chances.values()), weak)


def _chance_of_half(evidence: Evidence, without: Fit) -> float:
    """p-value by the plainest look, 0 where there is none; further ones only if needed."""
    prepared, least = evidence.prepared, 1.0
    looks: tuple[Callable[[], SmoothPart | None], ...] = (
        lambda: of_a_finer_model(prepared, without),
        lambda: parameter_constancy_of(prepared, without),
        lambda: parameter_constancy_of(prepared, without, evidence.final.fit),
    )
    for look in looks:
        part = look()
        least = min(least, 0.0 if part is None else part.chance_of(0.5 * part.excess))
        if least < evidence.rules.significance:
            break
    return least


def possibly_omitted(evidence: Evidence) -> Reading | None:
    """Smallest Holm-corrected p-value of another effect in all trials; those plain.

    Those held out do not confirm them, or they would have been accepted.  Who has all that is
    there asks for nothing more than a negligible part of what was explained.
    """
    if not evidence.prepared.noise_is_measured or evidence.below_stated:
        return None
    fits, final, rules = evidence.fits, evidence.final, evidence.rules
    rivals = {name for names in evidence.tied.values() for name in names}
    offered = [e for n, e in fits.library.items() if n not in {*final.names, *rivals}]
    asked = of_effects(evidence.prepared, final.fit, offered)
    adjusted = holm([p for _, p in asked.values()])
    fall = evidence.base.chi2 - final.chi2
    chances = {
        name: p if part.chi2 - part.count > rules.negligible_share * fall else 1.0
        for (name, (part, _)), p in zip(asked.items(), adjusted, strict=True)
    }
    plain = sorted((p, name) for name, p in chances.items() if p < rules.significance)
    return Reading(min(chances.values(), default=1.0), tuple(name for _, name in plain))


def noise_range(evidence: Evidence) -> Reading | None:
    """Largest mean square that the rest allows the noise, over its best estimate."""
    allowed = evidence.noise_model.allowed_over_level
    return Reading(allowed) if evidence.is_base and allowed is not None else None


def _has_smooth_part(evidence: Evidence) -> bool:
    """Whether the slow part of an error says something here."""
    return evidence.smooth_before is not None and _judged_by_rest(evidence)


def _of_part(evidence: Evidence, left: SmoothPart | None) -> Reading | None:
    """p-value of a part of the error, 1 where it is negligible.

    A tenth of it counts where more than a tenth of what the baseline leaves beyond noise is left.
    """
    before, rules = evidence.smooth_before, evidence.rules
    if before is None or left is None or not _judged_by_rest(evidence):
        return None
    shares: tuple[tuple[float, float], ...] = (
        (rules.slight_share, rules.residual_significance),
        (rules.small_share, rules.significance),
    )
    if evidence.is_base:
        shares = ((0.0, rules.residual_significance),)
    least = 1.0
    for share, significance in shares:
        too_much = left.excess_of_all > share * before.excess_of_all
        if too_much or left.excess_of_all > rules.most_over_noise**2 - 1.0:
            least = min(least, left.p_value * rules.residual_significance / significance)
    return Reading(least)


def _p_value(chi2: float, count: int, dof: float) -> float:
    """Of a χ² of `count` values whose unit is known from `dof` others."""
    if np.isfinite(dof):
        return float(f_sf(count, dof, chi2 / count))
    return float(chi2_sf(count, chi2))
