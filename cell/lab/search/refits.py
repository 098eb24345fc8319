"""A model refitted with one effect more, for several effects side by side on all cores."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.lab.data.work import Progress, side_by_side
from cell.lab.fit.sensitivity import shapes_of
from cell.lab.search.extension import ENOUGH_PASSES, Extension, continued
from cell.lab.search.fitted_model import POLISH, REFIT, FittedModel, error_text
from cell.lab.search.screen import ScreenedEffect

#: So many of the first refits, those that promise most, are taken to convergence.
POLISHED = 3
#: A first refit is given up if it is soon far above the best of the first few effects, which are
#: the likeliest by the screen.
FIRST = 2
#: Far above the best is an objective so many times as large, if so much of the fall is missing that
#: the best effect brings.  A refit with a strong effect that misses a hundredth of the fall may be
#: ten times above the best, and yet end as low when it is taken on.
FAR_ABOVE, FAR_FROM_FALL = 10.0, 0.1


@dataclass(frozen=True)
class _Refit:
    """An effect with which a model is to be fitted."""

    effect: type[Effect]
    options: Options = REFIT


@dataclass(frozen=True, eq=False)
class Refits:
    """Refits of a model with one effect more.  A user's own effects are all taken to convergence.

    screens   by effect
    offered   effects that what is fitted may have
    earlier   models of an earlier search, as `models`: fits begin there
    models    by their effects' names: what is known; results are added to it
    polished  those that gain nothing by being taken on; added to, too
    """

    extension: Extension
    screens: Mapping[str, Sequence[ScreenedEffect]]
    offered: Sequence[type[Effect]]
    earlier: Mapping[frozenset[str], FittedModel]
    models: dict[frozenset[str], FittedModel]
    polished: set[frozenset[str]]
    progress: Progress

    def with_each(self, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The model with each of the effects that it can be simulated with from some start."""
        prepared, models = self.extension.prepared, self.models
        work = prepared.work
        unknown = [e for e in effects if self._key(e) not in models]
        unknown = [e for e in unknown if work.affords(f"a fit with {self._name(e)}")]
        done = itertools.count(len(effects) - len(unknown) + 1)

        def refitted(job: _Refit) -> FittedModel | None:
            if known := self.earlier.get(self._key(job.effect)):
                at_once = replace(job.options, above=(job.options.above[0], 1))
                with contextlib.suppress(*UNSIMULATED):
                    again = continued(prepared, known, at_once)
                    return self.extension.at_least_nested(again, job.options)
            return self.extension.by(job.effect, self.screens[job.effect.name], job.options)

        def taken_on(model: FittedModel) -> FittedModel:
            with contextlib.suppress(*UNSIMULATED):  # it ended where hardly anything is simulated
                return continued(prepared, model, POLISH)
            return model

        def not_fitted(job: _Refit) -> FittedModel | None:
            work.leave_out(f"a fit with {self._name(job.effect)}")
            return None

        def was_fitted(job: _Refit, model: FittedModel | None) -> None:
            if model is not None:
                models[model.names] = model
            text = f"refitted with {self._name(job.effect)}, {self._error_fall(effects)}"
            self.progress(text, next(done), len(effects))

        def was_taken_on(_: FittedModel, model: FittedModel) -> None:
            models[model.names] = model
            if model.fit.solution.iterations < POLISH.max_iterations:  # it gained no more
                self.polished.add(model.names)

        text = f"refitting with one effect more, {self._error_fall(effects)}"
        self.progress(text, len(effects) - len(unknown), len(effects))
        functions = (refitted, taken_on)
        with side_by_side(prepared.work, functions, self.offered, len(unknown)) as pool:
            first = [_Refit(e) for e in unknown if e in effects[:FIRST] or e.file is not None]
            pool.map(refitted, first, not_fitted, was_fitted)
            begun = [job.effect for job in first]
            above = (self._far([*effects[:FIRST], *begun]), ENOUGH_PASSES)
            hurried = replace(REFIT, above=above)
            # those with most shapes take longest, and so begin first
            rest = [_Refit(e, hurried) for e in unknown if e not in begun]
            by_shapes = sorted(rest, key=lambda j: -shapes_of(j.effect))
            pool.map(refitted, by_shapes, not_fitted, was_fitted)
            found = self._fitted(effects)
            rough = self._to_take_on(found, self._far(effects))
            if rough and not work.spent:
                pool.map(taken_on, rough, lambda model: model, was_taken_on)
        return [models[c.names] for c in found]

    def _error_fall(self, effects: Sequence[type[Effect]]) -> str:
        """How far the error has fallen by now, for who watches."""
        base_m = self.extension.base.fit.rms_m
        least_m = min((c.fit.rms_m for c in self._fitted(effects)), default=base_m)
        return error_text(self.extension.prepared, base_m, min(base_m, least_m))

    def _name(self, effect: type[Effect]) -> str:
        return " and ".join((*sorted(self.extension.base.names), effect.name))

    def _key(self, effect: type[Effect]) -> frozenset[str]:
        return frozenset({*self.extension.base.names, effect.name})

    def _fitted(self, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """What is known with these effects."""
        return [c for e in effects if (c := self.models.get(self._key(e))) is not None]

    def _far(self, effects: Sequence[type[Effect]]) -> float:
        """Objective from which a refit is far above the best with these effects."""
        fitted = self._fitted(effects)
        if not fitted:
            return np.inf
        best = min(c.fit.objective for c in fitted)
        fall = self.extension.base.fit.objective - best
        return max(FAR_ABOVE * best, best + FAR_FROM_FALL * fall)

    def _to_take_on(self, found: Sequence[FittedModel], far: float) -> list[FittedModel]:
        """The likeliest, unless they are far above the best, and all with a user's own effect."""
        ordered = sorted(found, key=lambda c: -c.promised_evidence)
        return [
            c
            for place, c in enumerate(ordered)
            if (place < POLISHED and self._unpolished(c, far))
            or (c.effects[-1].file is not None and self._unpolished(c, np.inf))
        ]

    def _unpolished(self, model: FittedModel, far: float) -> bool:
        """Whether a model is worth to be taken to convergence, and never was."""
        if model.fit.solution.converged_or_idle or model.names in self.polished:
            return False
        return model.fit.objective <= far
