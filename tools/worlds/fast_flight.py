"""Simulated insertion without pictures, with disturbances in flight and their corrections."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion
from cell.identify.identified import Identified
from cell.plan.correction import Flight, Tail, decisions_s
from cell.plan.response import expected_nodes
from cell.run.candidates import Executing
from cell.run.station import Timing
from drivers.interfaces import Trajectory
from tools.worlds.fast_truth import Observer, full_motion


@dataclass(frozen=True)
class Flown:
    """Conditions of a simulated insertion.

    feedback   whether it is corrected
    late_s     age of the last used frame at a decision
    dead_s     delay between a decision and the earliest beginning of a change
    knock      time at which the gripper is displaced, and displacement to the right and up, m
    lost       share of the frames without a detection
    latency_s  unknown additional delay of the pictures
    """

    feedback: bool = False
    late_s: float = 0.015
    dead_s: float = 0.025
    knock: tuple[float, float, float] | None = None
    lost: float = 0.0
    latency_s: float = 0.0


@dataclass(frozen=True, eq=False)
class View:
    """Measurements of the camera of a hidden cable in flight."""

    observer: Observer
    timing: Timing
    down: Motion
    start_s: float
    identified: Identified
    executing: Executing

    def expected_nodes(self, path: Trajectory, t_s: FloatArray) -> FloatArray:
        """Predicted nodes for a path, as the cell simulates it in flight."""
        at_s, motion = self.executing.begin_s + t_s, self.executing.motion(path)
        return expected_nodes(self.identified, motion, at_s, self.observer.task.arc_length_m)

    def motion(self, path: Trajectory, flown: Flown) -> Motion:
        """The gripper's true motion, including the hold."""
        task, lag_s = self.observer.task, self.timing.arm_lag_s
        motion = full_motion(task, self.down, path, self.start_s, lag_s)
        if flown.knock is None:
            return motion
        at_s, right_m, up_m = flown.knock
        u = np.clip((motion.t_s - self.start_s - at_s) / 0.02, 0.0, 1.0)
        knocked = u * u * (3.0 - 2.0 * u)
        return replace(motion, x_m=motion.x_m + right_m * knocked, y_m=motion.y_m + up_m * knocked)

    def nodes_m(self, motion: Motion, t_s: FloatArray, flown: Flown) -> FloatArray:
        """(frames, nodes, 2) as observed, from the gripper's command to move on."""
        observed_m = self.observer.nodes_m(motion, self.start_s + t_s - flown.latency_s)
        observed_m[self.observer.rng.random(len(observed_m)) < flown.lost] = np.nan
        return observed_m


@dataclass(frozen=True, eq=False)
class Inserted:
    """Result of a simulated insertion.

    motion   true, of the gripper
    tails    changes of the path that were commanded
    tip_m    (T, 2) last prediction, at the times of the responses
    stopped  whether the gripper was stopped before the opening, which is not simulated
    """

    motion: Motion
    tails: tuple[Tail, ...]
    tip_m: FloatArray
    stopped: bool = False


def inserted(view: View, path: Trajectory, flight: Flight, flown: Flown) -> Inserted:
    """Simulate an insertion with corrections decided as by `Corrector`."""
    done = Inserted(view.motion(path, flown), (), flight.response.nodes_m[:, 0])
    pending = list(decisions_s(flight.response, flight.destination)) if flown.feedback else []
    while pending:
        decide_s = pending.pop(0)
        t_s = np.arange(0.001, decide_s - flown.late_s, 0.005)
        observed_m = view.nodes_m(done.motion, t_s, flown)
        decision = flight.decide(t_s, observed_m, decide_s + flown.dead_s)
        if decision.tail is not None:
            path = decision.tail.of(path)
            flight = flight.expecting(view.expected_nodes(path, flight.response.t_s))
            tails = (*done.tails, decision.tail)
            done = Inserted(view.motion(path, flown), tails, decision.tail.tip_m)
        elif decision.hopeless and not pending:
            done = replace(done, stopped=True)
    return done
