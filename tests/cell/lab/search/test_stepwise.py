"""The search over sets of effects, against sets whose scores are given."""

from dataclasses import dataclass

import pytest

from cell.lab.search.stepwise import exchanged, in_order, levels, pruned

LIBRARY = "abcd"


@dataclass(frozen=True)
class Fitted:
    """A set of effects and how well it does."""

    names: frozenset[str]
    score: float


class Given:
    """A space whose scores are given; sets that are not named have a score of 0."""

    def __init__(self, scores: dict[str, float]) -> None:
        self._scores = {frozenset(k): v for k, v in scores.items()}
        self._known: dict[frozenset[str], Fitted] = {}
        self.fitted: list[str] = []

    def of(self, names: str | frozenset[str]) -> Fitted:
        key = frozenset(names)
        if key not in self._known:
            self.fitted.append("".join(sorted(key)))
            self._known[key] = Fitted(key, self._scores.get(key, 0.0))
        return self._known[key]

    def extended(self, model: Fitted) -> list[Fitted]:
        return [self.of(model.names | {e}) for e in LIBRARY if e not in model.names]

    def reduced(self, model: Fitted) -> list[Fitted]:
        return [self.of(model.names - {e}) for e in sorted(model.names)]


def best(model, options):
    found = max(options, key=lambda o: o.score)
    return [found] if found.score > model.score else []


def test_a_forward_search_keeps_the_best_of_each_level_until_none_is_better() -> None:
    space = Given({"a": 2.0, "b": 3.0, "ab": 4.0, "bc": 5.0})
    steps = ["".join(sorted(m.names)) for (m,) in levels(space.of(""), space.extended, best)]
    assert steps == ["", "b", "bc"]


def test_the_next_level_is_fitted_only_if_it_is_asked_for() -> None:
    space = Given({"a": 2.0})
    found = levels(space.of(""), space.extended, best)
    assert next(found) == [space.of("")]
    assert space.fitted == [""]
    next(found)
    assert space.fitted == ["", "a", "b", "c", "d"]


def test_an_exhaustive_search_has_every_set_of_a_level_once() -> None:
    space = Given({})
    sizes = [len(level) for level in levels(space.of(""), space.extended, lambda _, o: o)]
    assert sizes == [1, 4, 6, 4, 1]


def better(rest, options, model):
    found = max(options, key=lambda o: o.score)
    return found if found.score > model.score else None


def test_an_effect_that_stood_in_for_another_is_exchanged() -> None:
    space = Given({"ab": 4.0, "bc": 5.0, "cd": 6.0})
    assert exchanged(space, space.of("ab"), better, lambda: True).names == set("cd")


def test_nothing_is_exchanged_without_time_and_no_rest_is_tried_twice() -> None:
    space = Given({"ab": 4.0, "bc": 5.0})
    assert exchanged(space, space.of("ab"), better, lambda: False).names == set("ab")
    rests = []

    def noted(rest, options, model):
        rests.append(rest.names)
        return better(rest, options, model)

    exchanged(space, space.of("ab"), noted, lambda: True)
    assert len(rests) == len(set(rests))


@pytest.mark.parametrize(("alone", "kept"), [(4.0, "b"), (3.0, "ab")])
def test_an_effect_that_another_has_made_unnecessary_goes(alone: float, kept: str) -> None:
    space = Given({"ab": 4.0, "b": alone})
    found = pruned(space, space.of("ab"), lambda rest, model: rest.score < model.score)
    assert found.names == set(kept)


def test_in_order_each_step_lacks_what_the_rest_needs_least() -> None:
    space = Given({"abc": 9.0, "ab": 5.0, "bc": 7.0, "b": 4.0, "c": 6.0})
    steps = in_order(space, space.of("abc"), lambda m: m.score)
    assert ["".join(sorted(m.names)) for m in steps] == ["", "c", "bc", "abc"]
