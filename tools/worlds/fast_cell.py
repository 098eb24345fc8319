"""Simulated cell without pictures: nodes with noise; everything else as in `cell run`.

A cable takes a third of a second instead of several, so that thousands can be tried.  The world is
finer than the model, and its noise is that of vision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.effects import Effect
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, identify
from cell.plan.choose import Choice, choose, enough_frames
from cell.plan.correction import Flight, Tail, detection_std_m
from cell.plan.passage import Passage, measured_passage
from cell.plan.response import simulate_response
from cell.run.candidates import Executing, simulate_offsets
from cell.run.early_estimate import possible_ends_s, without_gripper_errors
from cell.run.findings import Candidates
from cell.run.station import Task, Timing
from cell.settings import Settings
from cell.study.data import Trial
from cell.wiring.build import cell_task
from cell.wiring.twins import hidden_cable
from tools.worlds.fast_flight import Flown, View, inserted
from tools.worlds.fast_truth import (
    RATE_HZ,
    Bias,
    Errors,
    Observer,
    filmed_of,
    moved_until,
    true_hold,
    truths,
    until,
)
from tools.worlds.made_studies import WORLD, logged

#: Least margin of the best offset, m, for a cable to count as insertable by a perfect model: three
#: times the repeatability of arm and camera.
INSERTABLE_M = 3e-4


@dataclass(frozen=True, eq=False)
class FastCycle:
    """Measurements, decision and result of one cable; None = the cycle did not come so far.

    best_margin_m   true margin of the best offset: whether a perfect model could insert this cable;
                    nan = only the chosen one was simulated
    true_margin_m   of the chosen offset, or of the best rejected one
    """

    held: Trial
    executed: Trial | None
    identified: Identified | None
    candidates: Candidates | None
    choice: Choice | None
    passage: Passage | None
    reason: str | None
    best_margin_m: float
    true_margin_m: float
    true_tip_error_m: float
    hold_saved_s: float = 0.0
    tails: tuple[Tail, ...] = ()
    true_miss_m: float = np.nan
    stopped: bool = False

    @property
    def outcome(self) -> str:
        """Outcome as of a `Result`."""
        if self.passage is None:
            return "rejected"
        if self.stopped:
            return "stopped"
        return "inserted" if self.passage.passed else "missed"


def typical(effect: type[Effect], size: float) -> dict[str, float]:
    """An effect's parameters at `size` times its typical strength."""
    return {
        p.name: p.default + size * (p.starts[0] - p.default) if p.amplitude else p.starts[0]
        for p in effect.parameters
    }


def with_world(settings: Settings, effects: dict[str, dict[str, float]]) -> Settings:
    """The settings with other effects in the simulated world."""
    return settings.model_copy(
        update={"world": settings.world.model_copy(update={"effects": effects})}
    )


def with_opening(settings: Settings, half_mm: float) -> Settings:
    """The settings with an opening of `half_mm` on either side of its middle."""
    middle_m = float(np.mean(settings.destination.y_m))
    height = (middle_m - half_mm * 1e-3, middle_m + half_mm * 1e-3)
    destination = settings.destination.model_copy(update={"y_m": height})
    return settings.model_copy(update={"destination": destination})


def fast_cycle(
    settings: Settings,
    seed: int,
    number: int,
    *,
    task: Task | None = None,
    errors: Errors = Errors(),  # noqa: B008
    hidden: CableModel | None = None,
    only_chosen: bool = False,
    flown: Flown | None = None,
) -> FastCycle:
    """One cycle with the `number`-th hidden cable of a seed.

    only_chosen  simulate the true margin of the chosen offset only, for a third less time
    flown        disturbances in flight, and whether it is corrected; None = neither
    """
    task = cell_task(settings) if task is None else task
    hidden = hidden_cable(settings, seed, number) if hidden is None else hidden
    rng = np.random.default_rng([seed, number, 1])
    lag_s, frame_hz = settings.arm.lag_s, settings.camera.frame_rate_hz
    timing = Timing(RATE_HZ, lag_s, frame_hz)
    down = true_hold(task, lag_s)
    t_s = np.arange(0.001, float(down.t_s[-1]), 1.0 / frame_hz)
    bias = Bias.drawn(rng, errors, len(task.arc_length_m))
    observer = Observer(task, hidden, bias, errors, rng)
    held = observer.hold(down, t_s, logged(rng, down, errors.log_m))
    end_s = _end_of_hold_s(task, timing, held)
    held, down = until(held, end_s), moved_until(down, end_s)
    start_s, filmed = end_s + task.decide_s, filmed_of(held)
    identified, expected, choice, reason = None, None, None, None
    try:
        identified = identify(held, task.arc_length_m, task.cable, options=task.identification)
        expected = simulate_offsets(task, timing, filmed, held, identified, start_s)
        choice = choose(expected.forecast, identified, task.destination, task.choice)
        reason = choice.reason
    except CableRejectedError as error:
        reason = str(error)
    table = [(o, 0.0, 1.0, 0.0) for o in task.offsets_m]
    if expected is not None:
        coming = expected.forecast
        options = (coming.delays_s, coming.paces, coming.further_m)
        table = list(zip(coming.offsets_m, *options, strict=True))
    truth = truths(task, hidden, down, start_s, lag_s, table)
    at_s = np.arange(0.0, truth.end_s - start_s, 0.005)
    index = None if choice is None else choice.table.index(choice.best)
    best_m = np.nan
    if not only_chosen:
        tips = truth.tips(at_s)
        best_m = float(task.destination.margin_m(tips).max())
    saved_s = float(t_s[-1]) - float(held.markers.t_s[-1])
    nan = float("nan")
    cycle = FastCycle(
        held, None, identified, expected, choice, None, reason, best_m, nan, nan, saved_s
    )
    if choice is None or index is None:
        return cycle
    tip = truth.tips(at_s, [index])[0] if only_chosen else tips[index]
    cycle = _in_truth(cycle, task, at_s, tip, choice.t_s, choice.tip_m)
    if reason is not None:
        return cycle
    executing = Executing.of(task, timing, filmed, held, start_s)
    motion = truth.motions[index]
    if flown is not None:
        view = View(observer, timing, down, start_s, identified, executing)
        cycle, motion = _flown(cycle, view, flown, at_s)
    executed = observer.execution(motion, start_s, held)
    passage = measured_passage(
        task.destination,
        executed.markers.t_s,
        executed.markers.xy_m[:, 0],
        start_s + choice.t_s,
        choice.tip_m,
    )
    return replace(cycle, executed=executed, passage=passage)


def _in_truth(
    cycle: FastCycle,
    task: Task,
    at_s: FloatArray,
    tip_m: FloatArray,
    predicted_s: FloatArray,
    predicted_m: FloatArray,
) -> FastCycle:
    """The cycle with the true tip's margin and miss, and its largest forecast error."""
    predicted = np.column_stack([np.interp(at_s, predicted_s, predicted_m[:, k]) for k in (0, 1)])
    clean = measured_passage(task.destination, at_s, tip_m, at_s, predicted)
    return replace(
        cycle,
        true_margin_m=float(task.destination.margin_m(tip_m[None])[0]),
        true_tip_error_m=clean.error_m,
        true_miss_m=clean.miss_m,
    )


def _flown(
    cycle: FastCycle, view: View, flown: Flown, at_s: FloatArray
) -> tuple[FastCycle, Motion]:
    """The cycle with its flight, and the gripper's true motion."""
    observer, coming, identified = view.observer, cycle.candidates, cycle.identified
    task = observer.task
    assert coming is not None and identified is not None and cycle.choice is not None
    path = coming.paths[cycle.choice.table.index(cycle.choice.best)]
    executing = view.executing
    ahead = simulate_response(
        identified,
        executing.motion(path),
        executing.begin_s,
        view.start_s + float(at_s[-1]),
        task.arc_length_m,
    )
    flight = Flight(
        ahead,
        task.destination,
        detection_std_m(identified),
        view.timing.arm_lag_s,
        task.choice.repeatability_m,
    )
    done = inserted(view, path, flight, flown)
    at_tip = np.array([task.cable.free_length_m])
    tip_m = simulate(observer.hidden, done.motion, view.start_s + at_s, at_tip, solver=WORLD)[
        0, :, 0
    ]
    cycle = _in_truth(cycle, task, at_s, tip_m, ahead.t_s, done.tip_m)
    cycle = replace(cycle, tails=done.tails, stopped=done.stopped)
    return cycle, done.motion


def _end_of_hold_s(task: Task, timing: Timing, held: Trial) -> float:
    """End of the hold by the rule of `EarlyEstimator`, s."""
    last_s = float(held.grip.t_s[-1])
    if task.least_hold_s is None:
        return last_s
    rest_s, previous = last_s - task.hold_s, None
    for after_s, end_s in possible_ends_s(task, task.least_hold_s, task.hold_s):
        part = until(held, rest_s + after_s)
        try:
            previous = identify(
                part,
                task.arc_length_m,
                task.cable,
                previous=previous,
                options=without_gripper_errors(task.identification),
            )
        except CableRejectedError:
            continue
        start_s = rest_s + end_s + task.decide_s
        coming = simulate_offsets(task, timing, filmed_of(part), part, previous, start_s)
        inputs = coming.forecast, previous, task.destination, task.choice
        if enough_frames(choose(*inputs), *inputs):
            return rest_s + end_s
    return last_s


def best_margin_m(settings: Settings, seed: int, number: int) -> float:
    """Largest true margin over all offsets, m: > 0 = a perfect model could insert this cable."""
    task, lag_s = cell_task(settings), settings.arm.lag_s
    down = true_hold(task, lag_s)
    start_s = float(down.t_s[-1]) + task.decide_s
    table = [(offset_m, 0.0, 1.0, 0.0) for offset_m in task.offsets_m]
    truth = truths(task, hidden_cable(settings, seed, number), down, start_s, lag_s, table)
    tips = truth.tips(np.arange(0.0, truth.end_s - start_s, 0.005))
    return float(task.destination.margin_m(tips).max())


def fast_measured(
    settings: Settings,
    seed: int,
    number: int,
    motion: Motion,
    *,
    task: Task,
    hidden: CableModel,
    errors: Errors = Errors(),  # noqa: B008
) -> Trial:
    """A hidden cable measured with a motion only; the noise is of the `number`-th of a seed."""
    rng = np.random.default_rng([seed, number, 2])
    t_s = np.arange(0.001, float(motion.t_s[-1]), 1.0 / settings.camera.frame_rate_hz)
    bias = Bias.drawn(rng, errors, len(task.arc_length_m))
    observer = Observer(task, hidden, bias, errors, rng)
    trial = observer.hold(motion, t_s, logged(rng, motion, errors.log_m))
    return replace(trial, name="stroke")
