"""The safe motion at which given effects show best, whether or not a study has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cell.cable.effects.base import after_number
from cell.identify.parameters import ParameterSpace
from cell.lab.data.rival import Rival
from cell.lab.fit.plausibility import is_no_model
from cell.lab.next.asked import AskedEffect
from cell.lab.next.suggest import distinguishing_motions, worth_a_cable
from cell.lab.next.suggestion import Suggestion
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.doubts import no_model_doubt
from cell.settings.surroundings import Surroundings


def asked_and_tried(effects: Sequence[str]) -> tuple[list[str], list[str]]:
    """Effects to design a motion for, and files of effects to try with the library.

    effects  NAME, NAME=SIZE, file.py=SIZE: of the first kind; file.py: of the second
    raises   ValueError: both kinds are given
    """
    tried = [given for given in effects if given.endswith(".py")]
    asked = [given for given in effects if not given.endswith(".py")]
    if asked and tried:
        raise ValueError(
            f"--try {tried[0]}: is tried beside the library, but {asked[0]} asks for a motion "
            f"that shows it; give {tried[0]}=SIZE for a motion that shows both, or leave one out"
        )
    return asked, tried


def showing_motion(
    fits: FitCache, asked: Sequence[AskedEffect], surroundings: Surroundings
) -> Suggestion:
    """The safe motion at which these effects differ most from what the model can do without them.

    An effect of which no size is given has its typical one.
    raises  ValueError: the study cannot be fitted, no motion keeps the limits, or none shows them
    """
    base = fits.base
    if is_no_model(fits.prepared, base.fit):
        raise ValueError(f"study {fits.prepared.study.name}: {no_model_doubt().message}")
    fit, name = base.fit, " + ".join(e.name for e in base.effects) or "baseline"
    without = Rival(name, fit.space, fit.q, fit.covariance)
    rivals = [without, *(_with(without, one) for one in asked)]
    found = distinguishing_motions(fits.prepared, rivals, surroundings, fits.progress)
    return worth_a_cable(found, fits.prepared)


def _with(rival: Rival, asked: AskedEffect) -> Rival:
    """The same with an effect whose size is known, so that only the cable's parameters are open."""
    parameter = asked.parameter
    size = asked.typical if asked.size is None else asked.size
    name = f"{asked.effect.name} ({parameter.name} {size:.3g}{after_number(parameter.unit)})"
    return replace(rival, name=name, space=_holding(rival.space, asked, size))


def _holding(space: ParameterSpace, asked: AskedEffect, size: float) -> ParameterSpace:
    effect = asked.effect
    names = (f"{effect.name}.{p.name}" for p in effect.parameters)
    held = tuple(zip(names, asked.at(size).values, strict=True))
    return replace(space, effects=(*space.effects, effect), exact=(*space.exact, *held))
