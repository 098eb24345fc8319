"""A trial's wrench survives writing and reading; what cannot be one is refused with its place."""

import re
from dataclasses import replace

import numpy as np
import pytest

from cell.cable.wrench import Gauge, Tool
from cell.files.input_error import InputError
from cell.lab.data.opened_study import open_study
from cell.records.recording.unpack import study_from_plain, study_to_plain
from cell.study.data import Wrench, WrenchSensor
from cell.study.folder import read_study, study_as_it_is, write_study
from cell.study.wrench import wrench_facts
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import rig_study

SENSOR = WrenchSensor(Gauge(Tool(0.02, (0.03, -0.01), 1e-5), turns=False), 0.004, None, 0.01)


@pytest.fixture(scope="module")
def made():
    study = rig_study(replace(KINDS["wrench"](0), clocks=()), None)
    return replace(study, trials=study.trials[:2])


def table(folder, name="identify"):
    return folder / name / "wrench.csv"


def refused(folder):
    with pytest.raises(InputError) as error:
        read_study(folder)
    (problem,) = error.value.problems
    return problem


def changed(folder, line, column, value):
    """The file with another value in one cell, lines from 1."""
    rows = [r.split(",") for r in table(folder).read_text().splitlines()]
    rows[line - 1][column] = value
    table(folder).write_text("\n".join(",".join(r) for r in rows) + "\n")


def with_first(study, change=lambda values: None, late_s=0.0):
    """The study whose first trial has another wrench: values (T, 3) are changed in place."""
    first, *rest = study.trials
    wrench = Wrench(first.wrench.t_s + late_s, first.wrench.values.copy())
    change(wrench.values)
    return replace(study, trials=(replace(first, wrench=wrench), *rest))


def test_a_wrench_is_read_back_to_the_last_bit(made, tmp_path):
    trials = list(made.trials)
    values = trials[1].wrench.values.copy()
    values[:, 0], values[3, 1] = np.nan, np.nan
    trials[1] = replace(trials[1], wrench=Wrench(trials[1].wrench.t_s, values))
    study = replace(made, trials=tuple(trials), sensor=SENSOR)
    write_study(study, tmp_path)
    assert table(tmp_path, "probe_up").read_text().startswith("t_s,force_y_n,moment_nm\n")
    plain = study_from_plain(study_to_plain(study))
    for back in (study_as_it_is(tmp_path)[0], plain):
        assert back.sensor == SENSOR
        for one, other in zip(study.trials, back.trials, strict=True):
            np.testing.assert_array_equal(one.wrench.t_s, other.wrench.t_s)
            np.testing.assert_array_equal(one.wrench.values, other.wrench.values)


def test_a_study_without_a_sensor_says_nothing_of_one(made, tmp_path):
    bare = replace(made, trials=tuple(replace(t, wrench=None) for t in made.trials))
    write_study(bare, tmp_path)
    assert "wrench" not in (tmp_path / "study.yaml").read_text()
    assert not list(tmp_path.glob("*/wrench.csv"))
    assert "wrench" not in study_to_plain(bare)["trials"][0]
    assert all(t.wrench is None for t in read_study(tmp_path).trials)


@pytest.mark.parametrize(
    ("line", "column", "value", "name", "said"),
    [
        (1, 1, "force_x_mn", "force_x_mn", "unknown column.*possible: force_x_n"),
        (5, 2, "1200", "force_y_n", "1200 is beyond ±1000 N; give N, not mN"),
        (6, 3, "-150.0", "moment_nm", "-150 is beyond ±100 N·m"),
        (7, 1, "off", "force_x_n", "'off' is not a number"),
        (8, 1, "inf", "force_x_n", "not finite"),
        (9, 0, "0.0", "t_s", "comes after"),
    ],
)
def test_a_wrong_cell_is_refused_with_its_place(made, tmp_path, line, column, value, name, said):
    write_study(made, tmp_path)
    changed(tmp_path, line, column, value)
    problem = refused(tmp_path)
    assert (problem.path, problem.line, problem.key) == (table(tmp_path), line, name)
    assert re.search(said, problem.message)


def test_a_file_without_any_column_of_a_wrench_is_refused(made, tmp_path):
    write_study(made, tmp_path)
    table(tmp_path).write_text("t_s\n0.0\n0.1\n")
    assert "give one or more of force_x_n, force_y_n, moment_nm" in refused(tmp_path).message


def test_a_sensor_that_shows_no_noise_is_refused(made, tmp_path):
    def stuck(values):
        values[:, 2] = 0.25

    write_study(with_first(made, stuck), tmp_path)
    problem = refused(tmp_path)
    assert (problem.line, problem.key) == (2, "moment_nm")
    assert "is 0.25 in all of" in problem.message
    assert "leave the column out" in problem.message


def test_another_clock_is_refused(made, tmp_path):
    write_study(with_first(made, late_s=100.0), tmp_path)
    assert "put both on one clock" in refused(tmp_path).message


def test_a_wrench_without_markers_is_refused_with_what_is_needed(made, tmp_path):
    write_study(replace(made, trials=made.trials[:1]), tmp_path)
    (tmp_path / "identify" / "markers.csv").unlink()
    problem = refused(tmp_path)
    assert problem.path == tmp_path / "identify" / "markers.csv"
    assert "a wrench alone does not show where the cable is" in problem.message
    assert problem.message.endswith("give t_s, x0_m, y0_m")
    header = tmp_path / "study.yaml"
    text = header.read_text()
    begin, end = text.index("markers:"), text.index("trials:")
    header.write_text(text[:begin] + text[end:])
    problem = refused(tmp_path)
    assert (problem.path, problem.key) == (header, "markers")
    assert "give its arc_length_m and its markers.csv" in problem.message


def test_a_key_without_a_file_is_refused(made, tmp_path):
    bare = replace(made, sensor=SENSOR, trials=tuple(replace(t, wrench=None) for t in made.trials))
    write_study(bare, tmp_path)
    problem = refused(tmp_path)
    assert problem.path == tmp_path / "study.yaml"
    assert "no trial has a wrench.csv" in problem.message


@pytest.mark.parametrize("entry", ["mass_kg: 0", "mass_kg: 1, centre_m: [30, 0]"])
def test_an_impossible_tool_is_refused(made, tmp_path, entry):
    write_study(made, tmp_path)
    header = tmp_path / "study.yaml"
    header.write_text(header.read_text() + f"wrench: {{tool: {{{entry}}}}}\n")
    problem = refused(tmp_path)
    assert problem.path == header
    assert problem.key.startswith("wrench.tool.")


@pytest.mark.parametrize(
    ("factor", "said"),
    [(-1.0, "it points the other way"), (100.0, "give N, not mN")],
)
def test_a_force_that_moves_no_such_cable_is_refused(made, tmp_path, factor, said):
    trials = tuple(
        replace(t, wrench=replace(t.wrench, values=factor * (t.wrench.values - np.mean(
            t.wrench.values, axis=0)))) for t in made.trials
    )  # fmt: skip
    write_study(replace(made, trials=trials), tmp_path)
    with pytest.raises(InputError) as error:
        read_study(tmp_path)
    problem = error.value.problems[0]
    assert problem.key == "force_y_n"
    assert said in problem.message


def test_a_tool_that_is_not_stated_is_told(made, tmp_path):
    rig = replace(KINDS["wrench"](0))
    heavy = replace(rig, sensor=replace(rig.sensor, tool=Tool(0.1)))
    study = rig_study(heavy, None)
    write_study(replace(study, sensor=WrenchSensor()), tmp_path)
    notes = read_study(tmp_path).notes
    assert any("wrench.tool in study.yaml" in note for note in notes)


def test_a_single_wrong_row_is_left_out_and_told(made, tmp_path):
    def wrong(values):
        values[100, 1] += 0.5

    write_study(with_first(made, wrong), tmp_path)
    opened = open_study(tmp_path)
    (note,) = (n for n in opened.notes if "wrench.csv" in n)
    assert "line 102, force_y_n by +0.5 N; left out" in note
    kept = opened.trials[0].wrench.values
    assert np.argwhere(np.isnan(kept)).tolist() == [[100, 1]]


def test_a_sensor_that_slips_often_is_refused(made, tmp_path):
    def slips(values):
        values[20::30, 2] += 0.05

    write_study(with_first(made, slips), tmp_path)
    with pytest.raises(InputError, match=r"wrench.csv:22: moment_nm: .*limit 2%"):
        open_study(tmp_path)


def test_facts_of_a_wrench_are_its_rate_noise_and_range(made):
    facts = wrench_facts(made.trials[0])
    sensor = KINDS["wrench"](0).sensor
    assert facts.rate_hz == pytest.approx(sensor.rate_hz)
    expected = [sensor.force_n, sensor.force_n, sensor.moment_nm]
    np.testing.assert_allclose(facts.noise, expected, rtol=0.4)
    assert set(facts.to_json()) == {
        "rate_hz", "still_rows", "force_x_n", "force_y_n", "moment_nm",
    }  # fmt: skip
