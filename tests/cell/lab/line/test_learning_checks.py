"""The tables of checks of what many cables teach: every row can be read, and fails as it says."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.identify.individual import CableRejectedError, IdentifyOptions, Reason
from cell.lab.line.effect_fit import LearningBudget, LearningResult
from cell.lab.line.learn import FITTED_TO, identified_cables, learned_from
from cell.lab.line.learning_checks import (
    LEARNING,
    learning_outcomes,
    learning_verdict,
)
from cell.lab.report.line_tables import learning_lines, learning_parts
from cell.lab.verdict.checks import CHECKS
from cell.workers.here import OneAfterAnother


def test_what_a_diagnosis_asks_too_has_the_same_name_and_means_the_same() -> None:
    diagnosis = {c.name: c.failing for c in CHECKS}
    same = {c.name: c.failing for c in LEARNING if c.name in diagnosis}
    assert set(same) == {"fitted_error", "ties", "noise_unknown"}
    assert same == {name: diagnosis[name] for name in same}


def result(rms_m: float = 1e-4, *, beyond_m: float = 0.0, allowed: float = 1.2) -> LearningResult:
    """Two cables without a missing effect, at a noise of 0.1 mm."""
    noise_model = SimpleNamespace(range_m=(9e-5, 1.1e-4), allowed_over_level=allowed, stated=False)
    cable = SimpleNamespace(noise=SimpleNamespace(std_m=1e-4), noise_model=noise_model)
    fit: Any = SimpleNamespace(
        rms_m=rms_m,
        noise_m=1e-4,
        cables=(cable, cable),
        end_offset_m=np.full(2, beyond_m),
        end_std_m=5e-5,
    )
    return LearningResult((), fit)


@pytest.mark.parametrize(
    ("given", "failed", "verdict"),
    [
        ({}, [], "complete"),
        ({"rms_m": 1.2e-4}, ["fitted_error"], "unexplained"),
        ({"beyond_m": 2e-4}, ["ends_beyond"], "unexplained"),
        ({"allowed": 2.5}, ["noise_unknown"], "cannot_tell"),
        ({"rms_m": 1.2e-4, "allowed": 2.5}, ["fitted_error", "noise_unknown"], "unexplained"),
    ],
)
def test_a_result_is_complete_only_if_every_question_is_answered_so(
    given: dict[str, float], failed: list[str], verdict: str
) -> None:
    found = result(**given)
    answers = learning_outcomes(found)
    assert [a.name for a in answers if a.passed is False] == failed
    assert learning_verdict(found, answers) == verdict
    assert ("the model is complete" in learning_lines(found)[-1]) == (verdict == "complete")
    assert str(learning_parts(found, [])[0]).startswith(f"Verdict {verdict}: ")


def test_a_complete_model_says_what_was_tried_and_what_it_does_not_exclude() -> None:
    first, last = learning_lines(result())
    assert first.endswith("the measured noise is 0.100 mm")
    assert last.startswith("no effect was tried, because the error beyond the noise is below 0.005")
    assert "complete for these cycles; smaller effects are possible (`cell diagnose`" in last
    tried = learning_lines(result(1.02e-4))[-1]
    assert tried.startswith("no effect of the library explains more than chance: the model is comp")


def test_nothing_is_complete_while_effects_were_left_out() -> None:
    found = replace(result(), left_out=("a fit with draught, for the limit",))
    assert learning_verdict(found, learning_outcomes(found)) == "cannot_tell"


def test_a_line_of_more_cables_than_are_learned_from_can_be_complete() -> None:
    """From the thirteenth cable on no model was complete, and "some were not tried" of effects."""
    found: Any = SimpleNamespace(model_error_m=1e-5)
    no_trials = SimpleNamespace(trials=())
    cables: Any = [
        (SimpleNamespace(name=f"c{i:02d}", held=1, executed=1, study=no_trials), found)
        for i in range(FITTED_TO + 1)
    ]
    budget = LearningBudget()
    assert len(learned_from(cables, budget)) == FITTED_TO
    (told,) = budget.cables
    assert told.startswith("c12: ")
    assert budget.left_out == []
    of_some = replace(result(), cables_left_out=(told,))
    assert learning_verdict(of_some, learning_outcomes(of_some)) == "complete"
    assert "the model is complete" in learning_lines(of_some)[-1]


@pytest.mark.parametrize(
    ("reason", "by_model"), [(Reason.UNSEEN_FRAMES, False), (Reason.NO_FIT, True)]
)
def test_a_cable_that_the_model_does_not_fit_leaves_a_doubt_of_it(
    reason: Reason, by_model: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rejected(*_: Any, **__: Any) -> None:
        raise CableRejectedError(reason, "…")

    monkeypatch.setattr("cell.lab.line.learn.identify", rejected)
    monkeypatch.setattr("cell.lab.line.learn._unfit", lambda _: None)
    cycle: Any = SimpleNamespace(
        name="c1", held=1, study=SimpleNamespace(arc_length_m=1, trials=()), cable=None
    )
    budget, options, nobody = LearningBudget(), IdentifyOptions(), OneAfterAnother()
    given: Any = None
    with pytest.raises(ValueError, match="c1: it cannot be identified"):
        identified_cables([cycle], given, options, lambda _: None, budget, nobody)
    assert (len(budget.left_out), len(budget.cables)) == ((1, 0) if by_model else (0, 1))
