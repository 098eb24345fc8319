"""Commands end to end: files written, tables printed, bad input refused with nothing written."""

import json
import shutil

import pytest
import yaml
from typer.testing import CliRunner

from cell.cable.effects import library
from cell.lab.commands import app
from cell.study.folder import read_study, write_study

run = CliRunner().invoke


@pytest.fixture(scope="module")
def folder(make_study, tmp_path_factory):
    study = make_study([library()["tip_mass"].active(mass_kg=2.5e-5)], seed=11)
    path = tmp_path_factory.mktemp("study") / "made"
    write_study(study, path)
    return path


def test_fit_with_an_effect_then_compare_and_report(folder, tmp_path):
    model, page, out = tmp_path / "model.json", tmp_path / "page.html", tmp_path / "c.json"
    done = run(app, ["fit", str(folder), "--effect", "tip_mass", "-o", str(model)])
    assert done.exit_code == 0, done.output
    found = {p["name"]: p for p in json.loads(model.read_text())["parameters"]}
    assert found["tip_mass.mass_kg"]["value"] == pytest.approx(2.5e-5, rel=0.05)

    given = ["compare", str(folder), "--model", str(model)]
    done = run(app, [*given, "--json", str(out), "--report", str(page)])
    assert done.exit_code == 0, done.output
    comparison = json.loads(out.read_text())
    assert comparison["heldout_rms_m"] == pytest.approx(1e-4, rel=0.05)
    text = page.read_text()
    assert "identify" in text
    assert 'src="http' not in text  # nothing is loaded from a network


def test_effects_are_listed_with_units(tmp_path):
    out = tmp_path / "effects.json"
    done = run(app, ["effects", "--json", str(out)])
    assert done.exit_code == 0
    listed = {e["effect"]: e for e in json.loads(out.read_text())["effects"]}
    assert set(listed) == set(library())
    assert listed["tip_mass"]["parameters"][0]["unit"] == "kg"


def test_study_gathers_cycles(folder, tmp_path):
    cycle = tmp_path / "cycle"
    shutil.copytree(folder, cycle / "study")
    out = tmp_path / "gathered"
    done = run(app, ["study", str(cycle), str(folder), "-o", str(out)])
    assert done.exit_code == 0, done.output
    trials = read_study(out).trials
    assert len(trials) == 8
    assert [t.role for t in trials[4:]] == ["validate"] * 4


def broken(folder, tmp_path, change):
    path = tmp_path / "broken"
    shutil.copytree(folder, path)
    change(path)
    return path


def edit_header(path, **cable):
    header = yaml.safe_load((path / "study.yaml").read_text())
    header["cable"].update(cable)
    (path / "study.yaml").write_text(yaml.safe_dump(header))


def shorten(path):
    file = path / "identify" / "markers.csv"
    file.write_text("\n".join(file.read_text().splitlines()[:50]) + "\n")


def repeat_a_time(path):
    file = path / "identify" / "markers.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:6], lines[5], *lines[6:]]) + "\n")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: edit_header(p, free_length_m=100.0), "study.yaml:"),
        (repeat_a_time, "markers.csv:7"),
        (shorten, "markers.csv:50"),
        (lambda p: (p / "identify" / "grip.csv").unlink(), "grip.csv"),
    ],
)
def test_bad_studies_are_refused_and_nothing_is_written(folder, tmp_path, change, says):
    out = tmp_path / "out.json"
    done = run(app, ["diagnose", str(broken(folder, tmp_path, change)), "--json", str(out)])
    assert done.exit_code == 2
    assert says in done.output
    assert not out.exists()


def test_a_prior_of_another_cable_is_refused(folder, tmp_path):
    model = tmp_path / "model.json"
    assert run(app, ["fit", str(folder), "-o", str(model)]).exit_code == 0
    other = broken(folder, tmp_path, lambda p: edit_header(p, line_density_kg_per_m=0.01))
    done = run(app, ["diagnose", str(other), "--prior", str(model)])
    assert done.exit_code == 2
    assert "another cable" in done.output


def test_unknown_effects_are_refused_with_a_guess(folder):
    done = run(app, ["fit", str(folder), "--effect", "air_darg"])
    assert done.exit_code == 2
    assert "air_drag" in done.output


def test_all_nan_markers_are_refused(folder, tmp_path):
    def blind(path):
        file = path / "identify" / "markers.csv"
        head, *rows = file.read_text().splitlines()
        empty = [",".join([r.split(",")[0]] + ["nan"] * head.count(",")) for r in rows]
        file.write_text("\n".join([head, *empty]) + "\n")

    done = run(app, ["fit", str(broken(folder, tmp_path, blind))])
    assert done.exit_code == 2
    assert "no marker is seen" in done.output
