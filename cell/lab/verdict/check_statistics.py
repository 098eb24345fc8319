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
from cell.lab.fit.fitting import Fit, errors_m, fit_trials
from cell.lab.fit.heldout import heldout_rows
from cell.lab.fit.projection import orthonormal
from cell.lab.fit.score_test import holm
from cell.lab.fit.systematic_error import of_all_trials
from cell.lab.search.fitted_model import FittedModel, residuals_m
from cell.lab.strength.estimate import LEAST_KNOWN, MODEL_ERROR
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.smooth_part import (
    AllTrialsResidual,
    SmoothPart,
    all_trials_residual,
    noise_is_from_rest,
    without_systematic_error,
)


def within_stated(evidence: Evidence) -> Reading | None:
    """p-value of the residual under the stated noise; None if the study states none."""
    prepared = evidence.prepared
    if not prepared.noise_is_stated:
        return None
    return Reading(p_value_of_stated(prepared, evidence.final, evidence.rules.most_over_noise))


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
    return _p_value_of_part(evidence, without_systematic_error)


def parameter_constancy(evidence: Evidence) -> Reading | None:
    """p-value of the test that all trials share the same parameters."""
    return _p_value_of_part(evidence, parameter_constancy_of)


def wider_law(evidence: Evidence) -> Reading | None:
    """Smallest p-value of an effect's more general law; the effects whose law is rejected."""
    before, rules = evidence.smooth_before, evidence.rules
    if before is None:
        return None
    p_values = {}
    for effect in evidence.final.effects:
        part = wider_law_of(evidence.prepared, evidence.final.fit, effect)
        if part is not None:
            # a correct law in another converged simulator leaves at most this
            negligible = part.excess_of_all <= MODEL_ERROR**2 * before.excess_of_all
            p_values[effect.name] = 1.0 if negligible else part.p_value
    rejected = tuple(name for name, p in p_values.items() if p < rules.residual_significance)
    return Reading(min(p_values.values()), rejected) if p_values else None


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
    log_lr = {e.name: evidence.fits.heldout_log_lr(evidence.final, e) for e in evidence.added}
    below = tuple(name for name, ln in log_lr.items() if ln < evidence.rules.heldout_gain)
    return Reading(min(log_lr.values()), below)


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
    p_values = {name: _p_value_at_half_size(evidence, fit) for name, fit in without.items()}
    weak = tuple(name for name, p in p_values.items() if p >= evidence.rules.significance)
    return Reading(max(p_values.values()), weak)


def _p_value_at_half_size(evidence: Evidence, without: Fit) -> float:
    """p-value of half the effect by the first significant test, else the least; 0 without test."""
    prepared, least = evidence.prepared, 1.0
    tests: tuple[Callable[[], SmoothPart | None], ...] = (
        lambda: without_systematic_error(prepared, without),
        lambda: parameter_constancy_of(prepared, without),
        lambda: parameter_constancy_of(prepared, without, evidence.final.fit),
    )
    for test in tests:
        part = test()
        least = min(least, 0.0 if part is None else part.p_value_of(0.5 * part.excess))
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
    tests = score_tests(evidence.prepared, final.fit, offered)
    adjusted = holm([p for _, p in tests.values()])
    fall = evidence.base.chi2 - final.chi2
    p_values = {
        name: p if part.chi2 - part.count > rules.negligible_share * fall else 1.0
        for (name, (part, _)), p in zip(tests.items(), adjusted, strict=True)
    }
    significant = sorted((p, name) for name, p in p_values.items() if p < rules.significance)
    return Reading(min(p_values.values(), default=1.0), tuple(name for _, name in significant))


def noise_range(evidence: Evidence) -> Reading | None:
    """Ratio of the upper confidence bound of the noise variance to its estimate."""
    allowed = evidence.prepared.noise_model.allowed_over_level
    return Reading(allowed) if evidence.is_base and allowed is not None else None


def _p_value_of_part(
    evidence: Evidence, part_of: Callable[[PreparedStudy, Fit], SmoothPart | None]
) -> Reading | None:
    """p-value of a part of the error, 1 where it is negligible; None if the noise was not measured.

    The limit is stricter where the part exceeds a larger share of the baseline's excess over noise.
    """
    before, rules = evidence.smooth_before, evidence.rules
    part = None if before is None else part_of(evidence.prepared, evidence.final.fit)
    if before is None or part is None:
        return None
    shares: tuple[tuple[float, float], ...] = (
        (rules.slight_share, rules.residual_significance),
        (rules.small_share, rules.significance),
    )
    if evidence.is_base:
        shares = ((0.0, rules.residual_significance),)
    least = 1.0
    for share, significance in shares:
        too_much = part.excess_of_all > share * before.excess_of_all
        if too_much or part.excess_of_all > rules.most_over_noise**2 - 1.0:
            least = min(least, part.p_value * rules.residual_significance / significance)
    return Reading(least)


def _p_value(chi2: float, count: int, dof: float) -> float:
    """p-value of the χ² of `count` values; their unit is estimated from `dof` other values."""
    if np.isfinite(dof):
        return float(f_sf(count, dof, chi2 / count))
    return float(chi2_sf(count, chi2))


def p_value_of_stated(prepared: PreparedStudy, final: FittedModel, negligible: float) -> float:
    """p-value of the residual under the noise that the study states.

    The smallest of three tests: on the fitted trials, on the held-out trials (with the variance of
    the prediction), and on all trials fitted jointly.  The count of independent values allows for
    correlation along the frames, (1 − ρ²) / (1 + ρ²) for a mean square, and between the markers.

    negligible  ratio of error to stated error up to which the p-value is 1 (the model's own error)
    """
    noise_model = prepared.noise_model
    square_m2, ar1_square = noise_model.noise.std_m**2, noise_model.noise.ar1**2
    share = (1.0 - ar1_square) / (1.0 + ar1_square) / noise_model.correlated_channels
    samples = [(errors_m(prepared, final.fit), 0.0)]
    if final.heldout is not None:
        if not np.isfinite(final.heldout.rms_m):
            return 0.0
        errors = residuals_m(prepared, final)
        heldout_errors = [errors[t.name] for t in prepared.study.role("validate")]
        samples.append((heldout_errors, _uncertain_m2(prepared, final.fit)))
        refit = of_all_trials(prepared, final.fit)
        if refit is None:
            return 0.0
        samples.append((errors_m(refit.prepared, refit.fit), 0.0))
    least = 1.0
    for sample, uncertain_m2 in samples:
        values = np.concatenate([e[np.isfinite(e)] for e in sample])
        ratio = float(np.mean(values**2)) / (square_m2 + uncertain_m2)
        independent = share * len(values)
        p_value = float(chi2_sf(independent, independent * ratio))
        if ratio > negligible**2:
            least = min(least, p_value)
    return least


def _uncertain_m2(prepared: PreparedStudy, fit: Fit) -> float:
    """Mean variance of the predicted markers of the held-out trials, m²; 0 if unknown."""
    rows = heldout_rows(prepared, fit)
    if not np.all(np.isfinite(rows.spread)):
        return 0.0
    square, count = 0.0, 0
    for name, part in prepared.by_trial(prepared.study.role("validate"), rows.spread).items():
        whitener = prepared.whiteners[name]
        count += whitener.count
        square += sum(float(np.nansum(whitener.error_m(column) ** 2)) for column in part.T)
    return square / max(count, 1)


#: Directions in which an effect changes less than this share of its largest are not tested.
LEAST_TESTED = 1e-6


@once_per_study
def parameter_constancy_of(
    prepared: PreparedStudy, fit: Fit, parameters: Fit | None = None
) -> SmoothPart | None:
    """Test whether the model's parameters are the same in all trials.

    A right model has the same parameters in every trial; a wrong one needs other values for each
    motion.  These few directions detect that where the complete smooth part still looks like noise.

    parameters  the model whose parameters are tested, if it differs: one with a further effect
    """
    if not noise_is_from_rest(prepared):
        return None
    residual, tested = (all_trials_residual(prepared, f) for f in (fit, parameters or fit))
    if residual is None or tested is None:
        return None
    solution = tested.all_trials.fit.solution
    free = solution.free
    jacobian = solution.jacobian[:, free]
    parts = directions_of_trials(
        jacobian, solution.covariance[np.ix_(free, free)], residual.all_trials.systematic_error.ends
    )
    bases = dict(zip(residual.whiteners, parts, strict=True))
    return residual.part(lambda whitener, rows: np.asarray(bases[whitener].T @ rows))


def directions_of_trials(
    jacobian: FloatArray, covariance: FloatArray, ends: NDArray[np.intp]
) -> list[FloatArray]:
    """Per trial (rows, directions): orthonormal directions of a change of that trial's parameters.

    jacobian    (rows, free) of all trials, which end at `ends`
    covariance  (free, free) of the parameters given all trials and the prior
    """
    least = float(np.sqrt(LEAST_KNOWN))
    parts = np.split(jacobian @ parameters_root(covariance), ends[:-1])
    return [orthonormal(part, least) for part in parts]


def wider_law_of(prepared: PreparedStudy, fit: Fit, effect: type[Effect]) -> SmoothPart | None:
    """χ² that an effect's more general law would explain in addition; None if it has none.

    If the effect is present, its own law explains everything.  If it replaces an effect outside
    the library, part of that remains: the same in every trial, and in these few directions.
    """
    residual = None if effect.wider is None else all_trials_residual(prepared, fit)
    if effect.wider is None or residual is None:
        return None
    directions = _directions(residual, residual.all_trials.sensitivities([effect.wider])[0].rows[0])
    return residual.test(directions @ residual.components.T) if len(directions) else None


def score_tests(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> dict[str, tuple[SmoothPart, float]]:
    """χ² that each effect would explain beyond the model, for its most significant shape.

    returns  by name, with its p-value corrected for the number of shapes; without effects that the
             parameters imitate fully, and empty where a trial cannot be simulated
    """
    residual = all_trials_residual(prepared, fit)
    tests: dict[str, tuple[SmoothPart, float]] = {}
    for sensitivity in [] if residual is None else residual.all_trials.sensitivities(effects):
        assert residual is not None
        shapes = [d for rows in sensitivity.rows if len(d := _directions(residual, rows))]
        parts = [residual.test(directions @ residual.components.T) for directions in shapes]
        if parts:
            best = min(parts, key=lambda part: part.p_value)
            tests[sensitivity.effect.name] = best, min(1.0, len(parts) * best.p_value)
    return tests


def _directions(residual: AllTrialsResidual, rows: FloatArray) -> FloatArray:
    """(directions, values) orthonormal, of changes (n, values) orthogonal to all fitted ones."""
    least = LEAST_TESTED * float(np.linalg.norm(rows))
    return orthonormal(residual.all_trials.linear.remove(rows).T, least).T
