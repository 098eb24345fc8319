"""One cycle of the cell: the steps in their order, inside the machine's states, with a record."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from cell.computer.memory import give_back
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError
from cell.plan.choose import Choice
from cell.plan.measuring import Measuring
from cell.plan.passage import height_at_mouth_m
from cell.records.folder import Record
from cell.records.result import Fault, Outcome, Result
from cell.run import dry_run, steps
from cell.run.agreement import agreement
from cell.run.commands import INTERRUPTING, RESUMING, Commands, InterruptedByCommandError
from cell.run.legs import cycle_legs, measuring_legs, slowed, slowed_motion
from cell.run.machine import CellState, Event, EventRefusedError, Machine
from cell.run.pictures import dry_run_pictures, held_pictures, measured_pictures, passage_pictures
from cell.run.progress import Progress
from cell.run.station import Candidates, Devices, Filmed, Station, Task, executed_trial, held_trial
from cell.study.data import Trial
from drivers.interfaces import (
    CameraError,
    ConnectError,
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
)

Given = ParamSpec("Given")
Found = TypeVar("Found")

#: Steps that only compute: their time is the computer's, not that of the cell's clock.
COMPUTING = frozenset({"warm_up", "identify", "simulate", "choose", "verify"})

#: Steps that begin with a cable between the jaws and end with it there.
HOLDING = frozenset(
    {"lower", "hold_and_capture", "approach", "measure", "go_back"}
    | {"identify", "simulate", "choose", "execute", "verify"}
)

#: After these the devices are connected anew; after the others they are still there.
UNREACHED = (ConnectError, DeviceLostError, DeviceTimeoutError, CameraError)

#: A computer that needs longer for a choice is not going to manage, s: the longer the hand waits,
#: the more there is to simulate.
LONGEST_LEAD_S = 3.0

#: Share of a measuring motion's frames in which the cable must be seen.
LEAST_SEEN = 0.8


class Cell:
    """A live cell: runs cycles, obeys commands from any thread, and always leaves the arm stopped.

    devices   guarded by their limits
    task      what to do with every cable
    settings  as resolved, for the record
    runs      folder in which every cycle gets its own
    computer  computes while frames are looked at; None = a thread
    watched   look at the devices all the time; only those that run in real time can be
    on_step   told of every step as it begins: number of the cycle, name of the step
    """

    def __init__(
        self,
        devices: Devices,
        task: Task,
        settings: Mapping[str, Any],
        runs: Path,
        on_step: Callable[[int, str], None] = lambda number, step: None,
        *,
        computer: Executor | None = None,
        watched: bool = False,
    ) -> None:
        self.commands = Commands()
        self.machine = Machine(devices.clock.now_s)
        computer = ThreadPoolExecutor(1, "ahead") if computer is None else computer
        self._station = Station(devices, task, self.commands, computer)
        self._settings = settings
        self._runs = runs
        self._on_step = on_step
        self._watched = watched
        self._connected = self._warm = False

    def command(self, event: Event, reason: str = "") -> None:
        """Stop, abort, hold, unhold, suspend or unsuspend, from any thread, at any time.

        A stop or an abort is given to the arm before this returns.
        """
        self.commands.give(event, reason)
        if event in INTERRUPTING:
            steps.stop(self._station.devices, reason or event.value)

    def acknowledge(self) -> None:
        """A person's word that the cause of a stop or an abort is gone.

        raises  EventRefusedError: the cell is not stopped
        """
        if self.machine.state is CellState.ABORTED:
            self.machine.send(Event.CLEAR)
            self.machine.send(Event.DONE)
        if self.machine.state is not CellState.STOPPED:
            raise EventRefusedError(f"nothing to acknowledge while {self.machine.state.value}")
        self.commands.clear()

    def close(self) -> None:
        """Stop the arm and disconnect all devices."""
        steps.close(self._station.devices)
        self._station.computer.shutdown(wait=False, cancel_futures=True)
        self._connected = self._warm = False

    def run_cycle(
        self, number: int, motion: Measuring | None = None, *, dry_run_speed: float | None = None
    ) -> Result:
        """One cable from grasp to release; whatever happens, a result, a record and a still arm.

        motion         only measure the cable with this motion; None = insert it
        dry_run_speed  make these motions with empty jaws, at this share of their speed
        raises  EventRefusedError: the cell was stopped by a fault that nobody acknowledged;
                ValueError: a speed that is not > 0 and ≤ 1
        """
        if not self.machine.can(Event.RESET):
            raise EventRefusedError(f"no cycle can begin while {self.machine.state.value}")
        before = self.machine.seconds()
        station, empty = self._station, dry_run_speed is not None
        if dry_run_speed is not None:
            station = replace(station, task=slowed(station.task, dry_run_speed))
        progress = Progress(number, Record(self._runs, number, datetime.now()), station, empty)
        try:
            progress.record.settings(self._settings)
            self._reset(progress, dry_run_speed)
            if self._watched:
                progress.watch.begin()
            self._send(progress, Event.START)
            self._step(progress, "start", steps.check_ready)
            self._send(progress, Event.DONE)
            if dry_run_speed is not None:
                self._rehearse(progress, motion, dry_run_speed)
            elif motion is None:
                self._insert(progress)
            else:
                self._measure(progress, motion)
            self._send(progress, Event.DONE)
            self._step(progress, "go_home", steps.go_home)
            self._send(progress, Event.DONE)
        except BaseException as error:
            self._end(progress, error)
        progress.watch.end()
        after = self.machine.seconds()
        progress.known["state_seconds"] = {
            state.value: after[state] - before[state]
            for state in CellState
            if after[state] > before[state]
        }
        result = progress.result()
        progress.record.close(result)
        give_back()
        return result

    # --- what happens in the states -----------------------------------------------------------

    def _reset(self, progress: Progress, dry_run_speed: float | None) -> None:
        self._send(progress, Event.RESET)
        if not self._connected:
            self._step(progress, "connect", steps.connect)
            self._connected = True
        if dry_run_speed is not None:
            progress.known["speed"] = dry_run_speed
            progress.known["checks"] = self._step(progress, "reset", dry_run.reset)
        else:
            if not self._warm:
                self._step(progress, "warm_up", steps.warm_up)
                self._warm = True
            self._step(progress, "reset", steps.reset)
        self._send(progress, Event.DONE)

    def _insert(self, progress: Progress) -> None:
        """The nine steps; what each of them finds is recorded at once."""
        self._pause(progress)
        self._step(progress, "grasp", steps.grasp)
        self._pause(progress)
        filming = self._step(progress, "lower", steps.lower)
        held = self._step(progress, "hold_and_capture", steps.hold_and_capture, filming)
        trial = held_trial(held)
        try:
            identified, prospect, choice = self._conclude(progress, held, trial)
        except CableRejectedError as error:
            self._reject(progress, str(error))
            return
        if choice.reason is not None:
            self._reject(progress, choice.reason)
            progress.record.pictures(held_pictures(held, trial, identified, self._station.task))
            return
        progress.known["offset_m"] = choice.best.offset_m
        path = prospect.paths[choice.table.index(choice.best)]
        executed = self._step(progress, "execute", steps.execute, path, prospect.start_s)
        progress.add_study(trial, executed_trial(trial, held, executed))
        passage = self._step(progress, "verify", steps.verify, executed, prospect, choice)
        progress.add_passage(passage)
        # Pictures take their time, and the execution began at a moment that had been planned.
        progress.record.pictures(held_pictures(held, trial, identified, self._station.task))
        progress.record.pictures(passage_pictures(executed, prospect, choice, self._station.task))
        progress.add_model(steps.settled(self._station, trial, identified))
        self._pause(progress)
        self._step(progress, "release", steps.release, aside=not passage.passed)
        progress.known["outcome"] = Outcome.INSERTED if passage.passed else Outcome.MISSED

    def _conclude(
        self, progress: Progress, held: Filmed, trial: Trial
    ) -> tuple[Identified, Candidates, Choice]:
        """What cable this is and what to do with it; recorded then, for the hand waits for it."""
        identified: Identified | None = None
        recorded = False

        def record() -> None:
            nonlocal recorded
            if not recorded:
                recorded = True
                progress.add_study(trial)
                if identified is not None:
                    progress.add_model(identified)

        try:
            identified = self._step(progress, "identify", steps.identify, trial, held.early)
            return identified, *self._decide(progress, held, trial, identified, record)
        finally:
            record()

    def _decide(
        self,
        progress: Progress,
        held: Filmed,
        trial: Trial,
        identified: Identified,
        record: Callable[[], None],
    ) -> tuple[Candidates, Choice]:
        """Simulate, choose and record, again if a pause or a slow computer let the moment go by."""
        lead_s = self._station.task.decide_s
        waits_from_s = held.seen_at_s
        while True:
            prospect = self._step(
                progress, "simulate", steps.simulate, held, trial, identified, lead_s
            )
            choice = self._step(progress, "choose", steps.choose, prospect, identified)
            progress.known.update(
                wait_s=time.perf_counter() - waits_from_s,
                probability=choice.best.probability,
                predicted_margin_m=choice.best.margin_m,
                predicted_miss_m=height_at_mouth_m(self._station.task.destination, choice.tip_m),
            )
            record()
            paused = self._pause(progress)
            if paused:
                waits_from_s = time.perf_counter()
            if choice.reason is not None or not (
                paused or steps.is_past(self._station, prospect.start_s)
            ):
                return prospect, choice
            if not paused and lead_s > LONGEST_LEAD_S:
                raise DeviceTimeoutError(
                    "computer",
                    f"a choice took longer than the {lead_s:.1f} s allowed for it",
                    "end other programs, or allow a longer motion.decide_s",
                )
            lead_s *= 1.0 if paused else 2.0

    def _reject(self, progress: Progress, reason: str) -> None:
        progress.known["reason"] = reason
        self._pause(progress)
        self._step(progress, "release", steps.release, aside=True)
        progress.known["outcome"] = Outcome.REJECTED

    def _measure(self, progress: Progress, motion: Measuring) -> None:
        """A trial for the model lab, after which the cable is back where it was grasped."""
        self._pause(progress)
        self._step(progress, "grasp", steps.grasp)
        self._pause(progress)
        self._step(progress, "approach", steps.approach, motion)
        filmed = self._step(progress, "measure", steps.measure, motion)
        progress.add_study(replace(held_trial(filmed), name=motion.name))
        progress.record.pictures(measured_pictures(filmed, self._station.task))
        self._pause(progress)
        self._step(progress, "go_back", steps.go_home)
        self._step(progress, "release", steps.release, aside=False)
        seen = sum(s.seen for s in filmed.sightings)
        if seen < LEAST_SEEN * len(filmed.sightings):
            progress.known["outcome"] = Outcome.REJECTED
            progress.known["reason"] = (
                f"the cable is seen in {seen} of {len(filmed.sightings)} frames, needs "
                f"{LEAST_SEEN:.0%}; keep the motion inside the picture"
            )
        else:
            progress.known["outcome"] = Outcome.MEASURED

    def _rehearse(self, progress: Progress, motion: Measuring | None, speed: float) -> None:
        """All motions of a cycle, or of a measuring one, with empty jaws; and what they show."""
        task, arm = progress.station.task, progress.station.devices.arm
        legs = (
            cycle_legs(task, arm.rate_hz)
            if motion is None
            else measuring_legs(task, slowed_motion(motion, speed), arm.rate_hz)
        )
        progress.known["checks"] += self._step(progress, "check_paths", dry_run.check_paths, legs)
        followed = []
        for leg in legs:
            self._pause(progress)
            followed.append(self._step(progress, leg.name, dry_run.follow, leg))
        made = [f for f in followed if f is not None]
        camera = progress.station.devices.camera
        progress.known["checks"] += agreement(
            made, lag_s=arm.lag_s, frame_rate_hz=camera.frame_rate_hz
        )
        progress.record.pictures(dry_run_pictures(made, task))
        wrong = [check.what for check in progress.known["checks"] if not check.right]
        progress.known["outcome"] = Outcome.UNFIT if wrong else Outcome.REHEARSED
        if wrong:
            progress.known["reason"] = f"not as it must be: {', '.join(wrong)}"

    def _end(self, progress: Progress, error: BaseException) -> None:
        """Stop, say why, and come to rest in Stopped (by command) or Aborted (by fault)."""
        fault, event = _fault(progress.step, error)
        progress.watch.cease()
        mode = steps.halt(self._station.devices, fault.cause)
        self._connected &= not isinstance(error, UNREACHED)
        for sent in (event, Event.DONE):
            if self.machine.can(sent):
                self.machine.send(sent)
        progress.known.update(outcome=Outcome.FAILED, fault=fault)
        progress.record.state(
            state=self.machine.state.value,
            arm=mode.value,
            traceback=None
            if isinstance(error, DeviceError | InterruptedByCommandError | KeyboardInterrupt)
            else "".join(traceback.format_exception(error)),
        )

    # --- what surrounds every step ------------------------------------------------------------

    def _step(
        self,
        progress: Progress,
        name: str,
        act: Callable[Concatenate[Station, Given], Found],
        *args: Given.args,
        **kwargs: Given.kwargs,
    ) -> Found:
        progress.step = name
        progress.record.state(step=name, state=self.machine.state.value)
        self._on_step(progress.number, name)
        now_s = time.perf_counter if name in COMPUTING else self._station.devices.clock.now_s
        begun_s = now_s()
        progress.watch.holding = name in HOLDING and not progress.empty
        try:
            self.commands.check()
            found = act(progress.station, *args, **kwargs)
            self.commands.check()
            return found
        except DeviceError:
            self.commands.check()  # a device that refuses because of a stop is not the cause
            raise
        finally:
            passed_s = now_s() - begun_s
            progress.seconds[name] = progress.seconds.get(name, 0.0) + passed_s
            progress.record.state(seconds=progress.seconds)

    def _send(self, progress: Progress, event: Event) -> None:
        progress.record.state(state=self.machine.send(event).value)

    def _pause(self, progress: Progress) -> bool:
        """Hold or suspend if that was asked for, until it is taken back; whether it was."""
        pause = self.commands.pause
        if pause is None:
            return False
        self._send(progress, pause)
        self._send(progress, Event.DONE)
        self._on_step(progress.number, self.machine.state.value)
        self.commands.wait_until_resumed(pause)
        self._send(progress, RESUMING[pause])
        self._send(progress, Event.DONE)
        return True


def _fault(step: str, error: BaseException) -> tuple[Fault, Event]:
    match error:
        case InterruptedByCommandError():
            return Fault(step, error.reason or error.event.value), error.event
        case KeyboardInterrupt():
            return Fault(step, "interrupted by a person"), Event.STOP
        case DeviceError():
            return Fault(step, error.cause, error.device, error.remedy), Event.ABORT
    return Fault(step, f"{type(error).__name__}: {error}"), Event.ABORT
