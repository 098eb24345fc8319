"""Suggested motions: safe for the true cable in the cell, and telling what they say they tell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import stats

from cell.api.results import SuggestResult
from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.files.input_error import InputError
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.diagnosis import diagnose
from cell.lab.fit.fitting import Rival
from cell.lab.fit.heldout import predict_cable
from cell.lab.next.motion_file import Option, Stroke, Suggestion, load_motion, strokes, write_motion
from cell.lab.next.simulated import planned_trials
from cell.lab.next.suggest import (
    DECIDED,
    _evaluated,
    _prediction_of,
    _rest_low_m,
    _separation,
    suggest_motion,
    whitener_of_planned,
)
from cell.plan.measuring import measuring_path
from cell.settings import load_settings
from cell.settings.surroundings import CLEARANCE_M, Surroundings, Swept, jaw_points_m
from cell.settings.translate import cable_of
from drivers.guard import ArmLimits, check_path
from tests.cell.lab.conftest import fits_of
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import rig_study

FAKE = Path(__file__).parents[4] / "config" / "fake.yaml"


def test_strokes_keep_the_limits():
    limits = Surroundings(angle_rad=(-1.1, 0.1), velocity_m_per_s=0.3)
    offered = strokes(limits)
    assert offered
    for stroke in offered:
        motion = stroke.motion()
        step = np.diff(motion.t_s)
        speed = np.hypot(np.diff(motion.x_m), np.diff(motion.y_m)) / step
        assert speed.max() <= 0.3
        assert np.abs(np.diff(motion.y_m, 2)).max() / 0.002**2 <= 5.0
        assert -1.1 <= stroke.angle_rad <= 0.1


@pytest.fixture(scope="module")
def tied(make_study):
    """Fits and examination of a study that hardly tells added mass from natural curvature."""
    study = make_study([library()["added_mass"].active(kg_per_m=3e-4)], seed=3)
    study = replace(study, trials=tuple(t for t in study.trials if t.name != "up"))
    fits = fits_of(study, ["added_mass", "natural_curvature"])
    return fits, diagnose(fits)


def test_the_clamp_is_tilted_to_tell_added_mass_from_natural_curvature(tied):
    suggestion = suggest_motion(tied[1], Surroundings(angle_rad=(-1.1, 0.3)))
    best = suggestion.options[0]
    level_best = max(o.separation for o in suggestion.options if o.motion.angle_rad == 0.0)
    assert abs(best.motion.angle_rad) > 0.4
    assert best.separation > 2.0 * level_best
    assert {*suggestion.candidates} == {"added_mass", "natural_curvature"}
    assert best.hardest in suggestion.candidates
    assert all(0.0 <= o.power <= 1.0 for o in suggestion.options)


@pytest.fixture(scope="module")
def suggested(tied, tmp_path_factory):
    """A cell whose home is not the origin, and what is suggested for it."""
    text = FAKE.read_text().replace(
        "home: {x_m: 0.0, y_m: 0.0, angle_rad: 0.0}", "home: {x_m: 0.005, y_m: -0.004}"
    )
    config = tmp_path_factory.mktemp("cell") / "cell.yaml"
    config.write_text(text)
    settings = load_settings(config)
    assert settings.motion.home.x_m == 0.005
    return settings, suggest_motion(tied[1], Surroundings.read(config))


def test_the_true_cable_stays_in_the_picture_and_off_the_workpiece(suggested):
    settings, suggestion = suggested
    assert suggestion.options
    assert suggestion.refused["picture"] > 0
    view, limits = settings.camera.view, settings.limits
    rng = np.random.default_rng(3)  # as the study's cable was made
    rigidity = 2.5e-5 * np.exp(rng.uniform(-0.2, 0.2, 4))
    mass = library()["added_mass"].active(kg_per_m=3e-4)
    cable = CableModel(cable_of(settings), rigidity, 1.05, 1e-7, effects=(mass,))
    motions = [o.motion.motion() for o in suggestion.options]
    arcs = np.linspace(settings.cable.free_length_m, 0.0, 41)
    for option, motion in zip(suggestion.options, motions, strict=True):
        t_s = np.arange(0.0, motion.t_s[-1], 0.004)
        points = simulate(cable, motion, t_s, arcs)[0]
        hand = np.column_stack([np.interp(t_s, motion.t_s, v) for v in (motion.x_m, motion.y_m)])
        jaw = hand[:, None] + jaw_points_m(option.motion.angle_rad)
        column = view.origin_column_px + np.concatenate([points, jaw], 1)[..., 0] / (
            view.metres_per_pixel
        )
        row = view.origin_row_px - np.concatenate([points, jaw], 1)[..., 1] / view.metres_per_pixel
        assert column.min() > 5.0, option
        assert column.max() < settings.camera.width_px - 6.0, option
        assert row.min() > 5.0, option
        assert row.max() < settings.camera.height_px - 6.0, option
        assert points[..., 0].min() > settings.destination.x_m[1] + 0.8 * CLEARANCE_M
        # A millimetre inside: an arm is never quite where it is sent.
        assert limits.x_m[0] + 0.00099 <= hand[:, 0].min()
        assert hand[:, 0].max() <= limits.x_m[1] - 0.00099
        assert limits.y_m[0] + 0.00099 <= hand[:, 1].min()
        assert hand[:, 1].max() <= limits.y_m[1] - 0.00099


def test_what_is_written_is_what_the_cell_runs(suggested, tmp_path):
    settings, suggestion = suggested
    path = tmp_path / "second.yaml"
    write_motion(suggestion, path)
    motion = load_motion(path, settings)
    best = suggestion.options[0].motion
    assert (motion.start.x_m, motion.start.y_m) == pytest.approx((best.x_m, best.y_m), abs=1e-6)
    goal = motion.moves[0].goal
    assert goal.y_m == pytest.approx(best.y_m + best.dy_m, abs=1e-6)
    limits = settings.limits
    guard = ArmLimits(
        *limits.x_m, *limits.y_m, *limits.angle_rad, limits.velocity_m_per_s,
        limits.acceleration_m_per_s2, limits.jerk_m_per_s3,
    )  # fmt: skip
    check_path(measuring_path(motion.start, motion.moves, 500.0), guard)
    purpose = yaml.safe_load(path.read_text())["purpose"]
    assert purpose == f"tell {suggestion.candidates[0]} from {suggestion.candidates[1]}"


def test_without_a_safe_motion_it_says_what_forbids_it(tied):
    small = Surroundings(picture_m=((-0.05, 0.05), (-0.05, 0.05)))
    with pytest.raises(ValueError, match=r"none of 144 motions is safe.* 144 for the picture"):
        suggest_motion(tied[1], small)


def test_a_motion_that_tells_nothing_is_refused_and_it_is_said_what_would_help(tied, monkeypatch):
    """A motion with power 0.00 was written as if it were worth a cable."""
    weak = Option(Stroke(0.0, 0.0, -0.05, 0.3), 0.25, "natural_curvature", 0.0)
    names = ("added_mass", "natural_curvature")
    found = Suggestion(names, (weak,), Surroundings(), {"picture": 12})
    monkeypatch.setattr("cell.lab.next.suggest.distinguishing_motions", lambda *_: found)
    with pytest.raises(ValueError, match="no safe motion tells") as caught:
        suggest_motion(tied[1], Surroundings())
    said = str(caught.value)
    assert "decides with probability 0.00 (separation χ² 0.25, 9 are needed)" in said
    assert "the best one 36 times over" in said
    noise_mm = tied[0].prepared.noise.std_m * 1e3
    assert f"noise of {noise_mm / 6.0:.2g} mm instead of {noise_mm:.2g} mm" in said
    assert "room for the 12 motions that were refused, 12 for the picture" in said
    strong = replace(found, options=(replace(weak, power=0.3),))
    monkeypatch.setattr("cell.lab.next.suggest.distinguishing_motions", lambda *_: strong)
    diagnosis = tied[1].diagnosis
    assert diagnosis.verdict == "missing" and not diagnosis.missing[0].tied_with
    already, table = SuggestResult(suggest_motion(tied[1], Surroundings())).parts()
    said = "The present trials already separate added_mass from natural_curvature: no further"
    assert str(already).startswith(said)
    assert "clamp angles from -92 to 92°" in str(table) and "`limits.angle_rad`" in str(table)
    open_question = replace(tied[1], diagnosis=replace(diagnosis, verdict="cannot_tell"))
    assert suggest_motion(open_question, Surroundings()) == strong


def test_a_complete_model_leaves_nothing_to_tell(make_study):
    fits = fits_of(make_study(seed=5), ["tip_mass", "grip_angle"])
    with pytest.raises(ValueError, match="nothing to tell apart"):
        suggest_motion(diagnose(fits), Surroundings())


def swept(**changes):
    given = {"low_m": np.array([-0.1, -0.03]), "high_m": np.array([0.04, 0.01])}
    return Swept(**(given | {"cable_low_m": -0.1, "rest_low_m": -0.1} | changes))


def test_where_a_stroke_may_begin_by_hand():
    cell = Surroundings(
        home=(0.0, 0.0, 0.0), x_m=(-0.05, 0.02), y_m=(-0.1, 0.02),
        picture_m=((-0.2, 0.05), (-0.17, 0.03)), workpiece_m=-0.13,
    )  # fmt: skip
    # from the workpiece −0.13 + 0.005 + 0.1, from the picture's right edge 0.05 − 0.04
    assert cell.start_range(swept(), (0.0, -0.05)) == (
        pytest.approx((-0.025, 0.01)), pytest.approx((-0.049, 0.019))
    )  # fmt: skip
    assert cell.start_range(swept(), (-0.08, 0.0)) == "limits"
    assert cell.start_range(swept(low_m=np.array([-0.3, 0.0])), (0.0, 0.0)) == "picture"
    assert cell.start_range(swept(cable_low_m=-0.15), (0.0, 0.0)) == "workpiece"
    away = replace(cell, home=(-0.04, 0.0, 0.0))  # the resting cable would touch at home itself
    assert away.start_range(swept(), (0.0, 0.0)) == "workpiece"
    assert cell.nearest_start(swept(high_m=np.array([0.06, 0.01])), (0.0, 0.0)) == (
        pytest.approx((-0.01, 0.0))
    )


def test_a_clamp_angle_at_its_limit_is_not_suggested_unless_it_is_homes():
    cell = Surroundings(angle_rad=(-np.pi / 6, np.pi / 3))
    offered = {stroke.angle_rad for stroke in strokes(cell)}
    assert min(offered) == pytest.approx(-np.pi / 12)
    assert max(offered) == pytest.approx(np.pi / 6)
    level = replace(cell, angle_rad=(0.0, 1.0))
    assert min(stroke.angle_rad for stroke in strokes(level)) == 0.0


def test_settings_are_checked_as_for_a_run(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("cable: {}\n")
    with pytest.raises(InputError, match=r"cell\.yaml:1"):
        Surroundings.read(path)
    cell = Surroundings.read(FAKE)
    assert cell.picture_m[0] == pytest.approx((-0.198, 0.0538))
    assert cell.picture_m[1] == pytest.approx((-0.1726, 0.028))
    assert cell.workpiece_m == -0.13


@pytest.mark.parametrize("size", [0.3, 3.0])
def test_the_power_promised_is_kept(size):
    rng = np.random.default_rng(0)
    n, tries = 200, 1500
    open_first = size * rng.normal(size=(n, 4)) / np.sqrt(n)
    open_second = open_first + 0.3 * size * rng.normal(size=(n, 4)) / np.sqrt(n)
    apart = rng.normal(size=n)
    apart *= np.sqrt(20.0 / _separation((0 * apart, open_first), (apart, open_second)))
    promised = stats.norm.cdf((20.0 - DECIDED) / (2.0 * np.sqrt(20.0)))

    def log_likelihood(y, mean, span):
        inner = np.eye(4) + span.T @ span
        against = span.T @ (y - mean)
        square = (y - mean) @ (y - mean) - against @ np.linalg.solve(inner, against)
        return -0.5 * square - 0.5 * np.linalg.slogdet(inner)[1]

    decided = 0
    for _ in range(tries):
        y = open_first @ rng.normal(size=4) + rng.normal(size=n)
        gain = log_likelihood(y, 0 * apart, open_first) - log_likelihood(y, apart, open_second)
        decided += 2.0 * gain > DECIDED
    assert decided / tries > promised - 3.0 * np.sqrt(promised * (1 - promised) / tries)


def test_a_motion_counts_with_the_wrench_that_the_study_has():
    """A mass at the tip pulls at the clamp; what a tare can imitate of it does not count."""
    study = rig_study(KINDS["wrench"](4), None)
    study = replace(study, trials=study.trials[:1])
    bare = replace(study, trials=tuple(replace(t, wrench=None) for t in study.trials))
    space = ParameterSpace.of(study.cable, effects=(library()["tip_mass"],))
    light, heavy = space.natural(space.mean), space.natural(space.mean)
    heavy[space.names.index("tip_mass.mass_kg")] = 1e-3
    rivals = [
        Rival(name, space, space.coordinates(values), 1e-6 * np.eye(len(light)))
        for name, values in (("light", light), ("heavy", heavy))
    ]
    coarse = Solver(segments=20, step_s=2e-3, threads=1)

    def apart(measured, stroke):
        prepared = PreparedStudy.of(measured, solver=coarse)
        known, (trial,) = planned_trials(prepared, [("stroke", stroke.motion())])
        (shown,), _ = predict_cable(known, trial, [rivals[0].model])
        white = whitener_of_planned(known, trial, shown)
        return _separation(*(_prediction_of(known, rival, trial, white)[0] for rival in rivals))

    swing, rest = Stroke(0.0, 0.0, -0.1, 0.4), Stroke(0.0, 0.0, -1e-9, 0.4)
    assert apart(study, swing) > 1.1 * apart(bare, swing)
    assert apart(study, rest) == pytest.approx(apart(bare, rest), rel=1e-3)


@pytest.fixture(scope="module")
def soft(make_study):
    """A study, and two soft cables that it leaves open."""
    study = make_study(seed=1)
    coarse = Solver(segments=20, step_s=2e-3, threads=1)
    prepared, space = PreparedStudy.of(study, solver=coarse), ParameterSpace.of(study.cable)
    far = np.zeros_like(space.mean)
    far[: space.knots] = 1.5
    return prepared, [
        Rival(name, space, space.mean - size * far, 1e-8 * np.eye(len(far)))
        for name, size in (("soft", 1.0), ("less", 0.9))
    ]


def test_a_slow_camera_does_not_hide_where_the_cable_turns_back(soft):
    """At 10 pictures a second it was 15 mm beyond where it was seen, and 5 mm are kept clear."""
    prepared, rivals = soft
    stroke = Stroke(np.pi / 2, -0.08, 0.0, 0.31)

    def begins_m(rate_hz):
        cell = Surroundings(x_m=(-0.3, 0.3), workpiece_m=-0.11, frame_rate_hz=rate_hz)
        return _evaluated(prepared, rivals, stroke, cell, -0.01).motion.x_m

    assert begins_m(200.0) > 0.005
    assert begins_m(10.0) == pytest.approx(begins_m(200.0), abs=5e-4)


def test_a_cable_that_rests_nobody_knows_where_may_be_as_far_as_it_reaches(soft, monkeypatch):
    prepared, rivals = soft
    lost = np.full((1, 3, 21, 2), np.nan)
    monkeypatch.setattr("cell.lab.next.suggest.predict_cable", lambda *_: (lost, lost))
    low_m = _rest_low_m(prepared, [rivals[0].model], Surroundings(), 0.0)
    assert low_m == -prepared.study.cable.length_m
