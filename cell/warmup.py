"""Loads compiled code before a cable hangs in the jaws and waits for it."""

from __future__ import annotations

from functools import cache

import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.identify.individual import hold_trial, identify
from cell.plan.choose import choose, forecast
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits, executed_motion, identification_path, insertion_path
from drivers.interfaces import Pose

_NOISE_M = 2e-5


@cache
def warm_up(cable: Cable) -> None:
    """Identify a made-up cable and choose a motion for it; what comes out is forgotten."""
    home, limits, rate_hz = Pose(0.0, 0.0), MotionLimits(), 500.0
    length_m = cable.free_length_m
    down = identification_path(home, 0.5 * length_m, limits, rate_hz, hold_s=0.5)
    t_s = np.arange(-0.2, float(down.t_s[-1]), 0.01)
    hand = Motion(down.t_s, down.x_m, down.y_m, down.angle_rad)
    rigidity = 0.4 * cable.line_density_kg_per_m * 9.81 * length_m**3
    model = CableModel(cable, np.array([rigidity]), 1.0, 0.004 * rigidity)
    arc_length_m = node_arc_lengths(length_m)
    nodes_m = simulate(model, hand, t_s, arc_length_m)[0]
    nodes_m += np.random.default_rng(1).normal(scale=_NOISE_M, size=nodes_m.shape)
    seen_m = np.column_stack([np.interp(t_s, hand.t_s, v) for v in (hand.x_m, hand.y_m)])
    trial = hold_trial(hand, t_s, nodes_m, seen_m, np.zeros(len(t_s)))
    identified = identify(trial, arc_length_m, cable)
    path = insertion_path(home, 0.0, 0.5 * length_m, limits, rate_hz)
    expected = forecast(identified, np.zeros(1), [executed_motion(path, 0.03)])
    hole = Destination(-1.4 * length_m, -1.3 * length_m, -length_m, length_m)
    choose(expected, identified, hole)
