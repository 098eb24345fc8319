"""Effects against closed forms: drag of a towed strip, Maxwell's relaxation, Dahl's loop."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cell.cable import layout as at
from cell.cable.dynamics import simulate
from cell.cable.effects import library, unscreened
from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3
from cell.cable.effects.compiled import loops_of
from cell.cable.effects.pointer import ADVANCE, EVALUATE, REST
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver

EFFECTS = library() | unscreened()
RIGIDITY = 3e-5


def test_towed_strip_bends_like_a_cantilever_under_its_drag(cable):
    # hanging, weightless, towed sideways at a constant speed: q = ½ρ C_d w U², tip q L⁴/(8 EI)
    drag, speed = 2.0, 0.3
    load = 0.5 * AIR_DENSITY_KG_PER_M3 * drag * cable.width_m * speed**2
    expected = load * cable.free_length_m**4 / (8 * RIGIDITY)
    model = CableModel.uniform(
        cable,
        RIGIDITY,
        viscosity_n_m2_s=2e-6,
        gravity_m_per_s2=(0.0, 0.0),
        effects=(EFFECTS["air_drag"].active(drag_coefficient=drag),),
    )
    t = np.arange(0.0, 4.0, 0.01)
    x = speed * np.where(t < 1.0, t**2 / 2, t - 0.5)
    towed = Motion(t, x, 0 * t, np.full_like(t, np.pi / 2))
    xy = simulate(model, towed, np.array([3.9]), np.array([0.0, cable.free_length_m]))[0, 0]
    # of the normal velocity only: to first order in the slope as computed by hand
    assert xy[0, 0] - xy[1, 0] == pytest.approx(expected, rel=5e-3)


class Hinge:
    """The compiled loop of a bending effect on one hinge whose curvature is prescribed."""

    def __init__(self, name, **values):
        active = EFFECTS[name].active(**values)
        (module,) = loops_of(active.effect).alive
        self.loop = module.loop
        self.params = np.tile(np.array([0.016, 1e-4, 0.0074, 0.1, *active.values]), (at.LANES, 1)).T
        self.params = np.ascontiguousarray(self.params).ravel()
        self.memory = np.zeros(2 * at.LANES)
        self.state = np.zeros((2, at.FIELDS, at.LANES))
        self.state[:, at.PER_LENGTH] = 1.0
        self.state[:, at.RIGIDITY] = RIGIDITY

    def call(self, mode, duration):
        self.loop(
            self.state.ravel(), 1, 1, mode, duration, 0.25 * duration**2, 0.5 * duration,
            self.params, 4, self.memory, 0,
        )  # fmt: skip

    def rest(self, curvature):
        self.state[1, at.BEND_C] = curvature
        self.call(REST, 1.0)

    def step(self, before, after, duration):
        """Moment at the end of a step in which the curvature went from one to the other."""
        s = self.state[1]
        s[at.BEND_0], s[at.BEND], s[at.BEND_C] = before, after, after
        s[at.RATE_C] = (after - before) / duration
        s[at.MOMENT] = s[at.STIFF] = 0.0
        self.call(EVALUATE, duration)
        self.call(ADVANCE, duration)
        return s[at.MOMENT, 0]


@pytest.mark.parametrize("step_s", [1e-4, 1e-3, 0.5])
def test_maxwell_branch_relaxes_exponentially(step_s):
    fraction, tau, curvature = 0.3, 0.02, 5.0
    hinge = Hinge("stress_relaxation", fraction=fraction, time_s=tau)
    hinge.rest(0.0)
    hinge.step(0.0, curvature, 1e-9)
    for k in range(1, 20):
        moment = hinge.step(curvature, curvature, step_s)
        exact = fraction * RIGIDITY * curvature * np.exp(-k * step_s / tau)
        assert moment == pytest.approx(exact, rel=1e-6, abs=1e-14)


def test_rest_is_relaxed():
    hinge = Hinge("stress_relaxation", fraction=0.3, time_s=0.02)
    hinge.rest(7.0)
    assert hinge.state[1, at.MOMENT, 0] == 0.0
    assert hinge.step(7.0, 7.0, 1e-3) == pytest.approx(0.0, abs=1e-18)


@pytest.mark.parametrize("steps", [1, 7, 400])
def test_dahl_follows_its_closed_form_whatever_the_step(steps):
    moment, scale = 4e-6, 1.2
    hinge = Hinge("bending_hysteresis", moment_n_m=moment, curvature_1_per_m=scale)
    hinge.rest(0.0)
    z, here = 0.0, 0.0
    for target in (3.0, -2.0, 0.5, 0.4):
        path = np.linspace(here, target, steps + 1)
        for before, after in itertools.pairwise(path):
            found = hinge.step(before, after, 1e-3)
        sign = np.sign(target - here)
        z = sign + (z - sign) * np.exp(-abs(target - here) / scale)
        here = target
        assert found == pytest.approx(moment * z, rel=1e-6)


@pytest.mark.parametrize("steps", [60, 2000])
def test_a_set_cable_levels_off_as_tanh_and_springs_back_straight(steps):
    radius, most = 0.05, 35.0
    hinge = Hinge("plastic_set", radius_m=radius)
    hinge.rest(0.0)

    def bend(curvatures):
        moments = [hinge.step(*ends, 1e-3) for ends in itertools.pairwise(curvatures)]
        return np.array(moments) + RIGIDITY * curvatures[1:]

    out = np.linspace(0.0, most, steps + 1)
    assert bend(out) == pytest.approx(
        RIGIDITY * np.tanh(radius * out[1:]) / radius, rel=2.0 / steps, abs=1e-9
    )
    left = most - np.tanh(radius * most) / radius
    back = np.linspace(most, left, steps + 1)
    assert bend(back) == pytest.approx(RIGIDITY * (back[1:] - left), rel=1e-2, abs=1e-6)


@pytest.mark.parametrize("curvature", [-30.0, 0.1, 0.3, 25.0])
def test_at_rest_a_set_cable_was_bent_once(curvature):
    """The memory at rest joins on to that of a cable bent there from straight."""
    radius = 0.05
    hinge = Hinge("plastic_set", radius_m=radius)
    hinge.rest(curvature)
    moment = hinge.state[1, at.MOMENT, 0] + RIGIDITY * curvature
    assert moment == pytest.approx(RIGIDITY * np.tanh(radius * curvature) / radius, rel=1e-6)


def test_perspective_is_that_of_a_pinhole():
    turn, nod, distance = 0.2, -0.1, 0.4
    lens = EFFECTS["lens_perspective"]
    p = lens.active(turn_rad=turn, nod_rad=nod, distance_m=distance, centre_x_m=0.0, centre_y_m=0.0)
    xy = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 2))
    axis = Rotation.from_euler("yx", [-turn, nod])  # x right, y up, z away from a camera at −z
    x, y, z = axis.apply(np.column_stack([xy, np.zeros(50)])).T
    seen = lens.camera_points(None, xy, SimpleNamespace(**p.named))
    expected = np.column_stack([x, y]) * (distance / (distance + z))[:, None]
    np.testing.assert_allclose(seen, expected, atol=1e-12)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_a_start_off_by_a_hair_stays_a_hair_off(cable, arc, jerk, name):
    effect = EFFECTS[name]
    active = effect.active(**{p.name: p.starts[0] for p in effect.parameters})
    models = [
        CableModel.uniform(cable, 3e-5 * (1.0 + hair), viscosity_n_m2_s=1e-7, effects=(active,))
        for hair in (0.0, 1e-12)
    ]
    a, b = simulate(models, jerk, np.arange(0.0, 1.5, 0.05), arc, solver=Solver(60, 4e-4))
    assert np.abs(a - b).max() < 1e-9
