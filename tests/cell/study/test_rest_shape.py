"""A cable at rest tells how fast it swings and how it is held: wrong units and frames are named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion
from cell.study.data import Markers, Trial
from cell.study.facts import facts_of
from cell.study.record_checks import oddities
from cell.study.rest_shape import clamped_end, swing_scale
from cell.study.trial_checks import trial_problems

LENGTH_M, DROOP = 0.1, 0.028
GRAVITY = (0.0, -9.81)
ARCS_M = np.array([0.1, 0.08, 0.06, 0.04, 0.02, 0.01])
#: By Euler and Bernoulli, of a cantilever that droops by so much: √(1.54 g / δ) / 2π.
SWING_HZ = 3.7


def a_trial(angle_rad: float = 0.1) -> Trial:
    """A cable that droops by 28 mm is moved down and swings at the frequency of its droop."""
    t_s = np.arange(0.0, 2.4, 0.005)
    s = np.clip((t_s - 0.4) / 0.3, 0.0, 1.0)
    stroke = s**3 * (10 - 15 * s + 6 * s**2)
    after = np.clip(t_s - 0.45, 0.0, None)
    ring = 1.0 - 0.4 * np.exp(-after) * np.sin(2.0 * np.pi * SWING_HZ * after)
    fine = np.linspace(0.0, LENGTH_M, 2001)
    along = fine / LENGTH_M
    turn = angle_rad + 1.12 * ring[:, None] * (along - along**2 + along**3 / 3.0) * DROOP / 0.028
    steps = -np.stack([np.cos(turn), np.sin(turn)], axis=2)
    middle = 0.5 * (steps[:, 1:] + steps[:, :-1]) * fine[1]
    curve = np.concatenate([np.zeros((len(t_s), 1, 2)), np.cumsum(middle, axis=1)], axis=1)
    hand = np.column_stack([0.01 * stroke, -0.05 * stroke])
    noise = np.random.default_rng(1).normal(0.0, 5e-5, (len(t_s), len(ARCS_M), 2))
    xy_m = hand[:, None] + curve[:, np.searchsorted(fine, ARCS_M - 1e-9)] + noise
    grip = Motion(t_s, hand[:, 0], hand[:, 1], np.full(len(t_s), angle_rad))
    return Trial("made", "fit", "equilibrium", grip, Markers(t_s, xy_m))


def told(trial: Trial, arcs_m: np.ndarray = ARCS_M, gravity=GRAVITY) -> str:
    """All that is said of a trial, refused or odd."""
    cable = Cable(LENGTH_M, 0.0074, 0.016, 0.0001)
    problems, notes = trial_problems(trial, cable, arcs_m, gravity)
    said = [*(p.message for p in problems), *notes]
    return " ".join([*said, *oddities(facts_of([trial], arcs_m, gravity), None)]).strip()


def test_a_cantilever_swings_at_the_frequency_of_its_droop() -> None:
    """Euler and Bernoulli: δ = ρA g L⁴ / 8EI and ω² = 12.36 EI / (ρA L⁴)."""
    trial = a_trial(0.0)
    found = swing_scale(trial, 80, 0, LENGTH_M, GRAVITY)
    assert found is not None
    load, stiffness = 1.0, 1.0 / (8.0 * found.droop_m / 9.81 / LENGTH_M**4)
    omega = np.sqrt(12.3624 * stiffness / (load * LENGTH_M**4))
    assert found.droops_hz == pytest.approx(omega / (2.0 * np.pi), rel=0.01)
    assert found.slowest_hz == pytest.approx(
        2.4048 / 2.0 * np.sqrt(9.81 / 0.1) / 2 / np.pi, rel=0.01
    )
    assert swing_scale(trial, 80, 0, LENGTH_M, (0.0, 0.0)) is None


def test_the_root_is_where_and_as_the_cable_leaves() -> None:
    found = clamped_end(a_trial(0.1), 80, ARCS_M)
    assert found is not None
    assert found.away_m < 2e-4
    assert abs(found.turned_rad) < 0.02
    assert found.worst_m < 2e-4
    assert clamped_end(a_trial(), 80, ARCS_M + 0.02) is None  # no marker is near the clamp


def markers(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Trial], Trial]:
    return lambda t: replace(t, markers=Markers(t.markers.t_s, change(t.markers.xy_m.copy())))


def grip(change: Callable[[Motion], tuple[np.ndarray, ...]]) -> Callable[[Trial], Trial]:
    return lambda t: replace(t, grip=Motion(*change(t.grip)))


def clock(factor: float) -> Callable[[Trial], Trial]:
    def changed(t: Trial) -> Trial:
        g = t.grip
        grip = Motion(g.t_s * factor, g.x_m, g.y_m, g.angle_rad)
        return replace(t, grip=grip, markers=Markers(t.markers.t_s * factor, t.markers.xy_m))

    return changed


def turned(degrees: float) -> Callable[[Trial], Trial]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return markers(lambda xy: xy @ np.array([[c, s], [-s, c]]))


FAULTS: dict[str, tuple[Callable[[Trial], Trial], str]] = {
    "time ×8": (clock(8.0), "units of time"),
    "time ×3": (clock(3.0), "units of time"),
    "time ÷3": (clock(1 / 3.0), "units of time"),
    "markers ×1.04": (markers(lambda xy: xy * 1.04), "check its arc length"),
    "markers ×10": (markers(lambda xy: xy * 10.0), "(2.5 free lengths) from the gripping point"),
    "markers 4 mm higher": (markers(lambda xy: xy + np.array([0.0, 4e-3])), "gripping point"),
    "markers 20 mm aside": (markers(lambda xy: xy + np.array([2e-2, 0.0])), "gripping point"),
    "markers turned by 25°": (turned(25.0), "from its angle"),
    "x mirrored": (markers(lambda xy: xy * [-1.0, 1.0]), "change the sign of x_m"),
    "y mirrored": (markers(lambda xy: xy * [1.0, -1.0]), "gripping point"),
    "x and y exchanged": (markers(lambda xy: xy[..., ::-1]), "gripping point"),
    "markers reversed": (markers(lambda xy: xy[:, ::-1]), "turn markers.arc_length_m round"),
    "neighbours exchanged": (markers(lambda xy: xy[:, [1, 0, 2, 3, 4, 5]]), "order of markers"),
    "angle off by 25°": (
        grip(lambda g: (g.t_s, g.x_m, g.y_m, g.angle_rad + np.radians(25.0))), "from its angle"
    ),
    "angle in degrees": (
        grip(lambda g: (g.t_s, g.x_m, g.y_m, np.degrees(g.angle_rad))), "from its angle"
    ),
    "hand in half its unit": (
        grip(lambda g: (g.t_s, g.x_m * 0.5, g.y_m * 0.5, g.angle_rad)), "farther than any cable"
    ),
    "gripper 0.2 s late": (
        grip(lambda g: (g.t_s + 0.2, g.x_m, g.y_m, g.angle_rad)), "clocks differ"
    ),
    "gripper 0.2 s early": (
        grip(lambda g: (g.t_s - 0.2, g.x_m, g.y_m, g.angle_rad)), "clocks differ"
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_unit_clock_axis_or_role_is_named(fault: str) -> None:
    change, said = FAULTS[fault]
    assert said in told(change(a_trial()))


def test_a_right_trial_has_nothing_odd() -> None:
    assert told(a_trial()) == ""


def test_an_arc_length_that_is_4_percent_off_is_named() -> None:
    arcs = ARCS_M.copy()
    arcs[2] += 4e-3
    assert "check its arc length" in told(a_trial(), arcs)
