"""How long a cable swings on after its hand has come to rest."""

from __future__ import annotations

import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.plan.choose import coarsened

#: Between the instants at which the tip is looked at, s.
_INTERVAL_S = 0.01


def time_to_rest_s(
    identified: Identified,
    motion: Motion,
    within_m: float,
    longest_s: float,
    solver: Solver = Solver(),  # noqa: B008
) -> float:
    """Time from the end of a motion until the tip stays within a distance of where it rests, s.

    motion     of the hand, from a cable at rest on; it is held still afterwards
    within_m   distance of the tip from its place at rest
    longest_s  returned if it swings longer
    raises     what the engine raises
    """
    # held still beyond its log, which `simulate` does: a last sample added there would be led to by
    # a curve that bulges with the noise of the samples before it
    end_s = float(motion.t_s[-1])
    t_s = np.arange(end_s, end_s + longest_s, _INTERVAL_S)
    at_tip = np.array([identified.space.cable.length_m])
    tip_m = simulate(identified.model, motion, t_s, at_tip, solver=coarsened(solver))[0, :, 0]
    away_m = np.linalg.norm(tip_m - tip_m[-1], axis=1)
    swinging = np.flatnonzero(away_m > within_m)
    return 0.0 if not swinging.size else float(t_s[swinging[-1]] - end_s) + _INTERVAL_S
