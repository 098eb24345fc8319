"""The mapping file, cable-import/1: which column is what, in which unit, along which axes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cell.cable.geometry import Start
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Document, Key, read_yaml, validate
from cell.study.imports.cells import Decimal

FORMAT: Final = "cable-import/1"
FILE = "import.yaml"

BodyAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
BODY_AXES: tuple[BodyAxis, ...] = ("+x", "-x", "+y", "-y", "+z", "-z")

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Name = Annotated[str, Field(min_length=1)]
_Vector = Annotated[list[_Finite], Field(min_length=2, max_length=3)]

#: By so much the two directions may miss length 1 and a right angle: numbers of three digits.
NOT_SQUARE = 2e-3


class Part(BaseModel):
    """A section of the file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ConnectorSection(Part):
    """A rigid body at the cable's end; without an inertia it is a rod's."""

    mass_kg: _Positive
    length_m: _Positive
    inertia_kg_m2: _Positive | None = None


class CableSection(Part):
    """The cable; null = to be filled in."""

    free_length_m: _Positive | None = None
    line_density_kg_per_m: _Positive | None = None
    width_m: _Positive | None = None
    thickness_m: _Positive | None = None
    diameter_m: _Positive | None = None
    connector: ConnectorSection | None = None


class TextSection(Part):
    """How tables are written as text."""

    separator: Annotated[str, Field(min_length=1, max_length=1)]
    decimal: Decimal


class TimeSection(Part):
    """Times of rows; `starts_at_zero`: the first row of a trial is its origin."""

    column: _Name
    seconds_per_unit: _Positive | None
    starts_at_zero: bool = False


class AxesSection(Part):
    """Directions of the study's x (right) and y (up), along the columns of a point."""

    right: _Vector
    up: _Vector


class MarkerEntry(Part):
    """A marker: its columns, two or three (null = not measured), and where on the cable it is.

    arc_length_std_m  standard deviation of its arc length; None = it is exact
    """

    name: _Name
    columns: Annotated[list[_Name | None], Field(min_length=2, max_length=3)]
    arc_length_m: _Finite | None
    arc_length_std_m: _Finite | None = None


class AngleSection(Part):
    """The clamp angle: a constant, a column, a direction of a body, or a line between two points.

    constant_rad      it never turns
    column            of the angle, with `radians_per_unit` (negative: positive means up)
    quaternion        columns x, y, z, w; `body_axis`: along it the cable leaves the clamp
    towards           columns of a second point of the hand; the cable leaves in its direction
    offset_rad        added
    """

    constant_rad: _Finite | None = None
    column: _Name | None = None
    radians_per_unit: _Finite | None = None
    quaternion: Annotated[list[_Name], Field(min_length=4, max_length=4)] | None = None
    body_axis: BodyAxis | None = None
    towards: Annotated[list[_Name], Field(min_length=2, max_length=3)] | None = None
    offset_rad: _Finite = 0.0


class HandSection(Part):
    """The gripping point.  What is not given here is as for the markers.

    columns    of the gripping point, or fixed_m: it never moves, in the study's frame
    origin_m   the hand's origin in the study's frame, where its file has another one
    """

    columns: Annotated[list[_Name], Field(min_length=2, max_length=3)] | None = None
    fixed_m: tuple[_Finite, _Finite] | None = None
    angle: AngleSection
    text: TextSection | None = None
    time: TimeSection | None = None
    metres_per_unit: _Positive | None = None
    axes: AxesSection | None = None
    origin_m: tuple[_Finite, _Finite] = (0.0, 0.0)


class TrialEntry(Part):
    """A trial; file names are relative to the mapping's folder.

    clock_offset_s  added to the times of the hand's file
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    file: _Name
    hand_file: _Name | None = None
    clock_offset_s: _Finite = 0.0
    role: Literal["fit", "validate"] = "fit"
    start: Start = "equilibrium"
    release_s: _Finite | None = None


class Mapping(Part):
    """All of the file."""

    format: Literal["cable-import/1"]
    name: _Name
    cable: CableSection
    gravity_m_per_s2: tuple[_Finite, _Finite] = (0.0, -9.81)
    noise_std_m: _Positive | None = None
    text: TextSection | None = None
    time: TimeSection
    metres_per_unit: _Positive | None
    lost: list[_Finite] = []
    axes: AxesSection
    hand: HandSection
    markers: Annotated[list[MarkerEntry], Field(min_length=1)]
    trials: Annotated[list[TrialEntry], Field(min_length=1)]


@dataclass(frozen=True)
class ReadMapping:
    """A mapping, and its document, which knows where everything stands."""

    mapping: Mapping
    document: Document

    def error(self, key: Key, message: str) -> InputError:
        """A complaint about an entry, to be raised."""
        return InputError([self.document.problem(key, message)])

    def file(self, name: str) -> Path:
        """A file that the mapping names."""
        return Path(os.path.normpath(self.document.path.parent / name))


def read_mapping(path: Path) -> ReadMapping:
    """Read a mapping.  Raises InputError: it is none, lacks entries, or contradicts itself."""
    document = read_yaml(path)
    mapping = validate(document, Mapping)
    problems = [
        *_missing(document, mapping),
        *_axes(document, mapping),
        *_hand(document, mapping),
        *_twice(document, mapping),
    ]
    if problems:
        raise InputError(problems)
    return ReadMapping(mapping, document)


def _missing(document: Document, mapping: Mapping) -> list[Problem]:
    """Entries that the file leaves to be filled in."""
    cable = mapping.cable
    wanted: list[tuple[Key, Any, str]] = [
        (("cable", "free_length_m"), cable.free_length_m,
         "measure the cable from the gripping point to its tip"),
        (("cable", "line_density_kg_per_m"), cable.line_density_kg_per_m,
         "weigh a piece and divide its mass by its length"),
        (("time", "seconds_per_unit"), mapping.time.seconds_per_unit,
         "give 1 / frames a second, such as 0.01 for 100"),
        (("metres_per_unit",), mapping.metres_per_unit,
         "give 0.001 for millimetres; for pixels, the length of one in metres"),
    ]  # fmt: skip
    if mapping.hand.time is not None:
        key = ("hand", "time", "seconds_per_unit")
        wanted.append((key, mapping.hand.time.seconds_per_unit, wanted[2][2]))
    for i, marker in enumerate(mapping.markers):
        where: Key = ("markers", i, "arc_length_m")
        wanted.append((where, marker.arc_length_m, "measure it along the cable from the clamp"))
    problems = [
        document.problem(key, f"is not known from the file: {remedy}")
        for key, value, remedy in wanted
        if value is None
    ]
    if cable.diameter_m is None and (cable.width_m is None or cable.thickness_m is None):
        message = "its section is not known from the file: give width_m and thickness_m of a flat "
        problems.append(document.problem(("cable",), f"{message}cable, diameter_m of a round one"))
    return problems


def _axes(document: Document, mapping: Mapping) -> list[Problem]:
    """Directions that are no right-angled pair along the columns of the points."""
    problems = []
    sections: list[tuple[Key, AxesSection, list[Any]]] = [
        (
            ("axes",),
            mapping.axes,
            [(("markers", i), m.columns) for i, m in enumerate(mapping.markers)],
        )
    ]
    if mapping.hand.columns is not None:
        axes = mapping.hand.axes or mapping.axes
        key: Key = ("axes",) if mapping.hand.axes is None else ("hand", "axes")
        sections.append((key, axes, [(("hand",), mapping.hand.columns)]))
    for key, axes, points in sections:
        right, up = np.array(axes.right), np.array(axes.up)
        if len(right) != len(up):
            message = f"has {len(right)} numbers, up {len(up)}; give one for each column of a point"
            problems.append(document.problem((*key, "right"), message))
            continue
        for point, columns in points:
            if len(columns) != len(right):
                message = f"names {len(columns)} columns, the axes {len(right)}; give as many"
                problems.append(document.problem((*point, "columns"), message))
        for name, vector in (("right", right), ("up", up)):
            if abs(np.linalg.norm(vector) - 1.0) > NOT_SQUARE:
                message = f"has length {np.linalg.norm(vector):.4g}, limit 1 ± {NOT_SQUARE}; "
                problems.append(
                    document.problem(
                        (*key, name), f"{message}give a direction such as {_unit(vector)}"
                    )
                )
        if not problems and abs(right @ up) > NOT_SQUARE:
            angle = np.degrees(np.arccos(np.clip(right @ up, -1.0, 1.0)))
            message = f"is {angle:.3g}° from right; give directions at a right angle"
            problems.append(document.problem((*key, "up"), message))
    return problems


def _unit(vector: np.ndarray) -> list[float]:
    """The axis that a vector is nearest to."""
    nearest = np.zeros(len(vector))
    largest = int(np.argmax(np.abs(vector)))
    nearest[largest] = np.sign(vector[largest]) or 1.0
    return [float(v) for v in nearest]


def _hand(document: Document, mapping: Mapping) -> list[Problem]:
    """Ways to say one thing, of which exactly one must be given."""
    hand, angle, problems = mapping.hand, mapping.hand.angle, []
    if (hand.columns is None) == (hand.fixed_m is None):
        message = "give columns of the gripping point, or fixed_m if it never moves; one of them"
        problems.append(document.problem(("hand",), message))
    ways = {"constant_rad": angle.constant_rad, "column": angle.column,
            "quaternion": angle.quaternion, "towards": angle.towards}  # fmt: skip
    given = [name for name, value in ways.items() if value is not None]
    if len(given) != 1:
        message = f"{' and '.join(given) or 'nothing'} given; give one of {', '.join(ways)}"
        problems.append(document.problem(("hand", "angle"), message))
    elif angle.column is not None and angle.radians_per_unit is None:
        message = (
            "is missing; give 0.0174533 for degrees, 1 for radians, negative if up is positive"
        )
        problems.append(document.problem(("hand", "angle", "radians_per_unit"), message))
    elif angle.quaternion is not None and angle.body_axis is None:
        message = (
            "is missing; give the axis of the hand along which the cable leaves it, such as +x"
        )
        problems.append(document.problem(("hand", "angle", "body_axis"), message))
    return problems


def _twice(document: Document, mapping: Mapping) -> list[Problem]:
    """Names and columns that are given to two markers or trials."""
    problems = []
    for what, names in (
        ("markers", [m.name for m in mapping.markers]),
        ("trials", [t.name for t in mapping.trials]),
    ):
        for i, name in enumerate(names):
            if name in names[:i]:
                message = f"{name!r} is given twice, first as entry {names.index(name) + 1}; rename"
                problems.append(document.problem((what, i, "name"), f"{message} one"))
    seen: dict[str, int] = {}
    for i, marker in enumerate(mapping.markers):
        for column in marker.columns:
            if column is not None and seen.setdefault(column, i) != i:
                first = mapping.markers[seen[column]].name
                message = f"{column!r} is also of marker {first!r}; give each its own columns"
                problems.append(document.problem(("markers", i, "columns"), message))
    return problems
