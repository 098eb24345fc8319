"""95 % limits of the size of effects that the diagnosis of a study does not name.

The jacobian says how much of an effect the other parameters can imitate.  Where they imitate most
of it, the remainder is small compared with second-order terms: the effect is held at a given size,
and all other parameters are refitted.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect, Effect, Parameter
from cell.cable.solver import threads
from cell.identify.fit import variance_inflation
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Limit
from cell.lab.data.work import Progress, no_progress, side_by_side
from cell.lab.fit.fitting import Fit, by_trial, extended, fit_model, fit_trials, space_with
from cell.lab.fit.projection import (
    Projection,
    is_distinct,
    jacobian_with_prior,
    nuisance_of,
    orthonormal,
    prior_root,
)
from cell.lab.fit.sensitivity import Sensitivity, changes, one_sided
from cell.lab.fit.systematic_error import AllTrialsFit, SystematicError
from cell.lab.strength.estimate import LEAST_KNOWN, MIN_FREEDOM

_REFIT = Options(tolerance=0.1, max_iterations=15, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class HeldEffect:
    """An effect added to a fitted model, with one amplitude and the shape held.

    amplitude  number of the parameter that is held; other amplitudes are free

    Changes are whitened, of the fit trials, the prior's rows included.
    """

    prepared: PreparedStudy
    fit: Fit
    effect: type[Effect]
    amplitude: int

    @cached_property
    def space(self) -> ParameterSpace:
        """Parameters of the model with the effect."""
        return space_with(self.fit.space, (*self.fit.space.effects, self.effect))

    @cached_property
    def _held(self) -> list[int]:
        """Indices of the held parameters."""
        return [
            self.space.names.index(f"{self.effect.name}.{p.name}")
            for i, p in enumerate(self.effect.parameters)
            if i == self.amplitude or not p.amplitude
        ]

    def response(self, active: ActiveEffect, change: FloatArray, others: FloatArray) -> FloatArray:
        """(p + unknowns of initial states,) coordinates of a linear refit with the effect held.

        change  (rows,) of the observations by the effect alone
        others  (n, rows) the same per unit of each of its free amplitudes
        """
        jacobian = jacobian_with_prior(self.fit)
        step = np.linalg.lstsq(np.column_stack([jacobian, -others.T]), change, rcond=None)[0]
        p, all_q = len(self.fit.q), jacobian.shape[1]
        values = np.array(active.values)
        amplitudes = [i for i, x in enumerate(self.effect.parameters) if x.amplitude]
        values[[i for i in amplitudes if i != self.amplitude]] += step[all_q:]
        q = extended(self.fit, self.space, self.effect, values)
        q[:p] += step[:p]
        q = np.clip(q, self.space.low, self.space.high)
        return np.concatenate([q, self.fit.solution.q[p:] + step[p:all_q]])

    def at(self, active: ActiveEffect, base: FloatArray | None) -> FloatArray:
        """Coordinates with the held parameters set, the others from `base`; None = from the fit."""
        q = extended(self.fit, self.space, self.effect, np.array(active.values))
        if base is None:
            return np.concatenate([q, self.fit.solution.q[len(self.fit.q) :]])
        moved = base.copy()
        moved[self._held] = q[self._held]
        return moved

    def refitted(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The model's coordinates refitted from q, the effect held as there, and the change.

        raises  UnsimulatedError: it cannot be simulated there
        """
        low, high = self.space.low.copy(), self.space.high.copy()
        low[self._held] = high[self._held] = q[self._held]
        space = replace(self.space, low=low, high=high)
        fit = fit_model(
            self.prepared, space, q[: len(space.names)], self.fit.initial_states, options=_REFIT
        )
        change = self.fit.solution.residual - fit.solution.residual
        return fit.solution.q, self._with_prior(fit.solution.q, change)

    def _with_prior(self, q: FloatArray, change: FloatArray) -> FloatArray:
        p, fit = len(self.fit.q), self.fit
        moved = np.concatenate([q[:p], q[len(self.space.names) :]]) - fit.solution.q
        return np.concatenate([change, -prior_root(fit) @ moved])


def all_changes(held: Sequence[HeldEffect], q: Sequence[FloatArray]) -> list[FloatArray]:
    """(rows,) change from the fit by each held effect at its q, simulated in one batch.

    held  of the same fit
    q     (p + unknowns of initial states,) of each
    """
    if not held:
        return []
    prepared, fit = held[0].prepared, held[0].fit
    trials = fit_trials(prepared)
    places = [(h, len(h.space.names), q_one) for h, q_one in zip(held, q, strict=True)]
    models = [fit.model, *(h.space.model(q_one[:p]) for h, p, q_one in places)]
    states = np.stack([fit.solution.q[len(fit.q) :], *(q_one[p:] for _, p, q_one in places)])
    white = prepared.white_near(trials, models, by_trial(prepared, trials, states))
    changes = white[0] - white[1:]
    return [h._with_prior(q_one, row) for (h, _, q_one), row in zip(places, changes, strict=True)]


CONFIDENCE = 0.95
#: Number of simulations of a limit, each moving it to where the effect is excluded; fewer if it
#: moves by less than this share.
ROUNDS, NEARLY = 3, 0.01
#: A limit within this many standard deviations of zero is linear: the slope at zero is exact.
NEAR = 0.3
#: A shape of an effect is excluded if it explains less than the best shape by this χ², and by this
#: share of what the best explains (slopes at zero are inaccurate for a strong effect).
TIE, TIE_SHARE = 9.0, 0.25
#: No refit is needed if the other parameters respond to the effect as their slopes predict, within
#: this share of the effect's change that they cannot imitate.
AS_PREDICTED = 0.1
#: Most refits of an end; it has converged if ln of its size changes by less than this.
REFITS, SETTLED = 3, 0.1
#: Steepest credible slope of a refitted end by the size at which the effect is held.
STEEPEST = 3.0


@dataclass(eq=False)
class Side:
    """One end of the interval of an amplitude; `size` is its distance from no effect.

    sign    of the side
    std     of the amplitude
    values  of the effect's parameters: the guess of its shape with the largest limit
    rows    (n, values) slopes of its other amplitudes; others: basis of what they can imitate
    change  of the observations by the effect of this size; converged: further simulations change
            nothing; in_bounds: there is an end within the bounds
    first   the end by slopes at zero
    tried   (ln size, ln of the ratio of the next estimate to it) so far
    """

    sign: float
    size: float
    std: float
    values: FloatArray
    rows: FloatArray
    others: FloatArray
    first: float
    change: FloatArray | None = None
    converged: bool = False
    in_bounds: bool = True
    tried: list[tuple[float, float]] = field(default_factory=list)


class LimitSearch:
    """Search for the interval of one amplitude that a study does not exclude."""

    def __init__(
        self,
        slopes: Sensitivity,
        j: int,
        nuisance: Projection,
        systematic_error: SystematicError,
        inflation: float,
    ) -> None:
        self.effect = slopes.effect
        amplitudes = [i for i, p in enumerate(slopes.effect.parameters) if p.amplitude]
        self.which = amplitudes[j]
        self._parameter: Parameter = slopes.effect.parameters[self.which]
        self._nuisance = nuisance
        self._systematic_error = systematic_error
        self._inflation = inflation
        self._one_sided = one_sided(slopes.effect)
        tail = 1.0 - CONFIDENCE if self._one_sided else 0.5 * (1.0 - CONFIDENCE)
        self._reach = -float(normal_quantile(tail))
        p = self._parameter
        self._room = p.low - p.default, p.high - p.default
        self._sides = self._first_sides(slopes, j)

    def _first_sides(self, slopes: Sensitivity, j: int) -> list[Side]:
        """The farthest end on each side, by slopes, over shapes that fit about equally well."""
        tried: list[tuple[float, Side]] = []
        for shape, rows in enumerate(slopes.rows):
            rest = np.delete(rows, j, axis=0)
            basis = orthonormal(self._nuisance.remove(rest).T, 1e-8, of_largest=True)
            orthogonal = self._not_imitated(rows[j], basis)
            if not is_distinct(orthogonal, rows[j]):
                continue
            size, std = self._estimate(orthogonal)
            square = float(orthogonal @ orthogonal) / self._inflation
            explained = square * (max(size, 0.0) if self._one_sided else size) ** 2
            for sign in (1.0,) if self._one_sided else (-1.0, 1.0):
                end = self._end(sign, size, std)
                side = Side(sign, end, std, slopes.values[shape], rest, basis, end)
                tried.append((explained, side))
        best = max((explained for explained, _ in tried), default=0.0)
        least = best - max(TIE, TIE_SHARE * best)
        plausible = [side for explained, side in tried if explained >= least]
        return [
            max((s for s in plausible if s.sign == sign), key=lambda s: s.sign * s.size)
            for sign in sorted({s.sign for s in plausible})
        ]

    def _not_imitated(self, row: FloatArray, others: FloatArray) -> FloatArray:
        """Part of a change that the other parameters cannot imitate."""
        orthogonal = self._nuisance.remove(row)
        return np.asarray(orthogonal - (orthogonal @ others) @ others.T)

    def _estimate(self, change: FloatArray) -> tuple[float, float]:
        """Estimated size and its standard deviation, from the change per unit of the amplitude."""
        square = float(change @ change)
        size = float(change @ self._nuisance.residual) / square
        factor = self._inflation + self._systematic_error.variance(change) / square
        return size, float(np.sqrt(max(factor, self._disagreement(change, size, factor)) / square))

    def _disagreement(self, orthogonal: FloatArray, size: float, expected: float) -> float:
        """Cochran's Q over its degrees of freedom: disagreement of the trials on the size.

        `expected` where the disagreement is not significant.
        """
        parts = zip(
            self._systematic_error.by_trial(orthogonal),
            self._systematic_error.by_trial(self._nuisance.residual),
            strict=True,
        )
        information, score = np.array([(row @ row, row @ residual) for row, residual in parts]).T
        informative = information > LEAST_KNOWN * information.sum()
        dof = int(informative.sum()) - 1
        if dof < MIN_FREEDOM:
            return expected
        q = float(np.sum((score - size * information)[informative] ** 2 / information[informative]))
        disagree = float(chi2_sf(dof, q / expected)) < 1.0 - CONFIDENCE
        return q / dof if disagree else expected

    def _end(self, sign: float, size: float, std: float) -> float:
        """End of the range on a side, as distance from zero."""
        return (max(size, 0.0) if self._one_sided else size) + sign * self._reach * std

    def open_sides(self) -> list[Side]:
        """Ends that are within the parameter's bounds, and so are to be simulated."""
        low, high = self._room
        for side in self._sides:
            side.in_bounds = side.in_bounds and low < side.size < high
        return [side for side in self._sides if side.in_bounds]

    def active(self, side: Side) -> ActiveEffect:
        """The effect with the size of an end, its other amplitudes zero."""
        values = side.values.copy()
        for k, p in enumerate(self.effect.parameters):
            if p.amplitude:
                values[k] = p.default + (side.size if k == self.which else 0.0)
        return ActiveEffect(self.effect, tuple(map(float, values)))

    def update(self, side: Side, change: FloatArray) -> None:
        """Move an end to where it is excluded, by the simulated change of the effect at the end."""
        if not np.all(np.isfinite(change)):
            side.in_bounds = False
            return
        side.change = change
        if self.exact(side):
            side.converged = True
            return
        row = self._with_prior(change) / side.size
        orthogonal = self._not_imitated(row, side.others)
        if not is_distinct(orthogonal, row):
            side.in_bounds = False
            return
        before = side.size
        self._step(side, self._end(side.sign, *self._estimate(orthogonal)))
        side.converged = abs(side.size - before) < NEARLY * abs(before)

    def exact(self, side: Side) -> bool:
        """Whether an end is so near to zero that the slope at zero is exact."""
        return side.change is None or abs(side.first) < NEAR * side.std

    def response(self, side: Side, held: HeldEffect) -> FloatArray:
        """Coordinates of all other parameters, by their slopes, with the effect at an end."""
        assert side.change is not None
        return held.response(self.active(side), self._with_prior(side.change), side.rows)

    def confirm(self, side: Side, held: HeldEffect, q: FloatArray, change: FloatArray) -> None:
        """Keep an end if the other parameters respond as their slopes predict; if not, refit there.

        change  of the observations, simulated at the response q
        """
        assert side.change is not None
        predicted = self._not_imitated(self._with_prior(side.change), side.others)
        off = self._not_imitated(change, side.others) - predicted
        if float(np.linalg.norm(off)) < AS_PREDICTED * float(np.linalg.norm(predicted)):
            return
        self._refit(side, held, q if np.all(np.isfinite(off)) else None)

    def _refit(self, side: Side, held: HeldEffect, q: FloatArray | None) -> None:
        """Move an end to where the effect is excluded with all other parameters refitted."""
        side.tried = []
        for _ in range(REFITS):
            try:
                q, change = held.refitted(held.at(self.active(side), q))
            except UNSIMULATED:
                side.in_bounds = False
                return
            size, std = self._estimate(change / side.size)
            end = self._end(side.sign, size, std)
            ratio = end / side.size
            if ratio > 0.0 and abs(np.log(ratio)) < SETTLED:
                self._move(side, end)
                return
            self._step(side, end)
            if not ratio > 0.0 or side not in self.open_sides():
                return

    def _step(self, side: Side, end: float) -> None:
        """Move an end towards its new estimate; by less where the last move went too far.

        A strong effect is nonlinear in the other parameters: the estimate can be far too small at
        one size, and far too large at the next.
        """
        ratio = end / side.size
        if not ratio > 0.0:
            self._move(side, end)
            return
        side.tried.append((float(np.log(abs(side.size))), float(np.log(ratio))))
        self._move(side, side.size * float(np.exp(_further(side.tried))))

    def _with_prior(self, change: FloatArray) -> FloatArray:
        """A change padded with zeros for the prior's rows."""
        return np.pad(change, (0, len(self._nuisance.residual) - len(change)))

    def _move(self, side: Side, size: float) -> None:
        if side.change is not None:
            side.change = side.change * (size / side.size)
        side.size = size

    def limit(self, prepared: PreparedStudy) -> Limit:
        """The limit of the amplitude; with None for ends that are not within the bounds."""
        p = self._parameter
        low, high = self._room
        complete = bool(self._sides) and all(
            s.in_bounds and s.change is not None and low < s.size < high for s in self._sides
        )
        if not complete:
            return Limit(self.effect.name, p.name, p.unit, None, None, None)
        ends = [p.default + s.size for s in self._sides]
        tip_m = max(_tip_m(prepared, s.change) for s in self._sides if s.change is not None)
        lowest = p.default if self._one_sided else ends[0]
        return Limit(self.effect.name, p.name, p.unit, lowest, ends[-1], tip_m)


def _further(tried: Sequence[tuple[float, float]]) -> float:
    """Step of ln size towards ln ratio = 0, from (ln size, ln ratio) so far."""
    size, ratio = tried[-1]
    slope = -1.0
    if len(tried) > 1 and size != tried[-2][0]:
        slope = (ratio - tried[-2][1]) / (size - tried[-2][0])
        slope = float(np.clip(slope, -STEEPEST, -1.0 / STEEPEST))
    return -ratio / slope


def _tip_m(prepared: PreparedStudy, change: FloatArray) -> float:
    """Largest distance that a whitened change of the fit trials moves the outermost marker by."""
    tip = int(np.argmax(prepared.study.arc_length_m))
    by_trial = prepared.by_trial(fit_trials(prepared), change)
    moved = [prepared.whiteners[name].error_m(rows)[:, tip] for name, rows in by_trial.items()]
    distance = [np.sqrt(np.nansum(m**2, axis=-1)) for m in moved]
    return max(float(d.max(initial=0.0)) for d in distance)


#: Number of jobs per core.
PER_CORE = 2


def limits(
    joint: AllTrialsFit, effects: Sequence[type[Effect]], progress: Progress = no_progress
) -> tuple[Limit, ...]:
    """95 % limits of the amplitudes of effects given a fitted model, each effect alone.

    The limit follows from the score's estimate and standard deviation, with all fitted parameters
    and the effect's other amplitudes free; the largest of the shapes that fit about equally well.
    It is widened by the residual's excess over noise, or by the trials' disagreement on the size.
    Then the effect is simulated at its limit, which corrects for nonlinearity.  Where the other
    parameters do not respond as their slopes predict, they are refitted with the effect held there
    (profile likelihood).

    The limit of a one-sided amplitude is one-sided, and a negative estimate counts as zero: no
    limit is below what the study can detect (a power-constrained limit).
    """
    progress("how strong other effects could be")
    prepared, fit, mesh = joint.prepared, joint.fit, joint.systematic_error.mesh
    whiteners = [prepared.whiteners[t.name] for t in fit_trials(prepared)]
    nuisance = nuisance_of(fit).moved(mesh)
    inflation = variance_inflation(nuisance.residual[: len(mesh)], whiteners, len(fit.q))
    done = itertools.count(1)

    def of_some(some: Sequence[type[Effect]]) -> tuple[Limit, ...]:
        """Limits of some effects, simulated together on one core."""
        alone = prepared.on_one_core()
        searches = [
            LimitSearch(slopes, j, nuisance, joint.systematic_error, inflation)
            for slopes in replace(joint, prepared=alone).sensitivities(some)
            for j in range(slopes.rows.shape[1])
        ]
        for _ in range(ROUNDS):
            sides = [(s, side) for s in searches for side in s.open_sides() if not side.converged]
            if not sides:
                break
            moved_rows = changes(alone, fit, [s.active(side) for s, side in sides])
            for (search, side), change in zip(sides, moved_rows, strict=True):
                search.update(side, change)
        nonlinear = [
            (search, side, HeldEffect(alone, fit, search.effect, search.which))
            for search in searches
            for side in search.open_sides()
            if not search.exact(side)
        ]
        q = [search.response(side, held) for search, side, held in nonlinear]
        simulated = all_changes([held for _, _, held in nonlinear], q)
        for (search, side, held), response, change in zip(nonlinear, q, simulated, strict=True):
            search.confirm(side, held, response, change)
        return tuple(search.limit(alone) for search in searches)

    # some effects take far longer than others
    count = min(len(effects), PER_CORE * threads()) if threads() > 1 else 1
    jobs = [effects[i::count] for i in range(count)]
    known_effects = (*fit.space.effects, *effects)
    with side_by_side(prepared.work, [of_some], known_effects, len(jobs)) as pool:
        groups = pool.map(
            of_some,
            jobs,
            lambda _: (),
            lambda *_: progress("how strong other effects could be", next(done), len(jobs)),
        )
    by_effect = itertools.groupby(itertools.chain(*groups), key=lambda limit: limit.effect)
    limits_of = {name: tuple(of_it) for name, of_it in by_effect}
    for effect in effects:
        if effect.name not in limits_of:
            prepared.work.leave_out(f"the limit of {effect.name}")
    return tuple(limit for effect in effects for limit in limits_of.get(effect.name, ()))
