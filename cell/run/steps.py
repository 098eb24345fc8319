"""The steps of an insertion and of the states before it; `measuring_steps` has the others.

Of this package, only the steps, `waiting`, `filming`, `endings`, `dry_run` and `watch` call
devices.  A step takes the station and the findings that it reads, and returns those that it adds;
it has no other state.  A cable is rejected by its findings, not by an exception.  `plans` lists the
steps, what each reads and adds, and their order.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import replace

import numpy as np

from cell.cable.geometry import Motion
from cell.cable.solver import DivergedError
from cell.cable.statics import UnsettledError
from cell.computer.memory import freeze_loaded_objects
from cell.identify.individual import CableRejectedError, Reason
from cell.identify.individual import identify as identify_cable
from cell.plan.choose import choose as choose_offset
from cell.plan.passage import measured_passage
from cell.plan.paths import MotionLimits, identification_path, path_to
from cell.plan.response import time_to_rest_s
from cell.records.result import Outcome
from cell.run.candidates import simulate_offsets
from cell.run.clocks import delay_checks
from cell.run.corrector import Corrector
from cell.run.early_estimate import EarlyEstimator
from cell.run.filming import capture, film
from cell.run.findings import Filming, Findings, required
from cell.run.movements import APPROACH_SLOWER, Movement, Movements, paths_from
from cell.run.station import Station, Task
from cell.run.trials import executed_trial, held_trial
from cell.run.waiting import AHEAD_S, await_rest, check_arm, wait_until
from cell.run.warm_up import second_process, warm_up_vision
from cell.run.warm_up import warm_up as warm_up_engine
from cell.vision.sighting import why_unseen
from drivers.interfaces import (
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    GripError,
    LimitError,
    Pose,
    Trajectory,
)

_LOG = logging.getLogger(__name__)

#: One frame in so many is stored as a picture, during the hold and during the execution.
KEEP_EVERY_HELD, KEEP_EVERY_MOVING = 20, 4
#: Below this shift of its tips a forecast is corrected to first order, not simulated again, m.
SMALL_SHIFT_M = 5e-4
#: A computer that needs longer for a choice is not going to manage, s: the longer the gripper
#: waits, the more there is to simulate.
LONGEST_LEAD_S = 3.0
#: A cable rests if its tip stays within so much of its place, m: a twentieth of a pixel, or the
#: noise if that is more.  No cable of a few decimetres swings longer than this, s.
RESTING_M, LONGEST_SWING_S = 1e-5, 30.0
#: Errors of a simulation with impossible parameters.
IMPOSSIBLE = (DivergedError, UnsettledError)


# --- in every cycle -----------------------------------------------------------------------------


def connect(station: Station, findings: Findings) -> Findings:
    """Connect all devices, the one that moves last.  Raises ConnectError."""
    station.devices.gripper.connect()
    station.devices.camera.connect()
    station.devices.arm.connect()
    return findings


def warm_up(station: Station, findings: Findings) -> Findings:
    """Compile and load all numerical code in the processes that will use it.

    It keeps the computer busy for seconds, so no device should be connected yet.
    raises  DeviceLostError; DeviceError: the model of the settings cannot be simulated
    """
    tasks = (station.task, *station.others)
    models = list(dict.fromkeys((t.cable, t.identification.kind) for t in tasks))
    try:
        with second_process(station.computer) as process:
            computed = []
            if process is not None:
                computed = [process.submit(warm_up_engine, *model) for model in models]
            for task in tasks:  # meanwhile
                warm_up_vision(task.vision)
            for job in computed:
                job.result()
        for model in models:
            warm_up_engine(*model)
            station.computer.submit(warm_up_engine, *model).result()
    except BrokenExecutor as error:
        raise DeviceLostError(
            "computer",
            "the process that computes ahead ended as it began",
            "free memory; a script of your own must begin under `if __name__ == '__main__':`",
        ) from error
    except IMPOSSIBLE as error:
        raise DeviceError(
            "model",
            f"a usual cable with the effects of the settings cannot be simulated: {error}",
            "correct model.effects, or take the last promotion back: `cell promote --undo`",
        ) from error
    freeze_loaded_objects()
    return findings


def reset(station: Station, findings: Findings) -> Findings:
    """Clear our own stop, empty the jaws and bring the gripper home, level strokes first."""
    station.devices.arm.reset()
    station.commands.check()  # after the reset, so that a stop meanwhile is not lost
    station.devices.gripper.release()
    return go_home(station, findings)


def empty_jaws(former: Task, station: Station, findings: Findings) -> Findings:
    """Open the jaws; if they hold something, at the place where `former` puts cables aside."""
    station.devices.arm.reset()
    station.commands.check()  # after the reset, so that a stop meanwhile is not lost
    if station.devices.gripper.state().holding:
        move_to(station, former.aside, former.lowering)
    return let_go(station, findings)


def check_paths(movements: Movements, station: Station, findings: Findings) -> Findings:
    """Whether every path of the plan keeps limits and reach, before anything moves.

    The approach, the way back and the way aside count too: a cable between the jaws must not be
    stranded by a path that is refused later.
    raises  LimitError: naming the way, the point, its value and the limit
    """
    allowed_paths(station, movements(station.task, station.devices.arm.rate_hz, 1.0))
    return findings


def allowed_paths(
    station: Station, movements: Sequence[Movement]
) -> tuple[tuple[str, Trajectory], ...]:
    """Names and paths of movements from where the gripper is, and of every offset.

    raises  LimitError: the arm may not follow one of them; nothing was moved
    """
    arm = station.devices.arm
    paths = paths_from(arm.state().pose, station.task, movements, arm.rate_hz)
    for name, path in paths:
        try:
            arm.check(path)
        except LimitError as error:
            cause = f"on the way '{name.replace('_', ' ')}' {error.cause}"
            raise LimitError(error.device, cause, error.remedy) from error
    return paths


def check_ready(station: Station, findings: Findings) -> Findings:
    """Check that a cycle may begin: arm ready, jaws empty.  Raises DeviceError."""
    check_arm(station)
    if station.devices.gripper.state().holding:
        raise GripError(station.devices.gripper.name, "holds something already", "empty the jaws")
    return findings


def go_home(station: Station, findings: Findings) -> Findings:
    """Bring the gripper from wherever it is to where cables are grasped."""
    move_to(station, station.task.home, station.task.lowering)
    return findings


# --- inserting ----------------------------------------------------------------------------------


def grasp(station: Station, findings: Findings) -> Findings:
    """Close the jaws on the cable and let it calm down.  Raises GripError."""
    station.devices.gripper.grip(station.task.force_n)
    wait_until(station, station.devices.clock.now_s() + station.task.calm_s)
    return findings


def lower(station: Station, findings: Findings) -> Findings:
    """Begin to film the cable at rest, then move it down so that it swings."""
    task, path = station.task, lowering_path(station)
    return replace(
        findings, filming=film(station, path, task.still_s, task.hold_s, KEEP_EVERY_HELD)
    )


def lowering_path(station: Station) -> Trajectory:
    """The motion that makes the cable swing, from time 0."""
    task = station.task
    return identification_path(
        task.home,
        task.lower_m,
        task.lowering,
        station.devices.arm.rate_hz,
        duration_s=task.lower_s,
        hold_s=0.0,
    )


def hold_and_capture(station: Station, findings: Findings) -> Findings:
    """Hold still while the cable swings, and find it in every frame as it comes.

    The second process computes from the first frames, so that little work remains after the last
    one, which comes early if more frames would not matter and the task allows that.
    """
    filming = required(findings.filming)
    estimator = EarlyEstimator(station, filming)
    try:
        filmed = capture(station, filming, KEEP_EVERY_HELD, estimator.update)
        held = replace(filmed, early=estimator.result(len(filmed.sightings)))
    finally:
        estimator.close()
    return replace(
        findings,
        held=held,
        trials=(held_trial(held),),
        hold_saved_s=(filming.frame_count - len(held.sightings)) / station.timing.frame_rate_hz,
        lead_s=station.task.decide_s,
        waiting_since_s=held.last_frame_at_s,
    )


def check_clocks(station: Station, findings: Findings) -> Findings:
    """Whether latency and lag are still as calibrated, from the motion that was filmed anyway.

    raises  DeviceError: they are not; with the command that corrects it
    """
    task, held = station.task, required(findings.held)
    if task.delays is None:
        return findings
    path = lowering_path(station)
    commanded = replace(path, t_s=path.t_s + held.begin_s + task.still_s)
    checks = delay_checks(
        np.array([s.t_s for s in held.sightings]),
        np.array([s.grip_m for s in held.sightings]),
        held.gripper_log,
        commanded,
        station.devices.arm.lag_s,
        task.delays,
    )
    for check in checks:
        if not check.right:
            device, _, text = check.what.partition(": ")
            raise DeviceError(
                device,
                f"{text} {check.found * 1e3:+z.2f} ms since it was calibrated, at most "
                f"{1e3 * (check.high or 0.0):.2f} ms are allowed",
                check.remedy,
            )
    return replace(findings, checks=checks)


def delays_were_determined(station: Station, findings: Findings) -> bool:
    """Whether the motion determined both delays, if they are checked at all."""
    determined = [check.high is not None for check in findings.checks]
    return station.task.delays is None or (bool(determined) and all(determined))


def identify(station: Station, findings: Findings) -> Findings:
    """Identify the cable's parameters, or reject it with a reason."""
    task, early = station.task, required(findings.held).early
    try:
        identified = identify_cable(
            findings.trials[0],
            task.arc_length_m,
            task.cable,
            previous=None if early is None else early.identified,
            predicted=None if early is None else early.predicted,
            options=task.identification,
        )
    except CableRejectedError as error:
        if error.reason is not Reason.UNSEEN_FRAMES:
            return findings.reject(str(error))
        why = why_unseen(required(findings.held).sightings, task.vision.free_length_m)
        return findings.reject(f"{error}; {why}")
    return replace(findings, identified=identified)


def simulate(station: Station, findings: Findings) -> Findings:
    """Simulate every offset from `lead_s` after now, or reuse an early simulation that still holds.

    A cable whose swing cannot be simulated is rejected, as one that cannot be identified is.
    """
    held, identified = required(findings.held), required(findings.identified)
    now_s = station.devices.clock.now_s()
    findings = replace(findings, simulated_s=(*findings.simulated_s, now_s))
    early = held.early
    if early is not None and not is_past(station, early.candidates.start_s):
        expected = early.candidates.forecast
        shift_m = expected.moved_to(identified.mean).tip_m - expected.tip_m
        if np.abs(shift_m).max() < SMALL_SHIFT_M:
            return replace(findings, candidates=early.candidates)
    try:
        candidates = simulate_offsets(
            station.task,
            station.timing,
            held,
            findings.trials[0],
            identified,
            now_s + required(findings.lead_s),
        )
    except IMPOSSIBLE as error:
        return findings.reject(f"no forecast: {error}")
    return replace(findings, candidates=candidates)


def choose(station: Station, findings: Findings) -> Findings:
    """The offset that passes most probably, or why none does."""
    task = station.task
    choice = choose_offset(
        required(findings.candidates).forecast,
        required(findings.identified),
        task.destination,
        task.choice,
    )
    wait_s = time.perf_counter() - required(findings.waiting_since_s)
    findings = replace(findings, choice=choice, wait_s=wait_s)
    return findings if choice.reason is None else findings.reject(choice.reason)


def review_choice(station: Station, findings: Findings, paused: bool) -> Findings:
    """Confirm the choice if there is still time to execute it; else give the next one more time.

    paused  the cell was held or suspended after the choice: the gripper did not wait for the
            computer
    raises  DeviceTimeoutError: the computer is too slow for any choice
    """
    if paused:
        return replace(findings, waiting_since_s=time.perf_counter())
    if findings.rejected:
        return findings
    if not is_past(station, required(findings.candidates).start_s):
        return replace(findings, offset_m=required(findings.choice).best.offset_m)
    lead_s = required(findings.lead_s)
    if lead_s > LONGEST_LEAD_S:
        raise DeviceTimeoutError(
            "computer",
            f"a choice took longer than the {lead_s:.1f} s allowed for it",
            "end other programs, or allow a longer motion.decide_s",
        )
    return replace(findings, lead_s=2.0 * lead_s)


def execute(station: Station, findings: Findings) -> Findings:
    """Follow the chosen path from its planned moment on; film it until the gripper has settled.

    With feedback the path may be changed meanwhile, see `Corrector`.
    """
    task, arm, camera = station.task, station.devices.arm, station.devices.camera
    candidates, choice = required(findings.candidates), required(findings.choice)
    path, start_s = candidates.paths[choice.table.index(choice.best)], candidates.start_s
    duration_s = float(path.t_s[-1]) + arm.lag_s + task.settle_s
    frame_count = int(np.ceil(duration_s * camera.frame_rate_hz))
    end_s = start_s + duration_s
    arm.follow(path, start_s)
    corrector = Corrector(station, findings, path, arm.revise) if task.feedback else None
    wait_until(station, start_s)
    camera.start(frame_count)
    filming = Filming(start_s, end_s - task.settle_s, end_s, frame_count)
    if corrector is None:
        executed = capture(station, filming, KEEP_EVERY_MOVING)
    else:
        try:
            executed = capture(station, filming, KEEP_EVERY_MOVING, corrector.update)
        finally:
            corrector.close()
        findings = replace(findings, tails=corrector.tails)
        findings = replace(findings, stopped=corrector.stopped)
        if corrector.tails:  # without corrections the planned path is the prediction
            findings = replace(findings, predicted=corrector.predicted)
    (trial,) = findings.trials
    trials = (trial, executed_trial(trial, required(findings.held), executed))
    return replace(findings, executed=executed, trials=trials)


def verify(station: Station, findings: Findings) -> Findings:
    """Check whether the detected tip passed the destination, and compute the forecast's error."""
    executed, predicted = required(findings.executed), findings.predicted_choice
    passage = measured_passage(
        station.task.destination,
        np.array([s.t_s for s in executed.sightings]),
        np.array([s.nodes_m[0] for s in executed.sightings]),
        required(findings.candidates).start_s + predicted.t_s,
        predicted.tip_m,
    )
    if findings.stopped is not None:
        return replace(findings, passage=passage).reject(findings.stopped)
    outcome = Outcome.INSERTED if passage.passed else Outcome.MISSED
    return replace(findings, passage=passage, outcome=outcome, reason=passage.reason)


def review_insertion(station: Station, findings: Findings, paused: bool) -> Findings:
    """Clear the outcome for another try, if the cable was stopped and the task allows one."""
    if findings.stopped is None or len(findings.stops) >= station.task.retries:
        return findings
    return replace(findings, outcome=None, reason=None)


def bring_back(station: Station, findings: Findings) -> Findings:
    """Bring a cable that was stopped slowly to where it was grasped, until it rests.

    Its model predicts the time of the swing, from the gripper's motion since the cable was lowered.
    raises  DeviceTimeoutError: the arm does not come to rest
    """
    task, arm, clock = station.task, station.devices.arm, station.devices.clock
    identified, begin_s = required(findings.identified), required(findings.held).begin_s
    move_to(station, task.home, task.insertion.slowed(APPROACH_SLOWER))
    now_s = clock.now_s()
    hand = arm.log(begin_s, now_s)
    moved = Motion(hand.t_s - begin_s, hand.x_m, hand.y_m, hand.angle_rad)
    rest_m = max(RESTING_M, identified.noise.std_m)
    swings_s = time_to_rest_s(identified, moved, rest_m, LONGEST_SWING_S)
    _LOG.info("the cable rests %.1f s after the gripper", swings_s)
    wait_until(station, now_s + max(swings_s, task.calm_s))
    return findings.for_retry()


def release(station: Station, findings: Findings) -> Findings:
    """Let go of the cable: where it is if it was inserted, else aside.

    raises  DeviceTimeoutError: the arm does not come to rest
    """
    if findings.outcome is not Outcome.INSERTED:
        move_to(station, station.task.aside, station.task.lowering)
    return let_go(station, findings)


# --- releasing ------------------------------------------------------------------------------------


def let_go(station: Station, findings: Findings) -> Findings:
    """Open the jaws where the gripper rests.  Raises DeviceTimeoutError: it does not come to
    rest."""
    await_rest(station)
    station.devices.gripper.release()
    return findings


# --- shared by the steps ------------------------------------------------------------------------


def is_past(station: Station, t_s: float) -> bool:
    """Whether it is too late to command the arm to start at time `t_s`."""
    return station.devices.clock.now_s() > t_s - AHEAD_S


def move_to(station: Station, goal: Pose, limits: MotionLimits) -> None:
    """Move to `goal` from rest: level first, then up or down, then turning, and rest there.

    The motion before may have ended a moment ago, while the arm still settles.
    raises  DeviceTimeoutError: the arm does not come to rest
    """
    arm = station.devices.arm
    await_rest(station)
    path = path_to(goal, arm.state().pose, limits, arm.rate_hz)
    if path is None:
        return
    arm.follow(path)
    wait_until(station, station.devices.clock.now_s() + float(path.t_s[-1]) + arm.lag_s)
    await_rest(station)
