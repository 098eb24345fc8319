"""A cell without pictures: nodes with noise instead, everything else as `cell run` does it.

A cable takes a third of a second instead of several, so that thousands can be tried.  The world is
finer than the model, and its noise is what `coverage_study` found vision to have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.build import cell_task
from cell.cable.dynamics import simulate
from cell.cable.effects import Effect
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.flight.answers import Answers, answers
from cell.flight.correct import LEAST, Tail, best_tail, chance, decisions_s, moved_by
from cell.flight.estimate import deviation
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, hold_trial, identify
from cell.plan.choose import Choice, choose
from cell.plan.enough import enough_frames
from cell.plan.passage import Passage, measured_passage
from cell.plan.paths import executed_motion, identification_path, insertion_path
from cell.run.candidates import Executing, simulate_offsets
from cell.run.early_estimate import possible_ends_s, without_hand_errors
from cell.run.findings import Candidates, FilmedMotion
from cell.run.station import Task, Timing
from cell.settings import Settings
from cell.simulated.hidden import hidden_cable
from cell.study.data import Markers, Trial
from drivers.interfaces import Trajectory
from tools.studies.coverage_study import Errors

FloatArray = NDArray[np.float64]

WORLD = Solver(segments=60, step_s=5e-4)
RATE_HZ = 500.0


@dataclass(frozen=True, eq=False)
class FastCycle:
    """One cable: what was measured, decided and done; None = the cycle did not come so far.

    best_margin_m   of all offsets, in truth: whether a perfect model could insert this cable;
                    nan = only the chosen one was simulated
    true_margin_m   of the offset that was chosen, or would have been
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
        """As a result says it."""
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
    """The settings with other hidden physics."""
    return settings.model_copy(
        update={"world": settings.world.model_copy(update={"effects": effects})}
    )


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

    only_chosen  of the offsets, for a third less time
    flown        what happens in flight, and whether it is corrected; None = nothing, and it is not
    """
    task = cell_task(settings) if task is None else task
    hidden = hidden_cable(settings, seed, number) if hidden is None else hidden
    rng = np.random.default_rng([seed, number, 1])
    lag_s, frame_hz = settings.arm.lag_s, settings.camera.frame_rate_hz
    timing = Timing(RATE_HZ, lag_s, frame_hz)
    down = _true_hold(task, lag_s)
    t_s = np.arange(0.001, float(down.t_s[-1]), 1.0 / frame_hz)
    bias = _Bias.drawn(rng, errors, len(task.arc_length_m))
    hand = _logged(down, errors, rng)
    held = _seen(task, hidden, down, t_s, hand, bias, errors, rng)
    end_s = _end_of_hold_s(task, timing, held)
    held, down = until(held, end_s), _moved_until(down, end_s)
    start_s, filmed = end_s + task.decide_s, _filmed(held)
    identified, expected, choice, reason = None, None, None, None
    try:
        identified = identify(held, task.arc_length_m, task.cable, options=task.identification)
        expected = simulate_offsets(task, timing, filmed, held, identified, start_s)
        choice = choose(expected.forecast, identified, task.destination, task.choice)
        reason = choice.reason
    except CableRejectedError as error:
        reason = str(error)
    table = [(o, 0.0, 1.0) for o in task.offsets_m]
    if expected is not None:
        coming = expected.forecast
        table = list(zip(coming.offsets_m, coming.delays_s, coming.paces, strict=True))
    truth = _truths(task, hidden, down, start_s, lag_s, table)
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
    view = _View(task, timing, hidden, down, start_s, bias, errors)
    motion = truth.motions[index]
    if flown is not None:
        cycle, motion = _flown(cycle, view, flown, at_s, rng)
    executed = _executed(task, hidden, motion, start_s, held, bias, errors, rng)
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
    foretold_s: FloatArray,
    foretold_m: FloatArray,
) -> FastCycle:
    """The cycle with the true tip's margin and miss, and how far it was foretold wrongly."""
    foretold = np.column_stack([np.interp(at_s, foretold_s, foretold_m[:, k]) for k in (0, 1)])
    clean = measured_passage(task.destination, at_s, tip_m, at_s, foretold)
    return replace(
        cycle,
        true_margin_m=float(task.destination.margin_m(tip_m[None])[0]),
        true_tip_error_m=clean.error_m,
        true_miss_m=clean.miss_m,
    )


def _flown(
    cycle: FastCycle, view: _View, flown: Flown, at_s: FloatArray, rng: np.random.Generator
) -> tuple[FastCycle, Motion]:
    """The cycle with what happened in flight, and the hand's true motion."""
    task, coming, identified = view.task, cycle.candidates, cycle.identified
    assert coming is not None and identified is not None and cycle.choice is not None
    path = coming.paths[cycle.choice.table.index(cycle.choice.best)]
    executing = Executing.of(task, view.timing, _filmed(cycle.held), cycle.held, view.start_s)
    ahead = answers(
        identified,
        executing.motion(path),
        executing.begin_s,
        view.start_s + float(at_s[-1]),
        task.arc_length_m,
    )
    noise_m = max(identified.noise.std_m, identified.residual_rms_m)
    motion, tails, foretold_m, stopped = _corrected(view, path, ahead, flown, noise_m, rng)
    at_tip = np.array([task.cable.free_length_m])
    tip_m = simulate(view.hidden, motion, view.start_s + at_s, at_tip, solver=WORLD)[0, :, 0]
    return replace(
        _in_truth(cycle, task, at_s, tip_m, ahead.t_s, foretold_m), tails=tails, stopped=stopped
    ), motion


@dataclass(frozen=True)
class Flown:
    """What happens while a cable is inserted.

    feedback   whether it is corrected
    late_s     by so much earlier the last frame was taken that is used
    dead_s     a change can begin so long after it is decided
    knock      when the hand is set off, and by how much to the right and up, m
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
class _View:
    """A hidden cable as the camera sees it in flight."""

    task: Task
    timing: Timing
    hidden: CableModel
    down: Motion
    start_s: float
    bias: _Bias
    errors: Errors

    def motion(self, path: Trajectory, flown: Flown) -> Motion:
        """The hand's true one, the hold before included."""
        motion = _whole(self.task, self.down, path, self.start_s, self.timing.arm_lag_s)
        if flown.knock is None:
            return motion
        at_s, right_m, up_m = flown.knock
        u = np.clip((motion.t_s - self.start_s - at_s) / 0.02, 0.0, 1.0)
        knocked = u * u * (3.0 - 2.0 * u)
        return replace(motion, x_m=motion.x_m + right_m * knocked, y_m=motion.y_m + up_m * knocked)

    def nodes_m(
        self, motion: Motion, t_s: FloatArray, flown: Flown, rng: np.random.Generator
    ) -> FloatArray:
        """(frames, nodes, 2) as seen, from when the hand is told to move."""
        at_s = self.start_s + t_s - flown.latency_s
        nodes = simulate(self.hidden, motion, at_s, self.task.arc_length_m, solver=WORLD)[0]
        seen = _pictured(nodes, self.bias, self.errors, rng)
        seen[rng.random(len(seen)) < flown.lost] = np.nan
        return seen


def _corrected(
    view: _View,
    path: Trajectory,
    ahead: Answers,
    flown: Flown,
    noise_m: float,
    rng: np.random.Generator,
) -> tuple[Motion, tuple[Tail, ...], FloatArray, bool]:
    """The hand's true motion, the changes that were told, and the tip as last predicted; whether it
    is stopped in front of the mouth, which is not simulated.
    """
    tails: tuple[Tail, ...] = ()
    motion = view.motion(path, flown)
    tip_m = ahead.nodes_m[:, 0]
    task = view.task
    left = list(decisions_s(ahead, task.destination)) if flown.feedback else []
    while left:
        decide_s = left.pop(0)
        t_s = np.arange(0.001, decide_s - flown.late_s, 0.005)
        seen = view.nodes_m(motion, t_s, flown, rng)
        beside = deviation(ahead, t_s, seen, noise_m)
        tip_m = ahead.nodes_m[:, 0] + beside.tip_m
        tail = best_tail(
            ahead,
            beside,
            view.task.destination,
            decide_s + flown.dead_s,
            view.timing.arm_lag_s,
            view.task.choice.repeatability_m,
        )
        if tail is None and not left:
            passes = chance(ahead, beside, task.destination, task.choice.repeatability_m)
            if passes < LEAST:
                return motion, tails, tip_m, True
        if tail is not None:
            tails = (*tails, tail)
            path, ahead, tip_m = (
                tail.of(path),
                moved_by(ahead, tail, view.timing.arm_lag_s),
                tail.tip_m,
            )
            motion = view.motion(path, flown)
    return motion, tails, tip_m, False


def _whole(task: Task, down: Motion, path: Trajectory, start_s: float, lag_s: float) -> Motion:
    """The hand's true motion when it follows a path after a hold."""
    late = executed_motion(path, lag_s, settle_s=task.settle_s)
    rows = np.column_stack([late.t_s + start_s, late.x_m, late.y_m, late.angle_rad])
    before = np.column_stack([down.t_s, down.x_m, down.y_m, down.angle_rad])
    whole = np.vstack([before, rows[rows[:, 0] > down.t_s[-1] + 1e-6]])
    return Motion(*(np.ascontiguousarray(c) for c in whole.T))


def _end_of_hold_s(task: Task, timing: Timing, held: Trial) -> float:
    """When the hold ends, as `EarlyEstimator` ends it."""
    last_s = float(held.grip.t_s[-1])
    if task.least_hold_s is None:
        return last_s
    rest_s, previous = last_s - task.hold_s, None
    for after_s, end_s in possible_ends_s(task, task.least_hold_s, task.hold_s):
        seen = until(held, rest_s + after_s)
        try:
            previous = identify(
                seen,
                task.arc_length_m,
                task.cable,
                previous=previous,
                options=without_hand_errors(task.identification),
            )
        except CableRejectedError:
            continue
        start_s = rest_s + end_s + task.decide_s
        coming = simulate_offsets(task, timing, _filmed(seen), seen, previous, start_s)
        asked = coming.forecast, previous, task.destination, task.choice
        if enough_frames(choose(*asked), *asked):
            return rest_s + end_s
    return last_s


def until(trial: Trial, end_s: float) -> Trial:
    """The same if it had ended then."""
    seen = trial.markers.t_s < end_s
    markers = replace(trial.markers, t_s=trial.markers.t_s[seen], xy_m=trial.markers.xy_m[seen])
    return replace(trial, grip=_moved_until(trial.grip, end_s), markers=markers)


def _moved_until(motion: Motion, end_s: float) -> Motion:
    moved = motion.t_s <= end_s + 1e-9
    return Motion(*(getattr(motion, n)[moved] for n in ("t_s", "x_m", "y_m", "angle_rad")))


def _filmed(held: Trial) -> FilmedMotion:
    hand = Trajectory(held.grip.t_s, held.grip.x_m, held.grip.y_m, held.grip.angle_rad)
    return FilmedMotion(0.0, (), hand, (), 0.0)


def best_margin_m(settings: Settings, seed: int, number: int) -> float:
    """Of all offsets, in truth: whether a perfect model could insert this hidden cable."""
    task, lag_s = cell_task(settings), settings.arm.lag_s
    down = _true_hold(task, lag_s)
    start_s = float(down.t_s[-1]) + task.decide_s
    table = [(offset_m, 0.0, 1.0) for offset_m in task.offsets_m]
    truth = _truths(task, hidden_cable(settings, seed, number), down, start_s, lag_s, table)
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
    """A hidden cable only measured with a motion; the noise is of the `number`-th of a seed."""
    rng = np.random.default_rng([seed, number, 2])
    t_s = np.arange(0.001, float(motion.t_s[-1]), 1.0 / settings.camera.frame_rate_hz)
    bias = _Bias.drawn(rng, errors, len(task.arc_length_m))
    hand = _logged(motion, errors, rng)
    trial = _seen(task, hidden, motion, t_s, hand, bias, errors, rng)
    return replace(trial, name="stroke")


@dataclass(frozen=True, eq=False)
class _Truths:
    """The hand's true motion of every offset, holds before included, and the tips' true paths."""

    task: Task
    hidden: CableModel
    motions: list[Motion]
    start_s: float

    @property
    def end_s(self) -> float:
        return max(float(m.t_s[-1]) for m in self.motions)

    def tips(self, at_s: FloatArray, which: Sequence[int] | None = None) -> FloatArray:
        """(offsets, times, 2) from the beginning of the execution on; None = of all offsets."""
        tip = np.array([self.task.cable.free_length_m])
        motions = self.motions if which is None else [self.motions[i] for i in which]
        return simulate(self.hidden, motions, self.start_s + at_s, tip, solver=WORLD)[:, :, 0]


def _truths(
    task: Task,
    hidden: CableModel,
    down: Motion,
    start_s: float,
    lag_s: float,
    table: Sequence[tuple[float, float, float]],
) -> _Truths:
    """`table`: offset, delay and pace of every motion."""
    motions = []
    for offset_m, delay_s, pace in table:
        limits = task.insertion.slowed(pace)
        path = insertion_path(
            task.lowered, offset_m, task.advance_m, limits, RATE_HZ, delay_s=delay_s
        )
        motions.append(_whole(task, down, path, start_s, lag_s))
    return _Truths(task, hidden, motions, start_s)


def _true_hold(task: Task, lag_s: float) -> Motion:
    path = identification_path(
        task.home,
        task.lower_m,
        task.lowering,
        RATE_HZ,
        duration_s=task.lower_s,
        hold_s=task.hold_s,
    )
    late = executed_motion(path, lag_s)
    t = np.arange(0.0, task.still_s + float(late.t_s[-1]), 1.0 / RATE_HZ)
    poses = (late.x_m, late.y_m, late.angle_rad)
    return Motion(t, *(np.interp(t - task.still_s, late.t_s, v) for v in poses))


@dataclass(frozen=True, eq=False)
class _Bias:
    """Errors that are the same in every picture of a cable."""

    stretch: FloatArray
    across_m: FloatArray

    @staticmethod
    def drawn(rng: np.random.Generator, errors: Errors, nodes: int) -> _Bias:
        along = np.linspace(1.0, 0.0, nodes)
        return _Bias(errors.end_m * rng.normal() * along, errors.across_m * rng.normal(size=nodes))


def _pictured(
    nodes: FloatArray, bias: _Bias, errors: Errors, rng: np.random.Generator
) -> FloatArray:
    along = np.gradient(nodes, axis=1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    noise = rng.normal(size=nodes.shape)
    for i in range(1, len(noise)):
        noise[i] = errors.colour * noise[i - 1] + np.sqrt(1.0 - errors.colour**2) * noise[i]
    shifted = nodes - bias.stretch[:, None] * along + bias.across_m[:, None] * across
    return np.asarray(shifted + errors.node_m * noise)


def _logged(motion: Motion, errors: Errors, rng: np.random.Generator) -> Motion:
    xy = [v + errors.log_m * rng.normal(size=len(v)) for v in (motion.x_m, motion.y_m)]
    return Motion(motion.t_s, *xy, motion.angle_rad)


def _seen(
    task: Task,
    hidden: CableModel,
    motion: Motion,
    t_s: FloatArray,
    hand: Motion,
    bias: _Bias,
    errors: Errors,
    rng: np.random.Generator,
) -> Trial:
    nodes = simulate(hidden, motion, t_s, task.arc_length_m, solver=WORLD)[0]
    seen = np.stack([np.interp(t_s, motion.t_s, v) for v in (motion.x_m, motion.y_m)], axis=-1)
    return hold_trial(
        hand,
        t_s,
        _pictured(nodes, bias, errors, rng),
        seen + errors.grip_m * rng.normal(size=seen.shape),
        errors.angle_rad * rng.normal(size=len(t_s)),
    )


def _executed(
    task: Task,
    hidden: CableModel,
    motion: Motion,
    start_s: float,
    held: Trial,
    bias: _Bias,
    errors: Errors,
    rng: np.random.Generator,
) -> Trial:
    """As `station.executed_trial` makes it."""
    period_s = float(np.median(np.diff(held.markers.t_s)))
    t_s = np.arange(start_s + 0.001, float(motion.t_s[-1]), period_s)
    nodes = simulate(hidden, motion, t_s, task.arc_length_m, solver=WORLD)[0]
    log = _logged(motion, errors, rng)
    later = log.t_s > held.grip.t_s[-1]
    shift = [getattr(held.grip, n)[0] - getattr(motion, n)[0] for n in ("x_m", "y_m", "angle_rad")]
    grip = [np.concatenate([held.grip.t_s, log.t_s[later]])]
    for name, by in zip(("x_m", "y_m", "angle_rad"), shift, strict=True):
        grip.append(np.concatenate([getattr(held.grip, name), getattr(log, name)[later] + by]))
    pictured = _pictured(nodes, bias, errors, rng)
    return Trial("execute", "validate", "equilibrium", Motion(*grip), Markers(t_s, pictured))
