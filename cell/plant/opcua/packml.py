"""Tables of OPC 30050, PackML 1.01: names, numbers and numeric ids of its types; state machines.

Ids count in the namespace `URI`; those of Annex B.  Only what the types declare themselves is
listed, not the copies of it in instance declarations further down.
"""

from __future__ import annotations

from dataclasses import dataclass

from cell.plant.messages import Mode
from cell.run.machine import CellState

URI = "http://opcfoundation.org/UA/PackML/"
VERSION, PUBLISHED = "1.01", "2020-10-08"

#: Data type of the unit's modes, and its values.
MODE_ENUM = 11
MODE_NAMES = ("Invalid", "Produce", "Maintenance", "Manual")
MODE_NUMBERS = {Mode.PRODUCTION: 1, Mode.MAINTENANCE: 2, Mode.MANUAL: 3}


@dataclass(frozen=True)
class Structure:
    """A structured data type: its id, that of its binary encoding, and (field, type), … in order.

    A type that ends in `[]` is an array.
    """

    name: str
    id: int
    encoding: int
    fields: tuple[tuple[str, str], ...]


STRUCTURES = (
    Structure(
        "PackMLAlarmDataType",
        15,
        74,
        (
            ("ID", "Int32"),
            ("Value", "Int32"),
            ("Message", "String"),
            ("Category", "Int32"),
            ("DateTime", "UtcTime"),
            ("AckDateTime", "UtcTime"),
            ("Trigger", "Boolean"),
        ),
    ),
    Structure(
        "PackMLCountDataType",
        14,
        69,
        (
            ("ID", "Int32"),
            ("Name", "String"),
            ("Unit", "EUInformation"),
            ("Count", "Int32"),
            ("AccCount", "Int32"),
        ),
    ),
    Structure(
        "PackMLDescriptorDataType",
        16,
        77,
        (("ID", "Int32"), ("Name", "String"), ("Unit", "EUInformation"), ("Value", "Float")),
    ),
    Structure(
        "PackMLIngredientsDataType",
        17,
        79,
        (("IngredientID", "Int32"), ("Parameter", "PackMLDescriptorDataType[]")),
    ),
    Structure(
        "PackMLProductDataType",
        18,
        81,
        (
            ("ProductID", "Int32"),
            ("ProcessVariables", "PackMLDescriptorDataType[]"),
            ("Ingredients", "PackMLIngredientsDataType[]"),
        ),
    ),
    Structure(
        "PackMLRemoteInterfaceDataType",
        19,
        83,
        (
            ("Number", "Int32"),
            ("ControlCmdNumber", "Int32"),
            ("CmdValue", "Int32"),
            ("Parameter", "PackMLDescriptorDataType[]"),
        ),
    ),
)

#: Subtypes of HasComponent.
REFERENCES = {
    "HasInterlock": 21,
    "HasAlarm": 22,
    "HasAlarmHistory": 23,
    "HasWarning": 24,
    "HasStopReason": 25,
}


@dataclass(frozen=True)
class Declared:
    """A variable that a type declares.

    type       of the data; `[]` after it = an array, `[][]` = of two dimensions
    reference  by which the type has it
    range_id   id of the range of an analog item; None = not analog
    """

    name: str
    id: int
    type: str
    mandatory: bool = False
    reference: str = "HasComponent"
    range_id: int | None = None


STATUS_TYPE, ADMIN_TYPE, BASE_TYPE, OBJECTS_FOLDER = 4, 5, 6, 72

STATUS = (
    Declared("UnitModeRequested", 192, "Boolean"),
    Declared("UnitSupportedModes", 193, "NodeId", mandatory=True, reference="HasProperty"),
    Declared("UnitModeCurrent", 200, "Mode", mandatory=True),
    Declared("UnitModeChangeInProcess", 201, "Boolean"),
    Declared("StateRequested", 209, "Int32"),
    Declared("StateChangeInProcess", 210, "Boolean"),
    Declared("MachSpeed", 219, "Float", mandatory=True, range_id=220),
    Declared("CurMachSpeed", 232, "Float", mandatory=True, range_id=233),
    Declared("EquipmentBlocked", 211, "Boolean", mandatory=True),
    Declared("EquipmentStarved", 224, "Boolean", mandatory=True),
    Declared("MaterialInterlocked", 236, "Boolean"),
    Declared("MaterialInterlock", 237, "Boolean[]", reference="HasInterlock"),
    Declared("Parameter", 121, "PackMLDescriptorDataType[]"),
    Declared("RemoteParameter", 123, "PackMLRemoteInterfaceDataType[]"),
    Declared("Product", 122, "PackMLProductDataType[]"),
)

ADMIN = (
    Declared("Parameter", 276, "PackMLDescriptorDataType[]"),
    Declared("Alarm", 238, "PackMLAlarmDataType[]", reference="HasAlarm"),
    Declared("AlarmExtent", 239, "Int32"),
    Declared("AlarmHistory", 240, "PackMLAlarmDataType[]", reference="HasAlarmHistory"),
    Declared("AlarmHistoryExtent", 241, "Int32"),
    Declared("StopReason", 244, "PackMLAlarmDataType", reference="HasStopReason"),
    Declared("StopReasonExtent", 245, "Int32"),
    Declared("Warning", 242, "PackMLAlarmDataType[]", reference="HasWarning"),
    Declared("WarningExtent", 243, "Int32"),
    Declared("ModeCurrentTime", 246, "Int32[]"),
    Declared("ModeCumulativeTime", 247, "Int32[]"),
    Declared("StateCurrentTime", 248, "Int32[][]"),
    Declared("StateCumulativeTime", 249, "Int32[][]"),
    Declared("ProdConsumedCount", 124, "PackMLCountDataType[]"),
    Declared("ProdProcessedCount", 120, "PackMLCountDataType[]"),
    Declared("ProdDefectiveCount", 119, "PackMLCountDataType[]"),
    Declared("AccTimeSinceReset", 252, "Int32"),
    Declared("MachDesignSpeed", 253, "Float"),
)

#: Properties of a unit.
UNIT = (
    Declared("TagID", 218, "String", reference="HasProperty"),
    Declared("PackMLVersion", 221, "String", reference="HasProperty"),
)
#: Objects that a unit has, with id and type.
UNIT_PARTS = (("Admin", 73, 5), ("Status", 87, 4), ("BaseStateMachine", 88, 3))


@dataclass(frozen=True)
class Method:
    """A method that a type declares.

    arguments     (name, data type), …
    arguments_id  id of the property that lists them
    """

    name: str
    id: int
    mandatory: bool = False
    arguments: tuple[tuple[str, str], ...] = ()
    arguments_id: int | None = None


UNIT_METHODS = (
    Method("SetUnitMode", 362, True, (("RequestedMode", "Int32"),), 118),
    Method("SetMachSpeed", 400, True, (("RequestedMachineSpeed", "Float"),), 348),
    Method("SetProduct", 401, True, (("Product", "PackMLProductDataType[]"),), 349),
    Method("SetParameter", 402, True, (("Parameter", "PackMLDescriptorDataType[]"),), 352),
)


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
