"""Corrects the gripper's path during an insertion, from the frames as they arrive."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.solver import DivergedError, Solver, threads
from cell.cable.statics import UnsettledError
from cell.plan.correction import LEAST, Decision, Flight, Tail, decisions_s, detection_std_m
from cell.plan.paths import path_to_rest
from cell.plan.response import Response, expected_nodes, simulate_response
from cell.run.candidates import Executing
from cell.run.findings import Findings, required
from cell.run.station import Station
from cell.run.waiting import hurried, result_of
from cell.vision.sighting import Sighting, steady_nodes
from drivers.interfaces import LimitError, TooLateError, Trajectory

_LOG = logging.getLogger(__name__)

#: Time after the start of the motion at which the response of the cable must be simulated, s.
NEEDED_S = 0.1
#: From a decision's last frame until its change may begin, s: to detect, compute and command; then
#: the same for a second attempt, after the arm refused the first as too late.
DEAD_S = (0.04, 0.08)


class Corrector:
    """Changes the gripper's path if that makes it more probable that the tip passes.

    The choice of a decision's frames depends on their timestamps alone.  Without a correction, for
    any reason, the path stays.  `stopped` is the reason why the gripper was brought to rest in
    front of the opening; None = it was not.
    """

    def __init__(
        self,
        station: Station,
        findings: Findings,
        path: Trajectory,
        revise: Callable[[Trajectory, float], None],
    ) -> None:
        """For the insertion that is about to begin; `revise` is the arm's."""
        self._station, self._path, self._revise = station, path, revise
        self._start_s = required(findings.candidates).start_s
        self._identified = required(findings.identified)
        self._executing = Executing.of(
            station.task, station.timing, required(findings.held), findings.trials[0], self._start_s
        )
        self._solver = Solver(threads=max(1, threads() - 1))
        motion = self._executing.motion(path)
        self._job: Future[Response] = station.computer.submit(
            simulate_response,
            self._identified,
            motion,
            self._executing.begin_s,
            float(motion.t_s[-1]),
            station.task.arc_length_m,
            self._solver,
        )
        self._resimulation: Future[FloatArray] | None = None
        self._flight: Flight | None = None
        self._decide_at_s: list[float] | None = None
        self.tails: tuple[Tail, ...] = ()
        self.stopped: str | None = None
        self._tip_m: FloatArray | None = None

    @property
    def predicted(self) -> tuple[FloatArray, FloatArray] | None:
        """(T,) times from when the path began, and (T, 2) tip as last predicted."""
        if self._flight is None or self._tip_m is None:
            return None
        return self._flight.response.t_s, self._tip_m

    def update(self, sightings: list[Sighting]) -> bool:
        """Decide, if it is time to; never ends the filming."""
        since_s = sightings[-1].t_s - self._start_s
        if self._decide_at_s is None and since_s >= NEEDED_S:
            self._decide_at_s = self._begin()
        if self._flight is not None and self._decide_at_s and since_s >= self._decide_at_s[0]:
            self._decide_at_s.pop(0)
            self._decide(self._simulated(self._flight), sightings, since_s)
        return False

    def close(self) -> None:
        """Cancel simulations that have not begun."""
        for job in (self._job, self._resimulation):
            if job is not None:
                job.cancel()

    def _begin(self) -> list[float]:
        """Times of the decisions, once the response of the cable is simulated."""
        response, task = None, self._station.task
        try:
            with hurried(self._station.computer):
                response = result_of(self._job, self._station.commands)
        except (DivergedError, UnsettledError) as error:
            _LOG.warning("no correction in flight: %s", error)
        if response is None:
            return []
        self._flight = Flight(
            response,
            task.destination,
            detection_std_m(self._identified),
            self._station.timing.arm_lag_s,
            task.choice.repeatability_m,
        )
        return list(decisions_s(response, task.destination))

    def _simulated(self, flight: Flight) -> Flight:
        """The flight with its motion simulated again, if the path was changed since."""
        job, self._resimulation = self._resimulation, None
        if job is None:
            return flight
        try:
            nodes_m = result_of(job, self._station.commands)
        except (DivergedError, UnsettledError) as error:
            _LOG.warning("the changed path is not simulated: %s", error)
            return flight
        return flight if nodes_m is None else flight.expecting(nodes_m)

    def _decide(self, flight: Flight, sightings: list[Sighting], since_s: float) -> None:
        t_s = np.array([s.t_s for s in sightings]) - self._start_s
        nodes_m = steady_nodes(sightings)
        for dead_s in DEAD_S:
            decision = flight.decide(t_s, nodes_m, since_s + dead_s)
            if decision.withheld is not None:
                _LOG.info("no correction at %.2f s: %s", since_s, decision.withheld)
                return
            try:
                self._act(flight, decision, since_s, since_s + dead_s)
            except TooLateError as error:
                _LOG.warning("path not changed: %s", error)
            else:
                return

    def _act(self, flight: Flight, decision: Decision, since_s: float, from_s: float) -> None:
        """Carry out a decision.  Raises TooLateError: the arm refuses it as too late."""
        tail, self._tip_m = decision.tail, decision.tip_m
        if tail is not None and self._revise_path(tail.of(self._path), tail.from_s):
            _LOG.info(
                "corrected at %.2f s: %+.1f, %+.1f mm, each in %.2f s; probability %.2f, was %.2f",
                since_s, 1e3 * tail.rise_m, 1e3 * tail.then_m, tail.lasts_s, tail.probability,
                tail.before,
            )  # fmt: skip
            self._flight, self._tip_m = flight.changed(tail), tail.tip_m
            self.tails = (*self.tails, tail)
            if self._decide_at_s:
                self._resimulation = self._station.computer.submit(
                    expected_nodes,
                    self._identified,
                    self._executing.motion(self._path),
                    self._executing.begin_s + flight.response.t_s,
                    self._station.task.arc_length_m,
                    self._solver,
                )
        elif decision.hopeless and not self._decide_at_s:
            self._stop(decision, since_s, from_s)

    def _stop(self, decision: Decision, since_s: float, from_s: float) -> None:
        """Stop in front of the opening if the tip would miss it.  Raises TooLateError."""
        try:
            path = path_to_rest(self._path, from_s, self._station.task.lowering)
        except ValueError as error:
            _LOG.warning("not stopped at %.2f s: %s", since_s, error)
            return
        if self._revise_path(path, from_s):
            self.stopped = (
                "stopped in front of the opening: the tip would have passed with probability "
                f"{decision.probability:.2f}, and no change of the path made it {LEAST:.2f}"
            )
            _LOG.info("%s", self.stopped)

    def _revise_path(self, path: Trajectory, from_s: float) -> bool:
        """Change the path; whether the arm accepts it.  Raises TooLateError."""
        try:
            self._revise(path, self._start_s + from_s)
        except TooLateError:
            raise
        except LimitError as error:
            _LOG.warning("path not changed: %s", error)
            return False
        self._path = path
        return True
