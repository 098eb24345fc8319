"""Cables that begin beside their equilibrium: held bent, or in motion."""

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.cable.swing import ROOTS, mode_curvature

LENGTH_M, RIGIDITY_N_M2, DENSITY = 0.1, 3e-3, 0.0074
STILL = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))


@pytest.mark.parametrize("mode", range(len(ROOTS)))
def test_a_mode_moves_the_tip_by_one_length_and_its_end_is_free(mode):
    x = np.linspace(0.0, 1.0, 2001)
    curvature = mode_curvature(x, len(ROOTS))[:, mode]
    slope = np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * x[1])])
    assert np.trapezoid(slope, x) == pytest.approx(1.0, abs=3e-4)
    assert curvature[-1] == pytest.approx(0.0, abs=1e-5)
    assert np.gradient(curvature, x)[-1] == pytest.approx(0.0, abs=ROOTS[mode] ** 4 * x[1])


@pytest.mark.parametrize("start", ["held", "moving"])
def test_a_stiff_cable_vibrates_in_the_mode_in_which_it_begins(start):
    """Against the closed form: ω = β² √(EI / ρ L⁴), which gravity hardly changes here."""
    model = CableModel.uniform(Cable(LENGTH_M, DENSITY, 0.016, 1e-4), RIGIDITY_N_M2)
    omega = ROOTS[0] ** 2 * np.sqrt(RIGIDITY_N_M2 / DENSITY / LENGTH_M**4)
    t_s = np.linspace(0.0, 4.0 * np.pi / omega, 60)
    tip = np.array([LENGTH_M])
    modes = np.zeros((2, 3))
    if start == "held":
        modes[0, 0], release_s, expected = 0.01, 0.0, np.cos(omega * t_s)
    else:
        modes[1, 0], release_s, expected = 0.01 * omega, None, np.sin(omega * t_s)
    fine = Solver(segments=40, step_s=1e-4)
    seen = simulate(
        model, STILL, t_s, tip, solver=fine, start=start, release_s=release_s, bent=[modes]
    )
    rest = simulate(model, STILL, t_s[:1], tip, solver=fine)
    moved_m = -(seen - rest)[0, :, 0, 1]  # a positive curvature bends the tip down
    assert moved_m == pytest.approx(0.01 * LENGTH_M * expected, abs=2e-5)


def test_only_a_cable_that_is_bent_has_bends():
    model = CableModel.uniform(Cable(LENGTH_M, DENSITY, 0.016, 1e-4), RIGIDITY_N_M2)
    asked = (model, STILL, np.array([0.0, 0.1]), np.array([LENGTH_M]))
    with pytest.raises(ValueError, match="bends of 0 of 1 lanes"):
        simulate(*asked, start="moving")
    with pytest.raises(ValueError, match="bends of 1 of 1 lanes"):
        simulate(*asked, bent=[np.zeros((2, 3))])
    with pytest.raises(ValueError, match="'held' have a release"):
        simulate(*asked, start="held", bent=[np.zeros((2, 3))])


@pytest.mark.parametrize("delay_s", [0.003, 0.012])
def test_a_late_camera_shows_what_moved_before_the_first_picture(delay_s):
    """From a turning point without loss a swing goes back the way it came.

    It was shown as if the cable had stood still until then; a lag of the gripper was named instead.
    """
    latency = library()["camera_latency"].active(delay_s=delay_s)
    hand = Motion(np.array([0.0, 2.0]), *np.zeros((3, 2)))
    arcs, bent = np.array([LENGTH_M]), [np.array([[0.02], [0.0]])]

    def shown(t_s, *effects):
        cable = CableModel.uniform(Cable(LENGTH_M, DENSITY, 0.016, 1e-4), 3e-5, effects=effects)
        return simulate(cable, hand, t_s, arcs, start="moving", bent=bent)[0]

    t_s = 1.0 + np.array([0.0, 0.1, 0.2])
    late = shown(t_s, latency)
    known = shown(np.array([1.0, 1.0 + delay_s, 1.1 - delay_s, 1.2 - delay_s]))
    moved_m = np.abs(known[1] - known[0]).max()
    assert late[1:] == pytest.approx(known[2:], abs=2e-6)
    assert np.abs(late[0] - known[1]).max() < 1e-6 + 0.02 * moved_m


@pytest.mark.parametrize("name", ["camera_latency", "rolling_shutter"])
def test_a_held_cable_is_shown_still_until_its_release_whatever_the_cameras_clock(name):
    """It was shown where a parabola from behind the release led to, a free length away."""
    effect = library()[name]
    late = effect.active(**{p.name: p.starts[-1] for p in effect.parameters})
    cable = Cable(LENGTH_M, DENSITY, 0.016, 1e-4)
    t_s, arcs = np.array([0.0, 0.1, 0.2, 0.3]), np.array([LENGTH_M])
    bent = [np.array([[0.3], [0.0]])]

    def shown(*effects):
        model = CableModel.uniform(cable, RIGIDITY_N_M2, effects=effects)
        return simulate(model, STILL, t_s, arcs, start="held", release_s=0.25, bent=bent)[0, :, 0]

    assert shown(late)[:3] == pytest.approx(shown()[:3], abs=1e-9)
    assert shown(late)[3] != pytest.approx(shown()[3], abs=1e-5)
