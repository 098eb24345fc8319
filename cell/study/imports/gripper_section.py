"""The mapping's section of the gripper: alternative ways to give its position and angle."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal, get_args

from pydantic import Field

from cell.files.yaml_document import Key
from cell.study.entries import Finite, NotNegative, Positive, SectionPart
from cell.study.imports.capture import TextForm

BodyAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
#: Of angles about x, y and z: a rotation vector, or the order of turns about a body's own axes.
RotationOrder = Literal["vector", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]
ORDERS: tuple[RotationOrder, ...] = get_args(RotationOrder)
BODY_AXES: tuple[BodyAxis, ...] = ("+x", "-x", "+y", "-y", "+z", "-z")

Name = Annotated[str, Field(min_length=1)]
Vector = Annotated[list[Finite], Field(min_length=2, max_length=3)]
Columns = Annotated[list[Name | None], Field(min_length=2, max_length=3)]

#: Alternative entries of the gripper's position; those of `angle` are separate.
WAYS = ("columns", "fixed_m", "turns", "acceleration")


class TimeSection(SectionPart):
    """Times of rows; `starts_at_zero`: the first row of a trial is its origin."""

    column: Name
    seconds_per_unit: Positive | None
    starts_at_zero: bool = False


class AxesSection(SectionPart):
    """Directions of the study's x (right) and y (up), along the columns of a point."""

    right: Vector
    up: Vector


class TurnsSection(SectionPart):
    """A gripper on an arm that turns about an axle, by its encoder.

    At turn 0 the arm points from the axle to the left, as a cable does at clamp angle 0; positive
    turns it downwards.

    column            of the encoder, with `radians_per_unit` (negative: positive means up)
    axle_m            of the axle in the study's frame
    radius_m          from the axle to the gripping point; 0 = the clamp is on the axle
    offset_rad        added to the turn
    """

    column: Name
    radians_per_unit: Finite | None
    axle_m: tuple[Finite, Finite] | None
    radius_m: NotNegative | None
    offset_rad: Finite = 0.0


class AccelerationSection(SectionPart):
    """A gripper whose place is integrated twice from an accelerometer's specific force (a − g).

    columns            along `axes` of the gripper at clamp angle 0; null = it does not move so
    m_per_s2_per_unit  9.81 for g; negative where the sensor shows g − a
    along              `clamp`: the sensor turns with the clamp; `study`: it does not
    starts_at_m        gripping point before the motion, in the study's frame, if a trial does not
                       state its own
    gain_std           standard deviation of the sensor's sensitivity, as a share of it
    """

    columns: Columns
    m_per_s2_per_unit: Finite | None
    along: Literal["clamp", "study"]
    starts_at_m: tuple[Finite, Finite] | None
    gain_std: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0


class AngleSection(SectionPart):
    """The clamp angle: a constant, a column, a direction of a body, or a line between two points.

    constant_rad      it never turns
    column            of the angle, with `radians_per_unit` (negative: positive means up)
    quaternion        columns x, y, z, w; `body_axis`: along it the cable leaves the clamp
    rotation          three angles x, y, z of a body, with `order` and `radians_per_unit`, instead
    towards           columns of a second point of the gripper; the cable leaves in its direction
    follows           true: the clamp turns with the arm of `turns`; then the cable leaves along it
    offset_rad        added
    """

    constant_rad: Finite | None = None
    column: Name | None = None
    radians_per_unit: Finite | None = None
    quaternion: Annotated[list[Name], Field(min_length=4, max_length=4)] | None = None
    rotation: Annotated[list[Name], Field(min_length=3, max_length=3)] | None = None
    order: RotationOrder | None = None
    body_axis: BodyAxis | None = None
    towards: Annotated[list[Name], Field(min_length=2, max_length=3)] | None = None
    follows: Literal[True] | None = None
    offset_rad: Finite = 0.0


class GripperSection(SectionPart):
    """The gripping point.  Missing entries are as for the markers.

    columns    of the gripping point, null = it stays at its origin along this one; or
    fixed_m    it never moves, in the study's frame; or
    turns      it is on an arm that turns about an axle; or
    acceleration  its place is integrated
    origin_m   the gripper's origin in the study's frame, where its file has another one; null = so
               that the curve through the markers at rest begins at the gripper
    """

    columns: Columns | None = None
    fixed_m: tuple[Finite, Finite] | None = None
    turns: TurnsSection | None = None
    acceleration: AccelerationSection | None = None
    angle: AngleSection
    text: TextForm | None = None
    time: TimeSection | None = None
    metres_per_unit: Positive | None = None
    axes: AxesSection | None = None
    origin_m: tuple[Finite, Finite] | None = (0.0, 0.0)

    @property
    def along_columns(self) -> list[str | None] | None:
        """Columns that the gripper's axes are along; None = there are none."""
        return self.acceleration.columns if self.acceleration is not None else self.columns

    @property
    def unfinished(self) -> bool:
        """Whether entries must be filled in."""
        known = any(getattr(self, way) is not None for way in WAYS)
        return not known or self.angle == AngleSection() or bool(entries_to_fill_in(self))

    def standing_still(self) -> GripperSection:
        """The section with a fixed gripper, to show trials without its path."""
        still = {"fixed_m": (0.0, 0.0), "angle": AngleSection(constant_rad=0.0)}
        return self.model_copy(update={**dict.fromkeys(WAYS), **still})


#: Entries of sections that no file tells, and how to determine them.
_TO_FILL_IN = {
    ("turns", "radians_per_unit"):
        "give 2π / counts of a turn, 0.0174533 for degrees; negative if up is positive",
    ("turns", "axle_m"): "measure where the axle is, as [x, y]",
    ("turns", "radius_m"):
        "measure from the axle to the gripping point; 0 if the clamp is on the axle",
    ("acceleration", "m_per_s2_per_unit"):
        "give 9.81 for g, 1 for m/s², negative where the sensor shows g − a",
    ("acceleration", "starts_at_m"):
        "measure where the gripping point is before it moves, as [x, y]",
}  # fmt: skip


def entries_to_fill_in(hand: GripperSection) -> list[tuple[Key, str]]:
    """Entries that the user must fill in, and how to determine them."""
    return [
        (("hand", part, entry), remedy)
        for (part, entry), remedy in _TO_FILL_IN.items()
        if (section := getattr(hand, part)) is not None and getattr(section, entry) is None
    ]


def gripper_complaints(hand: GripperSection) -> Iterator[tuple[Key, str]]:
    """Problems of alternatives of which not exactly one is given."""
    angle = hand.angle
    named = [name for name in WAYS if getattr(hand, name) is not None]
    if len(named) != 1:
        message = f"{' and '.join(named) or 'nothing'} given; give one of: columns of the gripping "
        message += "point, fixed_m if it never moves, turns by an encoder of its axle, "
        yield ("hand",), f"{message}acceleration by a sensor on it"
    elif (columns := hand.along_columns) is not None and not any(columns):
        key: Key = ("hand", *(["acceleration"] if hand.acceleration else []), "columns")
        yield key, "are all null; name one, or give fixed_m instead"
    ways = ("constant_rad", "column", "quaternion", "rotation", "towards", "follows")
    angle_ways = [name for name in ways if getattr(angle, name) is not None]
    if len(angle_ways) != 1:
        message = f"{' and '.join(angle_ways) or 'nothing'} given; give one of {', '.join(ways)}"
        yield ("hand", "angle"), message
    elif (angle.column or angle.rotation) and angle.radians_per_unit is None:
        message = "is missing; give 0.0174533 for degrees, 1 for radians, "
        yield ("hand", "angle", "radians_per_unit"), f"{message}negative if up is positive"
    elif angle.rotation and angle.order is None:
        message = f"is missing; give one of {', '.join(ORDERS)}"
        yield ("hand", "angle", "order"), message
    elif (angle.quaternion or angle.rotation) and angle.body_axis is None:
        message = (
            "is missing; give the axis of the gripper along which the cable leaves it, such as +x"
        )
        yield ("hand", "angle", "body_axis"), message
    elif angle.follows and hand.turns is None:
        message = "is only for a gripper that `turns`; give constant_rad or column"
        yield ("hand", "angle", "follows"), message
    elif angle.towards and hand.columns is None and hand.fixed_m is None:
        message = "is only for a gripper with columns or fixed_m; give constant_rad or column"
        yield ("hand", "angle", "towards"), message
