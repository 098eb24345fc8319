"""When held-out trials confirm an effect, and when they cannot: by numbers alone."""

from dataclasses import replace

import pytest

from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.search.effect_search import Confirmation

RULES = DEFAULT_RULES
GIVEN = Confirmation(
    gain=RULES.heldout_gain + 1.0,
    fall_m2=2e-12,
    least_m2=1e-12,
    delta_chi2=1000.0,
    log_lr=lambda: RULES.heldout_gain + 1.0,
)


@pytest.mark.parametrize(
    ("change", "given"),
    [
        ({}, True),
        ({"gain": RULES.heldout_gain}, False),
        ({"fall_m2": 1e-12}, False),
        ({"log_lr": lambda: RULES.heldout_gain}, False),
    ],
)
def test_an_effect_is_confirmed_by_likelihood_by_error_and_by_itself(change, given):
    assert replace(GIVEN, **change).is_confirmed(RULES) is given


@pytest.mark.parametrize(
    ("change", "impossible"),
    [
        ({"log_lr": lambda: 0.5}, True),
        ({}, False),  # they see it
        ({"log_lr": lambda: 0.5, "delta_chi2": 5.0}, False),  # so do the others not see it plainly
        ({"log_lr": lambda: 0.5, "gain": -RULES.heldout_gain - 1.0}, False),  # they deny it
    ],
)
def test_trials_that_cannot_see_an_effect_neither_confirm_nor_deny_it(change, impossible):
    assert replace(GIVEN, **change).is_impossible(RULES) is impossible


def test_what_is_decided_without_it_is_not_simulated():
    def simulated() -> float:
        raise AssertionError("a simulation that nobody needs")

    assert not replace(GIVEN, gain=0.0, log_lr=simulated).is_confirmed(RULES)
    assert not replace(GIVEN, gain=-99.0, log_lr=simulated).is_impossible(RULES)
