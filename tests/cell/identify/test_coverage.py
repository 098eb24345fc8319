"""A small run of `coverage_study`: the study itself, and its bars on few cables."""

import numpy as np

from cell.identify.individual import IdentifyOptions
from tools.studies.coverage_study import photographed, study
from tools.worlds.fast_truth import Errors


def test_intervals_cover_and_errors_are_small() -> None:
    outcomes = study(48, 1, Errors(), IdentifyOptions())
    rigidity = np.concatenate([o.rigidity_error for o in outcomes])
    assert np.sqrt(np.mean(rigidity**2)) < 0.02
    assert np.abs(rigidity).max() < 0.06
    assert max(abs(o.viscosity_error) for o in outcomes) < 0.03
    covered = [
        [np.mean(o.rigidity_covered), o.exponent_covered, o.viscosity_covered] for o in outcomes
    ]
    # 40 of 48 happens to right 95 % intervals once in 500 times
    assert np.all(np.mean(covered, axis=0) > 40 / 48)
    assert np.mean([o.inflation for o in outcomes]) < 1.5


def test_from_rendered_pictures() -> None:
    outcome = study(1, 2, Errors(), IdentifyOptions(), photographed)[0]
    assert np.abs(outcome.rigidity_error).max() < 0.05
    assert abs(outcome.viscosity_error) < 0.15
    assert abs(outcome.exponent_error) < 0.01


def test_an_error_nobody_allows_for_is_not_covered() -> None:
    """The study can fail: nodes bent by ten times what vision is believed to do."""
    errors = Errors(across_m=6e-5)
    outcomes = study(4, 3, errors, IdentifyOptions())
    assert np.mean(np.concatenate([o.rigidity_covered for o in outcomes])) < 0.9
