"""`cell power` end to end: what is printed, written and refused."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.lab.data.prepared import all_fitted
from cell.study.folder import write_study
from tests.command import run_cell

pytestmark = pytest.mark.usefixtures("few_effects")

run = CliRunner().invoke


@pytest.fixture(scope="module")
def folder(make_study, tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "made"
    write_study(make_study(seed=21), path)
    return path


def test_size_and_smallest_size_are_told_and_written(folder, tmp_path):
    out = tmp_path / "power.json"
    done = run_cell("power", folder, "--try", "air_drag=0.3", "--try", "tip_mass", "-o", out)
    data = json.loads(out.read_text())
    drag, mass = data["effects"]
    assert (drag["parameter"], drag["size"], drag["recovery"]) == ("drag_coefficient", 0.3, None)
    assert mass["forecast"]["found"] == pytest.approx(data["power"], abs=0.02)
    assert f"{mass['smallest']:.3g}" in done.stdout
    assert drag["rivals"][0]["effect"] in done.stdout


def test_copies_are_diagnosed_beside_the_forecast(folder):
    done = run_cell("power", folder, "--try", "air_drag=1.5", "--verify", "1", "--json")
    (drag,) = json.loads(done.stdout)["effects"]
    assert drag["recovery"]["copies"] == drag["recovery"]["found"] == 1
    assert drag["forecast"]["found"] > 0.99


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--try", "air_dragg"], "no such effect; did you mean"),
        (["--try", "air_drag=60"], "is outside 0 … 50"),
        (["--try", "air_drag", "--verify", "0"], "greater than or equal to 1"),
        (["--try", "air_drag=1", "--with", "air_drag"], "part of the model by --with"),
    ],
)
def test_what_is_meant_wrongly_is_refused_and_nothing_is_written(folder, tmp_path, words, says):
    out = tmp_path / "power.json"
    done = run(app, ["power", str(folder), *words, "-o", str(out)])
    assert (done.exit_code, out.exists()) == (2, False)
    assert says in done.stderr


MOTION = """\
format: cell-motion/1
start: {x_m: 0.0, y_m: 0.0, angle_rad: 0.0}
still_s: 0.2
moves:
- {x_m: 0.0, y_m: -0.09, angle_rad: 0.0, duration_s: 0.35}
hold_s: 0.8
"""


def test_a_motion_counts_as_if_it_had_been_recorded_and_held_out(make_study, tmp_path):
    write_study(all_fitted(make_study(seed=21)), tmp_path / "made")
    (tmp_path / "deeper.yaml").write_text(MOTION)
    asked = ["power", str(tmp_path / "made"), "--try", "air_drag=0.5", "--json"]
    before = json.loads(run(app, asked).stdout)
    assert before["effects"][0]["forecast"]["found"] == 0.0
    assert [w["code"] for w in before["warnings"]] == ["confirmation"]
    done = run_cell(*asked, "--motion", tmp_path / "deeper.yaml")
    after = json.loads(done.stdout)
    assert after["warnings"] == []
    assert after["effects"][0]["forecast"]["found"] > 0.9


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("deep.yaml", MOTION, "there is a trial 'deep' already; rename the file"),
        ("new.yaml", MOTION.replace("0.35", "-1"), "new.yaml:5:"),
        ("new.yaml", MOTION.replace("moves", "move"), "new.yaml:"),
    ],
)
def test_a_motion_that_cannot_be_meant_is_refused(folder, tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    given = ["power", str(folder), "--try", "air_drag", "--motion", str(tmp_path / name)]
    done = run_cell(*given, code=2)
    assert says in done.stderr


def test_a_study_that_no_model_fits_is_refused(folder, monkeypatch):
    """As if this error were larger than the motion of the markers."""
    monkeypatch.setattr("cell.lab.search.fitted_model.NO_MODEL", 0.0)
    done = run_cell("power", folder, "--try", "air_drag", code=2)
    assert "is not a model of this cable; correct the study first" in done.stderr
