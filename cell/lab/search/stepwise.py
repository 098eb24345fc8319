"""Stepwise search for missing effects: sets of effects, one effect more at a time.

The search has two exchangeable parts.  A *space* fits sets of effects: to one study, to many
cables, or with a model's own error as noise.  It offers the sets with one effect more, and with one
less.  A *criterion* selects the set to continue with.

source  forward and backward selection with exchange: Miller 2002, Subset Selection in Regression;
        the parts kept apart as in PEtab Select (Pathirana et al. 2025)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol, TypeVar

from cell.lab.fit.score_test import holm
from cell.lab.search.fitted_model import FittedModel

State = TypeVar("State")
Option = TypeVar("Option")


class ModelSpace(Protocol[State]):
    """Sets of effects, fitted."""

    def extended(self, model: State) -> Sequence[State]:
        """The model with one effect more, for every effect that is worth a fit."""
        ...

    def reduced(self, model: State) -> Iterable[State]:
        """The model without one of its added effects, for each of them."""
        ...


def holm_among(p_values: Sequence[float], library: int) -> list[float]:
    """Holm-corrected p-values, where the untested rest of the library counts as p = 1.

    p_values  of those that were fitted
    library   number of effects to choose from (Holm's correction)
    """
    return holm([*p_values, *[1.0] * (library - len(p_values))])[: len(p_values)]


def levels(
    start: State,
    extended: Callable[[State], Sequence[Option]],
    select: Callable[[State, Sequence[Option]], Sequence[State]],
) -> Iterator[Sequence[State]]:
    """Yield the selected sets of each level, one effect more at each, until none is selected.

    A forward search selects one set per level, an exhaustive one all of them, each once.  The next
    level is fitted when it is requested.
    """
    level: Sequence[State] = [start]
    while level:
        yield level
        chosen = [new for state in level for new in select(state, extended(state))]
        level = list({id(state): state for state in chosen}.values())


def exchanged(
    space: ModelSpace[FittedModel],
    model: FittedModel,
    better: Callable[[FittedModel, Sequence[FittedModel], FittedModel], FittedModel | None],
    allowed: Callable[[], bool],
) -> FittedModel:
    """The model after exchanges of single effects for others, as long as each is better.

    An effect selected early was selected without the others, and may have replaced one of them.

    better   the better option, from the model without an effect, the options with another effect
             in its place, and the model itself; None if there is none
    allowed  whether there is time for another round
    """
    tried: set[frozenset[str]] = set()
    improved = True
    while improved and allowed():
        improved = False
        for without in space.reduced(model):
            if without.names in tried:
                continue
            tried.add(without.names)
            best = better(without, space.extended(without), model)
            if best is not None:
                model, improved = best, True
                break
    return model


def pruned(space: ModelSpace[State], model: State, needed: Callable[[State, State], bool]) -> State:
    """The model without effects that the others have made unnecessary.

    needed  whether an effect is needed, from the model without it and the model
    """
    for without in space.reduced(model):
        if not needed(without, model):
            return pruned(space, without, needed)
    return model


def in_order(
    space: ModelSpace[State], model: State, score: Callable[[State], float]
) -> list[State]:
    """Models from the start to `model`; backwards, each step drops the least needed effect."""
    steps = [model]
    while smaller := list(space.reduced(steps[0])):
        steps.insert(0, max(smaller, key=score))
    return steps
