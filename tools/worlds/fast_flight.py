"""Simulated insertion without pictures, with disturbances in flight and their corrections."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.identify.identified import Identified
from cell.plan.correction import Flight, Tail, decisions_s
from cell.plan.response import expected_nodes
from cell.run.candidates import Executing
from cell.run.station import Task, Timing
from drivers.interfaces import Trajectory
from tools.worlds.fast_truth import Bias, Errors, full_motion, pictured
from tools.worlds.made_studies import WORLD


@dataclass(frozen=True)
class Flown:
    """Conditions of a simulated insertion.

    feedback   whether it is corrected
    late_s     by so much earlier the last frame was taken that is used
    dead_s     a change can begin so long after it is decided
    knock      when the gripper is set off, and by how much to the right and up, m
    lost       share of the frames in which nothing is seen
    latency_s  by so much later than known pictures come
    """

    feedback: bool = False
    late_s: float = 0.015
    dead_s: float = 0.025
    knock: tuple[float, float, float] | None = None
    lost: float = 0.0
    latency_s: float = 0.0


@dataclass(frozen=True, eq=False)
class View:
    """Gives what the camera measures of a hidden cable in flight."""

    task: Task
    timing: Timing
    hidden: CableModel
    down: Motion
    start_s: float
    bias: Bias
    errors: Errors
    identified: Identified
    executing: Executing

    def expected_nodes(self, path: Trajectory, t_s: FloatArray) -> FloatArray:
        """Of a path, as the cell simulates it in flight."""
        at_s, motion = self.executing.begin_s + t_s, self.executing.motion(path)
        return expected_nodes(self.identified, motion, at_s, self.task.arc_length_m)

    def motion(self, path: Trajectory, flown: Flown) -> Motion:
        """The gripper's true one, the hold before included."""
        motion = full_motion(self.task, self.down, path, self.start_s, self.timing.arm_lag_s)
        if flown.knock is None:
            return motion
        at_s, right_m, up_m = flown.knock
        u = np.clip((motion.t_s - self.start_s - at_s) / 0.02, 0.0, 1.0)
        knocked = u * u * (3.0 - 2.0 * u)
        return replace(motion, x_m=motion.x_m + right_m * knocked, y_m=motion.y_m + up_m * knocked)

    def nodes_m(
        self, motion: Motion, t_s: FloatArray, flown: Flown, rng: np.random.Generator
    ) -> FloatArray:
        """(frames, nodes, 2) as seen, from when the gripper is commanded to move."""
        at_s = self.start_s + t_s - flown.latency_s
        nodes = simulate(self.hidden, motion, at_s, self.task.arc_length_m, solver=WORLD)[0]
        seen = pictured(nodes, self.bias, self.errors, rng)
        seen[rng.random(len(seen)) < flown.lost] = np.nan
        return seen


@dataclass(frozen=True, eq=False)
class Inserted:
    """Result of a simulated insertion.

    motion   true, of the gripper
    tails    changes of the path that were commanded
    tip_m    (T, 2) as last predicted, at the times of the answers
    stopped  whether the gripper was stopped in front of the opening, which is not simulated
    """

    motion: Motion
    tails: tuple[Tail, ...]
    tip_m: FloatArray
    stopped: bool = False


def inserted(
    view: View, path: Trajectory, flight: Flight, flown: Flown, rng: np.random.Generator
) -> Inserted:
    """Simulate an insertion with corrections decided as by `Corrector`."""
    done = Inserted(view.motion(path, flown), (), flight.response.nodes_m[:, 0])
    left = list(decisions_s(flight.response, flight.destination)) if flown.feedback else []
    while left:
        decide_s = left.pop(0)
        t_s = np.arange(0.001, decide_s - flown.late_s, 0.005)
        seen_m = view.nodes_m(done.motion, t_s, flown, rng)
        decision = flight.decide(t_s, seen_m, decide_s + flown.dead_s)
        if decision.tail is not None:
            path = decision.tail.of(path)
            flight = flight.expecting(view.expected_nodes(path, flight.response.t_s))
            tails = (*done.tails, decision.tail)
            done = Inserted(view.motion(path, flown), tails, decision.tail.tip_m)
        elif decision.hopeless and not left:
            done = replace(done, stopped=True)
    return done
