"""The cell as a service: it waits in Idle, makes a cycle for every start, and resets by itself.

At its start it takes over the open faults of an earlier service: from its cycles, or a flag file.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError
from cell.plant.messages import CommandReply, FaultNotice, Request
from cell.plant.reporter import Reporter, latch, refusal
from cell.plant.systemd import Watchdog
from cell.records.folder import (
    RecordError,
    acknowledge_record,
    cycle_of,
    read_record,
    read_state,
    started_of,
)
from cell.records.result import Outcome, Result
from cell.run.commands import InterruptedByCommandError, too_old
from cell.run.cycle import Cell
from cell.run.endings import fault_of
from cell.run.machine import CellState, MachineEvent
from cell.run.plans import INSERTING, Plan
from cell.settings.product import product_for
from drivers.interfaces import DeviceError
from drivers.threads import GuardedThread, error_text

_LOG = logging.getLogger(__name__)

#: Interval at which the idle service checks its commands and devices, s.
_POLL_S = 0.1
#: States in which no cycle is under way.
_BETWEEN = frozenset(
    {
        CellState.IDLE,
        CellState.STOPPED,
        CellState.ABORTED,
        CellState.CLEARING,
        CellState.RESETTING,
    }
)
_UNHURRIED = (CellState.HELD, CellState.SUSPENDED)
#: Number of other open cycles that a fault names.
_NAMED = 3


class Service:
    """Runs cycles on request until `end`; `answer` is the handler of its link.

    plan            of every cycle
    products        name of each product → pattern of its parts' ids, None = any
    product         default product; None = a start or `product` must name one
    select_product  sets the product of the next cycles; called between cycles, by `run`
    """

    def __init__(
        self,
        cell: Cell,
        reporter: Reporter,
        runs: Path,
        *,
        plan: Plan = INSERTING,
        products: Mapping[str, str | None] | None = None,
        product: str | None = None,
        select_product: Callable[[str], None] = lambda name: None,
    ) -> None:
        self._cell = cell
        self._reporter = reporter
        self._plan = plan
        self._products = products or {}
        self._select = select_product
        self._watchdog = Watchdog()
        self._changed = threading.Condition()
        self._ending = threading.Event()
        self._over = threading.Event()
        self._part: str | None = None
        self._product = product
        self._wanted: str | None = None
        self._begins: Request | None = None
        self._flag = AcknowledgementFlag(runs)
        earlier = earlier_cycles(runs)
        self._number = earlier.cycle + 1
        self._open: tuple[Path, ...] = earlier.open
        if earlier.fault is not None:
            for folder in earlier.open:
                cell.take_up(folder)
            reporter.state(CellState.STOPPED)
            reporter.fault(earlier.fault)
        elif (fault := self._flag.fault(self._number)) is not None:
            self._open = (self._flag.file,)
            reporter.state(CellState.STOPPED)
            reporter.fault(fault)
        # whether the service resets by itself at its start: no fault waits for a person
        self._never_ran = not self._open
        cell.machine.on_change = self._on_state
        cell.waited = reporter.take_waited

    # --- the link's threads -------------------------------------------------------------------

    def answer(self, request: Request) -> CommandReply:
        """Carry out a request or refuse it; returns at once."""
        with self._changed:
            if request.product is not None and request.product not in self._products:
                if not self._products:
                    why = "this cell's settings have no products; leave it out"
                    return self._refused("product", why, "product")
                known = ", ".join(self._products)
                why = f"{request.product!r} is not known, but {known}"
                return self._refused("product", why, "product")
            command = request.command
            if command in (MachineEvent.START, MachineEvent.RESET, MachineEvent.CLEAR):
                answer = self._transition(request, command)
            elif command is not None:
                if command is MachineEvent.SUSPEND:
                    self._reporter.suspended_for = request.note
                answer = latch(self._cell, request, unacknowledged=self._unacknowledged)
                if command is MachineEvent.ABORT and answer.accepted:
                    answer = self._abort_from_stopped(answer)
            elif request.product is None:
                answer = self._acknowledge_only(request)
            else:
                answer = CommandReply(True, self._cell.machine.state)
            if (
                answer.accepted
                and command is not MachineEvent.START
                and request.product is not None
            ):
                self._wanted = request.product
                if self._cell.machine.state in _BETWEEN:  # else when the cycle has ended
                    self._reporter.product(request.product)
            self._changed.notify_all()
            return answer

    def _transition(self, request: Request, command: MachineEvent) -> CommandReply:
        """Make the transition of start, reset or clear, from a state in which the cell rests."""
        machine = self._cell.machine
        if not machine.can(command):
            return self._refused(command.value)
        if self._ending.is_set():
            return self._refused(command.value, "the service is about to end")
        if command is MachineEvent.START:
            try:
                self._cell.check()
            except (InterruptedByCommandError, DeviceError) as error:
                return self._refused(command.value, str(error))
            part, usual = request.part or None, self._wanted or self._product
            try:
                product = product_for(self._products, request.product, part, usual)
            except ValueError as error:
                return self._refused(command.value, str(error), "part" if part else "product")
            self._part, self._wanted, self._begins = part, product, request
            self._reporter.cycle(self._number, self._part, product)
            return CommandReply(True, machine.send(command))
        if machine.state is CellState.COMPLETE:  # it resets by itself, at once
            return CommandReply(True, machine.state)
        note = request.note
        if machine.state is CellState.ABORTED or self._open:
            self._acknowledge(request)
            note = ""  # the acknowledgement has it
        if command is MachineEvent.RESET:
            self._never_ran = False
            self._begins = request
            self._cell.reset(request.by, note)
        return CommandReply(True, machine.state)

    def _abort_from_stopped(self, answer: CommandReply) -> CommandReply:
        """Go from Stopped to Aborted: no cycle obeys there, and a reset would undo the abort."""
        machine = self._cell.machine
        if machine.state is not CellState.STOPPED or self._never_ran:  # else a cycle obeys it
            return answer
        try:
            self._cell.check()
        except (InterruptedByCommandError, DeviceError) as error:
            self._flag.write(str(error))
            if not self._open:
                self._open = (self._flag.file,)
                fault, _ = fault_of(machine.state.value, error)
                notice = FaultNotice(self._number - 1, time_s=time.time(), **vars(fault))
                self._reporter.fault(notice)
        machine.send(MachineEvent.ABORT)
        return CommandReply(True, machine.send(MachineEvent.DONE))

    def _acknowledge_only(self, request: Request) -> CommandReply:
        """Acknowledge without a command: nothing moves before a reset."""
        state = self._cell.machine.state
        if state is CellState.ABORTED:
            return self._transition(request, MachineEvent.CLEAR)
        if not self._unacknowledged:
            return self._refused("acknowledge", "there is nothing to acknowledge")
        self._acknowledge(request)
        self._reporter.waiting("reset")
        return CommandReply(True, state)

    def _acknowledge(self, request: Request) -> None:
        self._cell.acknowledge(request.by, request.note)
        self._reporter.acknowledged(request.by, request.note)
        folders, self._open = self._open, ()
        for folder in folders:
            if cycle_of(folder) is not None:
                try:
                    acknowledge_record(folder, request.by, request.note)
                except RecordError as error:  # the next service asks again
                    _LOG.warning("%s", error)

    def _refused(self, command: str, why: str = "", wrong: str = "") -> CommandReply:
        return refusal(self._cell, command, why, wrong, unacknowledged=self._unacknowledged)

    @property
    def _unacknowledged(self) -> bool:
        """Whether a person can acknowledge a fault or a stop now."""
        state = self._cell.machine.state
        return state is CellState.ABORTED or (state is CellState.STOPPED and bool(self._open))

    def end(self) -> None:
        """End after the cycle under way, or at once if it is paused; safe in a signal's handler."""
        self._ending.set()

    # --- the thread that moves the cell -------------------------------------------------------

    def run(
        self, on_result: Callable[[Result], None], on_ready: Callable[[], None] = lambda: None
    ) -> None:
        """Serve until `end`.  Raises RecordError; KeyboardInterrupt.

        on_result  gets results
        on_ready   called when the cell waits for its first start
        """
        tending = GuardedThread("tend", self._watchdog_loop, self._watchdog_died)
        tending.start()
        self._watchdog.notifier.ready()
        told = False
        try:
            while not self._ending.is_set():
                self._select_product(tell=True)
                if self._wait_for_operator():
                    continue
                result = self._prepare()
                if result is None:
                    if not told:
                        on_ready()
                    told = True
                    result = self._run_next()
                if result is not None:
                    self._conclude(result, on_result)
        finally:
            self._watchdog.notifier.stopping()
            self._over.set()
            tending.join()

    def _wait_for_operator(self) -> bool:
        """Wait while a person has to act first; whether that was so."""
        with self._changed:
            state = self._cell.machine.state
            if state is not CellState.ABORTED and (
                state is not CellState.STOPPED or self._never_ran
            ):
                return False
        while self._cell.machine.state is state and not self._ending.is_set():
            self._wait_briefly()
        return True

    def _prepare(self) -> Result | None:
        """Make the cell ready; a flag file states meanwhile that the gripper may be moving."""
        self._flag.write("the program or the computer ended while the cell was made ready")
        self._stop_if_late()
        with self._changed:  # a person may send a reset, too
            self._never_ran = False
            if self._cell.machine.state is not CellState.RESETTING:
                self._cell.machine.send(MachineEvent.RESET)
        result = self._cell.prepare(self._number, self._plan)
        self._flag.remove()
        return result

    def _run_next(self) -> Result | None:
        """Run the next requested cycle: its result, or that of a fault; None = the service ends."""
        try:
            while self._cell.machine.state is CellState.IDLE:
                self._cell.check()
                if self._ending.is_set():
                    return None
                self._wait_briefly()
        except (InterruptedByCommandError, DeviceError) as error:
            # before it is published: the service may be killed at once
            self._flag.write(str(error))
            with self._changed:
                if self._cell.machine.state is CellState.IDLE:
                    return self._cell.leave_idle(error)
            self._flag.remove()  # a start came first: its cycle obeys the command
        self._stop_if_late()
        self._select_product(tell=False)  # the start has published it
        return self._cell.run_prepared(self._part)

    def _stop_if_late(self) -> None:
        """Stop if this process was halted since the start or reset: an old one moves nothing."""
        with self._changed:
            begins, self._begins = self._begins, None
        if begins is not None and begins.command is not None:
            late = too_old(begins.command.value, begins.asked_s)
            if late:
                self._cell.command(MachineEvent.STOP, late)

    def _conclude(self, result: Result, on_result: Callable[[Result], None]) -> None:
        recorded = cycle_of(Path(result.folder)) is not None
        with self._changed:  # no acknowledgement before everything is published
            if result.fault is not None:
                self._open = (Path(result.folder),)
            if recorded:
                self._flag.remove()
                self._number += 1
                self._reporter.result(result)
            elif result.fault is not None:
                fault = FaultNotice(self._number - 1, time_s=time.time(), **vars(result.fault))
                self._reporter.fault(fault)
            self._cell.come_to_rest()
        if recorded:
            on_result(result)

    def _select_product(self, *, tell: bool) -> None:
        with self._changed:
            wanted, self._wanted = self._wanted, None
        if wanted is not None and wanted != self._product:
            self._select(wanted)
            self._product = wanted
            if tell:
                self._reporter.product(wanted)

    def _wait_briefly(self) -> None:
        self._watchdog.waiting()
        with self._changed:
            self._changed.wait(_POLL_S)

    # --- signs of life ------------------------------------------------------------------------

    def step(self, number: int, step: str) -> None:
        """A step of a cycle begins: for the cell's `on_step`."""
        self._watchdog.step()
        self._reporter.step(number, step)

    def _on_state(self, state: CellState) -> None:
        self._watchdog.step()
        if state is CellState.IDLE:  # before it is published: the service may be killed at once
            self._flag.remove()
        self._reporter.state(state)
        self._watchdog.notifier.status(f"{state.value}, cycle {self._number}")

    def _watchdog_died(self, error: BaseException) -> None:
        """Systemd would kill the service in the middle of a motion: it stops and ends itself."""
        self._cell.command(
            MachineEvent.STOP, f"nobody tells that the service lives: {error_text(error)}"
        )
        self._ending.set()

    def _watchdog_loop(self) -> None:
        """Send signs of life to systemd, and end a pause when the service is to end."""
        while not self._over.wait(_POLL_S):
            paused = self._cell.machine.state in _UNHURRIED
            self._watchdog.notify(paused=paused)
            if self._ending.is_set() and paused:
                self._cell.command(MachineEvent.STOP, "the service ends")


@dataclass(frozen=True)
class EarlierCycles:
    """Summary of the cycles in a folder of records.

    cycle  the highest number among them; 0 = there are none
    open   folders of those that a person has to look at, the newest last
    fault  of the newest of these
    """

    cycle: int = 0
    open: tuple[Path, ...] = ()
    fault: FaultNotice | None = None


def earlier_cycles(runs: Path) -> EarlierCycles:
    """Find the highest cycle number and the open cycles in a folder of records.

    One is open if it was never concluded, or failed, and nobody has acknowledged that: whenever it
    was, since a clock may have been set back and a folder may come from elsewhere.
    """
    folders = [f for f in runs.iterdir() if cycle_of(f) is not None] if runs.is_dir() else []
    open_cycles = []
    for folder in folders:
        state = _state(folder)
        if (fault := _open_fault(folder, state)) is not None:
            open_cycles.append((started_of(folder, state), folder.name, fault))
    open_cycles.sort(key=lambda each: each[:2])
    return EarlierCycles(
        max((cycle_of(f) or 0 for f in folders), default=0),
        tuple(runs / name for _, name, _ in open_cycles),
        _newest_naming_others([fault for *_, fault in open_cycles]),
    )


def _state(folder: Path) -> Mapping[str, Any]:
    """State of a cycle; empty = there is none, or it cannot be read."""
    try:
        return read_state(folder) or {}
    except InputError:
        return {}


def _open_fault(folder: Path, state: Mapping[str, Any]) -> FaultNotice | None:
    """The unacknowledged fault of a cycle; None = it has none."""
    ended = state.get("outcome")
    if "acknowledged" in state:
        return None
    if state.get("closed") is True and ended in set(Outcome) - {Outcome.FAILED}:
        return None
    number, step = cycle_of(folder) or 0, str(state.get("step") or "")
    try:
        record = read_record(folder)
    except InputError:
        return _unfinished(folder, number, step, readable=not (folder / "state.json").exists())
    if not record.closed or record.result is None:
        return _unfinished(folder, number, step)
    fault = record.result.fault
    if record.result.outcome is not Outcome.FAILED or fault is None:
        return None
    return FaultNotice(number, time_s=time.time(), **vars(fault))


def _unfinished(folder: Path, number: int, step: str, *, readable: bool = True) -> FaultNotice:
    if readable:
        cause = f"cycle {number} was not finished: the program or the computer ended within it"
    else:
        cause = f"the files of cycle {number} cannot be read: nobody knows how it ended"
    return FaultNotice(
        number,
        step,
        cause,
        time.time(),
        remedy="look where the gripper and the cable are, then reset",
        cable=f"not known; see {folder}",
        code="unfinished",
    )


def _newest_naming_others(faults: list[FaultNotice]) -> FaultNotice | None:
    """The newest fault, which names the others; None = there are none."""
    if len(faults) < 2:
        return faults[0] if faults else None
    *others, newest = faults
    named = ", ".join(str(fault.cycle) for fault in others[: -_NAMED - 1 : -1])
    more = len(others) - _NAMED
    cycles = named if more <= 0 else f"{named}, … ({len(others)})"
    cause = f"{newest.cause}; not acknowledged either: cycles {cycles}"
    return FaultNotice(cause=cause, **{k: v for k, v in vars(newest).items() if k != "cause"})


class AcknowledgementFlag:
    """File that makes the next service wait for a person, where no record does.

    It is there while the gripper may be moving outside a cycle, and after a stop in Idle.
    """

    def __init__(self, runs: Path) -> None:
        self.file = runs.with_name(f"{runs.name}.unsettled")

    def write(self, cause: str) -> None:
        """Write it; a full disk is reported when the next record begins."""
        with suppress(OSError):
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self.file.write_text(cause, encoding="utf-8")

    def remove(self) -> None:
        """Remove it: nothing needs a person any more."""
        with suppress(OSError):
            self.file.unlink(missing_ok=True)

    def fault(self, number: int) -> FaultNotice | None:
        """Its cause as a fault of cycle `number`; None = there is no file."""
        if not self.file.exists():
            return None
        try:
            cause = self.file.read_text(encoding="utf-8")
        except OSError:
            cause = ""
        return FaultNotice(
            number,
            "reset",
            cause or "the service before has ended",
            time.time(),
            remedy="look where the gripper is and what the jaws hold, then reset",
            code="unfinished",
        )
