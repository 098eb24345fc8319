"""`cell look` shows a study, a refused one too, and draws what was measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cable.geometry import Cable, Motion
from cell.cli import app
from cell.lab.report.look_page import courses, film_strip, swing_figure
from cell.study.data import Markers, Study, Trial, Wrench
from cell.study.facts import trial_facts
from cell.study.folder import write_study
from tests.cell.study.imports.corpus.swing import ARCS_M
from tests.cell.study.imports.made import made


@pytest.fixture
def study() -> Study:
    m = made()
    grip = Motion(m.t_s, *(np.ascontiguousarray(v) for v in m.gripper_m.T), m.angle_rad)
    trials = [
        Trial(name, "fit", "equilibrium", grip, Markers(m.t_s, made(seed).markers_m[:, ::-1]))
        for seed, name in enumerate(("one", "two"))
    ]
    return Study("swings", Cable(0.1, 0.0074, 0.016, 1e-4), ARCS_M[::-1], tuple(trials))


def test_a_recording_that_is_there_twice_is_odd_and_counted_once(
    study: Study, tmp_path: Path
) -> None:
    first, second = study.trials
    copy = replace(second, role="validate", markers=first.markers)
    write_study(replace(study, trials=(first, copy)), tmp_path / "s")
    done = CliRunner().invoke(app, ["look", str(tmp_path / "s"), "--json"])
    data = json.loads(done.stdout)
    assert data["independence"] == {
        "effective_trials": 1.0,
        "recordings": [["one", "two"]],
        "motions": [["one", "two"]],
        "held_out": 0,
    }
    assert "one and two are one recording" in data["odd"][0]
    done = CliRunner().invoke(app, ["look", str(tmp_path / "s")])
    assert "effective trials 1.0 of 2, 1 motion, 0 held out" in " ".join(done.output.split())


def test_a_study_is_shown_with_all_its_trials(study: Study, tmp_path: Path) -> None:
    write_study(study, tmp_path / "s")
    page = tmp_path / "look.html"
    done = CliRunner().invoke(app, ["look", str(tmp_path / "s"), "-o", str(page)])
    assert done.exit_code == 0, done.output
    assert "Nothing is odd." in done.output
    text = page.read_text()
    assert text.count('class="trial"') == 2
    assert text.count("film strip</h2>") == 2


def test_json_says_what_the_table_says(study: Study, tmp_path: Path) -> None:
    write_study(study, tmp_path / "s")
    done = CliRunner().invoke(app, ["look", str(tmp_path / "s"), "--json"])
    data = json.loads(done.stdout)
    assert (data["format"], data["wrong"], data["odd"]) == ("cable-look/1", [], [])
    assert [t["name"] for t in data["trials"]] == ["one", "two"]
    assert data["trials"][0]["frequencies_hz"][0] == pytest.approx(4.0, abs=0.15)


def test_a_wrench_is_shown_with_its_noise_and_course(study: Study, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first, second = study.trials
    t_s = np.arange(first.grip.t_s[0], first.grip.t_s[-1], 0.002)
    values = np.column_stack([0.005 * rng.normal(size=len(t_s)), np.full(len(t_s), np.nan),
                              2e-4 * rng.normal(size=len(t_s))])  # fmt: skip
    sensed = replace(first, wrench=Wrench(t_s, values))
    write_study(replace(study, trials=(sensed, second)), tmp_path / "s")
    page = tmp_path / "look.html"
    done = CliRunner().invoke(app, ["look", str(tmp_path / "s"), "-o", str(page)])
    assert done.exit_code == 0, done.output
    rows = [line.split() for line in done.output.splitlines() if "mN" in line]
    assert [row[:4] for row in rows] == [["one", "force", "x,", "mN"], ["one", "moment,", "mN·m",
                                                                        "500"]]  # fmt: skip
    assert float(rows[0][-1]) == pytest.approx(5.0, rel=0.3)
    assert page.read_text().count("Wrench at the clamp</h2>") == 2  # table, and one course
    shown = json.loads(CliRunner().invoke(app, ["look", str(tmp_path / "s"), "--json"]).stdout)
    assert set(shown["trials"][0]["wrench"]) == {"rate_hz", "still_rows", "force_x_n", "moment_nm"}
    assert "wrench" not in shown["trials"][1]
    assert [t["sensors"] for t in shown["trials"]] == [["wrench"], []]
    assert "fit, equilibrium, wrench" in page.read_text()


def test_a_refused_study_is_shown_with_the_reason(study: Study, tmp_path: Path) -> None:
    write_study(study, tmp_path / "s")
    table = tmp_path / "s" / "two" / "markers.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()]
    for row in rows[150:]:
        row[1:3], row[3:5] = row[3:5], row[1:3]
    table.write_text("\n".join(",".join(row) for row in rows) + "\n")
    page = tmp_path / "look.html"
    done = CliRunner().invoke(app, ["look", str(tmp_path / "s"), "-o", str(page)])
    assert done.exit_code == 1, done.output
    assert f"{table}:151" in done.output
    assert "exchange the columns" in page.read_text()


def test_what_the_lab_refuses_is_to_be_mended(study: Study, tmp_path: Path) -> None:
    checked = tuple(replace(t, role="validate") for t in study.trials)
    write_study(replace(study, trials=checked), tmp_path / "s")
    done = CliRunner().invoke(app, ["look", str(tmp_path / "s")])
    assert done.exit_code == 1, done.output
    assert "To be mended:" in done.output
    assert "no trial has `role: fit`" in " ".join(done.output.split())


def test_a_folder_without_a_study_is_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["look", str(tmp_path)])
    assert done.exit_code == 2
    assert "study.yaml" in done.output


def test_a_film_strip_shows_shapes_as_they_were_to_one_scale(study: Study) -> None:
    trial = study.trials[0]
    figure = film_strip(trial, trial_facts(trial, study.arc_length_m))
    shapes = [t for t in figure.data if t.name == "cable"]
    assert len(shapes) == 10
    times = [float(a.text.removesuffix(" s")) for a in figure.layout.annotations]
    for shape, time in zip(shapes, times, strict=True):
        row = int(np.argmin(np.abs(trial.markers.t_s - time)))
        near = range(max(row - 2, 0), min(row + 3, len(trial.markers.t_s)))
        drawn = np.column_stack([shape.x, shape.y]).astype(float)
        drawn -= drawn[0]
        hand = np.column_stack([trial.grip.x_m, trial.grip.y_m])
        seen = [(trial.markers.xy_m[k, ::-1] - hand[k]) * 1e3 for k in near]
        # Labels have two decimals: one of the rows beside the time is the one drawn.
        assert min(np.abs(drawn[1:] - s).max() for s in seen) < 0.02


def test_courses_and_spectrum_have_the_tip_s_numbers(study: Study) -> None:
    trial = study.trials[0]
    facts = trial_facts(trial, study.arc_length_m)
    x = next(t for t in courses(trial, facts).data if t.name == "x (right)")
    np.testing.assert_allclose(x.y, trial.markers.xy_m[:, 0, 0] * 1e3, atol=1e-3)
    swing = swing_figure(facts)
    assert swing is not None
    assert float(swing.layout.annotations[0].text.split()[0]) == pytest.approx(4.0, abs=0.15)
