"""The number of knots of EI(s), increased where the data show that EI changes faster.

The prior of log EI is the same random walk for every number of knots, and the splines are nested,
so more knots only refine the description.  Their number is chosen by the marginal likelihood, which
penalises each knot.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.model import knot_basis
from cell.identify.gauss_newton import UNSIMULATED, jacobian_at
from cell.identify.parameters import ParameterSpace, Prior
from cell.lab.data.prepared import ERROR_RATIO
from cell.lab.fit.fitting import Fit, fit_model, fit_trials, problem_of
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import POLISH, FittedModel, model_of_fit

_LOG = logging.getLogger(__name__)

#: Numbers of knots of EI(s): the usual one, then more.  The splines are nested.
KNOTS = (Prior().knots, 11, 21)
#: Minimum gain in ln likelihood by more knots or an effect.
DECISIVE = 5.0
#: A fit is made if the linear model predicts this share of the required gain, and a residual within
#: this multiple of one that explains the study.
PROMISED, NEAR = 0.5, 2.0


def with_more_knots(fits: FitCache, first: FitCache) -> FitCache | None:
    """The fits with more knots of EI(s), if the data favour them decisively; else None.

    That is if with them the baseline, or else the likeliest model, explains the study and is
    decisively likelier than every model so far, and the held-out trials agree.

    fits   the models so far
    first  the same before noise was re-estimated given one of them
    """
    space = fits.space
    usable = fits.prior_q is None and space.rigidity_is_unknown and space.knots < KNOTS[-1]
    if not usable or not fits.work.affords("more knots of EI(s)"):
        return None
    likeliest = max(fits.known(), key=_log_likelihood)
    best = _log_likelihood(likeliest)
    for model in dict.fromkeys((fits.base, likeliest)):
        with contextlib.suppress(*UNSIMULATED):
            more = _more_knots(fits, model, best - _log_likelihood(model) + DECISIVE)
            if more is not None:
                _LOG.info("EI(s) at %d knots in place of %d", more.fit.space.knots, space.knots)
                finer = first.space.with_knots(more.fit.space.knots)
                start = more.fit.q[: len(finer.names)]
                return FitCache.of(replace(first.setup, space=finer, start_q=start))
    return None


def _log_likelihood(model: FittedModel) -> float:
    """ln likelihood of all trials: of the fitted ones, and of the others given these."""
    return model.evidence + (model.heldout.log_likelihood if model.heldout else 0.0)


def _more_knots(fits: FitCache, model: FittedModel, needed: float) -> FittedModel | None:
    """A model with the likeliest number of knots; None if its gain is below `needed`.

    raises  UnsimulatedError
    """
    prepared, before = fits.prepared, model.fit
    evidence_of = _linear_evidence(fits, before)
    if evidence_of is None:
        return None
    usual, _ = evidence_of(before.space)
    spaces = [before.space.with_knots(k) for k in KNOTS if k > before.space.knots]
    each = zip(map(evidence_of, spaces), spaces, strict=True)
    (evidence, square), likeliest = max(each, key=lambda e: e[0][0])
    noise = (NEAR * ERROR_RATIO) ** 2 * prepared.count(fit_trials(prepared))
    if evidence - usual < PROMISED * needed or square > noise:
        return None
    start = before.space.at_knots(before.q, likeliest.knots)
    fit = fit_model(prepared, likeliest, start, before.initial_states, options=POLISH)
    refitted = model_of_fit(prepared, model.effects, fit)
    fitted_gain, heldout_gain = fits.corrected_gain(model, refitted)
    gain = heldout_gain + 0.5 * (fitted_gain - _penalty(fits, fit) + _penalty(fits, before))
    favoured = gain > needed and heldout_gain >= 0.0 and fits.explained_by(refitted)
    return refitted if favoured else None


def _penalty(fits: FitCache, fit: Fit) -> float:
    """Occam factor of a fit: ln det ratio of the parameters' posterior and prior precision.

    source  Laplace's approximation of a marginal likelihood (MacKay 1992, Neural Comput. 4, 415)
    """
    precision = problem_of(fits.prepared, fit.space, fit_trials(fits.prepared)).precision
    jacobian = fit.solution.jacobian
    return _log_det(jacobian.T @ jacobian + precision) - _log_det(precision)


def _log_det(matrix: FloatArray) -> float:
    return float(np.linalg.slogdet(matrix)[1])


def _linear_evidence(
    fits: FitCache, fit: Fit
) -> Callable[[ParameterSpace], tuple[float, float]] | None:
    """Function: ln of the marginal likelihood of a space, and χ² of the residual at its optimum.

    The model is linearised at a fit, with the most knots.  The likelihood is integrated over the
    parameters, and defined up to a constant.
    returns  None if a finer cable cannot be simulated
    """
    prepared, trials, most = fits.prepared, fit_trials(fits.prepared), KNOTS[-1]
    finest = problem_of(prepared, fit.space.with_knots(most), trials)
    q = fit.space.at_knots(fit.solution.q, most)
    by_all = jacobian_at(finest, q, np.zeros((len(q), len(q))))
    if not np.all(np.isfinite(by_all)):
        return None

    def evidence(space: ParameterSpace) -> tuple[float, float]:
        problem = problem_of(prepared, space, trials)
        precision = problem.precision
        basis = knot_basis(space.knots, tuple(np.linspace(0.0, 1.0, most)))
        jacobian = np.hstack([by_all[:, :most] @ basis, by_all[:, most:]])
        prior_offset = fit.space.at_knots(fit.solution.q, space.knots) - problem.mean
        normal, measured = jacobian.T @ jacobian + precision, fit.solution.residual
        step = -np.linalg.solve(normal, jacobian.T @ measured + precision @ prior_offset)
        residual, offset = measured + jacobian @ step, prior_offset + step
        square = float(residual @ residual)
        objective = square + float(offset @ precision @ offset)
        return -0.5 * (objective + _log_det(normal) - _log_det(precision)), square

    return evidence
