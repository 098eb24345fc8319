"""`cell power` end to end: what is printed, written and refused."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.study.folder import write_study

run = CliRunner().invoke


@pytest.fixture(scope="module")
def folder(make_study, tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "made"
    write_study(make_study(seed=21), path)
    return path


def test_size_and_smallest_size_are_told_and_written(folder, tmp_path):
    out = tmp_path / "power.json"
    done = run(
        app,
        ["power", str(folder), "--effect", "air_drag=0.3", "--effect", "tip_mass", "-o", str(out)],
    )
    assert done.exit_code == 0, done.output
    data = json.loads(out.read_text())
    drag, mass = data["effects"]
    assert (drag["parameter"], drag["size"], drag["recovery"]) == ("drag_coefficient", 0.3, None)
    assert mass["forecast"]["found"] == pytest.approx(data["power"], abs=0.02)
    assert f"{mass['smallest']:.3g}" in done.stdout
    assert drag["rivals"][0]["effect"] in done.stdout


def test_copies_are_diagnosed_beside_the_forecast(folder):
    done = run(app, ["power", str(folder), "--effect", "air_drag=1.5", "--verify", "1", "--json"])
    assert done.exit_code == 0, done.output
    (drag,) = json.loads(done.stdout)["effects"]
    assert drag["recovery"]["copies"] == drag["recovery"]["found"] == 1
    assert drag["forecast"]["found"] > 0.99


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--effect", "air_dragg"], "no such effect; did you mean"),
        (["--effect", "air_drag=60"], "is outside 0 … 50"),
        (["--effect", "air_drag=1", "--known", "air_drag"], "part of the model by --known"),
    ],
)
def test_what_is_meant_wrongly_is_refused_and_nothing_is_written(folder, tmp_path, words, says):
    out = tmp_path / "power.json"
    done = run(app, ["power", str(folder), *words, "-o", str(out)])
    assert (done.exit_code, out.exists()) == (2, False)
    assert says in done.stderr


def test_a_study_that_no_model_fits_is_refused(folder, monkeypatch):
    """As if this error were larger than the motion of the markers."""
    monkeypatch.setattr("cell.lab.verdict.doubts.NO_MODEL", 0.0)
    done = run(app, ["power", str(folder), "--effect", "air_drag"])
    assert done.exit_code == 2
    assert "is not a model of this cable; correct the study first" in done.stderr
