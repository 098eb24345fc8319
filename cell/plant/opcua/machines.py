"""Tables of OPC 30050, PackML 1.01: three nested state machines.

Ids count in the namespace of `packml`.
"""

from __future__ import annotations

from dataclasses import dataclass

from cell.plant.opcua.packml import Method
from cell.run.machine import CellState


@dataclass(frozen=True)
class MachineState:
    """A state: its id, its number after ISA-TR88.00.02, and the id of the property with that."""

    name: str
    id: int
    number: int
    number_id: int


@dataclass(frozen=True)
class Transition:
    """A transition between states of one machine; cause = the method that triggers it."""

    source: str
    target: str
    id: int
    number_id: int
    cause: str | None = None

    @property
    def name(self) -> str:
        """Its browse name."""
        return f"{self.source}To{self.target}"


@dataclass(frozen=True)
class StateMachine:
    """A type of a state machine.

    type_id     of the type
    states_id, transitions_id   of AvailableStates and AvailableTransitions
    part        the machine within it: name and id; None = none
    parent      state that `part` is within: it is active in no other
    """

    name: str
    type_id: int
    states_id: int
    transitions_id: int
    states: tuple[MachineState, ...]
    transitions: tuple[Transition, ...]
    methods: tuple[Method, ...]
    part: tuple[str, int] | None = None
    parent: str | None = None


BASE = StateMachine(
    "PackMLBaseStateMachineType",
    3,
    167,
    158,
    (
        MachineState("Aborting", 61, 8, 168),
        MachineState("Aborted", 62, 9, 169),
        MachineState("Cleared", 71, 19, 178),
    ),
    (
        Transition("Aborted", "Cleared", 65, 174, "Clear"),
        Transition("Aborting", "Aborted", 66, 175),
        Transition("Cleared", "Aborting", 67, 176, "Abort"),
    ),
    (Method("Abort", 364), Method("Clear", 363)),
    part=("MachineState", 64),
    parent="Cleared",
)

MACHINE = StateMachine(
    "PackMLMachineStateMachineType",
    2,
    153,
    154,
    (
        MachineState("Stopped", 53, 2, 155),
        MachineState("Stopping", 54, 7, 156),
        MachineState("Clearing", 55, 1, 157),
        MachineState("Running", 75, 18, 171),
    ),
    (
        Transition("Stopping", "Stopped", 57, 163),
        Transition("Clearing", "Stopped", 58, 164),
        Transition("Stopped", "Running", 59, 165, "Reset"),
        Transition("Running", "Stopping", 60, 166, "Stop"),
    ),
    (Method("Stop", 375), Method("Reset", 376)),
    part=("ExecuteState", 56),
    parent="Running",
)

EXECUTE = StateMachine(
    "PackMLExecuteStateMachineType",
    1,
    125,
    126,
    (
        MachineState("Resetting", 27, 15, 127),
        MachineState("Idle", 28, 4, 128),
        MachineState("Starting", 29, 3, 129),
        MachineState("Suspending", 30, 13, 130),
        MachineState("Suspended", 31, 5, 131),
        MachineState("Unsuspending", 32, 14, 132),
        MachineState("Holding", 33, 10, 133),
        MachineState("Held", 34, 11, 134),
        MachineState("Unholding", 35, 12, 135),
        MachineState("Execute", 36, 6, 136),
        MachineState("Completing", 37, 16, 137),
        MachineState("Complete", 38, 17, 138),
    ),
    (
        Transition("Resetting", "Idle", 39, 139),
        Transition("Idle", "Starting", 40, 140, "Start"),
        Transition("Starting", "Execute", 41, 141),
        Transition("Execute", "Suspending", 42, 142, "Suspend"),
        Transition("Suspending", "Suspended", 43, 143),
        Transition("Unsuspending", "Execute", 44, 144),
        Transition("Execute", "Holding", 45, 145, "Hold"),
        Transition("Holding", "Held", 46, 146),
        Transition("Held", "Unholding", 47, 147, "Unhold"),
        Transition("Unholding", "Execute", 48, 148),
        Transition("Execute", "Completing", 49, 149, "ToComplete"),
        Transition("Completing", "Complete", 50, 150),
        Transition("Complete", "Resetting", 51, 151, "Reset"),
        Transition("Suspended", "Unsuspending", 52, 152, "Unsuspend"),
        Transition("Starting", "Holding", 99, 179, "Hold"),
        Transition("Unsuspending", "Holding", 100, 208, "Hold"),
        Transition("Suspended", "Holding", 101, 215, "Hold"),
        Transition("Suspending", "Holding", 102, 216, "Hold"),
        Transition("Unholding", "Holding", 103, 217, "Hold"),
    ),
    (
        Method("Start", 369, False, (("Parameter", "PackMLDescriptorDataType[]"),), 342),
        Method("Hold", 366),
        Method("Unhold", 368),
        Method("Suspend", 367),
        Method("Unsuspend", 372),
        Method("Reset", 361),
        Method("ToComplete", 365),
    ),
)

#: From the outermost to the innermost.
MACHINES = (BASE, MACHINE, EXECUTE)
#: Their browse paths within a unit.
MACHINE_PATHS = (
    "BaseStateMachine",
    "BaseStateMachine.MachineState",
    "BaseStateMachine.MachineState.ExecuteState",
)


def number_of(state: CellState) -> int:
    """Number of a state after ISA-TR88.00.02."""
    return next(s.number for m in MACHINES for s in m.states if s.name == state.value.title())


def active_states(state: CellState) -> tuple[str, ...]:
    """Names of the states that are active in the machines, from the outermost inwards."""
    name = state.value.title()
    above: list[str] = []
    for machine in MACHINES:
        if any(s.name == name for s in machine.states):
            return (*above, name)
        above.append(machine.parent or "")
    raise ValueError(f"{name} is no state of PackML")


def transition_between(before: CellState, after: CellState) -> tuple[int, str, Transition | None]:
    """Machine (level) of a transition of the cell, its name, and its entry in the table.

    That is None where PackML has none of this name: the cell may also be stopped while it clears.
    """
    was, now = active_states(before), active_states(after)
    for level, (source, target) in enumerate(zip(was, now, strict=False)):
        if source != target:
            name = f"{source}To{target}"
            known = (t for t in MACHINES[level].transitions if t.name == name)
            return level, name, next(known, None)
    return len(was) - 1, f"{was[-1]}To{now[-1]}", None
