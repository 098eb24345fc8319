"""How strong an effect could be that was not found: 95 % limits of its size in one study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri as normal_quantile

from cell.cable.effects.base import ActiveEffect, Effect, Parameter
from cell.identify.fit import variance_inflation
from cell.lab.diagnose import Examination
from cell.lab.doubts import interrupted_doubt
from cell.lab.estimate import CONVERGED, LEAST_KNOWN, MIN_FREEDOM
from cell.lab.explore import Explorer, Progress, no_progress
from cell.lab.fitting import Fit, fit_model, fit_trials
from cell.lab.prepared import PreparedStudy, StoppedError, pooled
from cell.lab.results import Limit
from cell.lab.score import Nuisance
from cell.lab.screen import Sensitivity, changes, nuisance_of, one_sided, sensitivities

FloatArray = NDArray[np.float64]

CONFIDENCE = 0.95
#: A limit is simulated, and moved to where the effect so strong is excluded, this often.
ROUNDS = 3
#: Less of a sensitivity than this share is not told from what the other parameters do.
LEAST_LEFT = 1e-6
#: Nearer to none of the effect than this many standard deviations its slope at zero is exact.
NEAR = 0.3


def with_limits(explorer: Explorer, examination: Examination) -> Examination:
    """The examination with limits of every effect that was tried and is neither named nor tied.

    None of an unexplained study: beside a wrong model the true effect would be excluded.  None,
    and a warning, where there is no time for them.
    """
    diagnosis = examination.diagnosis
    if diagnosis.verdict == "unexplained" or any(
        w.code == "interrupted" for w in diagnosis.warnings
    ):
        return examination
    try:
        return replace(
            examination, diagnosis=replace(diagnosis, limits=_limits(explorer, examination))
        )
    except StoppedError:
        explorer.prepared.work.stopped = False
        doubt = interrupted_doubt("how strong other effects could be was not computed")
        return replace(
            examination, diagnosis=replace(diagnosis, warnings=(*diagnosis.warnings, doubt))
        )


def _limits(explorer: Explorer, examination: Examination) -> tuple[Limit, ...]:
    """Limits of what the examination has neither named nor tied."""
    diagnosis = examination.diagnosis
    named = {n for f in (*diagnosis.missing, *diagnosis.partial) for n in (f.effect, *f.tied_with)}
    final = examination.final
    absent = [
        effect
        for name, effect in explorer.library.items()
        if name not in named and name not in final.names
    ]
    prepared, fit = examination.weighed, final.fit
    if any(t.role != "fit" for t in prepared.study.trials):
        prepared = pooled(prepared)
        fit = fit_model(prepared, fit.space, fit.q, fit.begun, options=CONVERGED)
    return limits(prepared, fit, absent, explorer.progress)


def limits(
    prepared: PreparedStudy,
    fit: Fit,
    effects: Sequence[type[Effect]],
    progress: Progress = no_progress,
) -> tuple[Limit, ...]:
    """95 % limits of the amplitudes of effects beside a fitted model, each effect alone.

    The score's estimate and standard deviation, everything that was fitted and the effect's other
    amplitudes free, of the guess of its shape that the study shows worst; widened by what the model
    leaves beyond noise, or by how much trials disagree on the size.  Then the effect is simulated
    so strong, and the limit moved to where it is excluded as it is and not as its slope says.

    Of an amplitude of one sign the limit is one-sided, and an estimate below none of it counts as
    none: no limit is below what the study can show (a power-constrained limit).
    fit   to the `fit` trials of `prepared`
    """
    progress("how strong other effects could be", 0, ROUNDS + 1)
    whiteners = [prepared.whiteners[t.name] for t in fit_trials(prepared)]
    inflation = variance_inflation(fit.solution.residual, whiteners, len(fit.q))
    nuisance = nuisance_of(fit)
    ends = np.cumsum([w.rows for w in whiteners])
    trials = tuple(slice(end - w.rows, end) for end, w in zip(ends, whiteners, strict=True))
    found = [
        _Search(slopes, j, nuisance, trials, inflation)
        for slopes in sensitivities(prepared, fit, effects)
        for j in range(slopes.rows.shape[1])
    ]
    for done in range(ROUNDS):
        progress("how strong other effects could be", done + 1, ROUNDS + 1)
        sides = [(s, i) for s in found for i in s.open_sides()]
        if not sides:
            break
        moved = changes(prepared, fit, [s.active(i) for s, i in sides])
        for (search, i), change in zip(sides, moved, strict=True):
            search.simulated(i, change)
    return tuple(search.limit(prepared) for search in found)


@dataclass(eq=False)
class _Side:
    """One end of the range of an amplitude, as far from none of the effect as `size` says."""

    size: float
    change: FloatArray | None = None
    seen: bool = True


class _Search:
    """The range of one amplitude of an effect that a study leaves possible."""

    def __init__(
        self,
        slopes: Sensitivity,
        j: int,
        nuisance: Nuisance,
        trials: Sequence[slice],
        inflation: float,
    ) -> None:
        self._effect = slopes.effect
        self._parameter: Parameter = [p for p in slopes.effect.parameters if p.amplitude][j]
        self._nuisance = nuisance
        self._trials = trials
        self._inflation = inflation
        self._one_sided = one_sided(slopes.effect)
        tail = 1.0 - CONFIDENCE if self._one_sided else 0.5 * (1.0 - CONFIDENCE)
        self._reach = -float(normal_quantile(tail))
        self._room = (
            self._parameter.low - self._parameter.default,
            self._parameter.high - self._parameter.default,
        )
        self._sides: list[_Side] = []
        tried = []
        for shape, rows in enumerate(slopes.rows):
            others = nuisance.remove(np.delete(rows, j, axis=0))
            basis = _orthonormal(others)
            estimate = self._estimate(rows[j], basis)
            if estimate is not None:
                size, std = estimate
                tried.append((abs(size) + self._reach * std, shape, basis, size, std))
        if not tried:
            return
        _, shape, self._others, size, self._std = max(tried, key=lambda t: t[0])
        self._values = slopes.values[shape]
        self._sides = [_Side(end) for end in self._ends(size, self._std)]

    def _estimate(self, row: FloatArray, others: FloatArray) -> tuple[float, float] | None:
        """Expected size and its standard deviation; None = the other parameters do the same."""
        left = self._nuisance.remove(row)
        left = left - (left @ others) @ others.T
        square = float(left @ left)
        if not np.sqrt(square) > LEAST_LEFT * float(np.linalg.norm(row)):
            return None
        size = float(left @ self._nuisance.residual) / square
        factor = max(self._inflation, self._disagreement(left, size))
        return size, float(np.sqrt(factor / square))

    def _disagreement(self, left: FloatArray, size: float) -> float:
        """Cochran's Q over its freedom: by how much trials ask for sizes of their own."""
        parts = [(left[rows], self._nuisance.residual[rows]) for rows in self._trials]
        known = np.array([float(one @ one) for one, _ in parts])
        asked = np.array([float(one @ residual) for one, residual in parts])
        telling = known > LEAST_KNOWN * known.sum()
        freedom = int(telling.sum()) - 1
        if freedom < MIN_FREEDOM:
            return 1.0
        return float(np.sum((asked - size * known)[telling] ** 2 / known[telling]) / freedom)

    def _ends(self, size: float, std: float) -> list[float]:
        """Ends of the range, from none of the effect."""
        if self._one_sided:
            return [max(size, 0.0) + self._reach * std]
        return [size - self._reach * std, size + self._reach * std]

    def open_sides(self) -> list[int]:
        """Ends that are within the parameter's bounds, and so are to be simulated."""
        low, high = self._room
        for side in self._sides:
            side.seen = side.seen and low < side.size < high
        return [i for i, side in enumerate(self._sides) if side.seen]

    def active(self, i: int) -> ActiveEffect:
        """The effect as strong as an end says, its other amplitudes off."""
        values = self._values.copy()
        for k, p in enumerate(self._effect.parameters):
            if p.amplitude:
                values[k] = p.default + (self._sides[i].size if p is self._parameter else 0.0)
        return ActiveEffect(self._effect, tuple(map(float, values)))

    def simulated(self, i: int, change: FloatArray) -> None:
        """Move an end to where it is excluded, by the change that the effect so strong makes."""
        side = self._sides[i]
        if not np.all(np.isfinite(change)):
            side.seen = False
            return
        side.change = change
        if abs(side.size) < NEAR * self._std:
            return
        prior = np.zeros(len(self._nuisance.residual) - len(change))
        estimate = self._estimate(np.concatenate([change, prior]) / side.size, self._others)
        if estimate is None:
            side.seen = False
            return
        new = self._ends(*estimate)[i]
        side.change = change * (new / side.size)
        side.size = new

    def limit(self, prepared: PreparedStudy) -> Limit:
        """What was found."""
        p = self._parameter
        low, high = self._room
        seen = bool(self._sides) and all(
            s.seen and s.change is not None and low < s.size < high for s in self._sides
        )
        if not seen:
            return Limit(self._effect.name, p.name, p.unit, None, None, None)
        ends = [p.default + s.size for s in self._sides]
        tip_m = max(_tip_m(prepared, s.change) for s in self._sides if s.change is not None)
        lowest = p.default if self._one_sided else ends[0]
        return Limit(self._effect.name, p.name, p.unit, lowest, ends[-1], tip_m)


def _orthonormal(rows: FloatArray) -> FloatArray:
    """(values, k) basis of the span of rows (n, values)."""
    if len(rows) == 0:
        return np.zeros((rows.shape[1], 0))
    u, size, _ = np.linalg.svd(rows.T, full_matrices=False)
    return np.asarray(u[:, size > 1e-8 * max(float(size[0]), 1e-300)])


def _tip_m(prepared: PreparedStudy, change: FloatArray) -> float:
    """Largest distance that a whitened change of the fit trials moves the outermost marker by."""
    tip = int(np.argmax(prepared.study.arc_length_m))
    largest, begin = 0.0, 0
    for trial in fit_trials(prepared):
        whitener = prepared.whiteners[trial.name]
        moved = whitener.error_m(change[begin : begin + whitener.rows])[:, tip]
        begin += whitener.rows
        distance = np.sqrt(np.nansum(moved**2, axis=-1))
        largest = max(largest, float(distance.max(initial=0.0)))
    return largest
