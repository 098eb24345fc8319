"""Limits, 95 %, of the strength of effects that were not found, in one study."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from cell.cable.effects.base import Effect
from cell.cable.solver import threads
from cell.identify.fit import variance_inflation
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.results import Limit
from cell.lab.data.side_by_side import side_by_side
from cell.lab.fit.all_trials_fit import AllTrialsFit
from cell.lab.fit.fitting import fit_trials
from cell.lab.fit.sensitivity import changes, nuisance_of
from cell.lab.statistics.score import Nuisance
from cell.lab.strength.held import HeldEffect, all_changes
from cell.lab.strength.limit_search import ROUNDS, LimitSearch

#: Effects are shared out in so many parts for each core.
PER_CORE = 2


def limits(
    whole: AllTrialsFit, effects: Sequence[type[Effect]], progress: Progress = no_progress
) -> tuple[Limit, ...]:
    """95 % limits of the amplitudes of effects beside a fitted model, each effect alone.

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
    common = _Common.of(whole)
    done = itertools.count(1)

    def of_some(some: Sequence[type[Effect]]) -> tuple[Limit, ...]:
        return _limits_of(common, some)

    # some effects take far longer than others
    count = min(len(effects), PER_CORE * threads()) if threads() > 1 else 1
    jobs = [effects[i::count] for i in range(count)]
    with side_by_side(whole.prepared.work, [of_some], common.effects(effects), len(jobs)) as beside:
        found = beside.map(
            of_some,
            jobs,
            _left_out,
            lambda *_: progress("how strong other effects could be", next(done), len(jobs)),
        )
    by_effect = itertools.groupby(itertools.chain(*found), key=lambda limit: limit.effect)
    known = {name: tuple(of_it) for name, of_it in by_effect}
    for effect in effects:
        if effect.name not in known:
            whole.prepared.work.leave_out(f"the limit of {effect.name}")
    return tuple(limit for effect in effects for limit in known.get(effect.name, ()))


def _left_out(some: Sequence[type[Effect]]) -> tuple[Limit, ...]:
    """Limits of effects for which the work does not suffice."""
    return ()


@dataclass(frozen=True, eq=False)
class _Common:
    """What the limits of all effects have in common.

    inflation  by which what the model leaves beyond noise widens variances
    """

    whole: AllTrialsFit
    nuisance: Nuisance
    inflation: float

    @staticmethod
    def of(whole: AllTrialsFit) -> _Common:
        prepared, fit, errs = whole.prepared, whole.fit, whole.systematic_error
        whiteners = [prepared.whiteners[t.name] for t in fit_trials(prepared)]
        nuisance = nuisance_of(fit).moved(errs.mesh)
        residual = nuisance.residual[: len(errs.mesh)]
        return _Common(whole, nuisance, variance_inflation(residual, whiteners, len(fit.q)))

    def effects(self, more: Iterable[type[Effect]]) -> tuple[type[Effect], ...]:
        """Those of the fitted model and more."""
        return (*self.whole.fit.space.effects, *more)


def _limits_of(common: _Common, effects: Sequence[type[Effect]]) -> tuple[Limit, ...]:
    """Limits of some effects, simulated together on one core."""
    whole = common.whole
    prepared, fit = whole.prepared.on_one_core(), whole.fit
    found = [
        LimitSearch(slopes, j, common.nuisance, whole.systematic_error, common.inflation)
        for slopes in replace(whole, prepared=prepared).sensitivities(effects)
        for j in range(slopes.rows.shape[1])
    ]
    for _ in range(ROUNDS):
        sides = [(s, side) for s in found for side in s.open_sides() if not side.settled]
        if not sides:
            break
        moved = changes(prepared, fit, [s.active(side) for s, side in sides])
        for (search, side), change in zip(sides, moved, strict=True):
            search.simulated(side, change)
    answered = [
        (search, side, HeldEffect.beside(prepared, fit, search.effect, search.which))
        for search in found
        for side in search.open_sides()
        if not search.exact(side)
    ]
    q = [search.answer(side, held) for search, side, held in answered]
    changed = all_changes([held for _, _, held in answered], q)
    for (search, side, held), near, change in zip(answered, q, changed, strict=True):
        search.confirm(side, held, near, change)
    return tuple(search.limit(prepared) for search in found)
