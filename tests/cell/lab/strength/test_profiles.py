"""`cell fit --profile`: intervals by the likelihood itself, on a page and in the model's file."""

import json

import pytest

from cell.lab.search.setup import read_model
from cell.study.folder import write_study
from tests.cell.lab.conftest import STROKES
from tests.command import run_cell


@pytest.fixture(scope="module")
def profiled(make_study, tmp_path_factory):
    folder = tmp_path_factory.mktemp("profiled")
    write_study(make_study(seed=2, strokes=(STROKES[0], STROKES[3])), folder / "study")
    model, page = folder / "model.json", folder / "page.html"
    done = run_cell(
        "fit", folder / "study", "--with", "bending_hysteresis", "-o", model, "--profile", page
    )
    return json.loads(model.read_text()), page.read_text(), model, done.output


def test_a_well_known_parameters_profile_is_its_interval(profiled):
    model, _, path, _ = profiled
    of = {p["name"]: p for p in model["profiles"]}
    for p in model["parameters"][1:4]:
        spread = p["high"] - p["low"]
        assert of[p["name"]]["low"] == pytest.approx(p["low"], abs=0.1 * spread)
        assert of[p["name"]]["high"] == pytest.approx(p["high"], abs=0.1 * spread)
    assert read_model(path).space.names[-1] == "bending_hysteresis.curvature_1_per_m"


def test_a_parameter_without_effect_is_not_bounded_and_that_is_said(profiled):
    """Friction that is absent slips at any curvature; the prior alone says something of it."""
    model, page, _, printed = profiled
    slips = model["profiles"][-1]
    points = slips["points"]
    assert max(p["value"] for p in points) > 50.0 * min(p["value"] for p in points)
    assert slips["low"] is None or slips["high"] is None or slips["high"] > 20.0 * slips["low"]
    assert "95 % by profile" in page
    assert "Plotly.newPlot" in page
    said = [line for line in printed.splitlines() if "is not bounded by this study" in line]
    unbounded = [p for p in model["profiles"] if None in (p["low"], p["high"])]
    assert bool(said) == bool(unbounded)
