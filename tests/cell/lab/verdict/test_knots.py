"""The number of knots of EI(s): as usual, or more where EI has a step."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cell.api import lab
from cell.cable.effects import library
from cell.exchange.description import description
from cell.lab import diagnosis
from cell.lab.data.results import to_json
from cell.lab.diagnosis import diagnose
from cell.lab.report.tables import knots_lines
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.setup import read_model
from tests.cell.lab.conftest import FEW_EFFECTS, fits_of

pytestmark = pytest.mark.usefixtures("few_effects")

#: EI beyond a share of the length, over that before it.
STEP = (0.5, 0.45)


@pytest.fixture(scope="module")
def stepped(make_study):
    return make_study(seed=3, noise_m=3e-5, step=STEP)


def test_a_step_of_rigidity_is_no_missing_effect(stepped):
    found = diagnose(fits_of(stepped, FEW_EFFECTS))
    assert found.diagnosis.verdict == "complete"
    assert found.diagnosis.missing == ()
    assert to_json(found.diagnosis)["knots"] == found.final.fit.space.knots > 6
    rigidity = found.final.fit.model.rigidity_at(np.array([0.035, 0.055]))
    assert rigidity[1] / rigidity[0] == pytest.approx(STEP[0], rel=0.15)


def test_an_effect_is_not_described_by_more_knots(make_study):
    study = make_study([library()["natural_curvature"].active(curvature_1_per_m=2.0)], seed=3)
    found = diagnose(fits_of(study, FEW_EFFECTS)).diagnosis
    assert [f.effect for f in found.missing] == ["natural_curvature"]
    assert found.knots == 6


def test_more_knots_that_do_not_explain_a_study_either_are_given_up(make_study, monkeypatch):
    def finer(fits, first):
        if fits.space.knots > 6:
            return None
        return FitCache.of(replace(first.setup, space=first.space.with_knots(11)))

    study = make_study([library()["stress_relaxation"].active(fraction=0.3)], seed=3)
    monkeypatch.setattr(diagnosis, "with_more_knots", finer)
    found = diagnose(fits_of(study, FEW_EFFECTS))
    assert found.diagnosis.verdict == "unexplained"
    assert found.diagnosis.knots == found.fits.space.knots == found.final.fit.space.knots == 6


def test_a_fit_has_as_many_knots_and_is_a_prior_and_a_description(stepped, tmp_path):
    result = lab.fit(stepped)
    knots = result.model.space.knots
    assert knots > 6
    assert knots_lines(knots)[0] in result.parts()
    result.write(tmp_path / "model.json")
    read = read_model(tmp_path / "model.json")
    assert json.loads((tmp_path / "model.json").read_text())["knots"] == knots
    np.testing.assert_allclose(read.model.rigidity_n_m2, result.model.model.rigidity_n_m2)
    assert len(description(read)["bending"]["rigidity_n_m2"]) == knots
    again = lab.fit(stepped, prior=tmp_path / "model.json")
    assert again.model.space.knots == knots
    (compared,) = lab.compare(stepped, [tmp_path / "model.json"]).comparisons
    assert compared.heldout_rms_m < 3.3e-5
