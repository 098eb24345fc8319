"""The cell: runs cycles as a plan's steps in the states of the machine, and records them."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from cell.computer.memory import release_free_memory
from cell.records.folder import LaterRecord, RecordError
from cell.records.result import Result
from cell.run import endings
from cell.run.archive import Archive, CycleListing, CycleRecording
from cell.run.commands import INTERRUPTING, Commands
from cell.run.machine import CellState, EventRefusedError, Machine, MachineEvent
from cell.run.movements import slowed
from cell.run.plans import INSERTING, REPEATED_AFTER_LOSS, Plan, changing_over, rehearsing
from cell.run.progress import CycleProgress, OneCycle
from cell.run.station import ProductTask, Station, Task
from cell.run.step_runner import StepRunner
from drivers.interfaces import ArmMode, DeviceError, Devices

_LOG = logging.getLogger(__name__)


class Cell:
    """A live cell: runs cycles, obeys commands from any thread, and always leaves the arm stopped.

    devices   guarded by their limits
    made      task for every cable, until `change_product`
    runs      parent folder of the cycles' folders
    computer  executor of computations during the processing of frames; None = a thread
    watched   whether devices are watched at all times; only real-time ones can be
    archive   recordings and ledger of cycles
    others    tasks of products that `change_product` may select: their code is loaded at the start
    on_step   called with cycle number and step name as each step begins
    """

    def __init__(
        self,
        devices: Devices,
        made: ProductTask,
        runs: Path,
        on_step: Callable[[int, str], None] = lambda number, step: None,
        *,
        computer: Executor | None = None,
        watched: bool = False,
        archive: Archive | None = None,
        others: Sequence[Task] = (),
    ) -> None:
        self.commands = Commands()
        #: Waiting times since its last call, s, by reason; may be set later.
        self.waited: Callable[[], Mapping[str, float]] = dict
        self.machine = Machine(devices.clock.now_s)
        computer = ThreadPoolExecutor(1, "ahead") if computer is None else computer
        self._station = Station(devices, made.task, self.commands, computer, tuple(others))
        self._steps = StepRunner(self.machine, self.commands, on_step)
        self._product_task = made
        self._former: Task | None = None
        self._runs = runs
        self._watched = watched
        self._archive = Archive() if archive is None else archive
        self._unacknowledged: list[CycleListing] = []
        self._acknowledged: list[CycleListing] = []
        self._prepared: OneCycle | None = None

    @property
    def product(self) -> str | None:
        """Product of the next cycles; None = the settings have no products."""
        return self._product_task.name

    def now_s(self) -> float:
        """Time on the cell's clock."""
        return self._station.devices.clock.now_s()

    def notes(self) -> Sequence[str]:
        """Messages for a person, about the recordings and the ledger."""
        return self._archive.notes()

    def command(self, event: MachineEvent, reason: str = "") -> None:
        """Stop, abort, hold, unhold, suspend or unsuspend, from any thread, at any time.

        A stop or an abort has reached the arm when this returns.
        """
        _LOG.warning("command %s: %s", event.value, reason)
        self.commands.give(event, reason)
        if event in INTERRUPTING:
            endings.stop(self._station.devices, reason or event.value)

    def acknowledge(self, by: str = "", note: str = "") -> None:
        """Acknowledge, in a person's name, that the cause of a stop or an abort is removed.

        The ledger lists it for every open cycle; after a stop in Idle only the log does.

        by, note  name and action of the person
        raises    EventRefusedError: the cell is not stopped
        """
        if self.machine.state is CellState.ABORTED:
            self.machine.send(MachineEvent.CLEAR)
            self.machine.send(MachineEvent.DONE)
        if self.machine.state is not CellState.STOPPED:
            raise EventRefusedError(f"nothing to acknowledge while {self.machine.state.value}")
        self.commands.clear()
        _LOG.warning("acknowledged by %s: %s", by, note)
        self._acknowledged, self._unacknowledged = self._unacknowledged, []
        for listing in self._acknowledged:
            listing.acknowledge(by, note)

    def reset(self, by: str = "", note: str = "") -> None:
        """Send the gripper home for a person, as listed in log and ledger.

        raises  EventRefusedError: the cell is not stopped, or complete
        """
        self.machine.send(MachineEvent.RESET)
        _LOG.warning("reset by %s: %s", by, note)
        listings, self._acknowledged = self._acknowledged, []
        for listing in listings:
            listing.reset(by, note)

    def take_up(self, folder: Path) -> None:
        """Include an open cycle of an earlier run, by its folder, in the next `acknowledge`."""
        listing = CycleListing(self._archive.ledger)
        listing.take_up(folder)
        self._unacknowledged.append(listing)

    def close(self) -> None:
        """Stop the arm and disconnect all devices."""
        with ExitStack() as stack:
            stack.callback(self._steps.forget)
            stack.callback(self._archive.close)
            stack.callback(self._station.computer.shutdown, wait=False, cancel_futures=True)
            endings.close(self._station.devices)

    def change_product(self, made: ProductTask) -> None:
        """Select the product of the next cycles, also of a prepared one; called between cycles.

        The next cycle first empties the jaws, in the way of the former product.
        """
        if self._former is None and made.name != self._product_task.name:
            self._former = self._station.task
        self._product_task = made
        self._station = replace(self._station, task=made.task)

    def rehearsal(self, plan: Plan, speed: float) -> Plan:
        """All movements of a plan with empty jaws, at a share of their speed.

        raises  ValueError: a speed that is not > 0 and ≤ 1
        """
        return rehearsing(plan, self._station.task, self._station.devices.arm.rate_hz, speed)

    def run_cycle(self, number: int, plan: Plan = INSERTING, part: str | None = None) -> Result:
        """Run a cycle for one cable; even an error leaves a result, a record and a stopped arm.

        part    id of the cable; None = it has none
        raises  EventRefusedError: the cell was stopped by a fault that nobody acknowledged
        """
        if not self.machine.can(MachineEvent.RESET):
            raise EventRefusedError(f"no cycle can begin while {self.machine.state.value}")
        cycle = self._new_cycle(number, plan)
        self._open(cycle, part)
        try:
            cycle.progress.record.settings(cycle.made.settings)
            self._reset(cycle)
            self._work(cycle)
        except BaseException as error:
            self._stop_after(cycle.progress, error)
        result = self._conclude(cycle)
        self.come_to_rest()
        del cycle  # and its pictures
        release_free_memory()
        return result

    def prepare(self, number: int, plan: Plan = INSERTING) -> Result | None:
        """Make ready for a cycle and rest in Idle; `run_prepared` continues.

        returns  None: it is ready, and nothing is recorded yet; or the result of a failed cycle
                 `number`, after which the caller must call `come_to_rest`
        raises   EventRefusedError: the cell was stopped by a fault that nobody acknowledged
        """
        if self.machine.state is not CellState.RESETTING and not self.machine.can(
            MachineEvent.RESET
        ):
            raise EventRefusedError(f"no cycle can begin while {self.machine.state.value}")
        cycle = self._new_cycle(number, plan)
        try:
            self._reset(cycle)
        except BaseException as error:
            return self._fail(cycle, error)
        self._prepared = cycle
        return None

    def run_prepared(self, part: str | None = None) -> Result:
        """Run the prepared cycle, as `run_cycle`; Start may have been sent already.

        After a stop or a fault the caller must call `come_to_rest`.
        raises  EventRefusedError: none is prepared
        """
        cycle = self._with_current_product(self._take_prepared())
        try:
            self._open(cycle, part)
            cycle.progress.record.settings(cycle.made.settings)
            self._work(cycle)
        except BaseException as error:
            self._stop_after(cycle.progress, error)
        result = self._conclude(cycle)
        del cycle  # and its pictures
        release_free_memory()
        return result

    def check(self) -> None:
        """Check that the cell can rest in Idle.

        raises  InterruptedByCommandError: after a stop or an abort; DeviceError
        """
        self.commands.check()

    def leave_idle(self, error: BaseException) -> Result:
        """Stop or abort after an error of `check`; then the caller must call `come_to_rest`.

        A fault of a device is recorded as the prepared cycle; a command is not recorded.
        raises  EventRefusedError: none is prepared
        """
        cycle = self._take_prepared()
        cycle.progress.step = CellState.IDLE.value
        if isinstance(error, DeviceError):
            return self._fail(cycle, error)
        self._stop_after(cycle.progress, error)
        return self._conclude(cycle)

    def come_to_rest(self) -> None:
        """Go from Stopping to Stopped, from Aborting to Aborted, after everything is recorded.

        Only then an acknowledgement is possible.  An abort meanwhile counts.
        """
        if self.machine.state is CellState.STOPPING and self.commands.aborted:
            self.machine.send(MachineEvent.ABORT)
        if self.machine.state in (CellState.STOPPING, CellState.ABORTING):
            self.machine.send(MachineEvent.DONE)

    # --- from the beginning of a cycle to its end ---------------------------------------------

    def _new_cycle(self, number: int, plan: Plan, *, at_start: bool = False) -> OneCycle:
        """A future cycle; `at_start` = it is reset already."""
        if self._former is not None:
            plan = changing_over(plan, self._former, at_start=at_start)
        station = replace(self._station, task=slowed(self._station.task, plan.speed))
        record, recording = LaterRecord(self._runs, number), CycleRecording(None)
        first = plan.resetting[0].name
        progress = CycleProgress(
            number,
            record,
            recording,
            station,
            plan.initial_findings,
            first,
            product=self._product_task.name,
        )
        return OneCycle(plan, self._product_task, progress, self.machine.seconds())

    def _with_current_product(self, cycle: OneCycle) -> OneCycle:
        """The prepared cycle, or after a change of product one of the new product."""
        if cycle.made is self._product_task:
            return cycle
        before = cycle.progress
        before.watch.end()
        new = self._new_cycle(before.number, cycle.plan, at_start=True)
        new.before = cycle.before
        new.progress.seconds = before.seconds
        if self._watched:
            new.progress.watch.begin()
        return new

    def _take_prepared(self) -> OneCycle:
        cycle, self._prepared = self._prepared, None
        if cycle is None:
            raise EventRefusedError("no cycle is prepared")
        return cycle

    def _open(self, cycle: OneCycle, part: str | None = None, *, filmed: bool = True) -> None:
        """Begin the record; `filmed` = with a recording.  Raises RecordError."""
        progress, plan, started = cycle.progress, cycle.plan, datetime.now().astimezone()
        assert isinstance(progress.record, LaterRecord)
        progress.record = record = progress.record.opened(started)
        begun = record.folder, progress.number, started
        if filmed:
            progress.recording = CycleRecording(self._archive.recording)
            goal = {"aim": plan.aim.value, "product": cycle.made.name}
            planned = {**goal, "steps": plan.names, "speed": plan.speed}
            progress.recording.begin(*begun, planned, cycle.made)
        cycle.part = part
        if cycle.made.name is not None:
            record.state(product=cycle.made.name)
        cycle.listing = CycleListing(self._archive.ledger)
        cycle.listing.begin(*begun, plan.aim.value, part, cycle.made)

    def _reset(self, cycle: OneCycle) -> None:
        """Resetting, into Idle."""
        if self.machine.state is not CellState.RESETTING:
            self._steps.send(cycle.progress, MachineEvent.RESET)
        with cycle.progress.written_after():
            cycle.progress.record.check_room()
            self._steps.carry_out(cycle.progress, cycle.plan.resetting)
            self._former = None
            self._steps.send(cycle.progress, MachineEvent.DONE)
        if self._watched:
            cycle.progress.watch.begin()

    def _work(self, cycle: OneCycle) -> None:
        """From Idle, or Starting, into Complete."""
        progress, plan = cycle.progress, cycle.plan
        with progress.written_after():
            progress.record.check_room()
            if self.machine.state is not CellState.STARTING:
                self._steps.send(progress, MachineEvent.START)
            for stages in (plan.starting, plan.execute, plan.completing):
                self._steps.carry_out(progress, stages)
                self._former = None  # its cable was let go
                self._steps.send(progress, MachineEvent.DONE)

    def _fail(self, cycle: OneCycle, error: BaseException) -> Result:
        """Result of a cycle that failed before it began; it is recorded, too."""
        self._stop_after(cycle.progress, error)
        self._open(cycle, filmed=False)
        return self._conclude(cycle)

    def _conclude(self, cycle: OneCycle) -> Result:
        """Result and records of a cycle that has come to rest."""
        progress, after = cycle.progress, self.machine.seconds()
        progress.watch.end()
        result = replace(progress.result(cycle.spent_s(after)), part=cycle.part)
        try:
            progress.record.close(result)
        except RecordError as error:
            result = endings.unrecorded(self._station.devices, progress.step, result, error)
        progress.recording.end(result)
        if cycle.listing is not None:
            cycle.listing.end(result, progress.findings.identified, self.waited())
            if result.fault is not None:
                self._unacknowledged.append(cycle.listing)
        _LOG.info(
            "cycle %d: %s in %s", progress.number, result.outcome.value, progress.record.folder
        )
        return result

    def _stop_after(self, progress: CycleProgress, error: BaseException) -> None:
        """Stop, record the reason, and change to Stopping (by command) or Aborting (by fault)."""
        fault, event = endings.fault_of(progress.step, error)
        foreign = None if isinstance(error, endings.EXPECTED) else error
        _LOG.error("step %s failed: %s", progress.step, error, exc_info=foreign)
        progress.watch.cease()
        mode = endings.halt(self._station.devices, fault.cause)
        cable = endings.whereabouts_of_cable(self._station.devices)
        _LOG.error("the arm is %s, %s", mode.value.replace("_", " "), cable)
        if endings.unreached(error) or mode is ArmMode.LOST:
            self._steps.repeat(REPEATED_AFTER_LOSS)
        rests = CellState.ABORTED if event is MachineEvent.ABORT else CellState.STOPPED
        if self.machine.can(event):
            self.machine.send(event)
        progress.fault = replace(fault, cable=cable)
        progress.recording.fault(progress.fault)
        with suppress(RecordError):  # there is another try at the end
            progress.record.use_reserve()
            progress.record.state(
                state=rests.value,
                arm=mode.value,
                cable=cable,
                traceback=None
                if isinstance(error, endings.EXPECTED)
                else "".join(traceback.format_exception(error)),
            )
