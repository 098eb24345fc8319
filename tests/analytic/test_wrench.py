"""The wrench at the clamp against weight and lever, momentum, and rigid bodies."""

import numpy as np
import pytest

from cell.cable.dynamics import Beginning, simulate, simulate_each
from cell.cable.effects import library
from cell.cable.geometry import Cable, Connector, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.cable.wrench import Gauge, Tool
from tools.worlds.made_studies import stroke

CABLE = Cable(0.4, 0.06, 0.008, 0.006)
BODY = Connector(0.012, 0.03, 2e-6)
FINE = Solver(segments=60, step_s=5e-4)
RIGIDITY = 4e-3
BARE = Gauge()
G = np.array([0.0, -9.81])
#: Gauss points of the cable, tip first, and their weights; rods are straight between nodes.
ROOTS, SHARES = (v[::-1] for v in np.polynomial.legendre.leggauss(60))
SHARES = SHARES / 2.0


def places(cable):
    return 0.5 * (1.0 + ROOTS) * cable.free_length_m


def gauged(model, hand, t_s, gauge=BARE, solver=FINE, begin=None):
    """Markers (T, 60, 2) at Gauss points, force (T, 2) and moment (T,)."""
    arcs = places(model.cable)
    (out,) = simulate_each(model, hand, [t_s], arcs, gauge=gauge, solver=solver, begin=begin)
    return out[:, :-2], out[:, -2], out[:, -1, 0]


def still(angle=0.0, at=(0.0, 0.0), seconds=0.5):
    t = np.array([0.0, seconds])
    return Motion(t, np.full(2, at[0]), np.full(2, at[1]), np.full(2, angle))


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def swinging(points, hand, t_s, cable, loads=0.0):
    """Force and moment by Newton's law: ∫ρ (a − g) ds − loads, accelerations by differences.

    loads  (T, 60, 2) external force per metre
    """
    h = t_s[1] - t_s[0]
    a = (points[2:] - 2.0 * points[1:-1] + points[:-2]) / h**2
    inner = slice(1, -1)
    grip = np.stack([hand.splines[0](t_s), hand.splines[1](t_s)], axis=1)[inner, None]
    per_m = cable.line_density_kg_per_m * (a - G) - (loads[inner] if np.ndim(loads) else 0.0)
    weights = SHARES * cable.free_length_m
    force = np.einsum("tmx,m->tx", per_m, weights)
    return force, np.einsum("tm,m->t", cross(points[inner] - grip, per_m), weights)


@pytest.mark.parametrize("angle", [0.0, 0.7, -1.2])
def test_at_rest_the_clamp_carries_the_weight_at_its_lever(angle):
    model = CableModel.uniform(CABLE, RIGIDITY)
    t_s = np.array([0.0, 0.2])
    points, force, moment = gauged(model, still(angle, (0.3, -0.2)), t_s)
    weight = CABLE.line_density_kg_per_m * CABLE.free_length_m * 9.81
    np.testing.assert_allclose(force, [[0.0, weight]] * 2, atol=1e-9)
    lever = (points[0, :, 0] - 0.3) @ SHARES
    np.testing.assert_allclose(moment, weight * lever, rtol=3e-4)


def test_a_connector_and_a_tip_mass_add_their_weight_and_lever():
    cable = Cable(0.4, 0.06, 0.008, 0.006, BODY)
    tip = library()["tip_mass"].active(mass_kg=0.005)
    model = CableModel.uniform(cable, RIGIDITY, effects=(tip,))
    arcs = np.array([0.4 + 0.5 * BODY.length_m, 0.4, 0.2])
    (out,) = simulate_each(model, still(), [np.array([0.1])], arcs, gauge=Gauge(), solver=FINE)
    points, force, moment = gauged(model, still(), np.array([0.1]))
    masses = [0.06 * 0.4, BODY.mass_kg, 0.005]
    levers = [points[0, :, 0] @ SHARES, out[0, 0, 0], out[0, 1, 0]]
    np.testing.assert_allclose(force[0], [0.0, 9.81 * sum(masses)], atol=1e-9)
    np.testing.assert_allclose(moment[0], 9.81 * np.dot(masses, levers), rtol=3e-4)


def test_a_point_mass_is_carried_at_its_place_and_at_the_end_is_a_tip_mass():
    mass, place = library()["point_mass"], 0.37
    arcs, t_s = CABLE.free_length_m * np.array([place]), np.array([0.1])
    model = CableModel.uniform(CABLE, RIGIDITY, effects=(mass.active(mass_kg=0.004, place=place),))
    (out,) = simulate_each(model, still(), [t_s], arcs, gauge=Gauge(), solver=FINE)
    points, force, moment = gauged(model, still(), t_s)
    weights = 9.81 * np.array([CABLE.line_density_kg_per_m * CABLE.free_length_m, 0.004])
    np.testing.assert_allclose(force[0], [0.0, weights.sum()], atol=1e-9)
    levers = np.array([points[0, :, 0] @ SHARES, out[0, 0, 0]])
    np.testing.assert_allclose(moment[0], weights @ levers, rtol=3e-4)
    both = [mass.active(mass_kg=0.004, place=1.0), library()["tip_mass"].active(mass_kg=0.004)]
    hand, t_s = stroke(0.2, (-0.05, -0.08), 0.4), np.arange(0.0, 1.0, 0.01)
    at_end, at_tip = (
        simulate(CableModel.uniform(CABLE, RIGIDITY, effects=(e,)), hand, t_s, arcs) for e in both
    )
    np.testing.assert_allclose(at_end, at_tip, atol=1e-12)


@pytest.mark.parametrize("drag", [0.0, 2.0])
def test_in_motion_it_is_the_rate_of_momentum_less_what_else_acts(drag):
    effect = library()["linear_air_drag"].active(drag_n_s_per_m2=drag)
    model = CableModel.uniform(CABLE, RIGIDITY, viscosity_n_m2_s=2e-5, effects=(effect,))
    hand = stroke(0.2, (-0.05, -0.08), 0.4)
    t_s = np.arange(0.1, 1.2, 1e-3)
    points, force, moment = gauged(model, hand, t_s, solver=Solver(segments=100, step_s=2.5e-4))
    velocity = np.gradient(points, t_s, axis=0)
    along = -np.gradient(points, places(CABLE), axis=1, edge_order=2)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    load = -drag * np.sum(velocity * normal, axis=-1, keepdims=True) * normal
    wanted, about = swinging(points, hand, t_s, CABLE, load)
    size = np.abs(wanted - wanted[0]).max()
    assert size > 0.05
    np.testing.assert_allclose(force[1:-1], wanted, atol=0.005 * size)
    np.testing.assert_allclose(moment[1:-1], about, atol=0.005 * np.abs(about - about[0]).max())
    if drag:
        without, _ = swinging(points, hand, t_s, CABLE)
        assert np.abs(without - wanted).max() > 0.05 * size


def test_a_cable_that_hardly_bends_is_a_rod():
    """Force m (a − g) of its middle, and moment of the rod about its end, the gripper turning
    too."""
    model = CableModel.uniform(Cable(0.1, 0.06, 0.008, 0.006), 50.0)
    t = np.arange(0.0, 1.0, 0.002)
    turn, pace = 0.4, 2.0 * np.pi * 1.5
    angle = turn * np.sin(pace * t) ** 3
    hand = Motion(t, 0.02 * np.sin(pace * t) ** 3, 0.0 * t, angle)
    t_s = np.arange(0.2, 0.8, 0.01)
    _, force, moment = gauged(model, hand, t_s)
    m, length = 0.006, 0.1
    x, theta = hand.splines[0], hand.splines[2]
    h = 1e-4

    def second(f):
        return (f(t_s + h) - 2.0 * f(t_s) + f(t_s - h)) / h**2

    def first(f):
        return (f(t_s + h) - f(t_s - h)) / (2.0 * h)

    spin, alpha = first(theta), second(theta)
    r = -0.5 * length * np.stack([np.cos(theta(t_s)), np.sin(theta(t_s))], axis=1)
    a = alpha[:, None] * np.stack([-r[:, 1], r[:, 0]], axis=1) - spin[:, None] ** 2 * r
    a[:, 0] += second(x)
    wanted = m * (a - G)
    about = cross(r, wanted) + m * length**2 / 12.0 * alpha
    np.testing.assert_allclose(force, wanted, atol=0.005 * np.abs(wanted).max())
    np.testing.assert_allclose(moment, about, atol=0.005 * np.abs(about).max())


def test_a_tool_adds_a_rigid_body_that_turns_with_the_hand():
    """Gauge with a tool less the gauge without: m (a − g) of its centre, and I α."""
    model = CableModel.uniform(CABLE, RIGIDITY)
    t = np.arange(0.0, 1.0, 0.002)
    hand = Motion(t, 0.0 * t, 0.03 * np.sin(8.0 * t) ** 3, 0.3 * np.sin(6.0 * t) ** 3)
    t_s = np.arange(0.3, 0.9, 0.01)
    tool = Tool(0.2, (0.05, -0.02), 1e-4)
    _, force, moment = gauged(model, hand, t_s, Gauge(tool))
    _, bare_force, bare_moment = gauged(model, hand, t_s)
    h = 1e-4

    def centre(s):
        x, y, angle = (f(s) for f in hand.splines)
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack([x + 0.05 * cos + 0.02 * sin, y + 0.05 * sin - 0.02 * cos], axis=1)

    a = (centre(t_s + h) - 2.0 * centre(t_s) + centre(t_s - h)) / h**2
    theta = hand.splines[2]
    alpha = (theta(t_s + h) - 2.0 * theta(t_s) + theta(t_s - h)) / h**2
    wanted = 0.2 * (a - G)
    grip = np.stack([f(t_s) for f in hand.splines[:2]], axis=1)
    about = cross(centre(t_s) - grip, wanted) + 1e-4 * alpha
    np.testing.assert_allclose(force - bare_force, wanted, atol=0.004 * np.abs(wanted).max())
    np.testing.assert_allclose(moment - bare_moment, about, atol=0.004 * np.abs(about).max())


def test_axes_that_turn_with_the_hand_show_the_same_wrench_turned():
    model = CableModel.uniform(CABLE, RIGIDITY)
    t_s = np.array([0.1])
    _, force, moment = gauged(model, still(0.5), t_s)
    _, turned, same = gauged(model, still(0.5), t_s, Gauge(turns=True))
    weight = force[0, 1]
    np.testing.assert_allclose(turned[0], [weight * np.sin(0.5), weight * np.cos(0.5)])
    assert same == moment


def test_markers_are_those_of_a_simulation_without_a_gauge():
    """To the last bit, of lanes of several blocks and of one that cannot be simulated."""
    hand = stroke(0.2, (-0.05, -0.08), 0.4)
    late = library()["camera_latency"].active(delay_s=0.01)
    models = [CableModel.uniform(CABLE, RIGIDITY * k) for k in np.linspace(0.5, 2.0, 18)]
    models[3] = CableModel.uniform(CABLE, RIGIDITY, effects=(late,))
    models[5] = CableModel.uniform(CABLE, 1e-12)
    t_s = [np.arange(0.1, 0.5, 0.01) + 1e-3 * k for k in range(18)]
    arcs, coarse = np.array([0.4, 0.2]), Solver(segments=12, step_s=2e-3)
    plain = simulate_each(models, hand, t_s, arcs, solver=coarse)
    shown = simulate_each(models, hand, t_s, arcs, gauge=Gauge(), solver=coarse)
    for one, other in zip(plain, shown, strict=True):
        np.testing.assert_array_equal(one, other[:, :2])
        assert np.isnan(one).all() == np.isnan(other).all()


def test_a_cable_let_go_is_held_from_then_on():
    """A straight cable at the moment of release: the moment of a free rod's first acceleration."""
    model = CableModel.uniform(CABLE, RIGIDITY)
    begin = Beginning.of("straight", 0.1, (), 1)
    _, force, _ = gauged(model, still(), np.array([0.0, 0.1, 0.4]), begin=begin)
    assert force[0, 1] == force[1, 1]
    weight = CABLE.line_density_kg_per_m * CABLE.free_length_m * 9.81
    assert 0.0 < force[0, 1] < 0.7 * weight < force[2, 1]


def test_the_wrench_of_a_lane_does_not_depend_on_lanes_beside_it():
    """Up to its last time: a record that ends in mid-swing, alone and beside a longer one."""
    model = CableModel.uniform(CABLE, RIGIDITY)
    hand, coarse = stroke(0.2, (-0.05, -0.08), 0.3), Solver(segments=20, step_s=2e-3)
    t_s = np.arange(0.1, 0.4567, 2e-3)
    arcs, longer = np.array([0.4]), np.arange(0.1, 0.6, 2e-3)
    (alone,) = simulate_each(model, hand, [t_s], arcs, gauge=Gauge(), solver=coarse)
    beside, _ = simulate_each([model] * 2, hand, [t_s, longer], arcs, gauge=Gauge(), solver=coarse)
    np.testing.assert_allclose(alone, beside, rtol=1e-9, atol=1e-12)
    ending = [np.append(t_s[t_s < end], end) for end in np.linspace(0.4, 0.402, 7)]
    for each in ending:
        (short,) = simulate_each(model, hand, [each], arcs, gauge=Gauge(), solver=coarse)
        (long,) = simulate_each(
            model, hand, [np.append(each, 0.5)], arcs, gauge=Gauge(), solver=coarse
        )
        np.testing.assert_allclose(short, long[:-1], rtol=1e-9, atol=1e-12)
