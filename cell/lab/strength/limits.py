"""95 % limits of the size of effects that the diagnosis of a study does not name."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect, Effect, Parameter
from cell.cable.solver import threads
from cell.identify.fit import variance_inflation
from cell.identify.gauss_newton import UNSIMULATED
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Limit
from cell.lab.data.work import Progress, no_progress, side_by_side
from cell.lab.fit.all_trials_fit import AllTrialsFit
from cell.lab.fit.fitting import fit_trials
from cell.lab.fit.projection import Projection, nuisance_of, orthonormal
from cell.lab.fit.sensitivity import Sensitivity, changes, one_sided
from cell.lab.fit.systematic_error import SystematicError
from cell.lab.strength.estimate import LEAST_KNOWN, MIN_FREEDOM
from cell.lab.strength.held import HeldEffect, all_changes

CONFIDENCE = 0.95
#: A limit is simulated, and moved to where the effect so strong is excluded, this often; not again
#: if that was by less than this share.
ROUNDS, NEARLY = 3, 0.01
#: Less of a sensitivity than this share is not told from what the other parameters do.
LEAST_LEFT = 1e-6
#: Nearer to none of the effect than this many standard deviations its slope at zero is exact.
NEAR = 0.3
#: A guess of an effect's shape that explains less than the best by this χ² is not its shape; nor by
#: this share of what the best explains: slopes at none of an effect promise what a strong one
#: explains no better.
TIE, TIE_SHARE = 9.0, 0.25
#: Where everything else answers an effect as its slopes promise, give or take this share of what is
#: left of the effect, no refit is needed.
AS_PROMISED = 0.1
#: Refits of an end, at most; it is found if the next would be nearer than this, in logarithm.
REFITS, SETTLED = 3, 0.1
#: Steepest slope believed of how a refitted end depends on where it is held.
STEEPEST = 3.0


@dataclass(eq=False)
class Side:
    """One end of the interval of an amplitude; `size` is its distance from no effect.

    sign    of the side
    std     of the amplitude
    values  of the effect's parameters: the guess of its shape that puts the end farthest out
    rows    (n, values) slopes of its other amplitudes; others: basis of what they can imitate
    change  of what is seen, by the effect so strong; converged: further simulations change
            nothing; seen: there is an end within the bounds
    first   the end by slopes at none of the effect
    tried   (ln size, ln of how many times farther out it then seemed to be) so far
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
    seen: bool = True
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
        self._room = (
            self._parameter.low - self._parameter.default,
            self._parameter.high - self._parameter.default,
        )
        self._sides = self._first_sides(slopes, j)

    def _first_sides(self, slopes: Sensitivity, j: int) -> list[Side]:
        """The farthest end on each side, by slopes, over guesses of its shape that fit as well."""
        tried: list[tuple[float, Side]] = []
        for shape, rows in enumerate(slopes.rows):
            rest = np.delete(rows, j, axis=0)
            basis = orthonormal(self._nuisance.remove(rest).T, 1e-8, of_largest=True)
            left = self._not_imitated(rows[j], basis)
            if not float(np.linalg.norm(left)) > LEAST_LEFT * float(np.linalg.norm(rows[j])):
                continue
            size, std = self._estimate(left)
            square = float(left @ left) / self._inflation
            explained = square * (max(size, 0.0) if self._one_sided else size) ** 2
            for sign in (1.0,) if self._one_sided else (-1.0, 1.0):
                end = self._end(sign, size, std)
                side = Side(sign, end, std, slopes.values[shape], rest, basis, end)
                tried.append((explained, side))
        best = max((explained for explained, _ in tried), default=0.0)
        least = best - max(TIE, TIE_SHARE * best)
        kept = [side for explained, side in tried if explained >= least]
        return [
            max((s for s in kept if s.sign == sign), key=lambda s: s.sign * s.size)
            for sign in sorted({s.sign for s in kept})
        ]

    def _not_imitated(self, row: FloatArray, others: FloatArray) -> FloatArray:
        """What the other parameters do not imitate of a change."""
        left = self._nuisance.remove(row)
        return np.asarray(left - (left @ others) @ others.T)

    def _estimate(self, left: FloatArray) -> tuple[float, float]:
        """Expected size and its standard deviation, by what is seen per unit of the amplitude."""
        square = float(left @ left)
        size = float(left @ self._nuisance.residual) / square
        factor = self._inflation + self._systematic_error.variance(left) / square
        return size, float(np.sqrt(max(factor, self._disagreement(left, size, factor)) / square))

    def _disagreement(self, left: FloatArray, size: float, expected: float) -> float:
        """Cochran's Q over its degrees of freedom: by how much trials ask for sizes of their own.

        Where that is no more than chance may do, `expected`.
        """
        parts = zip(
            self._systematic_error.by_trial(left),
            self._systematic_error.by_trial(self._nuisance.residual),
            strict=True,
        )
        known, asked = np.array([(one @ one, one @ residual) for one, residual in parts]).T
        telling = known > LEAST_KNOWN * known.sum()
        dof = int(telling.sum()) - 1
        if dof < MIN_FREEDOM:
            return expected
        q = float(np.sum((asked - size * known)[telling] ** 2 / known[telling]))
        disagree = float(chi2_sf(dof, q / expected)) < 1.0 - CONFIDENCE
        return q / dof if disagree else expected

    def _end(self, sign: float, size: float, std: float) -> float:
        """End of the range on a side, from none of the effect."""
        return (max(size, 0.0) if self._one_sided else size) + sign * self._reach * std

    def open_sides(self) -> list[Side]:
        """Ends that are within the parameter's bounds, and so are to be simulated."""
        low, high = self._room
        for side in self._sides:
            side.seen = side.seen and low < side.size < high
        return [side for side in self._sides if side.seen]

    def active(self, side: Side) -> ActiveEffect:
        """The effect as strong as an end says, its other amplitudes off."""
        values = side.values.copy()
        for k, p in enumerate(self.effect.parameters):
            if p.amplitude:
                values[k] = p.default + (side.size if k == self.which else 0.0)
        return ActiveEffect(self.effect, tuple(map(float, values)))

    def simulated(self, side: Side, change: FloatArray) -> None:
        """Move an end to where it is excluded, by the change that the effect so strong makes."""
        if not np.all(np.isfinite(change)):
            side.seen = False
            return
        side.change = change
        if self.exact(side):
            side.converged = True
            return
        row = self._with_prior(change) / side.size
        left = self._not_imitated(row, side.others)
        if not float(np.linalg.norm(left)) > LEAST_LEFT * float(np.linalg.norm(row)):
            side.seen = False
            return
        before = side.size
        self._step(side, self._end(side.sign, *self._estimate(left)))
        side.converged = abs(side.size - before) < NEARLY * abs(before)

    def exact(self, side: Side) -> bool:
        """Whether an end is so near to none of the effect that its slope there is all there is."""
        return side.change is None or abs(side.first) < NEAR * side.std

    def answer(self, side: Side, held: HeldEffect) -> FloatArray:
        """Where everything else goes, by its slopes, with the effect at an end."""
        assert side.change is not None
        return held.answer(self.active(side), self._with_prior(side.change), side.rows)

    def confirm(self, side: Side, held: HeldEffect, q: FloatArray, change: FloatArray) -> None:
        """Keep an end if everything else answers the effect as promised; if not, refit there.

        change  of what is seen where it answers, at q
        """
        assert side.change is not None
        promised = self._not_imitated(self._with_prior(side.change), side.others)
        off = self._not_imitated(change, side.others) - promised
        if float(np.linalg.norm(off)) < AS_PROMISED * float(np.linalg.norm(promised)):
            return
        self._refit(side, held, q if np.all(np.isfinite(off)) else None)

    def _refit(self, side: Side, held: HeldEffect, q: FloatArray | None) -> None:
        """Move an end to where the effect held there, everything else refitted, is excluded."""
        side.tried = []
        for _ in range(REFITS):
            try:
                q, change = held.refitted(held.at(self.active(side), q))
            except UNSIMULATED:
                side.seen = False
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
        """Move an end towards where it seems to be; by less where the last move went too far.

        A strong effect bends what the other parameters do, so that the end seems much nearer than
        where it is, and from there much farther.
        """
        ratio = end / side.size
        if not ratio > 0.0:
            self._move(side, end)
            return
        side.tried.append((float(np.log(abs(side.size))), float(np.log(ratio))))
        self._move(side, side.size * float(np.exp(_further(side.tried))))

    def _with_prior(self, change: FloatArray) -> FloatArray:
        """A change that leaves the prior's rows as they are."""
        return np.pad(change, (0, len(self._nuisance.residual) - len(change)))

    def _move(self, side: Side, size: float) -> None:
        if side.change is not None:
            side.change = side.change * (size / side.size)
        side.size = size

    def limit(self, prepared: PreparedStudy) -> Limit:
        """What was found."""
        p = self._parameter
        low, high = self._room
        seen = bool(self._sides) and all(
            s.seen and s.change is not None and low < s.size < high for s in self._sides
        )
        if not seen:
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


#: Effects are shared out in so many parts for each core.
PER_CORE = 2


def limits(
    joint: AllTrialsFit, effects: Sequence[type[Effect]], progress: Progress = no_progress
) -> tuple[Limit, ...]:
    """95 % limits of the amplitudes of effects given a fitted model, each effect alone.

    The score's estimate and standard deviation, everything that was fitted and the effect's other
    amplitudes free, farthest out over the guesses of its shape that fit as well; widened by what
    the model leaves beyond noise, or by how much trials disagree on the size.  Then the effect is
    simulated so strong, and the limit moved to where it is excluded as it is and not as its slope
    says.  Where everything else does not answer it as slopes promise, all of it is fitted anew with
    the effect held there (profile likelihood).

    Of an amplitude of one sign the limit is one-sided, and an estimate below none of it counts as
    none: no limit is below what the study can show (a power-constrained limit).
    """
    progress("how strong other effects could be")
    prepared, fit, mesh = joint.prepared, joint.fit, joint.systematic_error.mesh
    whiteners = [prepared.whiteners[t.name] for t in fit_trials(prepared)]
    nuisance = nuisance_of(fit).moved(mesh)
    inflation = variance_inflation(nuisance.residual[: len(mesh)], whiteners, len(fit.q))
    done = itertools.count(1)

    def of_some(some: Sequence[type[Effect]]) -> tuple[Limit, ...]:
        return _limits_of(joint, nuisance, inflation, some)

    # some effects take far longer than others
    count = min(len(effects), PER_CORE * threads()) if threads() > 1 else 1
    jobs = [effects[i::count] for i in range(count)]
    known_effects = (*fit.space.effects, *effects)
    with side_by_side(prepared.work, [of_some], known_effects, len(jobs)) as pool:
        found = pool.map(
            of_some,
            jobs,
            lambda _: (),
            lambda *_: progress("how strong other effects could be", next(done), len(jobs)),
        )
    by_effect = itertools.groupby(itertools.chain(*found), key=lambda limit: limit.effect)
    known = {name: tuple(of_it) for name, of_it in by_effect}
    for effect in effects:
        if effect.name not in known:
            prepared.work.leave_out(f"the limit of {effect.name}")
    return tuple(limit for effect in effects for limit in known.get(effect.name, ()))


def _limits_of(
    joint: AllTrialsFit, nuisance: Projection, inflation: float, effects: Sequence[type[Effect]]
) -> tuple[Limit, ...]:
    """Limits of some effects, simulated together on one core.

    inflation  by which what the model leaves beyond noise widens variances
    """
    prepared, fit = joint.prepared.on_one_core(), joint.fit
    found = [
        LimitSearch(slopes, j, nuisance, joint.systematic_error, inflation)
        for slopes in replace(joint, prepared=prepared).sensitivities(effects)
        for j in range(slopes.rows.shape[1])
    ]
    for _ in range(ROUNDS):
        sides = [(s, side) for s in found for side in s.open_sides() if not side.converged]
        if not sides:
            break
        moved = changes(prepared, fit, [s.active(side) for s, side in sides])
        for (search, side), change in zip(sides, moved, strict=True):
            search.simulated(side, change)
    answered = [
        (search, side, HeldEffect(prepared, fit, search.effect, search.which))
        for search in found
        for side in search.open_sides()
        if not search.exact(side)
    ]
    q = [search.answer(side, held) for search, side, held in answered]
    changed = all_changes([held for _, _, held in answered], q)
    for (search, side, held), near, change in zip(answered, q, changed, strict=True):
        search.confirm(side, held, near, change)
    return tuple(search.limit(prepared) for search in found)
