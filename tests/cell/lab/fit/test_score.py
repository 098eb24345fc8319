"""Score tests: right size under noise alone, and against textbook answers."""

import numpy as np
import pytest
from scipy import stats

from cell.cable.effects import library
from cell.lab.fit.projection import Projection
from cell.lab.fit.score_test import boundary_p_value, holm, score_test
from cell.lab.search.fitted_model import bic_penalty


def nuisance(residual, derivatives):
    return Projection.of(residual, derivatives, independent=1e-9)


def test_statistic_and_amplitude_equal_those_of_least_squares():
    rng = np.random.default_rng(1)
    baseline, effect = rng.normal(size=(200, 3)), rng.normal(size=200)
    y = baseline @ [1.0, -2.0, 0.5] + 0.7 * effect + rng.normal(size=200)
    score = score_test(nuisance(y, baseline), effect[None, None], one_sided=False)
    both = np.column_stack([baseline, effect])
    solution, square = np.linalg.lstsq(both, y, rcond=None)[:2]
    without = np.linalg.lstsq(baseline, y, rcond=None)[1]
    assert score.amplitude[0] == pytest.approx(solution[3])
    assert score.statistic == pytest.approx(float(without[0] - square[0]))
    assert score.std[0] == pytest.approx(np.sqrt(np.linalg.inv(both.T @ both)[3, 3]))


@pytest.mark.parametrize(("shapes", "one_sided"), [(1, False), (1, True), (4, True)])
def test_p_values_are_uniform_under_noise(shapes, one_sided):
    rng = np.random.default_rng(2)
    baseline = rng.normal(size=(60, 2))
    rows = rng.normal(size=(1, 1, 60)) + 0.7 * rng.normal(size=(shapes, 1, 60))
    p = [
        score_test(nuisance(rng.normal(size=60), baseline), rows, one_sided=one_sided).p_value
        for _ in range(400)
    ]
    for level in (0.05, 0.2):
        assert np.mean(np.array(p) < level) == pytest.approx(level, abs=3.5 * np.sqrt(level / 400))


def test_an_effect_that_the_baseline_imitates_explains_nothing():
    rng = np.random.default_rng(3)
    baseline = rng.normal(size=(50, 2))
    imitated = (baseline @ [1.0, 2.0])[None, None]
    score = score_test(nuisance(rng.normal(size=50), baseline), imitated, one_sided=False)
    assert (score.statistic, score.p_value) == (0.0, 1.0)


def test_several_shapes_are_offered_as_starts_unless_nearly_the_same():
    rng = np.random.default_rng(4)
    one, other = rng.normal(size=(2, 300))
    rows = np.array([one, one + 1e-3 * other, other])[:, None]
    y = 5.0 * one + 3.0 * other
    score = score_test(nuisance(y, np.zeros((300, 0))), rows, one_sided=False)
    assert score.shape in (0, 1)
    assert [shape for shape, _ in score.others] == [2]


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_amplitude_at_its_bound_halves_the_tail():
    assert boundary_p_value(3.84, 1, 1) == pytest.approx(0.5 * stats.chi2.sf(3.84, 1))
    assert boundary_p_value(3.84, 1, 0) == pytest.approx(0.05, abs=1e-3)
    assert boundary_p_value(-1.0, 1, 0) == 1.0
    assert boundary_p_value(0.5, 1, 0, shapes=5) == 1.0


def test_coloured_values_count_as_fewer():
    drag = [library()["air_drag"]]
    assert bic_penalty(drag, 1000, 1.0) > bic_penalty(drag, 1000, 0.1)
