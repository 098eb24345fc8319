"""One cycle of the cell: a plan's steps in the machine's states, with a record."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from cell.computer.memory import release_free_memory
from cell.records.folder import LaterRecord, RecordError
from cell.records.result import Outcome, Result
from cell.run import steps
from cell.run.archive import Archive
from cell.run.commands import INTERRUPTING, RESUMING, Commands
from cell.run.endings import EXPECTED, UNREACHED, fault_of
from cell.run.listed import CycleListing
from cell.run.machine import CellState, Event, EventRefusedError, Machine
from cell.run.movements import slowed
from cell.run.plans import AGAIN_WHEN_LOST, INSERTING, Plan, Repeat, Step, rehearsing
from cell.run.progress import Progress
from cell.run.recorded import CycleRecording
from cell.run.station import Station, Task
from drivers.interfaces import DeviceError, Devices

_LOG = logging.getLogger(__name__)


@dataclass
class _Cycle:
    """A cycle from its preparation to its end.

    before   time spent in each state before it, s
    part     id of its cable
    listing  None = the ledger does not know of it yet
    """

    plan: Plan
    progress: Progress
    before: Mapping[CellState, float]
    part: str | None = None
    listing: CycleListing | None = None


class Cell:
    """A live cell: runs cycles, obeys commands from any thread, and always leaves the arm stopped.

    devices   guarded by their limits
    task      what to do with every cable
    settings  as resolved, for the record
    runs      folder in which every cycle gets its own
    computer  computes while frames are looked at; None = a thread
    watched   look at the devices all the time; only those that run in real time can be
    archive   where cycles are recorded and listed
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
        archive: Archive | None = None,
    ) -> None:
        self.commands = Commands()
        self.machine = Machine(devices.clock.now_s)
        computer = ThreadPoolExecutor(1, "ahead") if computer is None else computer
        self._station = Station(devices, task, self.commands, computer)
        self._settings = settings
        self._runs = runs
        self._on_step = on_step
        self._watched = watched
        self._archive = Archive() if archive is None else archive
        self._done_once: set[str] = set()
        self._listing: CycleListing | None = None
        self._prepared: _Cycle | None = None

    def now_s(self) -> float:
        """Time on the cell's clock."""
        return self._station.devices.clock.now_s()

    def notes(self) -> Sequence[str]:
        """What a person should know of the recordings and of the ledger."""
        return self._archive.notes()

    def command(self, event: Event, reason: str = "") -> None:
        """Stop, abort, hold, unhold, suspend or unsuspend, from any thread, at any time.

        A stop or an abort is given to the arm before this returns.
        """
        _LOG.warning("command %s: %s", event.value, reason)
        self.commands.give(event, reason)
        if event in INTERRUPTING:
            steps.stop(self._station.devices, reason or event.value)

    def acknowledge(self, by: str = "", note: str = "") -> None:
        """A person's word that the cause of a stop or an abort is gone; the ledger lists it.

        by, note  who says so, and what was done
        raises    EventRefusedError: the cell is not stopped
        """
        if self.machine.state is CellState.ABORTED:
            self.machine.send(Event.CLEAR)
            self.machine.send(Event.DONE)
        if self.machine.state is not CellState.STOPPED:
            raise EventRefusedError(f"nothing to acknowledge while {self.machine.state.value}")
        self.commands.clear()
        if self._listing is not None:
            self._listing.acknowledge(by, note)

    def take_up(self, folder: Path) -> None:
        """The cycle of an earlier run to which `acknowledge` refers, by its folder."""
        self._listing = CycleListing(self._archive.ledger)
        self._listing.take_up(folder)

    def close(self) -> None:
        """Stop the arm and disconnect all devices."""
        steps.close(self._station.devices)
        self._station.computer.shutdown(wait=False, cancel_futures=True)
        self._archive.close()
        self._done_once.clear()

    def rehearsal(self, plan: Plan, speed: float) -> Plan:
        """All movements of a plan with empty jaws, at a share of their speed.

        raises  ValueError: a speed that is not > 0 and ≤ 1
        """
        return rehearsing(plan, self._station.task, self._station.devices.arm.rate_hz, speed)

    def run_cycle(self, number: int, plan: Plan = INSERTING, part: str | None = None) -> Result:
        """One cable from grasp to release; whatever happens, a result, a record and a still arm.

        part    id of the cable; None = it has none
        raises  EventRefusedError: the cell was stopped by a fault that nobody acknowledged
        """
        if not self.machine.can(Event.RESET):
            raise EventRefusedError(f"no cycle can begin while {self.machine.state.value}")
        cycle = self._cycle(number, plan)
        self._open(cycle, part)
        try:
            cycle.progress.record.settings(self._settings)
            self._reset(cycle)
            self._work(cycle)
        except BaseException as error:
            self._end(cycle.progress, error)
        result = self._conclude(cycle)
        del cycle  # and its pictures
        release_free_memory()
        return result

    def prepare(self, number: int, plan: Plan = INSERTING) -> Result | None:
        """Make ready for a cycle and rest in Idle, where `run_prepared` goes on.

        returns  None: it is ready, and nothing is recorded yet; or how cycle `number` failed
        raises   EventRefusedError: the cell was stopped by a fault that nobody acknowledged
        """
        if self.machine.state is not CellState.RESETTING and not self.machine.can(Event.RESET):
            raise EventRefusedError(f"no cycle can begin while {self.machine.state.value}")
        cycle = self._cycle(number, plan)
        try:
            self._reset(cycle)
        except BaseException as error:
            return self._fail(cycle, error)
        self._prepared = cycle
        return None

    def run_prepared(self, part: str | None = None) -> Result:
        """The cycle that is prepared, as `run_cycle`; Start may have been sent already.

        raises  EventRefusedError: none is prepared
        """
        cycle = self._taken()
        try:
            self._open(cycle, part)
            cycle.progress.record.settings(self._settings)
            self._work(cycle)
        except BaseException as error:
            self._end(cycle.progress, error)
        result = self._conclude(cycle)
        del cycle  # and its pictures
        release_free_memory()
        return result

    def check(self) -> None:
        """Whether the cell can rest in Idle.

        raises  InterruptedByCommandError: a stop or an abort was given; DeviceError
        """
        self.commands.check()

    def leave_idle(self, error: BaseException) -> Result:
        """Come to rest in Stopped or Aborted because of what `check` has raised.

        A fault of a device is recorded as the cycle that was prepared; a command is not.
        raises  EventRefusedError: none is prepared
        """
        cycle = self._taken()
        cycle.progress.step = CellState.IDLE.value
        if isinstance(error, DeviceError):
            return self._fail(cycle, error)
        self._end(cycle.progress, error)
        return self._conclude(cycle)

    # --- from the beginning of a cycle to its end ---------------------------------------------

    def _cycle(self, number: int, plan: Plan) -> _Cycle:
        station = replace(self._station, task=slowed(self._station.task, plan.speed))
        record, recording = LaterRecord(self._runs, number), CycleRecording(None)
        first = plan.resetting[0].name
        progress = Progress(number, record, recording, station, plan.given, first)
        return _Cycle(plan, progress, self.machine.seconds())

    def _taken(self) -> _Cycle:
        cycle, self._prepared = self._prepared, None
        if cycle is None:
            raise EventRefusedError("no cycle is prepared")
        return cycle

    def _open(self, cycle: _Cycle, part: str | None = None, *, filmed: bool = True) -> None:
        """Begin the record; `filmed` = with a recording.  Raises RecordError."""
        progress, plan, started = cycle.progress, cycle.plan, datetime.now()
        assert isinstance(progress.record, LaterRecord)
        progress.record = record = progress.record.opened(started)
        if filmed:
            progress.recording = CycleRecording(self._archive.recording)
            meant = {"aim": plan.aim.value, "steps": plan.names, "speed": plan.speed}
            progress.recording.begin(record.folder, progress.number, started, meant)
        cycle.part = part
        self._listing = cycle.listing = CycleListing(self._archive.ledger)
        cycle.listing.begin(record.folder, progress.number, started, plan.aim.value, part)

    def _reset(self, cycle: _Cycle) -> None:
        """Resetting, into Idle."""
        if self.machine.state is not CellState.RESETTING:
            self._send(cycle.progress, Event.RESET)
        try:
            self._carry_out(cycle.progress, cycle.plan.resetting)
            self._send(cycle.progress, Event.DONE)
        finally:
            cycle.progress.write()
        if self._watched:
            cycle.progress.watch.begin()

    def _work(self, cycle: _Cycle) -> None:
        """From Idle, or Starting, into Complete."""
        progress, plan = cycle.progress, cycle.plan
        try:
            if self.machine.state is not CellState.STARTING:
                self._send(progress, Event.START)
            for stages in (plan.starting, plan.execute, plan.completing):
                self._carry_out(progress, stages)
                self._send(progress, Event.DONE)
        finally:
            progress.write()  # what was found before a step that failed

    def _fail(self, cycle: _Cycle, error: BaseException) -> Result:
        """How a cycle failed that was not begun: it gets a record all the same."""
        self._end(cycle.progress, error)
        self._open(cycle, filmed=False)
        return self._conclude(cycle)

    def _conclude(self, cycle: _Cycle) -> Result:
        """Result and records of a cycle that has come to rest."""
        progress, after = cycle.progress, self.machine.seconds()
        progress.watch.end()
        spent_s = {
            state.value: after[state] - cycle.before[state]
            for state in CellState
            if after[state] > cycle.before[state]
        }
        result = replace(progress.result(spent_s), part=cycle.part)
        try:
            progress.record.close(result)
        except RecordError as error:
            result = self._unrecorded(progress, result, error)
        progress.recording.end(result)
        if cycle.listing is not None:
            cycle.listing.end(result, progress.findings.identified)
        if result.fault is None:
            self._listing = None  # there is nothing to acknowledge
        _LOG.info(
            "cycle %d: %s in %s", progress.number, result.outcome.value, progress.record.folder
        )
        return result

    def _end(self, progress: Progress, error: BaseException) -> None:
        """Stop, say why, and come to rest in Stopped (by command) or Aborted (by fault)."""
        fault, event = fault_of(progress.step, error)
        foreign = None if isinstance(error, EXPECTED) else error
        _LOG.error("step %s failed: %s", progress.step, error, exc_info=foreign)
        progress.watch.cease()
        mode = steps.halt(self._station.devices, fault.cause)
        cable = steps.whereabouts_of_cable(self._station.devices)
        _LOG.error("the arm is %s, %s", mode.value.replace("_", " "), cable)
        if isinstance(error, UNREACHED):
            self._done_once -= AGAIN_WHEN_LOST
        for sent in (event, Event.DONE):
            if self.machine.can(sent):
                self.machine.send(sent)
        progress.fault = replace(fault, cable=cable)
        progress.recording.fault(progress.fault)
        with suppress(RecordError):  # there is another try at the end
            progress.record.use_reserve()
            progress.record.state(
                state=self.machine.state.value,
                arm=mode.value,
                cable=cable,
                traceback=None
                if isinstance(error, EXPECTED)
                else "".join(traceback.format_exception(error)),
            )

    def _unrecorded(self, progress: Progress, result: Result, error: RecordError) -> Result:
        """The result of a cycle whose record cannot be closed: it is only returned."""
        if result.fault is not None:
            return result
        fault, _ = fault_of(progress.step, error)
        cable = steps.whereabouts_of_cable(self._station.devices)
        return replace(result, outcome=Outcome.FAILED, fault=replace(fault, cable=cable))

    # --- what surrounds every step ------------------------------------------------------------

    def _carry_out(self, progress: Progress, sequence: Iterable[Step | Repeat]) -> None:
        """Do steps one after another; those that are due."""
        for element in sequence:
            match element:
                case Step():
                    if self._is_due(progress, element):
                        if element.may_pause:
                            self._pause(progress)
                        self._do(progress, element)
                case Repeat():
                    again = False
                    while not element.until(progress.findings):
                        if again:
                            self._carry_out(progress, element.before_again)
                        self._carry_out(progress, element.steps)
                        again = True
                        paused = self._pause(progress)
                        progress.findings = element.review(
                            progress.station, progress.findings, paused
                        )

    def _is_due(self, progress: Progress, step: Step) -> bool:
        return (
            step.name not in self._done_once
            and progress.number % step.every == 0
            and (step.with_rejected or not progress.findings.rejected)
        )

    def _do(self, progress: Progress, step: Step) -> None:
        """One step, what is made of it, and the record of it."""
        progress.step = step.name
        progress.record.state(step=step.name, state=self.machine.state.value)
        progress.recording.state(self.machine.state.value, step.name)
        if not step.hand_waits:
            progress.recording.found(progress.findings, progress.station)
        self._on_step(progress.number, step.name)
        now_s = time.perf_counter if step.computes else self._station.devices.clock.now_s
        begun_s = now_s()
        progress.watch.holding = step.holding
        try:
            self.commands.check()
            findings = step.act(progress.station, progress.findings)
            self.commands.check()
        except DeviceError:
            self.commands.check()  # a device that refuses because of a stop is not the cause
            raise
        finally:
            passed_s = now_s() - begun_s
            progress.seconds[step.name] = progress.seconds.get(step.name, 0.0) + passed_s
            _LOG.info("cycle %d: step %s took %.3f s", progress.number, step.name, passed_s)
            progress.record.note(seconds=progress.seconds)
        progress.findings = findings
        if step.once:
            self._done_once.add(step.name)
        if findings.rejected or not step.hand_waits:
            progress.record.state()
            progress.write()
        progress.findings = step.after(progress.station, findings)
        if progress.findings is not findings:
            progress.write()

    def _send(self, progress: Progress, event: Event) -> None:
        state = self.machine.send(event).value
        progress.record.state(state=state)
        progress.recording.state(state, None)

    def _pause(self, progress: Progress) -> bool:
        """Hold or suspend if that was asked for, until it is taken back; whether it was."""
        paused = False
        while (pause := self.commands.pause) is not None:  # one may be asked for in another
            self._send(progress, pause)
            self._send(progress, Event.DONE)
            self._on_step(progress.number, self.machine.state.value)
            self.commands.wait_until_resumed(pause)
            self._send(progress, RESUMING[pause])
            self._send(progress, Event.DONE)
            paused = True
        return paused
