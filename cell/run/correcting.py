"""Corrects an insertion while it is filmed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future

import numpy as np
from numpy.typing import NDArray

from cell.cable.solver import DivergedError, Solver, threads
from cell.cable.statics import UnsettledError
from cell.flight.answers import Answers, answers
from cell.flight.correct import LEAST, Tail, best_tail, chance, decisions_s, moved_by
from cell.flight.estimate import Deviation, deviation
from cell.flight.stop import brought_to_rest
from cell.run.candidates import Executing
from cell.run.findings import Findings, required
from cell.run.jobs import found_by, hurried
from cell.run.station import Station
from cell.vision.recording import steady_nodes
from cell.vision.sighting import Sighting
from drivers.interfaces import LimitError, Trajectory

FloatArray = NDArray[np.float64]

_LOG = logging.getLogger(__name__)

#: When the hand has been told to move so long ago, it must be known how the cable answers, s.
NEEDED_S = 0.1
#: From a decision's last frame until its change may begin, s: to look, to compute, to tell the arm.
DEAD_S = 0.04
#: Frames that differ from what is found by so many standard deviations are not explained by it.
MOST_MISFIT = 5.0
#: A decision needs so many frames in which the cable is seen.
LEAST_FRAMES = 10


class Corrector:
    """Changes the hand's path if the tip will pass more probably.

    Which frames a decision uses depends on their times alone.  Whatever keeps a correction from
    being found or told leaves the path as it is.  `stopped` says why the hand was brought to
    rest in front of the mouth; None = it was not.
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
        task, identified = station.task, required(findings.identified)
        self._lag_s = station.timing.arm_lag_s
        executing = Executing.of(
            task, station.timing, required(findings.held), findings.trials[0], self._start_s
        )
        motion = executing.motion(path)
        # so well the hold's frames were explained: a moving cable is seen less well than at rest
        self._noise_m = max(identified.noise.std_m, identified.residual_rms_m)
        self._job: Future[Answers] = station.computer.submit(
            answers,
            identified,
            motion,
            executing.begin_s,
            float(motion.t_s[-1]),
            task.arc_length_m,
            Solver(threads=max(1, threads() - 1)),
        )
        self._answers: Answers | None = None
        self._left: list[float] | None = None
        self.tails: tuple[Tail, ...] = ()
        self.stopped: str | None = None
        self._tip_m: FloatArray | None = None

    @property
    def predicted(self) -> tuple[FloatArray, FloatArray] | None:
        """(T,) times from when the path began, and (T, 2) tip as last predicted."""
        if self._answers is None or self._tip_m is None:
            return None
        return self._answers.t_s, self._tip_m

    def update(self, sightings: list[Sighting]) -> bool:
        """Decide, if it is time to; never ends the filming."""
        since_s = sightings[-1].t_s - self._start_s
        if self._left is None and since_s >= NEEDED_S:
            self._left = self._begin()
        if self._left and since_s >= self._left[0]:
            self._left.pop(0)
            self._decide(sightings, since_s)
        return False

    def _stop_if_hopeless(self, beside: Deviation, since_s: float) -> None:
        """At the last decision: what would not pass does not go on to the mouth's edge."""
        assert self._answers is not None
        task = self._station.task
        passes = chance(self._answers, beside, task.destination, task.choice.repeatability_m)
        if passes >= LEAST:
            return
        try:
            path = brought_to_rest(self._path, since_s + DEAD_S, task.lowering)
            self._revise(path, self._start_s + since_s + DEAD_S)
        except (LimitError, ValueError) as error:
            _LOG.warning("not stopped at %.2f s: %s", since_s, error)
            return
        self.stopped = (
            f"stopped in front of the mouth: the tip would have passed with probability "
            f"{passes:.2f}, and no change of the path made it {LEAST:.2f}"
        )
        _LOG.info("%s", self.stopped)

    def close(self) -> None:
        """Cancel what has not begun."""
        self._job.cancel()

    def _begin(self) -> list[float]:
        try:
            with hurried(self._station.computer):
                self._answers = found_by(self._job, self._station.commands)
        except (DivergedError, UnsettledError) as error:
            _LOG.warning("no correction in flight: %s", error)
        if self._answers is None:
            return []
        return list(decisions_s(self._answers, self._station.task.destination))

    def _decide(self, sightings: list[Sighting], since_s: float) -> None:
        assert self._answers is not None
        t_s = np.array([s.t_s for s in sightings]) - self._start_s
        nodes_m = steady_nodes(sightings)
        seen = np.isfinite(nodes_m[:, 0, 0]) & (t_s >= 0.0)
        if seen.sum() < LEAST_FRAMES:
            _LOG.info(
                "no correction at %.2f s: the cable is seen in %d frames", since_s, seen.sum()
            )
            return
        beside = deviation(self._answers, t_s[seen], nodes_m[seen], self._noise_m)
        if beside.misfit > MOST_MISFIT:
            _LOG.info("no correction at %.2f s: misfit %.1f", since_s, beside.misfit)
            return
        self._tip_m = self._answers.nodes_m[:, 0] + beside.tip_m
        task, lag_s = self._station.task, self._lag_s
        tail = best_tail(
            self._answers,
            beside,
            task.destination,
            since_s + DEAD_S,
            lag_s,
            task.choice.repeatability_m,
        )
        if tail is None:
            if not self._left:
                self._stop_if_hopeless(beside, since_s)
            return
        path = tail.of(self._path)
        try:
            self._revise(path, self._start_s + tail.from_s)
        except LimitError as error:
            _LOG.warning("no correction at %.2f s: %s", since_s, error)
            return
        _LOG.info(
            "corrected at %.2f s: %+.1f mm within %.2f s, probability %.2f instead of %.2f",
            since_s, 1e3 * tail.rise_m, tail.lasts_s, tail.probability, tail.before,
        )  # fmt: skip
        self._path, self._tip_m = path, tail.tip_m
        self._answers = moved_by(self._answers, tail, lag_s)
        self.tails = (*self.tails, tail)
