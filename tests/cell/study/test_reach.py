"""A study that an effect of the library can cause is read; one that none can cause is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import ActiveEffect, library
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.study import reach
from cell.study.data import Markers, Trial
from cell.study.import_checks import longer_than_cable
from cell.study.reach import Reach
from cell.study.tracks import frozen
from cell.study.trial_checks import TrialEvidence, trial_problems

LENGTH_M, GRAVITY = 0.1, (0.0, -9.81)
CABLE = Cable(LENGTH_M, 0.0074, 0.016, 1e-4)
ARCS_M = np.linspace(0.1, 0.0, 6)


def made(*effects: ActiveEffect, arcs_m: np.ndarray = ARCS_M) -> Trial:
    """A cable that is moved down and swings, with noise."""
    t_s = np.arange(0.0, 1.2, 0.005)
    x = np.clip((t_s - 0.2) / 0.3, 0.0, 1.0)
    grip = Motion(t_s, 0.0 * t_s, -0.05 * x**3 * (10 - 15 * x + 6 * x**2), 0.1 + 0 * t_s)
    model = CableModel.uniform(CABLE, 3e-5, viscosity_n_m2_s=1e-7, effects=effects)
    xy_m = simulate(model, grip, t_s, arcs_m)[0]
    xy_m = xy_m + np.random.default_rng(1).normal(0.0, 2e-4, xy_m.shape)
    return Trial("made", "fit", "equilibrium", grip, Markers(t_s, xy_m))


def said_of(trial: Trial, arcs_m: np.ndarray = ARCS_M) -> tuple[str, str]:
    """Problems and notes."""
    problems, notes = trial_problems(trial, CABLE, arcs_m, GRAVITY)
    return " ".join(p.message for p in problems), " ".join(notes)


def moved(trial: Trial, xy_m: np.ndarray) -> Trial:
    return replace(trial, markers=replace(trial.markers, xy_m=xy_m))


SHOWN = [
    ("camera_scale", {"factor": 1.2}),
    ("camera_scale", {"factor": 1.9}),
    ("camera_roll", {"angle_rad": 0.25}),
    ("camera_roll", {"angle_rad": 0.45}),
    ("grip_slip", {"length_m": 0.02}),
    ("grip_slip", {"length_m": 0.045}),
]


@pytest.mark.parametrize("arcs_m", [ARCS_M, ARCS_M[:1], ARCS_M[:5]], ids=["all", "tip", "no clamp"])
@pytest.mark.parametrize(("name", "values"), SHOWN)
def test_what_an_effect_shows_is_read(
    name: str, values: dict[str, float], arcs_m: np.ndarray
) -> None:
    trial = made(library()[name].active(**values), arcs_m=arcs_m)
    problems, notes = said_of(trial, arcs_m)
    assert problems == ""
    if name != "camera_roll":
        assert "farther than any cable lets it; camera_scale, camera_roll or grip_slip" in notes
    assert longer_than_cable.failure(TrialEvidence(trial, CABLE, arcs_m, GRAVITY)) is None


@pytest.mark.parametrize("name", ["camera_latency", "robot_lag"])
@pytest.mark.parametrize("delay_s", [-0.095, 0.095])
def test_a_delay_is_read(name: str, delay_s: float) -> None:
    assert said_of(made(library()[name].active(delay_s=delay_s)))[0] == ""


def test_each_limit_is_the_bound_of_an_effect() -> None:
    highest = {(e.name, p.name): p.high for e in library().values() for p in e.parameters}
    assert highest["camera_scale", "factor"] == reach.LARGEST_SCALE
    assert highest["grip_slip", "length_m"] == reach.LARGEST_SLIP_M
    assert highest["camera_latency", "delay_s"] == reach.LARGEST_DELAY_S
    assert highest["robot_lag", "delay_s"] == reach.LARGEST_DELAY_S
    roll = 2.0 * np.sin(0.5 * highest["camera_roll", "angle_rad"])
    assert roll == pytest.approx(reach.LARGEST_OFFSET, rel=0.02)


@pytest.mark.parametrize("way", [(-1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.6, -0.8)])
def test_another_frame_is_refused(way: tuple[float, float]) -> None:
    trial = made()
    problems, _ = said_of(moved(trial, trial.markers.xy_m + 0.06 * np.array(way)))
    assert "frame" in problems


@pytest.mark.parametrize("factor", [3.28, 39.4, 100.0, 1000.0])
@pytest.mark.parametrize("markers", [1, 6])
def test_another_unit_is_refused(factor: float, markers: int) -> None:
    trial = made(arcs_m=ARCS_M[:markers])
    problems, _ = said_of(moved(trial, factor * trial.markers.xy_m), ARCS_M[:markers])
    assert "give metres" in problems


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.2, 1.6])
def test_arc_lengths_from_the_other_end_are_refused_at_any_scale(factor: float) -> None:
    trial = made(library()["camera_scale"].active(factor=factor))
    problems, _ = said_of(trial, ARCS_M[::-1])
    assert "turn markers.arc_length_m round" in problems


@pytest.mark.parametrize("arcs_m", [[0.1, 0.05], [0.09, 0.05, 0.02], [0.1, 0.08, 0.06, 0.04]])
def test_arc_lengths_listed_the_other_way_round_are_refused(arcs_m: list[float]) -> None:
    problems, _ = said_of(made(arcs_m=np.array(arcs_m)), np.array(arcs_m[::-1]))
    assert "turn markers.arc_length_m round" in problems


def test_inner_markers_of_an_enlarged_picture_are_not_called_reversed() -> None:
    arcs_m = np.array([0.045, 0.03])
    trial = made(library()["camera_scale"].active(factor=1.5), arcs_m=arcs_m)
    assert said_of(trial, arcs_m)[0] == ""


def test_scale_is_that_of_the_picture() -> None:
    for factor, scale in ((0.8, 1.0), (1.0, 1.0), (1.2, 1.2), (1.6, 1.6), (3.0, 2.0)):
        trial = made()
        shown = moved(trial, factor * trial.markers.xy_m)
        assert Reach(shown, ARCS_M, LENGTH_M).scale == pytest.approx(scale, rel=0.03)
    assert Reach(made(arcs_m=ARCS_M[:1]), ARCS_M[:1], LENGTH_M).scale == 2.0


def test_a_marker_of_late_pictures_is_not_lost() -> None:
    """Rounded values stay while only the log says that the gripper moves."""
    t_s = np.arange(0.0, 0.6, 0.01)
    place_m = np.clip((t_s - 0.2) / 0.1, 0.0, 1.0) * 0.05
    trial = made()
    late_m = np.zeros((len(t_s), 2)) - [0.1, 0.0]
    late_m[29:, 0] += 0.008 + 0.001 * np.arange(len(t_s) - 29)
    grip = Motion(t_s, place_m, 0.0 * t_s, 0.0 * t_s)
    trial = replace(trial, grip=grip, markers=Markers(t_s, np.round(late_m[:, None], 3)))
    own = Reach(trial, ARCS_M[:1], LENGTH_M)
    outer = np.array([0])
    undelayed_m = trial.gripper_m(t_s)[None]
    assert frozen(trial.markers.xy_m, undelayed_m, outer, 0.01) is not None
    assert frozen(trial.markers.xy_m, own.delayed_m, outer, 0.01) is None
