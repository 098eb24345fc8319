"""What is computed while a hold is filmed, so that little is left after its last frame."""

from __future__ import annotations

from concurrent.futures import BrokenExecutor, Future
from contextlib import nullcontext
from dataclasses import replace
from typing import TypedDict, TypeVar

import numpy as np

from cell.cable.geometry import Motion
from cell.cable.solver import DivergedError, Solver, threads
from cell.cable.statics import UnsettledError
from cell.computer.second_process import SecondProcess
from cell.identify.hand import HandErrors
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, IdentifyOptions, identify, predict_frames
from cell.plan.choose import ChoiceOptions, choose, forecast
from cell.plan.closer import closer_look
from cell.plan.paths import executed_motion, insertion_path
from cell.run.commands import Commands
from cell.run.filming import filmed_so_far
from cell.run.findings import Candidates, EarlyEstimate, FilmedMotion, Filming
from cell.run.station import Station, Task, Timing
from cell.run.trials import hand_offset_m_rad, held_trial, moved
from cell.run.waiting import POLL_S
from cell.study.data import Trial
from cell.vision.sighting import Sighting
from drivers.interfaces import Trajectory

Value = TypeVar("Value")


class Simulated(TypedDict):
    """How insertions are simulated, see `forecast`."""

    begin_s: float
    end_s: float
    solver: Solver
    options: ChoiceOptions


#: Shares of the hold after which the cable is identified from the frames so far: at first from
#: scratch; then, starting there, nearly finally, with a simulation of the frames to come and of all
#: offsets.  The time after each is several times what it needs.
SHARES = (0.2, 0.6)

#: Shares where insertions may begin later (`Freedom`): to look for them takes as long again.
SHARES_FREELY = (0.2, 0.45)

#: An offset whose margin is so many times its standard deviation passes surely: no other moment is
#: looked at.
SURE = 4.0

#: A computation that takes longer has failed, s.
LONGEST_S = 5.0


class EarlyEstimator:
    """Identifies a cable from the first frames of a hold, in the second process, as others come.

    Which frames those are depends on their own times alone, and the result is waited for: it is
    the same however busy the computer is.
    """

    def __init__(self, station: Station, filming: Filming) -> None:
        self._station = station
        self._filming = filming
        self._first: Future[Identified | None] | None = None
        self._second: Future[EarlyEstimate | None] | None = None

    def update(self, sightings: list[Sighting]) -> None:
        """Start a computation if enough frames have come; the second one waits for the first."""
        hold_s = self._filming.end_s - self._filming.rest_s
        share = (sightings[-1].t_s - self._filming.rest_s) / hold_s
        station = self._station
        shares = SHARES if station.task.choice.freely.window_s == 0.0 else SHARES_FREELY
        if self._first is None and share >= shares[0]:
            self._first = station.computer.submit(
                _identify_so_far, station.task, filmed_so_far(station, self._filming, sightings)
            )
        elif self._first is not None and self._second is None and share >= shares[1]:
            self._second = station.computer.submit(
                _estimate,
                station.task,
                station.timing,
                replace(self._filming, sightings=(), pictures=()),
                filmed_so_far(station, self._filming, sightings),
                _result(self._first, station.commands),
            )

    def result(self) -> EarlyEstimate | None:
        """The early estimate, waiting for it; None if the first frames were not enough.

        No frame is looked at any more, so what computes it need not give way.
        """
        if self._second is None:
            return None
        computer = self._station.computer
        hurry = computer.hurried() if isinstance(computer, SecondProcess) else nullcontext()
        with hurry:
            return _result(self._second, self._station.commands)

    def close(self) -> None:
        """Cancel what has not begun."""
        for job in (self._first, self._second):
            if job is not None:
                job.cancel()


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
    closer = forecast(identified, offsets_m, motions, delays_s=delays_s, paces=paces, **how)
    return Candidates(start_s, (*paths, *new), expected.beside(closer))


def _result(job: Future[Value], commands: Commands) -> Value | None:
    """What a job found; None if its process was killed or hangs, which only costs time.

    raises  InterruptedByCommandError
    """
    for _ in range(round(LONGEST_S / POLL_S)):
        commands.check()
        try:
            return job.result(POLL_S)
        except TimeoutError:
            if job.done():  # it is the job's own
                raise
        except BrokenExecutor:
            return None
    return None


def _identify_so_far(
    task: Task, so_far: FilmedMotion, previous: Identified | None = None
) -> Identified | None:
    """The cable as it seems from the frames so far; None if they are not enough.

    How sure that is does not matter yet, so the hand's errors are left out.
    """
    options = _leaving_a_core(task.identification)
    options = replace(options, fit=replace(options.fit, hand=HandErrors(samples=0)))
    try:
        return identify(
            held_trial(so_far), task.arc_length_m, task.cable, previous=previous, options=options
        )
    except CableRejectedError:
        return None


def _estimate(
    task: Task, timing: Timing, filming: Filming, so_far: FilmedMotion, first: Identified | None
) -> EarlyEstimate | None:
    identified = _identify_so_far(task, so_far, first)
    if identified is None:
        return None
    trial = held_trial(so_far)
    options = _leaving_a_core(task.identification)
    missing = filming.frame_count - len(so_far.sightings)
    to_come_s = np.arange(1, missing + 1) / timing.frame_rate_hz
    t_s = np.concatenate([trial.markers.t_s, trial.markers.t_s[-1] + to_come_s])
    start_s = filming.end_s + task.decide_s
    solver = Solver(threads=_spare_threads())
    try:
        return EarlyEstimate(
            identified,
            predict_frames(trial, t_s, task.arc_length_m, identified, options),
            simulate_offsets(task, timing, so_far, trial, identified, start_s, solver),
        )
    except (DivergedError, UnsettledError):
        return None


def _leaving_a_core(options: IdentifyOptions) -> IdentifyOptions:
    """One core looks at the frames."""
    solver = replace(options.fit.solver, threads=_spare_threads())
    return replace(options, fit=replace(options.fit, solver=solver))


def _spare_threads() -> int:
    return max(1, threads() - 1)
