"""A fit as the stored model of a cable, with intervals widened by possibly omitted effects.

Most of an omitted effect does not appear in the residual: the other parameters imitate it, and so
are biased by far more than the noise would explain.  The residual shows which effects may be
omitted and how strong they are; from these follows the bias of the parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc as chi2_sf

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.fit import frames_detected, variance_inflation
from cell.identify.identified import Identified
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.thresholds import SIGNIFICANCE
from cell.lab.fit.all_trials_fit import AllTrialsFit
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.fit.projection import orthonormal
from cell.lab.fit.sensitivity import one_sided

#: Effects taken in at most, one after another, until what is left is noise.
MOST = 4
#: Parts of a trial that are taken for independent where a model errs.
PARTS = 4
#: Less of an effect than this share is not told from what the parameters do.
LEAST_LEFT = 1e-6


@dataclass(frozen=True, eq=False)
class OmittedEffectBias:
    """Omitted effects that explain the residual, and the bias of the parameters without them.

    effects     that explain what it leaves, linearly, the one that explains most first
    covariance  (p, p) of the fit's coordinates by their absence: how far they move with these in,
                and how uncertain that is; 0 where what is left is noise
    """

    effects: tuple[str, ...]
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class _Option:
    """An effect of one shape: rows (amplitudes, rows) by which its amplitudes change the residual.

    seen  the same without what the fitted parameters imitate
    """

    effect: type[Effect]
    rows: FloatArray
    seen: FloatArray


def omitted_effect_bias(joint: AllTrialsFit, effects: Iterable[type[Effect]]) -> OmittedEffectBias:
    """The bias of a fitted model's parameters that omitted effects may cause."""
    fit, linear = joint.fit, joint.linear
    p, none = len(fit.q), np.zeros((len(fit.q), len(fit.q)))
    tried = [e for e in effects if e.name not in {x.name for x in fit.space.effects}]
    chosen, factor = _explaining(joint, _options(joint, tried))
    if not chosen:
        return OmittedEffectBias((), none)
    rows, seen = (np.vstack([getattr(o, v) for o in chosen]) for v in ("rows", "seen"))
    amplitudes = np.linalg.lstsq(seen.T, linear.residual, rcond=1e-8)[0]
    by_each = linear.coordinates(rows)
    moved = by_each @ amplitudes
    spread = by_each @ np.linalg.pinv(seen @ seen.T) @ by_each.T * factor
    all_of = np.zeros((len(fit.solution.q), len(fit.solution.q)))
    free = fit.solution.free
    all_of[np.ix_(free, free)] = np.outer(moved, moved) + spread + _by_parts(joint)
    return OmittedEffectBias(tuple(o.effect.name for o in chosen), all_of[:p, :p])


def _options(joint: AllTrialsFit, effects: Sequence[type[Effect]]) -> list[_Option]:
    """Effects at every guess of their shape, but those of which nothing is seen."""
    options = []
    for slopes in joint.sensitivities(effects):
        for rows in slopes.rows:
            seen = joint.linear.remove(rows)
            if np.linalg.norm(seen) > LEAST_LEFT * np.linalg.norm(rows):
                options.append(_Option(slopes.effect, rows, seen))
    return options


def _explaining(joint: AllTrialsFit, options: Sequence[_Option]) -> tuple[list[_Option], float]:
    """Those that explain most, one after another while significant; and the variance left."""
    prepared, errs = joint.prepared, joint.systematic_error
    whiteners = [prepared.whiteners[t.name] for t in fit_trials(prepared)]
    chosen: list[_Option] = []
    left, factor = joint.linear.residual, 1.0
    taken = np.zeros((0, len(left)))
    while len(chosen) < MOST:
        names = {o.effect.name for o in chosen}
        found = [(o, _explained(o, taken, left)) for o in options if o.effect.name not in names]
        best, explained = max(found, key=lambda f: float(f[1] @ f[1]), default=(None, left))
        if best is None or not (square := float(explained @ explained)) > 0.0:
            break
        after = left - explained
        inflation = variance_inflation(after[: len(errs.mesh)], whiteners, len(joint.fit.q))
        expected = inflation + errs.variance(explained) / square
        chance = len(options) * float(chi2_sf(len(best.rows), square / expected))
        if chance > SIGNIFICANCE:
            break
        chosen.append(best)
        taken = orthonormal(np.vstack([taken, best.seen]).T, 1e-8, of_largest=True).T
        left, factor = after, inflation
    return chosen, factor


def _explained(option: _Option, taken: FloatArray, left: FloatArray) -> FloatArray:
    """(rows,) that an option explains of the residual given others; none by a wrong sign."""
    orthogonal = option.seen - (option.seen @ taken.T) @ taken
    amplitudes = np.linalg.lstsq(orthogonal.T, left, rcond=1e-8)[0]
    if one_sided(option.effect) and amplitudes[0] < 0.0:
        return np.zeros_like(left)
    return np.asarray(amplitudes @ orthogonal)


def _by_parts(joint: AllTrialsFit) -> FloatArray:
    """(free, free) by how much parts of trials ask for coordinates of their own.

    source  Liang & Zeger 1986, Biometrika 73, 13: the sandwich of clusters within which anything
            may depend on anything
    """
    prepared, solution, linear = joint.prepared, joint.fit.solution, joint.linear
    inside = np.linalg.inv(linear.triangle.T @ linear.triangle)
    scores = []
    rows = prepared.by_trial(fit_trials(prepared), np.arange(len(linear.residual)))
    for name, of_trial in rows.items():
        in_frames = of_trial.reshape(-1, prepared.whiteners[name].frames)
        for part in np.array_split(in_frames, PARTS, axis=1):
            slopes = solution.jacobian[part.ravel()][:, solution.free]
            scores.append(slopes.T @ linear.residual[part.ravel()])
    by_part = np.array(scores) @ inside
    return np.asarray(by_part.T @ by_part * len(scores) / (len(scores) - 1))


def identified(
    prepared: PreparedStudy, fit: Fit, effects: Iterable[type[Effect]] = ()
) -> Identified:
    """A fit as an `Identified` model, with intervals widened by its residual.

    effects  that it may lack: where what is left is not noise, its parameters are as uncertain as
             they move with those in that explain it
    """
    trials = fit_trials(prepared)
    whiteners = [prepared.whiteners[t.name] for t in trials]
    solution, p = fit.solution, len(fit.q)
    inflation = variance_inflation(solution.residual, whiteners, len(solution.q))
    # What the data say is worth less by the inflation, what the prior says is not.
    precision = solution.jacobian.T @ solution.jacobian / inflation
    precision[:p, :p] += fit.space.precision
    precision[p:, p:] += np.diag(1.0 / fit.initial_state_std**2)
    noise_only = np.linalg.inv(precision)
    joint = AllTrialsFit(prepared, fit)
    by_log = joint.systematic_error.covariance(noise_only[:p] @ solution.jacobian.T / inflation)
    unfinished = solution.unfinished[:p, :p]
    missed = omitted_effect_bias(joint, effects)
    return Identified(
        space=fit.space,
        mean=fit.q,
        covariance=np.asarray(noise_only[:p, :p] + by_log + missed.covariance + unfinished),
        noise=prepared.expected,
        residual_rms_m=fit.rms_m,
        converged=fit.arrived,
        inflation=inflation,
        frames_used=sum(frames_detected(t) for t in trials),
        frames_total=sum(len(t.markers.t_s) for t in trials),
        iterations=fit.solution.iterations,
        method="map",
        gripper_covariance=by_log,
        lacks=missed.effects,
    )
