"""Rules of the handshake: pure functions from inputs and status to requests and outputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from cell.plant.handshake.carrier import Inputs, Outputs
from cell.plant.messages import Status
from cell.records.result import Outcome
from cell.run.machine import CellState, MachineEvent

#: States of a cycle, or of its end.
_BUSY = frozenset(
    {
        CellState.STARTING,
        CellState.EXECUTE,
        CellState.COMPLETING,
        CellState.COMPLETE,
        CellState.HOLDING,
        CellState.HELD,
        CellState.UNHOLDING,
        CellState.SUSPENDING,
        CellState.SUSPENDED,
        CellState.UNSUSPENDING,
        CellState.STOPPING,
        CellState.ABORTING,
    }
)
#: A person has to look before the cell works again.
_FAULTED = frozenset(
    {
        CellState.STOPPING,
        CellState.STOPPED,
        CellState.ABORTING,
        CellState.ABORTED,
        CellState.CLEARING,
    }
)
#: Where Aborted leads when it is cleared.
_CLEARED = frozenset({CellState.CLEARING, CellState.STOPPED})
_SUSPENDING = frozenset({CellState.SUSPENDING, CellState.SUSPENDED})
_DONE = frozenset({Outcome.INSERTED, Outcome.MEASURED, Outcome.REHEARSED})
_REJECTED = frozenset({Outcome.MISSED, Outcome.REJECTED, Outcome.UNFIT})


@dataclass(frozen=True)
class Memory:
    """State of the rules between two evaluations.

    By the initial values a start or acknowledgement that is on already has no effect until it
    falls; a stop that is on already stops.

    before   inputs of the last look
    ready    output of the last look
    run      process of the cell; None = never reached
    results  results of this run that are known
    outcome  of the last cycle, as long as done or rejected show it
    start    level of start in the newest inputs: done and rejected hold until it changes
    pause    suspend or unsuspend, whichever was requested last in this Execute
    cleared  an acknowledgement has cleared Aborted, and resets as soon as the cell is Stopped
    """

    before: Inputs = field(default_factory=lambda: Inputs(start=True, acknowledge=True))
    ready: bool = False
    run: str | None = None
    results: int = 0
    outcome: Outcome | None = None
    start: bool = True
    pause: MachineEvent | None = None
    cleared: bool = False


@dataclass(frozen=True)
class Ask:
    """A request to the cell: command, note, and the product of a start."""

    command: MachineEvent
    note: str = ""
    product: str | None = None


@dataclass(frozen=True)
class PlcInputs:
    """Inputs of a rule at one moment."""

    inputs: Inputs
    status: Status
    memory: Memory

    def rose(self, name: str) -> bool:
        """Whether an input has come on since the last look."""
        return getattr(self.inputs, name) and not getattr(self.memory.before, name)

    def is_in(self, state: CellState) -> bool:
        """Whether the cell is in a state."""
        return self.status.state is state

    @property
    def obstacle(self) -> str:
        """The machine that does not allow the cell to work; empty = none."""
        if not self.inputs.upstream_ready:
            return "upstream"
        return "" if self.inputs.downstream_ready else "downstream"

    @property
    def suspended_by_plc(self) -> bool:
        """Whether the cell is suspended, or is to be, because of a neighbouring machine."""
        if self.memory.pause is MachineEvent.SUSPEND:
            return self.is_in(CellState.EXECUTE) or self.status.state in _SUSPENDING
        reported = {"upstream", "downstream"} & set(self.status.waiting_for)
        return self.is_in(CellState.SUSPENDED) and bool(reported) and self.memory.pause is None

    @property
    def is_acknowledged(self) -> bool:
        """Whether Stopped is acknowledged: now, or by the edge that has just cleared Aborted.

        A stop that is on takes precedence, because the gripper would go home.
        """
        pressed = self.rose("acknowledge") and not self.inputs.stop
        return pressed or (self.memory.cleared and self.goes_on_clearing)

    @property
    def goes_on_clearing(self) -> bool:
        """Whether nothing but the clearing has happened since Aborted was cleared."""
        return self.status.state in _CLEARED and not self.inputs.stop

    @property
    def is_faulted(self) -> bool:
        """Whether a person has to acknowledge first."""
        return self.status.fault is not None or self.status.state in _FAULTED

    @property
    def product(self) -> str | None:
        """The product that the PLC names; None = it names none."""
        number = self.inputs.product
        return self.status.products[number - 1] if number else None

    @property
    def start_allowed(self) -> bool:
        """Whether a start would be obeyed."""
        return (
            self.is_in(CellState.IDLE)
            and MachineEvent.START in self.status.possible
            and not self.is_faulted
            and self.inputs.product <= len(self.status.products)
            and self.inputs.part_present
            and not self.obstacle
            and not self.inputs.stop
        )


@dataclass(frozen=True)
class Rule:
    """A command, and the condition under which it is requested."""

    command: MachineEvent
    applies: Callable[[PlcInputs], bool]


#: The first rule that applies is requested; the edges of the others are lost.
RULES = (
    Rule(
        MachineEvent.STOP, lambda now: now.rose("stop") and MachineEvent.STOP in now.status.possible
    ),
    Rule(MachineEvent.CLEAR, lambda now: now.rose("acknowledge") and now.is_in(CellState.ABORTED)),
    Rule(MachineEvent.RESET, lambda now: now.is_in(CellState.STOPPED) and now.is_acknowledged),
    Rule(
        MachineEvent.SUSPEND,
        lambda now: (
            bool(now.obstacle)
            and now.is_in(CellState.EXECUTE)
            and now.memory.pause is not MachineEvent.SUSPEND
        ),
    ),
    Rule(MachineEvent.UNSUSPEND, lambda now: not now.obstacle and now.suspended_by_plc),
    Rule(
        MachineEvent.START, lambda now: now.rose("start") and now.memory.ready and now.start_allowed
    ),
)


def evaluate(
    inputs: Inputs, status: Status | None, memory: Memory
) -> tuple[tuple[Ask, ...], Outputs, Memory]:
    """Requests to the cell, outputs to the PLC, and the memory for the next evaluation.

    status  of the cell; None = it is not reached: nothing is requested then, and a stop waits
            as long as it is on
    """
    if status is None:
        missed = replace(inputs, stop=inputs.stop and memory.before.stop)
        outcome = _held_outcome(inputs, memory)
        outputs = Outputs(fault=True, done=outcome in _DONE, rejected=outcome in _REJECTED)
        after = replace(memory, before=missed, ready=False, outcome=outcome, cleared=False)
        return (), outputs, replace(after, start=inputs.start)
    memory = _with_result(inputs, status, memory)
    now = PlcInputs(inputs, status, memory)
    ask = next((_ask(rule, now) for rule in RULES if rule.applies(now)), None)
    busy = status.state in _BUSY
    outputs = Outputs(
        ready=now.start_allowed and not inputs.start,
        busy=busy,
        done=memory.outcome in _DONE and not busy,  # the result comes while Complete
        rejected=memory.outcome in _REJECTED and not busy,
        fault=now.is_faulted,
    )
    pause = memory.pause if busy else None
    if ask is not None and ask.command in (MachineEvent.SUSPEND, MachineEvent.UNSUSPEND):
        pause = ask.command
    cleared = memory.cleared and now.goes_on_clearing
    if ask is not None:
        cleared = ask.command is MachineEvent.CLEAR
    memory = replace(memory, before=inputs, ready=outputs.ready, pause=pause, cleared=cleared)
    return () if ask is None else (ask,), outputs, memory


def inputs_lost(memory: Memory) -> Memory:
    """Memory after a loss of the inputs: without edges, with the results."""
    return replace(memory, before=Memory().before, ready=False, cleared=False)


def obeyed(ask: Ask, outputs: Outputs) -> Outputs:
    """Outputs right after an accepted request: each start raises `busy`, even for a short cycle."""
    return (
        replace(outputs, ready=False, busy=True) if ask.command is MachineEvent.START else outputs
    )


def not_obeyed(ask: Ask, before: Memory, after: Memory) -> Memory:
    """Memory after a request that did not reach the cell or was refused.

    A pause or a stop is requested again.  A start or an acknowledgement is not: its edge is over.

    before, after  memory before and after the evaluation that made the request
    """
    if ask.command is MachineEvent.STOP:
        return replace(after, before=replace(after.before, stop=False))
    if ask.command in (MachineEvent.SUSPEND, MachineEvent.UNSUSPEND):
        return replace(after, pause=before.pause)
    return replace(after, cleared=False)


def _ask(rule: Rule, now: PlcInputs) -> Ask:
    match rule.command:
        case MachineEvent.SUSPEND:
            return Ask(rule.command, now.obstacle)
        case MachineEvent.CLEAR | MachineEvent.RESET:
            return Ask(rule.command, "acknowledged by the digital input")
        case MachineEvent.STOP:
            return Ask(rule.command, "stopped by the digital input")
        case MachineEvent.START:
            return Ask(rule.command, product=now.product)
    return Ask(rule.command)


def _held_outcome(inputs: Inputs, memory: Memory) -> Outcome | None:
    """The outcome that the outputs still show: until start changes."""
    return memory.outcome if inputs.start == memory.start else None


def _with_result(inputs: Inputs, status: Status, memory: Memory) -> Memory:
    """Memory with the result of a cycle that has ended since the last look."""
    results, outcome = sum(status.counts.values()), _held_outcome(inputs, memory)
    same = status.run == memory.run
    if same and results > memory.results and status.last is not None:
        outcome = Outcome(status.last["outcome"])
    cleared = memory.cleared and same
    memory = replace(memory, outcome=outcome, start=inputs.start)
    return replace(memory, run=status.run, results=results, cleared=cleared)
