"""Insertions that may be executed, simulated as the hand would make them."""

from __future__ import annotations

from dataclasses import replace
from typing import TypedDict

import numpy as np

from cell.cable.geometry import Motion
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.plan.choose import ChoiceOptions, choose, forecast
from cell.plan.closer import closer_look
from cell.plan.paths import executed_motion, insertion_path
from cell.run.findings import Candidates, FilmedMotion
from cell.run.station import Task, Timing
from cell.run.trials import hand_offset_m_rad, moved
from cell.study.data import Trial
from drivers.interfaces import Trajectory

#: An offset whose margin is so many times its standard deviation passes surely: no other moment is
#: looked at.
SURE = 4.0


class Simulated(TypedDict):
    """How insertions are simulated, see `forecast`."""

    begin_s: float
    end_s: float
    solver: Solver
    options: ChoiceOptions


def simulate_offsets(
    task: Task,
    timing: Timing,
    filmed: FilmedMotion,
    trial: Trial,
    identified: Identified,
    start_s: float,
    solver: Solver = Solver(),  # noqa: B008
) -> Candidates:
    """Simulate every offset as it would be executed from `start_s` on.

    The cable still swings from the hand's motion before; the hand follows with its known
    lag, and is seen by the camera a constant beside where the arm says it is.  Time goes on as in
    the hold, in which the cable was identified: an effect may depend on it.

    start_s  on the cell's clock, s
    raises   DivergedError, UnsettledError
    """
    begin_s = start_s - filmed.begin_s
    history = trial.grip.later(-begin_s)
    beside = hand_offset_m_rad(filmed.hand, trial.grip)

    def path(offset_m: float, delay_s: float = 0.0, pace: float = 1.0) -> Trajectory:
        lowered, limits = task.lowered, task.insertion.slowed(pace)
        return insertion_path(
            lowered, offset_m, task.advance_m, limits, timing.arm_rate_hz, delay_s=delay_s
        )

    def motion(path: Trajectory) -> Motion:
        hand = executed_motion(
            moved(path, beside), timing.arm_lag_s, settle_s=task.settle_s, history=history
        )
        return hand.later(begin_s)

    choice = task.choice
    paths = [path(o) for o in task.offsets_m]
    longest = path(
        task.offsets_m[-1], choice.freely.window_s, max([1.0, *choice.freely.paces], default=1.0)
    )
    how: Simulated = {
        "begin_s": begin_s,
        "end_s": float(motion(longest).t_s[-1]),
        "solver": solver,
        "options": choice,
    }
    expected = forecast(identified, np.array(task.offsets_m), [motion(p) for p in paths], **how)
    at_once = choose(expected, identified, task.destination, choice).best
    if choice.freely.window_s == 0.0 or at_once.margin_m > SURE * at_once.margin_std_m:
        return Candidates(start_s, tuple(paths), expected)
    spots = closer_look(
        identified,
        expected,
        lambda offset_m, pace: motion(path(offset_m, pace=pace)),
        task.destination,
        begin_s=begin_s,
        solver=solver,
        options=choice,
    )
    new = [path(*(float(v) for v in one)) for one in zip(*spots, strict=True)]
    offsets_m, delays_s, paces = spots
    motions = [motion(p) for p in new]
    closer = forecast(identified, offsets_m, motions, **how)
    closer = replace(closer, delays_s=delays_s, paces=paces)
    return Candidates(start_s, (*paths, *new), expected.beside(closer))
