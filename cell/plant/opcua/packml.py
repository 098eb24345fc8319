"""Tables of OPC 30050, PackML 1.01: names, numbers and numeric ids of its types.

Ids count in the namespace `URI`; those of Annex B.  Only what the types declare themselves is
listed, not the copies of it in instance declarations further down.
"""

from __future__ import annotations

from dataclasses import dataclass

from cell.plant.messages import Mode

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
