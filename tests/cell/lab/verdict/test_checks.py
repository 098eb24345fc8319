"""The table of checks: the verdict is the worst of what failed, and every row can be read."""

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest

from cell.lab.data.check import Check, CheckOutcome, Reading, worst_verdict
from cell.lab.data.rules import DEFAULT_RULES, Rules
from cell.lab.line.learning_checks import GATES, LEARNING, LineRules
from cell.lab.verdict import check_statistics
from cell.lab.verdict.checks import CHECKS, LEAVES_NOISE, MAY_BE_CLAIMED, evaluate, explains
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.smooth_part import SmoothPart
from cell.study.independence import Independence

NAMES = [c.name for c in CHECKS]


def by_name(name: str) -> Check:
    return next(c for c in CHECKS if c.name == name)


@pytest.mark.parametrize("check", [*CHECKS, *LEARNING, *GATES], ids=lambda c: c.name)
def test_a_row_has_a_question_a_limit_a_sentence_and_a_reason(check):
    """Those of what many cables teach, too."""
    assert check.question.endswith("?") and len(check.question) <= 60
    assert check.unit
    assert check.failed.endswith(".") and check.failed[0].isupper()
    assert check.reason
    assert check.limit in {f.name for f in fields(Rules if check in CHECKS else LineRules)}
    assert (check.failing == "refused") == (check in GATES)
    assert check not in CHECKS or (check.failing == "unexplained") == (check in LEAVES_NOISE)


def test_names_are_unique():
    assert len(set(NAMES)) == len(NAMES)


@pytest.mark.parametrize(
    ("failed", "is_base", "verdict"),
    [
        ((), True, "complete"),
        ((), False, "missing"),
        (("ties",), False, "cannot_tell"),
        (("noise_unknown",), True, "cannot_tell"),
        (("wider_law",), False, "unexplained"),
        (("ties", "residual_level"), False, "unexplained"),
    ],
)
def test_the_verdict_is_the_worst_of_what_failed(failed, is_base, verdict):
    found = [CheckOutcome(c, Reading(0.0), c.name not in failed) for c in CHECKS]
    assert worst_verdict(found, is_base) == verdict


def test_what_does_not_apply_fails_nothing():
    assert worst_verdict([CheckOutcome(c, None, None) for c in CHECKS], is_base=True) == "complete"


@pytest.mark.parametrize(
    ("value", "passes", "passed"),
    [(1.0, "<=", True), (1.0, "<", False), (1.0, ">=", True), (1.0, ">", False)],
)
def test_a_limit_is_met_as_its_sign_says(value, passes, passed):
    check = Check("n", "?", "", lambda _: Reading(value), passes, "one", "cannot_tell", "", "")
    assert check.evaluate(SimpleNamespace(rules=SimpleNamespace(one=1.0))).passed is passed


def fake(**given):
    """Evidence of a study with held-out trials, at the noise, whose parts can be set."""
    noise = SimpleNamespace(std_m=1e-4)
    noise_model = SimpleNamespace(
        stated=False, noise=noise, allowed_over_level=None, dof_in=lambda _: np.inf
    )
    study = SimpleNamespace(role=lambda _: [1, 2])
    prepared = SimpleNamespace(
        noise_is_measured=True,
        noise_is_stated=False,
        noise_model=noise_model,
        expected=noise,
        expected_m=lambda _: 1e-4,
        noise_m=lambda _: 1e-4,
        study=study,
        count=lambda _: 1000,
    )
    exact = SimpleNamespace(square=lambda _: 0.0, residual_square=lambda *_: 0.0)
    fits = SimpleNamespace(
        prepared=prepared,
        added=lambda m: m.effects,
        prior_q=None,
        gripper_log_error=lambda: exact,
        rules=DEFAULT_RULES,
        is_below_stated=lambda _: False,
    )

    def candidate(rms_m: float, chi2: float, effects=()):
        heldout = SimpleNamespace(rms_m=rms_m, chi2=chi2, count=1000)
        fit = SimpleNamespace(rms_m=rms_m, chi2=chi2, q=np.zeros(5))
        return SimpleNamespace(fit=fit, heldout=heldout, effects=effects)

    fits.base = candidate(2e-4, 4000.0)
    final = candidate(*given.pop("final", (1e-4, 1000.0)))
    return Evidence(fits, final, given.pop("tied", {}))


@pytest.mark.parametrize(
    ("rms_m", "chi2", "passed"),
    [
        (1.00e-4, 1000.0, True),
        (1.03e-4, 1061.0, True),  # below the margin: models err by as much
        (1.08e-4, 1166.0, True),
        (1.15e-4, 1322.0, False),
    ],
)
def test_the_whole_error_must_be_noise_or_close_to_it(rms_m, chi2, passed):
    answer = by_name("residual_level").evaluate(fake(final=(rms_m, chi2)))
    assert answer.passed is passed


def test_a_fit_of_more_than_noise_explains_nothing_and_ends_the_questions():
    evidence = fake(final=(1.2e-4, 1440.0))
    assert not explains(evidence)
    asked = list(evaluate(evidence))
    assert [a.check.name for a in asked] == ["stated_error", "fitted_error"]
    assert worst_verdict(asked, is_base=False) == "unexplained"


def test_a_negligible_smooth_part_passes_whatever_its_chance(monkeypatch):
    part = SmoothPart(chi2=400.0, count=200.0, rows=100_000, dof=np.inf)
    before = SmoothPart(chi2=90_000.0, count=200.0, rows=100_000, dof=np.inf)
    evidence = fake()
    vars(evidence)["smooth_before"] = before
    monkeypatch.setattr(check_statistics, "without_systematic_error", lambda *_: part)
    assert part.p_value < 1e-6
    assert check_statistics.heldout_smooth(evidence).value == 1.0
    vars(evidence)["smooth_before"] = SmoothPart(500.0, 200.0, 100_000, np.inf)
    assert by_name("heldout_smooth").evaluate(evidence).passed is False


@pytest.mark.parametrize(("held_out", "passed"), [(2, True), (1, True), (0, False)])
def test_only_held_out_trials_of_other_motions_confirm(held_out, passed):
    evidence = fake(final=(1e-4, 1000.0, ["an effect"]))
    vars(evidence)["independence"] = Independence((("a",), ("b",)), (("a", "b"),), held_out)
    answer = by_name("confirmation").evaluate(evidence)
    assert (answer.reading.value, answer.passed) == (held_out, passed)


def test_ties_count_the_effect_itself():
    tied = {"a": ("b", "c"), "d": ()}
    assert check_statistics.most_tied(fake(tied=tied)).value == 3.0
    assert by_name("ties").evaluate(fake(tied=tied)).passed is True
    assert by_name("ties").evaluate(fake(tied={"a": ("b", "c", "d")})).passed is False


def test_every_row_of_what_may_be_claimed_is_asked_of_a_model_at_the_noise(monkeypatch):
    for name in ("without_systematic_error", "parameter_constancy_of"):
        monkeypatch.setattr(check_statistics, name, lambda *_: None)
    monkeypatch.setattr(check_statistics, "score_tests", lambda *_: {})
    evidence = fake()
    vars(evidence)["smooth_before"] = None
    object.__setattr__(evidence, "final", evidence.base)
    evidence.base.fit.rms_m = evidence.base.heldout.rms_m = 1e-4
    evidence.base.heldout.chi2 = 1000.0
    evidence.fits.library, evidence.base.names = {}, frozenset()
    evidence.base.chi2 = 0.0
    asked = [a.check.name for a in evaluate(evidence)]
    assert asked == [*(c.name for c in LEAVES_NOISE), *(c.name for c in MAY_BE_CLAIMED)]
