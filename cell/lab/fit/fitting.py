"""Fits a model to the `fit` trials of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.model import CableModel
from cell.identify import gauss_newton
from cell.identify.gauss_newton import UNSIMULATED, Solution, jacobian_at
from cell.identify.parameters import ParameterSpace, Prior
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.series import overall
from cell.study.data import Markers, Trial

#: First frames of a cable in motion: this share of the period of a hanging cable's swing, and at
#: least so many.
SHARE_OF_SWING = 0.1
FEWEST_FRAMES = 6
#: Minimum noise of the markers, as share of the free length: the model is not fitted yet.
LEAST_NOISE = 1e-3
_ITERATIONS = 3


def estimate_initial_states(
    prepared: PreparedStudy, trials: Sequence[Trial], models: Sequence[CableModel]
) -> dict[str, FloatArray]:
    """Likeliest initial states by trial, (models, unknowns); delays stay at 0.

    By Gauss–Newton on the first frames; 0 for trials that do not begin bent, and for models that
    cannot be simulated.
    """
    return {t.name: _by_frames(prepared, t, models) for t in trials}


def _by_frames(prepared: PreparedStudy, trial: Trial, models: Sequence[CableModel]) -> FloatArray:
    state, lanes = prepared.initial_state(trial), len(models)
    initial_states = np.zeros((lanes, state.count))
    if not state.bent:
        return initial_states
    early = _early(prepared, trial)
    observed = np.isfinite(early.markers.xy_m)
    observed[:, len(prepared.study.arc_length_m) :] = False  # a sensor has an unknown tare
    noise_m = max(prepared.noise.std_m, LEAST_NOISE * prepared.study.cable.free_length_m)
    first = int(state.delayed)
    free = np.arange(first, state.count)
    prior = np.diag(1.0 / state.std[free] ** 2)
    repeated = [m for m in models for _ in range(len(free) + 1)]
    for _ in range(_ITERATIONS):
        tried = np.repeat(initial_states, len(free) + 1, axis=0).reshape(lanes, len(free) + 1, -1)
        for row, i in enumerate(free, 1):
            tried[:, row, i] += state.step[i]
        points = prepared.predict(early, repeated, tried.reshape(-1, state.count))
        points = points.reshape(lanes, len(free) + 1, *observed.shape)[:, :, observed] / noise_m
        jacobian = (points[:, 1:] - points[:, :1]) / state.step[free][:, None]
        residual = early.markers.xy_m[observed] / noise_m - points[:, 0]
        for lane in np.flatnonzero(np.isfinite(points).all(axis=(1, 2))):
            s, current = jacobian[lane], initial_states[lane, free]
            step = np.linalg.solve(s @ s.T + prior, s @ residual[lane] - prior @ current)
            initial_states[lane, free] = current + step
        initial_states = np.clip(initial_states, -state.limit, state.limit)
    return initial_states


def _early(prepared: PreparedStudy, trial: Trial) -> Trial:
    """The first frames of a trial; those before the release of a held cable if there are any."""
    t_s, study = trial.markers.t_s, prepared.study
    if trial.release_s is not None:
        count = int(np.searchsorted(t_s, trial.release_s, "right"))
        first = slice(0, count) if count else slice(0, 1)
    else:
        swing_s = 2.0 * np.pi * np.sqrt(study.cable.free_length_m / study.scale_m_per_s2)
        count = int(np.searchsorted(t_s, t_s[0] + SHARE_OF_SWING * swing_s))
        first = slice(0, max(count, FEWEST_FRAMES))
    return replace(trial, markers=Markers(t_s[first], trial.markers.xy_m[first]))


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted to the fit trials.

    q          (p,) coordinates of `space`
    initial_states      unknowns of each fit trial's initial state, where it has any
    solution   of the minimiser; its coordinates are q, then these unknowns
    chi2       sum of squares of whitened residuals; objective adds the prior's
    rms_m      per coordinate, forces included (scaled to lengths by their noise)
    markers_rms_m   of the markers alone
    initial_state_std  of the prior of all these unknowns
    """

    space: ParameterSpace
    q: FloatArray
    initial_states: dict[str, FloatArray]
    solution: Solution
    chi2: float
    objective: float
    rms_m: float
    markers_rms_m: float
    initial_state_std: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def model(self) -> CableModel:
        """The fitted cable."""
        return self.space.model(self.q)

    @property
    def predicted_objective(self) -> float:
        """Predicted objective at the minimum, by the linear model at the last step."""
        return self.objective - (0.0 if self.solution.converged_or_idle else self.solution.promised)

    @property
    def arrived(self) -> bool:
        """Whether the minimum of the linear model is within one standard deviation."""
        return self.solution.promised <= self.widening

    @property
    def widening(self) -> float:
        """Factor by which the residuals widen variances, at least 1."""
        return max(1.0, self.chi2 / max(1, int(np.count_nonzero(self.solution.residual))))

    @property
    def covariance(self) -> FloatArray:
        """(p, p) of q for residuals of white noise."""
        p = len(self.q)
        return np.asarray(self.solution.covariance[:p, :p])


@dataclass(frozen=True, eq=False)
class Rival:
    """A candidate model in the design of the next measurement.

    q, covariance  (p,), (p, p) coordinates of `space`, and their uncertainty
    """

    name: str
    space: ParameterSpace
    q: FloatArray
    covariance: FloatArray

    @property
    def model(self) -> CableModel:
        """The cable at q."""
        return self.space.model(self.q)


def fit_trials(prepared: PreparedStudy) -> tuple[Trial, ...]:
    """The trials that may be fitted.  Raises ValueError: none."""
    trials = prepared.study.role("fit")
    if not trials:
        raise ValueError(f"study {prepared.study.name}: no trial has role `fit`")
    return trials


def fit_model(
    prepared: PreparedStudy,
    space: ParameterSpace,
    start: FloatArray,
    initial_states: Mapping[str, FloatArray] | None = None,
    *,
    trials: Sequence[Trial] | None = None,
    residual_scale: float = 1.0,
    options: gauss_newton.Options = gauss_newton.Options(tolerance=0.03),  # noqa: B008
    from_far: bool = False,
) -> Fit:
    """Fit near `start`, with the unknowns of the trials' initial states as further unknowns.

    initial_states   their start values, as of an earlier fit
    trials  default: the `fit` trials
    residual_scale  residuals are divided by it: where a model cannot fit, the prior then still
            keeps its parameters plausible
    from_far  the start is far away: minimise first with the coarser solver of the slopes, if there
            is one, then with the study's own
    raises  UnsimulatedError: the model cannot be simulated at the start
    """
    trials = fit_trials(prepared) if trials is None else trials
    p, std = len(space.names), _joined([prepared.initial_state(t).std for t in trials])
    problem = problem_of(prepared, space, trials, residual_scale)
    begin = _start_coordinates(prepared, space, trials, start, initial_states or {})
    solution = None
    if from_far and prepared.slope_solver is not None:
        coarse = problem_of(prepared.coarser(prepared.slope_solver), space, trials, residual_scale)
        solution = _coarse_to_fine(coarse, problem, begin, options)
    if solution is None:
        solution = gauss_newton.minimise(problem, begin, options)
    solution = replace(
        solution,
        residual=solution.residual * residual_scale,
        jacobian=solution.jacobian * residual_scale,
    )
    q, states = solution.q[:p], by_trial(prepared, trials, solution.q[None, p:])
    predicted = prepared.predict_all(trials, [space.model(q)], states)
    chi2 = float(solution.residual @ solution.residual)
    initial = {name: rows[0] for name, rows in states.items()}
    rms_m = rms_of(prepared, trials, [points[0] for points in predicted])
    return Fit(space, q, initial, solution, chi2, solution.objective, *rms_m, std)


def rms_of(
    prepared: PreparedStudy, trials: Sequence[Trial], predicted_m: Sequence[FloatArray]
) -> tuple[float, float]:
    """Root mean square error of predictions in trials: of all points, and of the markers, m."""
    errors = [prepared.error_m(t, p) for t, p in zip(trials, predicted_m, strict=True)]
    places = [prepared.of_markers(t, e) for t, e in zip(trials, errors, strict=True)]
    return overall(errors), overall(places)


def _coarse_to_fine(
    coarse: gauss_newton.LeastSquaresProblem,
    problem: gauss_newton.LeastSquaresProblem,
    begin: FloatArray,
    options: gauss_newton.Options,
) -> Solution | None:
    """The minimum of a problem from that of a coarser one; None if one cannot be simulated there.

    If the coarser fit did not converge, the finer one makes a single iteration only.
    """
    try:
        near = gauss_newton.minimise(coarse, begin, options)
        remaining = options.max_iterations - near.iterations if near.converged_or_idle else 0
        limited = replace(options, max_iterations=1 + max(0, remaining))
        solution = gauss_newton.minimise(problem, near.q, limited, near.jacobian)
    except gauss_newton.UnsimulatedError:
        return None
    return replace(solution, iterations=near.iterations + solution.iterations - 1)


def problem_of(
    prepared: PreparedStudy,
    space: ParameterSpace,
    trials: Sequence[Trial],
    residual_scale: float = 1.0,
) -> gauss_newton.LeastSquaresProblem:
    """The least-squares problem of a fit, in the cable's coordinates and the initial states.

    residual_scale  residuals are divided by it
    """
    unknown = [prepared.initial_state(t) for t in trials]
    p, std = len(space.names), _joined([b.std for b in unknown])
    limit = _joined([b.limit for b in unknown])
    precision = np.zeros((p + len(std), p + len(std)))
    precision[:p, :p] = space.precision
    precision[p:, p:] = np.diag(1.0 / std**2)
    coarse_residuals = None
    if prepared.slope_solver is not None:
        coarse = prepared.coarser(prepared.slope_solver)

        def coarse_residuals(q: FloatArray) -> FloatArray:
            return residuals(coarse, space, trials, q) / residual_scale

    return gauss_newton.LeastSquaresProblem(
        residuals=lambda q: residuals(prepared, space, trials, q) / residual_scale,
        jacobian=coarse_residuals,
        mean=np.concatenate([space.mean, np.zeros(len(std))]),
        precision=precision,
        step=np.concatenate([space.step, _joined([b.step for b in unknown])]),
        low=np.concatenate([space.low, -limit]),
        high=np.concatenate([space.high, limit]),
        affordable=lambda: not prepared.work.spent,
    )


def _joined(parts: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([np.zeros(0), *parts])


def by_trial(
    prepared: PreparedStudy, trials: Sequence[Trial], rows: FloatArray
) -> dict[str, FloatArray]:
    """Initial states (lanes, all unknowns), split by trial, for trials that have unknowns."""
    states, begin = {}, 0
    for trial in trials:
        if count := prepared.initial_state(trial).count:
            states[trial.name] = rows[:, begin : begin + count]
            begin += count
    return states


def _start_coordinates(
    prepared: PreparedStudy,
    space: ParameterSpace,
    trials: Sequence[Trial],
    start: FloatArray,
    states: Mapping[str, FloatArray],
) -> FloatArray:
    """Coordinates of a fit's start, with initial states from another fit or newly estimated.

    Those of trials that begin bent depend on the model: the set with the smaller residual is used.
    """
    estimated = estimate_initial_states(prepared, trials, [space.model(start)])
    earlier = {t.name: states.get(t.name, estimated[t.name][0]) for t in trials}
    if not states or not any(t.bent for t in trials):
        return np.concatenate([start, *earlier.values()])
    renewed = {t.name: estimated[t.name][0] if t.bent else earlier[t.name] for t in trials}
    q = np.stack([np.concatenate([start, *chosen.values()]) for chosen in (earlier, renewed)])
    square = np.sum(residuals(prepared, space, trials, q) ** 2, axis=1)
    return np.asarray(q[int(np.argmin(np.where(np.isfinite(square), square, np.inf)))])


def residuals(
    prepared: PreparedStudy, space: ParameterSpace, trials: Sequence[Trial], q: FloatArray
) -> FloatArray:
    """(lanes, rows) whitened residuals of all trials.

    q  (lanes, p + unknowns of the trials' initial states); (lanes, p) = as recorded, or estimated
       from the first frames with each lane's model
    """
    p = len(space.names)
    if q.shape[1] > p and any(t.bent for t in trials):
        return _each_once(prepared, space, trials, q)
    models = [space.model(row) for row in q[:, :p]]
    if q.shape[1] > p or not any(t.bent for t in trials):
        initial_states = by_trial(prepared, trials, q[:, p:]) if q.shape[1] > p else {}
    else:
        initial_states = estimate_initial_states(prepared, trials, models)
    return prepared.all_white(trials, models, initial_states)


def _each_once(
    prepared: PreparedStudy, space: ParameterSpace, trials: Sequence[Trial], q: FloatArray
) -> FloatArray:
    """The same; lanes that are equal in a trial are simulated there only once."""
    p = len(space.names)
    initial_states, parts = by_trial(prepared, trials, q[:, p:]), []
    for trial in trials:
        own = initial_states.get(trial.name, q[:, :0])
        rows, lane = np.unique(np.hstack([q[:, :p], own]), axis=0, return_inverse=True)
        models = [space.model(row) for row in rows[:, :p]]
        parts.append(prepared.white(trial, prepared.predict(trial, models, rows[:, p:]))[lane])
    return np.concatenate(parts, axis=1)


def errors_m(prepared: PreparedStudy, fit: Fit) -> list[FloatArray]:
    """Per trial fitted to (times, channels): measured − predicted, m, nan where not observed."""
    trials = fit_trials(prepared)
    white = prepared.by_trial(trials, fit.solution.residual)
    return [
        prepared.whiteners[t.name].error_m(white[t.name]).reshape(len(t.markers.t_s), -1)
        for t in trials
    ]


def extended(
    fit: Fit, space: ParameterSpace, effect: type[Effect], values: FloatArray
) -> FloatArray:
    """Coordinates in `space` (one more effect than the fit's) with the effect at `values`."""
    return with_values(space, start_from(fit, space), effect, values)


def start_from(fit: Fit, space: ParameterSpace) -> FloatArray:
    """(p,) coordinates in another space: of a fit, or its prior's mean where the fit has none."""
    fitted = dict(zip(fit.space.names, fit.q, strict=True))
    return np.array([fitted.get(n, q) for n, q in zip(space.names, space.mean, strict=True)])


def with_values(
    space: ParameterSpace, q: FloatArray, effect: type[Effect], values: FloatArray
) -> FloatArray:
    """Coordinates (p,) in a space with natural values of one of its effects, within bounds."""
    index = [space.names.index(f"{effect.name}.{p.name}") for p in effect.parameters]
    natural = space.natural(q)
    natural[index] = values
    return np.clip(space.coordinates(natural), space.low, space.high)


def space_with(space: ParameterSpace, effects: Sequence[type[Effect]]) -> ParameterSpace:
    """The parameter space of the same cable, prior and baseline, with other effects.

    The prior of all parameters common to both spaces is kept, an earlier individual's included; the
    prior of the effects' amplitudes is very wide.
    """
    of_effects = tuple(f"{e.name}." for e in effects)
    new = ParameterSpace.of(
        space.cable,
        gravity_m_per_s2=space.gravity_m_per_s2,
        effects=tuple(effects),
        prior=Prior(knots=space.knots),
        exact={n: v for n, v in space.exact if n.startswith(of_effects)},
        pull_m_per_s2=space.pull_m_per_s2,
    )
    common = [n for n in new.names if n in space.names]
    target = [new.names.index(n) for n in common]
    source = [space.names.index(n) for n in common]
    mean, precision = new.mean.copy(), new.precision.copy()
    mean[target] = space.mean[source]
    precision[np.ix_(target, target)] = space.precision[np.ix_(source, source)]
    low, high = new.low.copy(), new.high.copy()
    low[target], high[target] = space.low[source], space.high[source]
    for effect in effects:
        for parameter in effect.parameters:
            name = f"{effect.name}.{parameter.name}"
            if name not in new.names:
                continue
            i = new.names.index(name)
            if not parameter.fitted:
                low[i] = high[i] = mean[i]
            elif parameter.amplitude and i not in target:
                # uninformative: cables differ by orders of magnitude
                precision[i, i] = (parameter.high - parameter.low) ** -2.0
    return replace(new, mean=mean, precision=precision, low=low, high=high)


def pinned(space: ParameterSpace, q: FloatArray) -> ParameterSpace:
    """The space with its coordinates held at q; effects added to it later are free."""
    return replace(space, mean=q, low=q.copy(), high=q.copy())


def best_initial_state(prepared: PreparedStudy, model: CableModel, trial: Trial) -> FloatArray:
    """(unknowns,) likeliest initial state of one trial; as recorded if it cannot be simulated.

    If the budget of work is spent, estimated from the first frames.
    """
    state = prepared.initial_state(trial)
    problem = gauss_newton.LeastSquaresProblem(
        residuals=lambda q: prepared.white(trial, prepared.predict(trial, [model] * len(q), q)),
        mean=np.zeros(state.count),
        precision=np.diag(state.std**-2),
        step=state.step,
        low=-state.limit,
        high=state.limit,
        affordable=lambda: not prepared.work.spent,
    )
    if state.count == 0:
        return np.zeros(0)
    start = estimate_initial_states(prepared, [trial], [model])[trial.name][0]
    if prepared.work.spent:
        return np.asarray(start)
    try:
        return gauss_newton.minimise(problem, start).q
    except UNSIMULATED:
        return np.zeros(state.count)


def best_initial_states(
    prepared: PreparedStudy, fit: Fit, trials: Sequence[Trial] | None = None
) -> dict[str, FloatArray]:
    """By trial (1, unknowns): the fitted initial state, else the likeliest one.

    trials  None = those of the study
    """
    states = {}
    for trial in prepared.study.trials if trials is None else trials:
        fitted = fit.initial_states.get(trial.name)
        state = best_initial_state(prepared, fit.model, trial) if fitted is None else fitted
        states[trial.name] = state[None]
    return states


#: Steps tried, in units of the solver's.
LONGER = (3.0, 2.0)
#: Largest error of a parameter's slopes, as share of the root of its information, prior included.
HARMLESS = 0.02


def with_slope_solver(prepared: PreparedStudy, fit: Fit) -> tuple[PreparedStudy, Fit]:
    """The study with the longest time step that does not change the jacobian of a fit.

    And the fit with its jacobian by that step, as later derivatives will have.
    """
    if prepared.slope_solver is not None:
        return prepared, fit
    trials, jacobian = fit_trials(prepared), fit.solution.jacobian
    prior_information = np.diag(problem_of(prepared, fit.space, trials).precision)
    size = np.sqrt(np.sum(jacobian**2, axis=0) + prior_information)
    for longer in LONGER:
        solver = replace(prepared.solver, step_s=longer * prepared.solver.step_s)
        problem = problem_of(replace(prepared, solver=solver), fit.space, trials)
        coarse = jacobian_at(problem, fit.solution.q, fit.solution.covariance)
        if np.all(np.linalg.norm(coarse - jacobian, axis=0) <= HARMLESS * size):
            solution = replace(fit.solution, jacobian=coarse)
            return replace(prepared, slope_solver=solver), replace(fit, solution=solution)
    return prepared, fit
