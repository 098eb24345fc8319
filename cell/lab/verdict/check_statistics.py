"""The statistics of the checks, as functions of the evidence: each returns one number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gaussian import parameters_root
from cell.lab.data.check import Reading
from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.fit.all_trials_fit import of_all_trials
from cell.lab.fit.fitting import Fit, errors_m, fit_trials
from cell.lab.fit.heldout import heldout_rows
from cell.lab.fit.projection import orthonormal
from cell.lab.fit.score_test import holm
from cell.lab.search.fitted_model import FittedModel, residuals_m
from cell.lab.strength.estimate import LEAST_KNOWN, MODEL_ERROR
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.smooth_part import (
    AllTrialsResidual,
    SmoothPart,
    all_trials_residual,
    noise_was_seen,
    of_a_finer_model,
)


def within_stated(evidence: Evidence) -> Reading | None:
    """p-value of the residual under the stated noise; None if the study states none."""
    prepared = evidence.prepared
    if not prepared.noise_is_stated:
        return None
    return Reading(chance_of_stated(prepared, evidence.final, evidence.rules.most_over_noise))


def fitted_ratio(evidence: Evidence) -> Reading | None:
    """Ratio of the fitted error to the expected one, of noise and gripper-log error."""
    prepared, fit = evidence.prepared, evidence.final.fit
    if prepared.noise_is_stated:
        return None
    trials = fit_trials(prepared)
    log_error = evidence.fits.gripper_log_error()
    by_log = log_error.residual_square(trials, fit) / prepared.count(trials)
    return Reading(fit.rms_m / (prepared.expected_m("fit") * float(np.sqrt(1.0 + by_log))))


def heldout_smooth(evidence: Evidence) -> Reading | None:
    """p-value of the slow part of the error on the held-out trials."""
    return _p_value_of_part(evidence, of_a_finer_model)


def parameter_constancy(evidence: Evidence) -> Reading | None:
    """p-value of the test that all trials share the same parameters."""
    return _p_value_of_part(evidence, parameter_constancy_of)


def wider_law(evidence: Evidence) -> Reading | None:
    """Smallest p-value of an effect's more general law; the effects whose law is rejected."""
    before, rules = evidence.smooth_before, evidence.rules
    if before is None:
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
    """p-value of the total χ²; 1 if the excess over noise is within the model error."""
    prepared, final = evidence.prepared, evidence.final
    if prepared.noise_is_stated:
        return None
    role: Literal["fit", "validate"] = "fit" if final.heldout is None else "validate"
    trials, log_error = prepared.study.role(role), evidence.fits.gripper_log_error()
    if final.heldout is not None:
        chi2, count, rms_m = final.heldout.chi2, final.heldout.count, final.heldout.rms_m
        by_log = log_error.square(trials)
    else:
        count = prepared.count(trials) - len(final.fit.q)
        chi2, rms_m = final.fit.chi2, final.fit.rms_m
        by_log = log_error.residual_square(trials, final.fit)
    expected = 1.0 + by_log / count
    chi2, rms_m = chi2 / expected, rms_m / float(np.sqrt(expected))
    ratio = max(rms_m / prepared.expected_m(role), float(np.sqrt(chi2 / count)))
    if ratio < evidence.rules.most_over_noise:
        return Reading(1.0)
    return Reading(_p_value(chi2, count, prepared.noise_model.dof_in(trials)))


def explained_of_earlier(evidence: Evidence) -> Reading | None:
    """Share of an earlier cable model's error that is explained; 1 if only noise remains."""
    prepared = evidence.prepared
    if prepared.noise_is_measured:
        return None
    if evidence.over_noise < evidence.rules.most_over_noise:
        return Reading(1.0)
    if evidence.is_base:
        return Reading(0.0)
    return Reading(evidence.fits.removed_share(evidence.fits.prior_candidate(), evidence.final))


def heldout_motions(evidence: Evidence) -> Reading | None:
    """Number of independent held-out motions; None if no effect was added."""
    return None if evidence.is_base else Reading(float(evidence.independence.held_out))


def least_visible(evidence: Evidence) -> Reading | None:
    """Smallest held-out ln likelihood ratio of an added effect; the effects below the limit."""
    if evidence.final.heldout is None or not evidence.added:
        return None
    seen = {e.name: evidence.fits.heldout_log_lr(evidence.final, e) for e in evidence.added}
    unseen = tuple(name for name, ln in seen.items() if ln < evidence.rules.heldout_gain)
    return Reading(min(seen.values()), unseen)


def most_tied(evidence: Evidence) -> Reading | None:
    """Largest number of tied effects, the named one included."""
    if evidence.is_base:
        return None
    counts = {name: len(tied) + 1 for name, tied in evidence.tied.items()}
    return Reading(float(max(counts.values(), default=1)))


def detectable_at_half_size(evidence: Evidence) -> Reading | None:
    """Largest p-value that an added effect would have at half its size; the weak effects."""
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
    """Smallest Holm-corrected p-value of a further effect, in all trials; the significant ones.

    The held-out trials do not confirm these effects, or they would have been accepted.  Effects
    that explain only a negligible share of the model's fall of χ² are not counted.
    """
    fits, final, rules = evidence.fits, evidence.final, evidence.rules
    if not fits.prepared.noise_is_measured or fits.is_below_stated(final):
        return None
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
    """Ratio of the upper confidence bound of the noise variance to its estimate."""
    allowed = evidence.prepared.noise_model.allowed_over_level
    return Reading(allowed) if evidence.is_base and allowed is not None else None


def _p_value_of_part(
    evidence: Evidence, part_of: Callable[[PreparedStudy, Fit], SmoothPart | None]
) -> Reading | None:
    """p-value of a part of the error, 1 where it is negligible; None if the noise was not measured.

    A tenth of it counts where more than a tenth of what the baseline leaves beyond noise is left.
    """
    before, rules = evidence.smooth_before, evidence.rules
    left = None if before is None else part_of(evidence.prepared, evidence.final.fit)
    if before is None or left is None:
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


def chance_of_stated(prepared: PreparedStudy, final: FittedModel, negligible: float) -> float:
    """p-value of the residual under the noise that the study states.

    Fitted, held out (allowing for what the fit leaves uncertain there), and fitted to all trials
    together: a right model can do that.  A mean square of them is worth as many values as their
    correlation leaves independent, along the frames ((1 − ρ²) / (1 + ρ²), of a mean square) and
    between the markers.

    negligible  error over the stated one up to which the p-value is 1: a model errs by as much
    """
    noise_model = prepared.noise_model
    square_m2, again = noise_model.noise.std_m**2, noise_model.noise.ar1**2
    share = (1.0 - again) / (1.0 + again) / noise_model.correlated_channels
    left = [(errors_m(prepared, final.fit), 0.0)]
    if final.heldout is not None:
        if not np.isfinite(final.heldout.rms_m):
            return 0.0
        errors = residuals_m(prepared, final)
        held = [errors[t.name] for t in prepared.study.role("validate")]
        left.append((held, _uncertain_m2(prepared, final.fit)))
        whole = of_all_trials(prepared, final.fit)
        if whole is None:
            return 0.0
        left.append((errors_m(whole.prepared, whole.fit), 0.0))
    least = 1.0
    for some, uncertain_m2 in left:
        seen = np.concatenate([e[np.isfinite(e)] for e in some])
        ratio = float(np.mean(seen**2)) / (square_m2 + uncertain_m2)
        independent = share * len(seen)
        chance = float(chi2_sf(independent, independent * ratio))
        if ratio > negligible**2:
            least = min(least, chance)
    return least


def _uncertain_m2(prepared: PreparedStudy, fit: Fit) -> float:
    """Mean square of what a fit leaves uncertain of the held-out trials' markers; 0 if unknown."""
    rows = heldout_rows(prepared, fit)
    if not np.all(np.isfinite(rows.spread)):
        return 0.0
    square, count = 0.0, 0
    for name, part in prepared.by_trial(prepared.study.role("validate"), rows.spread).items():
        whitener = prepared.whiteners[name]
        count += whitener.count
        square += sum(float(np.nansum(whitener.error_m(column) ** 2)) for column in part.T)
    return square / max(count, 1)


#: Nothing is asked for in directions of an effect that change less than by this share.
LEAST_ASKED = 1e-6


@once_per_study
def parameter_constancy_of(
    prepared: PreparedStudy, fit: Fit, parameters: Fit | None = None
) -> SmoothPart | None:
    """Test whether the model's parameters are the same in all trials.

    A right model is the same in every trial.  A wrong one must bend for each motion, and does so
    in these few directions: far from noise where all that is smooth still looks like it.

    parameters  the model whose parameters are asked, if it is another: one with an effect more
    """
    if not noise_was_seen(prepared):
        return None
    left, asked = (
        all_trials_residual(prepared, fit),
        all_trials_residual(prepared, parameters or fit),
    )
    if left is None or asked is None:
        return None
    solution = asked.whole.fit.solution
    free = solution.free
    slopes = solution.jacobian[:, free]
    parts = directions_of_trials(
        slopes, solution.covariance[np.ix_(free, free)], left.whole.systematic_error.ends
    )
    bases = dict(zip(left.whiteners, parts, strict=True))
    return left.part(lambda whitener, rows: np.asarray(bases[whitener].T @ rows))


def directions_of_trials(
    slopes: FloatArray, covariance: FloatArray, ends: NDArray[np.intp]
) -> list[FloatArray]:
    """Per trial (rows, directions): orthonormal directions of a change of that trial's parameters.

    slopes      (rows, free) of all trials, which end at `ends`
    covariance  (free, free) of what all trials and the prior leave open
    """
    least = float(np.sqrt(LEAST_KNOWN))
    parts = np.split(slopes @ parameters_root(covariance), ends[:-1])
    return [orthonormal(part, least) for part in parts]


def wider_law_of(prepared: PreparedStudy, fit: Fit, effect: type[Effect]) -> SmoothPart | None:
    """χ² that an effect's more general law would explain in addition; None if it has none.

    If the effect is present, its own law explains everything.  If it stands in for another effect,
    outside the library, part of that remains, alike in every trial and in these few directions.
    """
    left = None if effect.wider is None else all_trials_residual(prepared, fit)
    if effect.wider is None or left is None:
        return None
    directions = _directions(left, left.whole.sensitivities([effect.wider])[0].rows[0])
    return left.judged(directions @ left.every.T) if len(directions) else None


def of_effects(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> dict[str, tuple[SmoothPart, float]]:
    """χ² that each effect would explain beyond the model, for its most significant shape.

    returns  by name, with its p-value corrected for the number of shapes; without effects that the
             parameters imitate fully, and empty where a trial cannot be simulated
    """
    left = all_trials_residual(prepared, fit)
    found: dict[str, tuple[SmoothPart, float]] = {}
    for slopes in [] if left is None else left.whole.sensitivities(effects):
        assert left is not None
        ways = [d for rows in slopes.rows if len(d := _directions(left, rows))]
        parts = [left.judged(directions @ left.every.T) for directions in ways]
        if parts:
            best = min(parts, key=lambda part: part.p_value)
            found[slopes.effect.name] = best, min(1.0, len(parts) * best.p_value)
    return found


def _directions(left: AllTrialsResidual, rows: FloatArray) -> FloatArray:
    """(directions, values) orthonormal, of what changes (n, values) do that nothing fitted does."""
    least = LEAST_ASKED * float(np.linalg.norm(rows))
    return orthonormal(left.whole.linear.remove(rows).T, least).T
