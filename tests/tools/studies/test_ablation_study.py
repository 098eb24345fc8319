"""The verdict of a row, worked out of its statistics, with and without a check."""

import math

import pytest

from cell.lab.verdict.checks import CHECKS
from tools.studies.ablation_study import Row, answer, verdict

PASSING = {c.name: math.nan for c in CHECKS}


def row(kind="one", hidden="tip_mass", named="tip_mass", said="missing", **statistics):
    return Row(kind, "0", hidden, 1.0, said, named, statistics=PASSING | statistics)


def test_a_verdict_is_the_worst_of_the_statistics_that_fail():
    assert verdict(row()) == "missing"
    assert verdict(row(ties=5.0)) == "cannot_tell"
    assert verdict(row(ties=5.0, fitted_error=1.2)) == "unexplained"
    assert verdict(row(ties=5.0, fitted_error=1.2), "fitted_error") == "cannot_tell"
    assert verdict(row(ties=5.0), limits={"ties": 6.0}) == "missing"
    assert verdict(row(said="refused")) == "refused"


@pytest.mark.parametrize(
    ("kind", "hidden", "said", "named", "right"),
    [
        ("complete", "", "complete", "", "right"),
        ("complete", "", "unexplained", "", "wrong"),
        ("complete", "", "cannot_tell", "draught", "no answer"),
        ("complete", "", "refused", "", "no answer"),
        ("one", "tip_mass", "missing", "air_drag|tip_mass", "right"),
        ("one", "tip_mass", "missing", "air_drag", "wrong"),
        ("one", "tip_mass", "complete", "", "wrong"),
        ("one", "tip_mass", "unexplained", "", "no answer"),
        ("pair", "tip_mass+air_drag", "missing", "tip_mass", "no answer"),
        ("pair", "tip_mass+air_drag", "missing", "tip_mass+air_drag", "right"),
        ("outside", "jet", "missing", "draught", "wrong"),
        ("outside", "jet", "unexplained", "", "right"),
    ],
)
def test_an_answer_is_right_wrong_or_none(kind, hidden, said, named, right):
    assert answer(row(kind, hidden, named), said, named) == right
