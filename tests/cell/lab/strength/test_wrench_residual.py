"""A wrench beside a model's: what is noise, what is systematic, in newtons; and on the page."""

from dataclasses import replace

import numpy as np
import pytest

from cell.api.results import CompareResult
from cell.lab.report.figures import Series, history
from cell.lab.report.report import comparison_page
from cell.lab.report.wrench_report import wrench_overlay, wrenches_table
from cell.lab.strength.compare import compare_model
from tools.worlds.made_studies import random_model
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import rig_study

RIG = KINDS["wrench"](2)


@pytest.fixture(scope="module")
def study():
    made = rig_study(RIG, None)
    last = replace(made.trials[3], wrench=None)  # not every trial needs one
    return replace(made, trials=(made.trials[0], last))


@pytest.fixture(scope="module")
def truth():
    return random_model(np.random.default_rng([RIG.seed, 2]), RIG.cable, ())


@pytest.fixture(scope="module")
def both(study, truth):
    softer = replace(truth, rigidity_n_m2=0.7 * truth.rigidity_n_m2)
    return compare_model(study, softer, "softer"), compare_model(study, truth, "true")


def test_a_right_model_leaves_noise_and_a_wrong_one_a_systematic_part(both):
    softer, true = (c.wrenches[0] for c in both)
    np.testing.assert_allclose(true.rms, true.noise, rtol=0.3)
    assert np.all(true.beyond_noise < 0.6 * true.noise)
    assert np.all(softer.beyond_noise[:2] > true.noise[:2])
    assert np.all(softer.p_values < 1e-6)
    np.testing.assert_array_equal(true.t_s, softer.t_s)
    assert abs(np.nanmean(true.measured - true.predicted, axis=0)).max() < 0.5 * true.noise.max()


def test_markers_are_shown_without_the_wrench(study, both):
    true = both[1]
    assert [w.trial for w in true.wrenches] == ["identify"]
    for trial, where in zip(study.trials, true.where, strict=True):
        assert true.predicted_m[trial.name].shape == trial.markers.xy_m.shape
        assert true.cable_m[trial.name].shape[0] == len(trial.markers.t_s)
        assert where.rms_m == pytest.approx(true.noise_m, rel=0.3)
    assert true.error_m == pytest.approx(true.noise_m, rel=0.3)
    assert true.study.trials[0].markers.xy_m.shape[1] == 1


def test_tables_json_and_page_show_it(both):
    result = CompareResult(both)
    table = wrenches_table(both)
    assert table in result.parts()
    assert [row[:2] for row in table.rows] == [
        ["identify", "force x, mN"], ["identify", "force y, mN"], ["identify", "moment, mN·m"],
    ]  # fmt: skip
    first, second = result.to_json()["models"][1]["trials"]
    assert first["wrench"]["moment_nm"]["rms"] == both[1].wrenches[0].rms[2]
    assert "wrench" not in second
    page = comparison_page(both)
    assert "Wrench at the clamp" in page
    assert "force x: error, mN" in page
    assert history(both) is not None


def test_residuals_are_written_beside_those_of_the_markers(both, tmp_path):
    files = CompareResult(both).write_residuals(tmp_path)
    there = [str(f.relative_to(tmp_path)) for f in files]
    assert there[:3] == ["softer/identify.csv", "softer/deep.csv", "softer/identify_wrench.csv"]
    left = np.genfromtxt(files[2], delimiter=",", skip_header=1)
    wrench = both[0].wrenches[0]
    np.testing.assert_array_equal(left[:, 0], wrench.t_s)
    np.testing.assert_array_equal(left[:, 1:], wrench.measured - wrench.predicted)


def test_the_overlay_has_measured_and_predicted_and_their_difference(both):
    series = [Series(c.model, c.model, "#123456", c) for c in both]
    figure = wrench_overlay(series, "identify")
    assert len(figure.data) == 3 * (1 + 2 * len(both))
    first = both[0].wrenches[0]
    drawn = np.array(figure.data[0].y, float)
    assert len(drawn) <= 2 * 1500
    np.testing.assert_allclose(drawn[0], 1e3 * first.measured[0, 0], atol=1e-3)
    assert wrench_overlay(series, "deep") is None


def test_a_study_without_a_sensor_has_no_such_table(study, truth):
    bare = replace(study, trials=(replace(study.trials[0], wrench=None),))
    comparison = compare_model(bare, truth)
    assert comparison.wrenches == ()
    assert wrenches_table([comparison]) is None
    assert "Wrench" not in comparison_page([comparison])
