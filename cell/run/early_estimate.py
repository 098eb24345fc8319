"""Computes estimates while a hold is filmed, so that little work remains after its last frame."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.solver import DivergedError, Solver, threads
from cell.cable.statics import UnsettledError
from cell.identify.gripper_errors import GripperLogErrors
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, IdentifyOptions, identify, predict_frames
from cell.plan.choose import choose, enough_frames
from cell.run.candidates import simulate_offsets
from cell.run.filming import filmed_so_far
from cell.run.findings import EarlyEstimate, FilmedMotion, Filming
from cell.run.station import Station, Task, Timing
from cell.run.trials import held_trial
from cell.run.waiting import hurried, result_of
from cell.vision.sighting import Sighting

#: Shares of a fixed hold after which the cable is identified from the frames so far: at first from
#: scratch; then, starting there, nearly finally, with a simulation of the frames to come and of all
#: offsets.  The time after each is several times what it needs.
SHARES = (0.2, 0.6)
#: The same where insertions may begin later (`Freedom`): their search takes as long again.
SHARES_FREELY = (0.2, 0.45)

#: If a hold may end early, estimates start so long before each possible end, s …
AHEAD_S, AHEAD_FREELY_S = 0.3, 0.45
#: … but not before the gripper has rested so long.
FIRST_S = 0.1


@dataclass(frozen=True)
class ScheduledEstimate:
    """A computation that is to start while a hold is filmed.

    after_s  when the gripper has rested so long
    filming  the hold, as if it ended when this is used; None = it only identifies the cable
    """

    after_s: float
    filming: Filming | None


EstimateResult = EarlyEstimate | Identified | None


class EarlyEstimator:
    """Identifies a cable in the second process from a hold's first frames, while others arrive.

    The choice of frames depends on their timestamps alone, and the result is waited for: it is
    the same however busy the computer is.
    """

    def __init__(self, station: Station, filming: Filming) -> None:
        self._station, self._filming = station, filming
        self._scheduled = list(_schedule(station.task, station.timing, filming))
        self._running: list[tuple[ScheduledEstimate, Future[EstimateResult]]] = []

    def update(self, sightings: list[Sighting]) -> bool:
        """Start a computation if enough frames have come; each one waits for the one before it.

        returns  whether the hold may end with the last of these frames
        """
        station, filming = self._station, self._filming
        ending = self._ending_with(len(sightings))
        if ending is not None and len(sightings) < filming.frame_count:
            result = self._result_of(ending)
            if isinstance(result, EarlyEstimate) and result.enough:
                return True
        rested_s = sightings[-1].t_s - filming.rest_s
        if self._scheduled and rested_s >= self._scheduled[0].after_s:
            estimate = self._scheduled.pop(0)
            before = result_of(self._running[-1][1], station.commands) if self._running else None
            so_far = filmed_so_far(station, filming, sightings)
            previous = before.identified if isinstance(before, EarlyEstimate) else before
            end = estimate.filming and replace(estimate.filming, sightings=(), pictures=())
            arguments = station.task, station.timing, so_far, previous, end
            self._running.append((estimate, station.computer.submit(_estimate, *arguments)))
        return False

    def result(self, frame_count: int) -> EarlyEstimate | None:
        """The estimate for a hold of so many frames, waiting for it; None if there is none.

        No frame is processed any more, so the computation need not yield.
        """
        ending = self._ending_with(frame_count)
        estimate = None if ending is None else self._result_of(ending)
        return estimate if isinstance(estimate, EarlyEstimate) else None

    def close(self) -> None:
        """Cancel computations that have not begun."""
        for _, job in self._running:
            job.cancel()

    def _ending_with(self, frame_count: int) -> Future[EstimateResult] | None:
        for estimate, job in self._running:
            if estimate.filming is not None and estimate.filming.frame_count == frame_count:
                return job
        return None

    def _result_of(self, job: Future[EstimateResult]) -> EstimateResult:
        with hurried(self._station.computer):
            return result_of(job, self._station.commands)


def _schedule(task: Task, timing: Timing, filming: Filming) -> Iterator[ScheduledEstimate]:
    """Computations during a hold, in order of time."""
    most_s = filming.end_s - filming.rest_s
    if task.least_hold_s is None:
        first, second = SHARES if task.choice.freely.window_s == 0.0 else SHARES_FREELY
        yield ScheduledEstimate(first * most_s, None)
        yield ScheduledEstimate(second * most_s, filming)
        return
    for after_s, end_s in possible_ends_s(task, task.least_hold_s, most_s):
        count = filming.frame_count - int((most_s - end_s) * timing.frame_rate_hz)
        yield ScheduledEstimate(
            after_s, replace(filming, end_s=filming.rest_s + end_s, frame_count=count)
        )


def possible_ends_s(task: Task, least_s: float, most_s: float) -> Iterator[tuple[float, float]]:
    """Possible ends of a hold: (time of the decision, end) of each, s after its beginning."""
    ahead_s = AHEAD_S if task.choice.freely.window_s == 0.0 else AHEAD_FREELY_S
    first_s = max(least_s, FIRST_S + ahead_s)
    for end_s in (*np.arange(first_s, most_s - 0.5 * ahead_s, ahead_s), most_s):
        yield float(end_s) - ahead_s, float(end_s)


def _estimate(
    task: Task,
    timing: Timing,
    so_far: FilmedMotion,
    previous: Identified | None,
    filming: Filming | None,
) -> EstimateResult:
    """Identification from the frames so far, and forecast; None if these are not enough."""
    trial, options = held_trial(so_far), _leaving_a_core(task.identification)
    quickly = without_gripper_errors(options)
    try:
        identified = identify(
            trial, task.arc_length_m, task.cable, previous=previous, options=quickly
        )
    except CableRejectedError:
        return None
    if filming is None:
        return identified
    missing = filming.frame_count - len(so_far.sightings)
    to_come_s = np.arange(1, missing + 1) / timing.frame_rate_hz
    t_s = np.concatenate([trial.markers.t_s, trial.markers.t_s[-1] + to_come_s])
    start_s = filming.end_s + task.decide_s
    solver = Solver(threads=_spare_threads())
    try:
        predicted = predict_frames(trial, t_s, task.arc_length_m, identified, options)
        candidates = simulate_offsets(task, timing, so_far, trial, identified, start_s, solver)
    except (DivergedError, UnsettledError):
        return None
    arguments = candidates.forecast, identified, task.destination, task.choice
    enough = task.least_hold_s is not None and enough_frames(choose(*arguments), *arguments)
    return EarlyEstimate(identified, predicted, candidates, enough)


def without_gripper_errors(options: IdentifyOptions) -> IdentifyOptions:
    """Options without gripper-log errors: an early estimate needs no exact covariance."""
    return replace(options, fit=replace(options.fit, gripper_errors=GripperLogErrors(samples=0)))


def _leaving_a_core(options: IdentifyOptions) -> IdentifyOptions:
    """Options that leave one core to the processing of frames."""
    solver = replace(options.fit.solver, threads=_spare_threads())
    return replace(options, fit=replace(options.fit, solver=solver))


def _spare_threads() -> int:
    return max(1, threads() - 1)
