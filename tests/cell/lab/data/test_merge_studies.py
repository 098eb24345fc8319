"""Cycles that cannot belong to one study are refused, with the place where they differ."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.lab.data.cycles import merge_studies
from cell.lab.data.opened_study import open_study
from cell.study.data import Markers, Wrench
from cell.study.folder import write_study
from tests.command import run_cell

FAKE = Path(__file__).parents[4] / "config" / "fake.yaml"


@pytest.fixture(scope="module")
def measured(make_study):
    return make_study(seed=1), make_study(seed=2)


def recorded_anew(study, name):
    """The same motions of the same cable, with noise of their own."""
    rng = np.random.default_rng(list(name.encode()))
    trials = [
        replace(t, markers=replace(t.markers, xy_m=rng.normal(t.markers.xy_m, 1e-4)))
        for t in study.trials
    ]
    return replace(study, trials=tuple(trials))


@pytest.fixture
def record(tmp_path, measured):
    """Makes a cycle's folder: a study, and settings with words replaced."""

    def make(name, *, study=0, changes=()):
        run = tmp_path / name
        made = recorded_anew(measured[study], name) if isinstance(study, int) else study
        write_study(made, run / "study")
        text = FAKE.read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (run / "settings.yaml").write_text(text)
        return run

    return make


def refused(runs):
    with pytest.raises(InputError) as caught:
        merge_studies(runs, "together")
    return str(caught.value)


def test_cycles_of_one_cable_become_one_study(record, measured):
    runs = [
        record("first"),
        record("second", changes=[("y_m: [-0.10, 0.02]", "y_m: [-0.12, 0.02]")]),  # of the gripper
    ]
    study = merge_studies(runs, "together")
    assert len(study.trials) == 2 * len(measured[0].trials)
    assert study.trials[0].name == "first_identify"
    assert {t.role for t in study.trials[len(measured[0].trials) :]} == {"validate"}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("metres_per_pixel: 0.0002", "metres_per_pixel: 0.0003", "camera.view.metres_per_pixel"),
        ("frame_rate_hz: 200.0", "frame_rate_hz: 100.0", "camera.frame_rate_hz: is 100.0"),
        ("force_n: 20.0", "force_n: 35.0", "gripper.force_n: is 35.0, but 20.0 in"),
        ("lag_s: 0.03", "lag_s: 0.05", "arm.lag_s"),
        ("home: {x_m: 0.0, y_m: 0.0", "home: {x_m: 0.0, y_m: 0.01", "motion.home.y_m"),
        ("effects: {} ", "effects: {air_drag: {drag_coefficient: 2.0}} ", "world.effects.air_drag"),
    ],
)
def test_other_settings_are_refused_at_their_line(record, old, new, says):
    other = record("second", changes=[(old, new)])
    message = refused([record("first"), other])
    line = next(i for i, t in enumerate(FAKE.read_text().splitlines(), 1) if old in t)
    assert f"second/settings.yaml:{line}:" in message
    assert says in message
    assert "merge them apart" in message


def test_another_data_sheet_is_refused(record, measured):
    cable = replace(measured[0].cable, line_density_kg_per_m=0.0075)
    other = replace(measured[0], cable=cable)
    message = refused([record("first"), record("second", study=other)])
    assert "second/study/study.yaml:1: cable: is [0.1, 0.0075" in message


def test_another_individual_is_told_by_how_it_hangs(record, measured):
    (angle,) = {float(t.grip.angle_rad[0]) for t in measured[0].trials[:1]}
    droop = [np.nanmean(s.trials[0].markers.xy_m[:30, 0, 1]) for s in measured]
    assert angle == 0.0
    assert abs(droop[0] - droop[1]) > 2e-3  # of one kind, and 2 mm apart at the tip
    message = refused([record("first"), record("second", study=1)])
    assert "second/study/identify/markers.csv:2" in message
    assert "another individual" in message


def test_one_study_is_written_as_tables_whatever_hangs_in_it(record, measured, tmp_path):
    """Its trials were compared as if they were cycles to be merged."""
    first, second, *others = measured[0].trials
    xy_m = second.markers.xy_m + np.array([0.0, 0.003])
    second = replace(second, grip=first.grip, markers=replace(second.markers, xy_m=xy_m))
    study = replace(measured[0], trials=(first, second, *others))
    assert len(merge_studies([record("first", study=study)], "x").trials) == len(study.trials)


def test_a_marker_that_is_never_seen_at_rest_tells_nothing(record, measured):
    def blind(trial):
        xy_m = trial.markers.xy_m.copy()
        xy_m[:60, 0] = np.nan
        return replace(trial, markers=Markers(trial.markers.t_s, xy_m))

    other = replace(measured[0], trials=tuple(blind(t) for t in measured[0].trials))
    assert len(merge_studies([record("first"), record("second", study=other)], "x").trials) == 6


def test_a_cycle_given_twice_is_refused(record):
    run = record("first")
    assert "given twice" in refused([run, run])


def test_trials_that_would_have_one_name_are_refused(record, measured):
    """One was written over the other, and the study named a trial twice."""
    first, second = (
        replace(measured[0], trials=(replace(measured[0].trials[0], name=name),))
        for name in ("b_identify", "identify")
    )
    message = refused([record("a", study=first), record("a_b", study=second)])
    assert "a_b/study/study.yaml:1: trials: a trial of" in message
    assert "would be called 'a_b_identify', too; rename one folder" in message


def test_the_largest_error_that_any_study_states_is_that_of_all(record, measured):
    """Only that of markers was: arc lengths and wrenches were as certain as the first study's."""
    arcs = np.full(len(measured[0].arc_length_m), 1e-3)

    def pulling(force_std_n, gain_std):
        trial = measured[0].trials[0]
        t_s = trial.markers.t_s
        noise = 0.1 * np.random.default_rng(1).normal(size=(len(t_s), 3))
        trial = replace(trial, wrench=Wrench(t_s, noise))
        sensor = replace(measured[0].sensor, force_std_n=force_std_n, gain_std=gain_std)
        return replace(measured[0], trials=(trial,), sensor=sensor)

    studies = [pulling(0.1, 0.0), replace(pulling(0.3, 0.01), arc_length_std_m=arcs), measured[0]]
    runs = [record(name, study=made) for name, made in zip("abc", studies, strict=True)]
    merged = merge_studies(runs, "x")
    np.testing.assert_allclose(merged.arc_length_std_m, arcs)
    assert (merged.sensor.force_std_n, merged.sensor.gain_std) == (0.3, 0.01)
    assert merged.sensor.moment_std_nm is None
    assert merge_studies(runs[2:], "x").arc_length_std_m is None


def test_a_cycle_that_was_killed_before_it_measured_is_left_out_and_said(record, tmp_path):
    """One killed cycle of twenty made `cell study runs/*` fail; `learn` left it out."""
    good = record("first")
    without_study, without_state = tmp_path / "second", tmp_path / "third"
    for killed, leaves in ((without_study, "state.json"), (without_state, "reserve")):
        (killed / "study" / "identify").mkdir(parents=True)
        (killed / leaves).write_text("{}")
    runs = [str(folder) for folder in (good, without_study, without_state)]
    found = run_cell("study", *runs, "-o", tmp_path / "together")
    assert "3 trials of 1 cycle" in found.stdout
    for killed in (without_study, without_state):
        assert f"left out: {killed}: nothing was measured" in found.stderr
    none = run_cell("study", *runs[1:], "-o", tmp_path / "nothing", code=2)
    assert "no cycle here has measurements" in none.output
    assert not (tmp_path / "nothing").exists()


def test_nodes_that_the_cell_placed_wrong_along_the_cable_are_left_out_and_told(record, measured):
    spoilt = measured[0].trials[0]
    xy_m = spoilt.markers.xy_m.copy()
    rows = np.linspace(10, len(xy_m) - 10, 6).astype(int)
    xy_m[rows, 0] += 5.0 * (xy_m[rows, 0] - xy_m[rows, 1])
    trial = replace(spoilt, markers=replace(spoilt.markers, xy_m=xy_m))
    study = replace(measured[0], trials=(trial, *measured[0].trials[1:]))
    run = record("first", study=study)
    opened = open_study(run)
    assert np.isnan(opened.trials[0].markers.xy_m[rows, 0]).any(axis=1).all()
    gathered = merge_studies([run, record("second")], "together")
    assert np.isnan(gathered.trials[0].markers.xy_m[rows, 0]).any(axis=1).all()
    assert any("lie apart from the rows before and after" in note for note in gathered.notes)
