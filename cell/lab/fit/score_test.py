"""Score tests on whitened residuals: χ² that an effect would explain beyond the fitted model.

The screen tests every effect of a library so, with one simulation of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import ndtr as normal_cdf

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gaussian import covariance_root
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit
from cell.lab.fit.projection import Projection, nuisance_of
from cell.lab.fit.sensitivity import one_sided, sensitivities

#: Draws behind the p-value of a maximum over shapes; below a few of them Bonferroni is used.
DRAWS = 20_000
MIN_EXCEEDING = 20
#: Shapes are nearly the same if what they explain correlates by more than this.
SAME_SHAPE = 0.9
MOST_DISTINCT = 8


@dataclass(frozen=True, eq=False)
class Score:
    """Result of a score test.

    statistic    χ² that the effect would explain
    amplitude    (dof,) expected coefficients of the sensitivities
    std          (dof,) their standard deviations, the other amplitudes free
    shape        index of the shape with that statistic
    others       further distinct shapes and their coefficients, by falling statistic
    p_value      of the largest statistic over all shapes, under noise alone
    """

    statistic: float
    amplitude: FloatArray
    std: FloatArray
    shape: int
    p_value: float
    others: tuple[tuple[int, FloatArray], ...] = ()


def score_test(nuisance: Projection, sensitivity: FloatArray, *, one_sided: bool) -> Score:
    """Nuisance-projected score test of an effect whose shape parameters are unknown.

    sensitivity  (shapes, amplitudes, values) whitened output per unit of each amplitude, for each
                 guess of the effect's other parameters (a relaxation time, say); those have no
                 meaning without the effect, so the test is of the largest statistic (Davies 1987)
    one_sided    only a positive amplitude is physical, and there is one: at that bound the
                 statistic is a half-and-half mixture of 0 and χ²(1) (Self and Liang 1987)
    """
    shapes, dof, _ = sensitivity.shape
    orthogonal = nuisance.remove(sensitivity)
    raw = np.linalg.norm(sensitivity, axis=2)
    norm = np.linalg.norm(orthogonal, axis=2)
    scores: list[_ShapeScore] = []
    usable = norm > 1e-6 * np.maximum(raw, 1e-300)
    for shape in np.flatnonzero(usable.any(axis=1)):
        rows = orthogonal[shape]
        amplitude = np.linalg.lstsq(rows.T, nuisance.residual, rcond=1e-8)[0]
        statistic = float(amplitude @ (rows @ nuisance.residual))
        signed = -statistic if one_sided and amplitude[0] < 0.0 else statistic
        scores.append(_ShapeScore(signed, int(shape), amplitude, amplitude @ rows))
    if not scores:
        return Score(0.0, np.zeros(dof), np.full(dof, np.inf), 0, 1.0)
    scores.sort(key=lambda t: -t.signed)
    best = scores[0]
    if dof == 1:
        unit = orthogonal[usable[:, 0], 0] / norm[usable[:, 0]]
        z = float(np.sign(best.signed) * np.sqrt(abs(best.signed)))
        p_value = _p_of_maximum(z, unit @ unit.T, one_sided)
    else:
        p_value = min(1.0, shapes * float(chi2_sf(dof, max(best.signed, 0.0))))
    return Score(
        statistic=max(best.signed, 0.0),
        amplitude=best.amplitude,
        std=np.sqrt(np.diag(np.linalg.pinv(orthogonal[best.shape] @ orthogonal[best.shape].T))),
        shape=best.shape,
        p_value=p_value,
        others=tuple((t.shape, t.amplitude) for t in _distinct(scores)[1:]),
    )


@dataclass(frozen=True, eq=False)
class _ShapeScore:
    signed: float
    shape: int
    amplitude: FloatArray
    explained: FloatArray


def _distinct(scores: list[_ShapeScore]) -> list[_ShapeScore]:
    """The best shapes, without those that explain nearly the same as a better one."""
    distinct: list[_ShapeScore] = []
    units: list[FloatArray] = []
    for score in scores:
        size = float(np.linalg.norm(score.explained))
        if len(distinct) == MOST_DISTINCT or score.signed <= 0.0 or size == 0.0:
            break
        unit = score.explained / size
        if all(abs(float(unit @ u)) < SAME_SHAPE for u in units):
            distinct.append(score)
            units.append(unit)
    return distinct or scores[:1]


def _p_of_maximum(z: float, correlation: FloatArray, one_sided: bool) -> float:
    """P(max of correlated unit normals, or of their magnitudes, ≥ z)."""
    single = float(normal_cdf(-z)) * (1.0 if one_sided else 2.0)
    count = len(correlation)
    if count == 1 or single > 0.5:
        return min(1.0, single)
    bound = min(1.0, count * single)
    if bound * DRAWS < MIN_EXCEEDING:
        return bound
    root = covariance_root(correlation)
    draws = np.random.default_rng(0).standard_normal((DRAWS, count)) @ root.T
    largest = (draws if one_sided else np.abs(draws)).max(axis=1)
    return float(np.clip((1 + np.sum(largest >= z)) / (DRAWS + 1), single, bound))


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for choosing among them (Holm 1979): family-wise error at any level."""
    count, values = len(p_values), np.asarray(p_values, dtype=np.float64)
    order, adjusted = np.argsort(values, kind="stable"), np.empty(count)
    larger = np.minimum(1.0, np.arange(count, 0, -1) * values[order])
    adjusted[order] = np.maximum.accumulate(larger)
    return [float(p) for p in adjusted]


def boundary_p_value(delta_chi2: float, parameters: int, bounded: int, shapes: int = 1) -> float:
    """p of a fall of χ² by a refit, with some amplitudes at a bound when the effect is absent.

    parameters  free amplitudes of the effect; `bounded` of them (0 or 1) may not be negative:
                χ̄² with equal weights on `parameters` − 1 and `parameters` degrees of freedom
    shapes      guesses of parameters without meaning under absence, each an independent try
                (a Bonferroni bound on the maximum)
    """
    if delta_chi2 <= 0.0:
        return 1.0
    tail = float(chi2_sf(parameters, max(delta_chi2, 0.0)))
    if bounded:
        below = float(chi2_sf(parameters - 1, max(delta_chi2, 0.0))) if parameters > 1 else 0.0
        tail = 0.5 * (tail + below)
    return min(1.0, tail * shapes)


#: An effect with more start shapes than this acts at a place that must be searched.
MOST_SHAPES = 50


@dataclass(frozen=True, eq=False)
class ScreenedEffect:
    """An effect's score test, and parameter values from which refits should start, best first."""

    effect: type[Effect]
    score: Score
    starts: tuple[FloatArray, ...]


def screen(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> list[ScreenedEffect]:
    """Score tests of effects against a fit, the likeliest first.

    All effects, at every guess of their shape parameters, go into one batch per trial.
    """
    nuisance = nuisance_of(fit)
    screened = []
    for sensitivity in sensitivities(prepared, fit, effects):
        effect = sensitivity.effect
        score = score_test(nuisance, sensitivity.rows, one_sided=one_sided(effect))
        starts = tuple(
            _start(effect, sensitivity.values[shape], amplitude)
            for shape, amplitude in ((score.shape, score.amplitude), *score.others)
        )
        screened.append(ScreenedEffect(effect, score, starts))
    return sorted(screened, key=lambda s: (s.score.p_value, -s.score.statistic))


def _start(effect: type[Effect], guess: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Parameter values of the guess, amplitudes as the score expects them, within bounds."""
    values = guess.copy()
    expected = iter(np.atleast_1d(amplitude))
    for i, p in enumerate(effect.parameters):
        if p.amplitude:
            values[i] = np.clip(p.default + next(expected), p.low, p.high)
    return values
