"""Sequences of commands and faults, at any moment of the service, against the table of PackML.

The thread of the service stands still at every change of state, at every step, at every result, and
before and after whatever it does under its lock.  There commands come, so that they also fall
between two sections that hold the lock.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from cell.plant.messages import COMMANDS, MessageKind, Request, possible_in
from cell.plant.reporter import Reporter
from cell.plant.service import Service
from cell.records.result import Outcome
from cell.run.cycle import Cell
from cell.run.findings import Findings
from cell.run.machine import TRANSITIONS, CellState, MachineEvent, target_of
from cell.run.plans import Plan, Step
from cell.run.station import ProductTask, Station
from cell.settings import load_settings
from cell.wiring.build import cell_task
from drivers.interfaces import ArmMode, DeviceLostError
from drivers.sim.clock import SimClock

FAKE = Path(__file__).parents[3] / "config" / "fake.yaml"
#: More moments than there are until a service waits for a person, whatever it was given.
MANY = 200
#: So many moments without a change, and it waits.
STILL = 10
MOMENTS = (0, 1, 2, 3, 4, 5, 8, 13)
WAITING = {
    *(CellState.IDLE, CellState.STOPPED, CellState.ABORTED),
    *(CellState.HELD, CellState.SUSPENDED),
}
LEGAL = {(source, target) for source, _, target in TRANSITIONS}


class Lockstep:
    """Two threads of which one stands still: the service at its moments, or the test."""

    def __init__(self) -> None:
        self._go, self._there = threading.Semaphore(0), threading.Semaphore(0)
        self._stepped: threading.Thread | None = None
        self.over = False
        self.error: BaseException | None = None

    def begin(self, run: Callable[[], None]) -> None:
        def all_of_it() -> None:
            self._go.acquire()
            try:
                run()
            except BaseException as error:
                self.error = error
            self.over = True
            self._there.release()

        self._stepped = threading.Thread(target=all_of_it, daemon=True)
        self._stepped.start()

    @property
    def here(self) -> bool:
        """Whether this is the thread that is stepped."""
        return threading.current_thread() is self._stepped

    def moment(self) -> None:
        """Stand still until the next `advance`."""
        if self.here:
            self._there.release()
            self._go.acquire()

    def advance(self) -> None:
        """Let it go on to its next moment."""
        if not self.over:
            self._go.release()
            assert self._there.acquire(timeout=60.0), "it waits for something else"
        if self.error is not None:
            raise self.error


class Lock:
    """In place of a condition: nothing else runs anyway; moments are where it is free."""

    def __init__(self, lockstep: Lockstep, *, watched: bool) -> None:
        self._lockstep, self._watched, self.depth = lockstep, watched, 0

    def __enter__(self) -> None:
        if self._watched and self.depth == 0:
            self._lockstep.moment()
        self.depth += self._lockstep.here

    def __exit__(self, *_: object) -> None:
        self.depth -= self._lockstep.here
        if self._watched and self.depth == 0:
            self._lockstep.moment()

    def wait(self, seconds: float = 0.0) -> None:
        self._lockstep.moment()

    def notify_all(self) -> None:
        pass


@cache
def made() -> ProductTask:
    return ProductTask(None, cell_task(load_settings(FAKE)), {})


def inserted(station: Station, findings: Findings) -> Findings:
    return findings.__class__(**{**vars(findings), "outcome": Outcome.INSERTED})


def step(name: str) -> Step:
    return Step(name, lambda station, findings: findings, may_pause=True)


PLAN = Plan(
    Outcome.INSERTED,
    cast(Any, None),
    (step("reset"),),
    (step("start"),),
    (step("lower"), step("execute")),
    (Step("release", inserted, adds="outcome", may_pause=True),),
)


def cell_in(runs: Path, on_step: Callable[[int, str], None]) -> Cell:
    """A cell whose devices only stand still, on simulated time, which stands still, too."""
    arm = SimpleNamespace(
        name="arm",
        stop=lambda reason: None,
        state=lambda: SimpleNamespace(moving=False, mode=ArmMode.READY),
        lag_s=0.03,
    )
    camera = SimpleNamespace(name="camera", stop=lambda: None, check=lambda: None)
    gripper = SimpleNamespace(name="gripper", state=lambda: SimpleNamespace(holding=False))
    devices = SimpleNamespace(arm=arm, camera=camera, gripper=gripper, clock=SimClock())
    return Cell(cast(Any, devices), made(), runs, on_step)


class ServiceStates(RuleBasedStateMachine):
    """At most six commands or faults, each some moments after the one before."""

    def __init__(self) -> None:
        super().__init__()
        self._folder = tempfile.TemporaryDirectory()
        self._lockstep = lockstep = Lockstep()
        runs = Path(self._folder.name, "runs")
        self._cell = cell_in(runs, lambda number, name: lockstep.moment())
        self._service = Service(self._cell, Reporter(self._told), runs, plan=PLAN)
        self._lock = Lock(lockstep, watched=True)
        cast(Any, self._service)._changed = self._lock
        cast(Any, self._cell.commands)._changed = Lock(lockstep, watched=False)
        self._states = [self._cell.machine.state]
        self._reports = self._cell.machine.on_change
        self._cell.machine.on_change = self._changed_to
        self._asked: MachineEvent | None = None
        self._causes = 0  # given since a person's word, accepted or not
        self._due: set[CellState] = set()  # to be reached because of what was accepted
        lockstep.begin(lambda: self._service.run(lambda result: lockstep.moment()))

    def _told(self, kind: MessageKind, data: Mapping[str, Any]) -> None:
        if kind is MessageKind.FAULT:
            assert self._causes, f"nothing was given that explains {data}"
        if kind is MessageKind.ACKNOWLEDGED:
            self._causes = 0

    def _changed_to(self, state: CellState) -> None:
        before = self._states[-1]
        assert (before, state) in LEGAL, f"{before} → {state}"
        if (before, state) == (CellState.STOPPED, CellState.RESETTING):
            asked = self._asked is MachineEvent.RESET
            assert asked or len(self._states) == 1, "nobody has sent the gripper home"
        self._states.append(state)
        self._due -= {state}
        if state is CellState.ABORTED:
            self._due -= {CellState.STOPPED}
        assert self._reports is not None
        self._reports(state)
        if self._lock.depth == 0:
            self._lockstep.moment()

    @rule(number=st.integers(0, 3), after=st.sampled_from(MOMENTS))
    def possible(self, number: int, after: int) -> None:
        """One of the commands that the state knows."""
        self._advance(after)
        known = possible_in(self._cell.machine.state) or sorted(COMMANDS)
        self._give(known[number % len(known)])

    @rule(command=st.sampled_from(sorted(COMMANDS)), after=st.sampled_from(MOMENTS))
    def any(self, command: MachineEvent, after: int) -> None:
        self._advance(after)
        self._give(command)

    def _advance(self, moments: int) -> None:
        for _ in range(moments):
            self._lockstep.advance()

    def _settle(self) -> None:
        """Until the service waits for a person, or has ended."""
        changes, same = 0, 0
        for _ in range(MANY):
            self._lockstep.advance()
            same = same + 1 if changes == len(self._states) else 0
            changes = len(self._states)
            if self._lockstep.over or (self._states[-1] in WAITING and same > STILL):
                return

    def _give(self, command: MachineEvent) -> None:
        """A command is accepted if, and only if, the table knows it in this state."""
        cell, state = self._cell, self._cell.machine.state
        known = target_of(state, command) is not None or cell.commands.resumes(command)
        stopping = command in (MachineEvent.STOP, MachineEvent.ABORT)
        if command is MachineEvent.START and self._latched():
            known = False  # it would be stopped at once
        if stopping and known:
            self._causes += 1
        self._asked = command
        answer = self._service.answer(Request(command, "Ada"))
        self._asked = None
        assert answer.accepted is known, f"{command} in {state}: {answer}"
        if known and stopping:
            rests = CellState.ABORTED if command is MachineEvent.ABORT else CellState.STOPPED
            if cell.machine.state is not rests and not self._failed():
                self._due.add(rests)
        if known and command is MachineEvent.RESET and state is not CellState.COMPLETE:
            assert cell.machine.state is CellState.RESETTING
            assert len(self._states) <= 2 or not self._latched(), "it stops again at once"

    @rule(after=st.sampled_from(MOMENTS))
    def device_fails(self, after: int) -> None:
        """As its watch says, which only looks in a cycle and in Idle."""
        self._advance(after)
        if self._cell.machine.state in (CellState.IDLE, CellState.EXECUTE, CellState.HELD):
            self._causes += 1
            self._cell.commands.fail(DeviceLostError("arm", "is lost", "look"))

    def _failed(self) -> bool:
        """Whether a device has failed first, and the cell aborts because of that."""
        return cast(Any, self._cell.commands)._failure is not None

    def _latched(self) -> bool:
        try:
            self._cell.check()
        except Exception:
            return True
        return False

    def teardown(self) -> None:
        try:
            self._settle()
            state = self._cell.machine.state
            assert state in WAITING
            assert not self._due, f"accepted, but {state}: {self._states}"
            if state in (CellState.HELD, CellState.SUSPENDED):
                self._give(MachineEvent.STOP)
            self._service.end()
            self._settle()
            assert self._lockstep.over
        finally:
            self._folder.cleanup()


def test_commands_at_any_moment_do_what_the_table_says() -> None:
    effort = settings(max_examples=100, stateful_step_count=6, derandomize=True, database=None)
    run_state_machine_as_test(ServiceStates, settings=effort)
