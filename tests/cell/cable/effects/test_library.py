"""The project's own effects: names, that each does something, that each is off when off."""

import inspect

import numpy as np
import pytest

from cell.cable.clamp import pose_of
from cell.cable.dynamics import simulate
from cell.cable.effects import library, load_effect, unscreened
from cell.cable.effects.check import check
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver

NAMES = [
    "air_drag",
    "linear_air_drag",
    "added_mass",
    "draught",
    "stress_relaxation",
    "bending_hysteresis",
    "natural_curvature",
    "tip_mass",
    "point_mass",
    "grip_angle",
    "grip_compliance",
    "grip_slip",
    "camera_latency",
    "robot_lag",
    "robot_ringing",
    "camera_scale",
    "camera_roll",
    "rolling_shutter",
]
RARE = ["plastic_set", "lens_perspective", "rest_shape", "power_drag"]
EFFECTS = library() | unscreened()
TIMES = np.arange(0.0, 1.5, 0.01)

#: Largest displacement of the tip at the first of each parameter's `starts`, mm: expected sizes.
SIZE_MM = {
    "air_drag": (1, 5),
    "linear_air_drag": (1, 5),
    "added_mass": (2, 6),
    "draught": (0.2, 2),
    "stress_relaxation": (4, 13),
    "bending_hysteresis": (3, 12),
    "natural_curvature": (1, 9),
    "tip_mass": (7, 17),
    "grip_angle": (1, 5),
    "grip_compliance": (3, 20),
    "grip_slip": (1, 7),
    "camera_latency": (0.5, 4),
    "robot_lag": (0.5, 4),
    "robot_ringing": (0.2, 1.5),
    "camera_scale": (0.3, 1.2),
    "camera_roll": (0.3, 1.2),
    "rolling_shutter": (0.1, 2),
    "plastic_set": (4, 13),
    "lens_perspective": (0.3, 1.2),
    "rest_shape": (1, 9),
    "power_drag": (1, 5),
    "point_mass": (1, 8),
}


def paths(cable, jerk, arc, *active, **options):
    models = [
        CableModel(cable, np.array([3.5e-5, 2.5e-5]), 1.05, 1e-7, effects=(a,) if a else ())
        for a in active
    ]
    return simulate(models, jerk, TIMES, arc, **options)


def typical(effect):
    return effect.active(**{p.name: p.starts[0] for p in effect.parameters})


def test_all_names_are_there():
    assert sorted(library()) == sorted(NAMES)
    assert sorted(unscreened()) == sorted(RARE)


@pytest.mark.parametrize("name", RARE)
def test_a_rare_effect_can_be_given_as_a_file(name):
    file = inspect.getsourcefile(EFFECTS[name])
    assert load_effect(file).name == name


@pytest.mark.parametrize("name", NAMES + RARE)
def test_the_checks_of_a_users_effect_hold_for_ours(name):
    check(EFFECTS[name])
    assert len(EFFECTS[name].__doc__) > 30


@pytest.mark.parametrize("name", NAMES + RARE)
def test_an_effect_changes_the_output_by_its_size_and_is_off_when_off(cable, jerk, arc, name):
    effect = EFFECTS[name]
    without, on, off = paths(cable, jerk, arc, None, typical(effect), effect.active())
    change = np.linalg.norm(on - without, axis=-1).max() * 1e3
    low, high = SIZE_MM[name]
    assert low < change < high
    assert off == pytest.approx(without, abs=2e-7)


@pytest.mark.parametrize("name", NAMES + RARE)
def test_every_parameter_does_something(cable, jerk, arc, name):
    effect = EFFECTS[name]
    values = {p.name: p.starts[0] for p in effect.parameters}
    changed = []
    for p in effect.parameters:
        size = 0.3 * (p.starts[0] or p.high)
        other = p.starts[0] + size if p.starts[0] + size <= p.high else p.starts[0] - size
        changed.append(effect.active(**(values | {p.name: other})))
    base, *others = paths(cable, jerk, arc, typical(effect), *changed)
    for p, path in zip(effect.parameters, others, strict=True):
        assert np.abs(path - base).max() > 1e-6, p.name


@pytest.mark.parametrize("name", NAMES + RARE)
def test_parameters_mean_the_same_on_every_mesh(cable, jerk, arc, name):
    active = typical(EFFECTS[name])
    changes = []
    for segments in (12, 40):
        without, on = paths(cable, jerk, arc, None, active, solver=Solver(segments, 7.5e-4))
        changes.append(on - without)
    scale = np.abs(changes[1]).max()
    assert np.abs(changes[0] - changes[1]).max() < 0.03 * scale + 2e-5


def test_from_rest_lag_of_the_hand_and_latency_of_the_camera_look_alike(cable, jerk, arc):
    late = (
        EFFECTS["robot_lag"].active(delay_s=0.008),
        EFFECTS["camera_latency"].active(delay_s=0.008),
    )
    lag, latency = paths(cable, jerk, arc, *late)
    assert np.abs(lag - latency).max() < 2e-6


def test_compliance_turns_the_clamp_by_the_moment(cable, at_rest):
    soft = EFFECTS["grip_compliance"].active(rad_per_n_m=50.0)
    model = CableModel.uniform(cable, 3e-5, effects=(soft,))
    shape = at_rest(model, np.linspace(0.0, 0.1, 2001), segments=200)
    x = shape[:, 0]
    moment = 0.0074 * 9.81 * np.trapezoid(-x, np.linspace(0.0, 0.1, 2001))
    angle = np.arctan2(-shape[1, 1], -shape[1, 0])
    assert angle == pytest.approx(50.0 * moment, rel=0.02)


@pytest.mark.parametrize("seconds", [0.15, 0.3, 0.6])
def test_ringing_begins_when_the_hand_stops_however_smoothly(seconds):
    t = np.arange(0.0, 1.2, 0.002)
    u = np.clip((t - 0.2) / seconds, 0.0, 1.0)
    motion = Motion(t, 0 * t, -0.05 * u**3 * (10 - 15 * u + 6 * u**2), 0 * t)
    ringing = library()["robot_ringing"].active(amplitude_m=4e-4, frequency_hz=12.0, damping=0.0)
    later = 0.2 + seconds + np.linspace(0.01, 0.2, 20)
    added = pose_of(motion, (ringing,))(later)[1] - pose_of(motion)(later)[1]
    # down is the way it came; 2 ms late or early is 0.06 mm
    wave = -4e-4 * np.sin(2 * np.pi * 12.0 * (later - 0.2 - seconds))
    assert np.abs(added - wave).max() < 4e-5
