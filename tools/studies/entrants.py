"""Entrants of the benchmark of hidden effects: their claims about a study, with probabilities.

An entrant is a function of a folder with one study.  It returns claims and their probabilities: a
claim is `complete`, `outside` (of the library), or effects joined by "+", tied ones by "|".  The
remaining probability is undecided.  Each peer has the effects of the library, the noise and the
fits of this project, and all trials.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.api.lab import diagnosed, examined, opened_study, set_up, set_up_opened
from cell.cable.effects import library
from cell.cable.effects.base import Effect
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.prepared import all_fitted
from cell.lab.data.rules import SIGNIFICANCE
from cell.lab.data.work import Budget, Work
from cell.lab.fit.fitting import best_initial_state, fit_model, fit_trials
from cell.lab.fit.sensitivity import nuisance_of, sensitivities
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import REFIT, FittedModel, bic_penalty
from tools.studies import sysid_entrant

Claims = dict[str, float]
#: Minus twice the logarithm of a set of effects' weight; the empty set is the model without any.
Costs = dict[frozenset[str], float]
#: Largest number of effects that a search adds; number of options per level in costly searches.
MOST_EFFECTS, MOST_OPTIONS = 3, 6
#: Sets whose costs differ by less are tied: "not worth more than a bare mention" (Kass and Raftery
#: 1995, J. Am. Stat. Assoc. 90, 773).
TIED = 2.0
#: Least probability of a claim.
LEAST = 1e-3
#: CPU time of a peer's fits of a study, s.
PEER = Budget(cpu_s=300.0)
#: PySINDy: threshold and ridge of STLSQ, frames of the smoother: the best of `--search` for
#: `--seed 31 --share 0.03`, whose studies no table has.
SINDY = (0.1, 0.05, 21)
SINDY_MODELS = 50
#: Files of a PEtab Select problem whose parameters are switches of effects.
PETAB = {
    "space.tsv": "model_subspace_id\tmodel_subspace_petab_yaml\t{names}\n"
    "effects\tnone.yaml{cells}\n",
    "parameters.tsv": "parameterId\tparameterScale\tlowerBound\tupperBound\tnominalValue\t"
    "estimate\n{rows}",
    "none.yaml": "format_version: 1\nparameter_file: parameters.tsv\nproblems:\n- "
    "{{condition_files: [], measurement_files: [], observable_files: [], sbml_files: []}}\n",
    "problem.yaml": "format_version: 1.0.0\ncriterion: AICc\nmethod: forward\n"
    "model_space_files: [space.tsv]\n",
}


def ranked(costs: Mapping[frozenset[str], float]) -> Claims:
    """Claims with probabilities ∝ exp(−cost/2); the best set together with those tied with it."""
    best = min(costs, key=lambda s: (costs[s], sorted(s)))
    weight = {s: float(np.exp(-0.5 * (c - costs[best]))) for s, c in costs.items()}
    rivals = {s for s in costs if len(s) == len(best) and costs[s] - costs[best] < TIED}
    parts, joined = [], {best}
    for name in sorted(best):
        tied = {s for s in rivals if best - s <= {name}}
        joined |= tied
        parts.append("|".join(sorted({name}.union(*(s - (best - {name}) for s in tied)))))
    total = sum(weight.values())
    claims = {"+".join(parts) or "complete": sum(weight[s] for s in joined) / total}
    for s in sorted(weight.keys() - joined, key=lambda s: (-weight[s], sorted(s))):
        if weight[s] / total >= LEAST:
            claims["+".join(sorted(s)) or "complete"] = weight[s] / total
    return claims


def fits_of(folder: Path) -> FitCache:
    """A study's baseline, fitted to all trials."""
    study = all_fitted(opened_study(folder))
    return set_up_opened(study, EffectSelection((), library()), work=Work(PEER))


def values_of(fits: FitCache) -> int:
    """Number of values that are fitted."""
    return fits.prepared.count(fit_trials(fits.prepared))


def penalty(fits: FitCache, names: Iterable[str]) -> float:
    """Penalty of BIC for the parameters that effects add to the baseline."""
    return bic_penalty([fits.library[n] for n in names], values_of(fits), 1.0)


def bic(fits: FitCache, model: FittedModel) -> float:
    return model.fit.objective + penalty(fits, model.names)


def left_out_error(fits: FitCache, model: FittedModel) -> float:
    """χ² of each trial by the model fitted to the others."""
    prepared, total = fits.prepared, 0.0
    trials = fit_trials(prepared)
    for trial in trials:
        rest = [t for t in trials if t is not trial]
        fit = fit_model(prepared, model.fit.space, model.fit.q, trials=rest, options=REFIT)
        state = best_initial_state(prepared, fit.model, trial)
        white = prepared.white(trial, prepared.predict(trial, [fit.model], state[None]))
        total += float(np.sum(white**2))
    return total


def offered(fits: FitCache, model: FittedModel) -> list[type[Effect]]:
    """Effects that may be added to a model."""
    return [e for n, e in sorted(fits.library.items()) if n not in model.names]


def forward(
    fits: FitCache, cost: Callable[[FitCache, FittedModel], float], most: int | None = None
) -> Costs:
    """Costs of the sets of effects of a forward search: the best is added while the cost falls.

    most  number of options of a level, those with the best fit, whose cost is computed; None = all
    """
    model, costs = fits.base, {frozenset[str](): cost(fits, fits.base)}
    for _ in range(MOST_EFFECTS):
        options = fits.fit_extended(model, offered(fits, model))
        options = sorted(options, key=lambda m: m.fit.objective)[:most]
        costs |= (option_costs := {m.names: cost(fits, m) for m in options})
        best = min(options, key=lambda m: option_costs[m.names], default=model)
        if costs[best.names] >= costs[model.names]:
            break
        model = best
    return costs


def lab(folder: Path) -> Claims:
    """This lab: a verdict has the probability 1 − significance, one of `cannot_tell` half of it."""
    fits = set_up(folder, EffectSelection((), library()))
    diagnosis = diagnosed(examined(fits), folder).diagnosis
    sure = 1.0 - SIGNIFICANCE
    named = "+".join("|".join((m.effect, *m.tied_with)) for m in diagnosis.missing)
    if diagnosis.verdict == "cannot_tell":
        return {named: 0.5 * sure} if named else {}
    return {{"complete": "complete", "unexplained": "outside"}.get(diagnosis.verdict, named): sure}


def stepwise_bic(folder: Path) -> Claims:
    """Forward selection by BIC; its weights."""
    return ranked(forward(fits_of(folder), bic))


def heldout_error(folder: Path) -> Claims:
    """Forward selection by the error of held-out trials; weights of pseudo-BMA (Yao 2018)."""
    fits = fits_of(folder)
    if len(fit_trials(fits.prepared)) < 2:
        return {}
    return ranked(forward(fits, left_out_error, MOST_OPTIONS))


def largest_score(folder: Path) -> Claims:
    """The largest Lagrange multiplier, the gain of a first step, minus BIC's penalty."""
    fits = fits_of(folder)
    scores = {s.effect.name: s.score.statistic for s in fits.screened(fits.base)}
    costs = {frozenset({n}): penalty(fits, [n]) - score for n, score in scores.items()}
    return ranked({frozenset[str](): 0.0} | costs)


def columns(fits: FitCache) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Whitened residual (values,), sensitivities to effects (values, columns), and their names, all
    projected off the baseline's parameters; columns have length 1."""
    nuisance, rows, names = nuisance_of(fits.base.fit), [], []
    for sensitivity in sensitivities(fits.prepared, fits.base.fit, list(fits.library.values())):
        of_effect = nuisance.remove(sensitivity.rows).reshape(-1, len(nuisance.residual))
        rows += list(of_effect)
        names += [sensitivity.effect.name] * len(of_effect)
    norms = np.linalg.norm(rows, axis=1)
    usable = norms > 1e-9 * norms.max()
    usable_names = [n for n, is_usable in zip(names, usable, strict=True) if is_usable]
    return nuisance.residual, (np.array(rows)[usable] / norms[usable, None]).T, usable_names


def lasso(folder: Path) -> Claims:
    """The lasso's path on the residual, and single effects; refitted linearly, weighted by BIC."""
    from sklearn.linear_model import lars_path

    fits = fits_of(folder)
    residual, added, names = columns(fits)
    path = [*lars_path(added, residual, method="lasso", max_iter=12)[2].T, *np.eye(len(names))]
    costs: Costs = {}
    for active in map(np.flatnonzero, path):
        fitted, effects = added[:, active], frozenset(names[i] for i in active)
        if len(effects) <= MOST_EFFECTS:
            remainder = residual - fitted @ np.linalg.lstsq(fitted, residual, rcond=None)[0]
            cost = float(remainder @ remainder) + penalty(fits, effects)
            costs[effects] = min(cost, costs.get(effects, np.inf))
    return ranked(costs)


def accelerations(fits: FitCache, frames: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Accelerations of the residual (values,), and those by effects (values, effects), of length 1.

    Effects have their typical size; all is projected off the baseline's parameters.
    """
    import pysindy as ps

    prepared, fit = fits.prepared, fits.base.fit
    steps = np.diag(np.maximum(np.sqrt(np.diag(fit.covariance)), 1e-6))
    models = [fit.model, *(fit.space.model(fit.q + step) for step in steps)]
    for effect in fits.library.values():
        active = effect.active(**{p.name: p.starts[0] for p in effect.parameters})
        models.append(replace(fit.model, effects=(*fit.model.effects, active)))
    smooth = ps.SmoothedFiniteDifference(smoother_kws={"window_length": frames, "polyorder": 3})
    rows = []
    for trial in fit_trials(prepared):
        t_s, points = trial.markers.t_s, prepared.predict(trial, models)
        if len(t_s) > frames:
            moved = [prepared.error_m(trial, points[0]), *(points[1:] - points[:1])]
            flat = [np.nan_to_num(m).reshape(len(t_s), -1) for m in moved]
            rows.append([smooth._differentiate(smooth._differentiate(m, t_s), t_s) for m in flat])
    if not rows:
        return None
    joined = np.array([np.concatenate([np.ravel(m) for m in of]) for of in zip(*rows, strict=True)])
    basis = np.linalg.qr(joined[1 : len(steps) + 1].T)[0]
    projected = joined - (joined @ basis) @ basis.T
    projected /= np.maximum(np.linalg.norm(projected, axis=1, keepdims=True), 1e-300)
    return projected[0], projected[len(steps) + 1 :].T


def pysindy(folder: Path) -> Claims:
    """STLSQ on accelerations, in an ensemble over frames: frequency of each selected set."""
    fits = fits_of(folder)
    threshold, ridge, frames = SINDY
    regressed = accelerations(fits, frames)
    return {} if regressed is None else selected(fits, *regressed, threshold, ridge)


def selected(
    fits: FitCache, target: np.ndarray, added: np.ndarray, threshold: float, ridge: float
) -> Claims:
    """Shares of an ensemble that select each set of effects."""
    import pysindy as ps

    np.random.seed(0)  # its ensembles draw from there  # noqa: NPY002
    stlsq = ps.STLSQ(threshold=threshold, alpha=ridge)
    model = ps.EnsembleOptimizer(stlsq, bagging=True, n_models=SINDY_MODELS)
    with warnings.catch_warnings(action="ignore"):  # it warns where nothing is selected
        model.fit(added, target)
    claims: Claims = {}
    for coefficients in model.coef_list:
        chosen = zip(fits.library, np.ravel(coefficients), strict=True)
        claim = "+".join(sorted(name for name, c in chosen if c)) or "complete"
        claims[claim] = claims.get(claim, 0.0) + 1.0 / SINDY_MODELS
    return claims


def petab_select(folder: Path) -> Claims:
    """PEtab Select's forward search by AICc; each effect is a switch, its calibration our fit."""
    import petab_select as ps

    fits = fits_of(folder)
    names, known, costs = sorted(fits.library), {frozenset[str](): fits.base}, Costs()
    with tempfile.TemporaryDirectory() as root:
        for name, text in PETAB.items():
            rows = "".join(f"{n}\tlin\t0\t1\t0\t1\n" for n in names)
            cells = "\t0;estimate" * len(names)
            filled = text.format(names="\t".join(names), cells=cells, rows=rows)
            Path(root, name).write_text(filled, encoding="utf-8")
        problem = ps.Problem.from_yaml(Path(root, "problem.yaml"))
        candidates, terminate = None, False
        while not terminate:
            iteration = ps.ui.start_iteration(problem, candidates)
            models = iteration["uncalibrated_models"]
            for model in models:
                wanted = frozenset(model.get_estimated_parameter_ids())
                if wanted not in known:
                    before = known[max((s for s in known if s < wanted), key=lambda s: -costs[s])]
                    known |= {m.names: m for m in fits.fit_extended(before, offered(fits, before))}
                costs[wanted] = aicc(fits, known[wanted]) if wanted in known else float("inf")
                model.set_criterion(ps.Criterion.AICC, costs[wanted])
            ended = ps.ui.end_iteration(problem, iteration["candidate_space"], models)
            candidates, terminate = ended["candidate_space"], ended["terminate"]
            terminate = terminate or max(map(len, costs)) > MOST_EFFECTS
    return ranked(costs)


def aicc(fits: FitCache, model: FittedModel) -> float:
    values, count = values_of(fits), len(model.fit.q)
    return model.fit.objective + 2 * count + 2 * count * (count + 1) / (values - count - 1)


def mujoco_sysid(folder: Path) -> Claims:
    """Forward selection by BIC; MuJoCo simulates, and `mujoco.sysid` fits, from our baseline."""
    return ranked(sysid_entrant.costs(fits_of(folder), MOST_EFFECTS))


def abstain(folder: Path) -> Claims:
    """Claims nothing."""
    return {}


#: Entrants by name, and the packages of each beyond the project's own.
ENTRANTS: dict[str, tuple[Callable[[Path], Claims], Sequence[str]]] = {
    "this lab": (lab, ["cable-cell"]),
    "stepwise BIC": (stepwise_bic, ["cable-cell"]),
    "held-out error": (heldout_error, ["cable-cell"]),
    "largest score": (largest_score, ["cable-cell"]),
    "lasso": (lasso, ["scikit-learn"]),
    "PySINDy": (pysindy, ["pysindy"]),
    "mujoco.sysid": (mujoco_sysid, ["mujoco", "absl-py"]),
    "PEtab Select": (petab_select, ["petab-select"]),
    "abstains": (abstain, ["cable-cell"]),
}
