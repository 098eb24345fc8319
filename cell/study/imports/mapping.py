"""The mapping file, cable-import/1: meaning, unit and axis of every column."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Start
from cell.files.input_error import InputError
from cell.files.words import counted
from cell.files.yaml_document import Complaint, Document, Key, read_yaml, validate
from cell.study.data import Study, Wrench
from cell.study.entries import (
    CableSection,
    Finite,
    Positive,
    SectionPart,
    TrialName,
)
from cell.study.hand_drift import HandDrift, drift_complaint
from cell.study.imports.capture import Capture, TextForm
from cell.study.imports.gripper_section import (
    AxesSection,
    Columns,
    GripperSection,
    Name,
    TimeSection,
    entries_to_fill_in,
    gripper_complaints,
)
from cell.study.wrench import SensorEntry, sensor_entry


class WrenchSection(SensorEntry):
    """The sensor's entries of a study, and the columns of its values.

    columns  of force x, force y and moment; null = not measured
    newtons_per_unit, newton_metres_per_unit  negative: the sensor shows what acts on the gripper
    """

    columns: Annotated[list[Name | None], Field(min_length=3, max_length=3)]
    newtons_per_unit: Finite = 1.0
    newton_metres_per_unit: Finite = 1.0

    def wrench(self, capture: Capture, t_s: FloatArray) -> Wrench | None:
        """Wrench of a file; None = no values.  Raises InputError: there is no such column."""
        units = (self.newtons_per_unit, self.newtons_per_unit, self.newton_metres_per_unit)
        values = np.full((len(t_s), len(units)), np.nan)
        for axis, (name, unit) in enumerate(zip(self.columns, units, strict=True)):
            if name is not None:
                values[:, axis] = capture.column(name) * unit
        measured = np.isfinite(values).any(axis=1)
        return Wrench(t_s[measured], values[measured]) if measured.any() else None


def wrench_section(study: Study, names: Sequence[str]) -> WrenchSection | None:
    """The section of a study whose wrenches are in columns of these names; None = it has none."""
    wrenches = [t.wrench for t in study.trials if t.wrench is not None]
    if not wrenches:
        return None
    measured = np.any([np.isfinite(w.values).any(axis=0) for w in wrenches], axis=0)
    columns = [name if present else None for name, present in zip(names, measured, strict=True)]
    return WrenchSection(columns=columns, **sensor_entry(study.sensor))


FORMAT: Final = "cable-import/1"
FILE = "import.yaml"

#: Tolerance of unit length and of the right angle, for numbers with three digits.
NOT_SQUARE = 2e-3


class MarkerEntry(SectionPart):
    """A marker: its columns, two or three (null = not measured), and where on the cable it is.

    arc_length_std_m  standard deviation of its arc length; None = it is exact
    """

    name: Name
    columns: Columns
    arc_length_m: Finite | None
    arc_length_std_m: Finite | None = None


class TrialEntry(SectionPart):
    """A trial; file names are relative to the mapping's folder.

    joined_files    files with the same times, whose columns are joined to those of `file`
    only    column values that select its rows, where files hold several trials; empty = all rows
    clock_offset_s  added to the times of the gripper's file; None = estimate it
    hand_starts_at_m, hand_ends_at_m  gripping point before and after its motion, where an
                    accelerometer measures it: the integral's error at the end is corrected
    hand_drift      error of the gripper's place, as a study states it
    text, hand_text  format of its files; None = as `text` and `hand.text`
    seconds_per_unit, hand_seconds_per_unit  of its files' times, or None as for `text`
    """

    name: TrialName
    file: Name
    joined_files: tuple[Name, ...] = ()
    hand_file: Name | None = None
    text: TextForm | None = None
    hand_text: TextForm | None = None
    seconds_per_unit: Positive | None = None
    hand_seconds_per_unit: Positive | None = None
    only: dict[str, Finite | Name] = Field(default_factory=dict)
    clock_offset_s: Finite | None = 0.0
    hand_starts_at_m: tuple[Finite, Finite] | None = None
    hand_ends_at_m: tuple[Finite, Finite] | None = None
    hand_drift: HandDrift | None = None
    role: Literal["fit", "validate"] = "fit"
    start: Start = "equilibrium"
    release_s: Finite | None = None


class Mapping(SectionPart):
    """Contents of the mapping file.

    frames  column that is not 0 in the rows of frames; None = frames are rows that show a marker
    """

    format: Literal["cable-import/1"]
    name: Name
    cable: CableSection
    gravity_m_per_s2: tuple[Finite, Finite] = (0.0, -9.81)
    noise_std_m: Positive | None = None
    text: TextForm | None = None
    time: TimeSection
    frames: Name | None = None
    metres_per_unit: Positive | None
    lost: tuple[Finite, ...] = ()
    axes: AxesSection
    hand: GripperSection
    wrench: WrenchSection | None = None
    markers: Annotated[list[MarkerEntry], Field(min_length=1)]
    trials: Annotated[list[TrialEntry], Field(min_length=1)]

    @property
    def is_to_scale(self) -> bool:
        """Whether times, lengths and the gripper's path are known: else no trial shows oddities."""
        units = [s.seconds_per_unit for s in (self.time, self.hand.time) if s is not None]
        return None not in (*units, self.metres_per_unit) and not self.hand.unfinished

    def of_trial(self, trial: TrialEntry) -> Mapping:
        """The mapping for one trial, with the entries that it overrides."""
        time = _with_time_unit(self.time, trial.seconds_per_unit)
        hand_time = self.hand.time
        if hand_time is not None or trial.hand_seconds_per_unit is not None:
            hand_time = _with_time_unit(hand_time or time, trial.hand_seconds_per_unit)
        hand_values = {"time": hand_time, "text": trial.hand_text or self.hand.text}
        hand = self.hand.model_copy(update=hand_values)
        values = {"time": time, "text": trial.text or self.text, "hand": hand}
        return self.model_copy(update=values)


def _with_time_unit(time: TimeSection, seconds_per_unit: float | None) -> TimeSection:
    if seconds_per_unit is None:
        return time
    return time.model_copy(update={"seconds_per_unit": seconds_per_unit})


@dataclass(frozen=True)
class ReadMapping:
    """A mapping with its document, which gives the line of every entry."""

    mapping: Mapping
    document: Document

    def error(self, key: Key, message: str) -> InputError:
        """A complaint about an entry, to be raised."""
        return InputError([self.document.problem(key, message)])

    def of_trial(self, trial: TrialEntry) -> ReadMapping:
        """The mapping for one trial, with the entries that it overrides."""
        return ReadMapping(self.mapping.of_trial(trial), self.document)

    def file(self, name: str) -> Path:
        """A file that the mapping names."""
        return Path(os.path.normpath(self.document.path.parent / name))


def read_mapping(path: Path) -> ReadMapping:
    """Read a mapping.  Raises InputError: it is none, lacks entries, or contradicts itself."""
    document = read_yaml(path)
    mapping = validate(document, Mapping)
    complaints = [*_missing(mapping), *_axes(mapping), *gripper_complaints(mapping.hand)]
    complaints += [*_duplicates(mapping), *_sensor_complaints(mapping)]
    if complaints:
        raise InputError(document.problems(complaints))
    return ReadMapping(mapping, document)


def _missing(mapping: Mapping) -> Iterator[Complaint]:
    """Complaints about required entries that are not filled in."""
    cable = mapping.cable
    required: list[tuple[Key, Any, str]] = [
        (("cable", "free_length_m"), cable.free_length_m,
         "measure the cable from the gripping point to its tip"),
        (("cable", "line_density_kg_per_m"), cable.line_density_kg_per_m,
         "weigh a piece and divide its mass by its length"),
        (("time", "seconds_per_unit"), _seconds_per_unit(mapping, lambda of: of.time),
         "give 1 / frames a second, such as 0.01 for 100"),
        (("metres_per_unit",), mapping.metres_per_unit,
         "give 0.001 for millimetres, 1 for metres; for pixels, the length of one in metres"),
    ]  # fmt: skip
    if mapping.hand.time is not None:
        key = ("hand", "time", "seconds_per_unit")
        required.append((key, _seconds_per_unit(mapping, lambda of: of.hand.time), required[2][2]))
    for i, marker in enumerate(mapping.markers):
        where: Key = ("markers", i, "arc_length_m")
        required.append((where, marker.arc_length_m, "measure it along the cable from the clamp"))
    missing = [(key, remedy) for key, value, remedy in required if value is None]
    for entry, remedy in [*missing, *entries_to_fill_in(mapping.hand)]:
        yield entry, f"is not known from the file: {remedy}"
    if cable.diameter_m is None and (cable.width_m is None or cable.thickness_m is None):
        message = "its section is not known from the file: give width_m and thickness_m of a flat "
        yield ("cable",), f"{message}cable, diameter_m of a round one"


def _seconds_per_unit(
    mapping: Mapping, section: Callable[[Mapping], TimeSection | None]
) -> float | None:
    """Seconds a unit of the first trial's times; None if any trial has none."""
    sections = [section(mapping.of_trial(t)) for t in mapping.trials]
    units = [None if s is None else s.seconds_per_unit for s in sections]
    return None if None in units else units[0]


def _axes(mapping: Mapping) -> list[Complaint]:
    """Complaints about axes that are not orthonormal, or do not match the columns of points."""
    complaints: list[Complaint] = []
    markers = [(("markers", i), m.columns) for i, m in enumerate(mapping.markers)]
    sections: list[tuple[Key, AxesSection, list[Any]]] = [(("axes",), mapping.axes, markers)]
    hand = mapping.hand
    if hand.along_columns is not None:
        key: Key = ("axes",) if hand.axes is None else ("hand", "axes")
        location: Key = ("hand", *(["acceleration"] if hand.acceleration is not None else []))
        sections.append((key, hand.axes or mapping.axes, [(location, hand.along_columns)]))
    for key, axes, points in sections:
        right, up = np.array(axes.right), np.array(axes.up)
        if len(right) != len(up):
            message = f"has {len(right)} numbers, up {len(up)}; give one for each column of a point"
            complaints.append(((*key, "right"), message))
            continue
        for point, columns in points:
            if len(columns) != len(right):
                message = f"names {counted(len(columns), 'column')}, the axes {len(right)}; "
                complaints.append(((*point, "columns"), f"{message}give as many"))
        for name, vector in (("right", right), ("up", up)):
            length = np.linalg.norm(vector)
            if abs(length - 1.0) > NOT_SQUARE:
                message = f"has length {length:.4g}, limit 1 ± {NOT_SQUARE}; give a direction such "
                complaints.append(((*key, name), f"{message}as {_nearest_axis(vector)}"))
        if not complaints and abs(right @ up) > NOT_SQUARE:
            angle = np.degrees(np.arccos(np.clip(right @ up, -1.0, 1.0)))
            message = f"is {angle:.3g}° from right; give directions at a right angle"
            complaints.append(((*key, "up"), message))
    return complaints


def _nearest_axis(vector: np.ndarray) -> list[float]:
    nearest = np.zeros(len(vector))
    largest = int(np.argmax(np.abs(vector)))
    nearest[largest] = np.sign(vector[largest]) or 1.0
    return [float(v) for v in nearest]


def _sensor_complaints(mapping: Mapping) -> Iterator[Complaint]:
    """Complaints about unused or contradictory entries of trials; a wrench without columns."""
    for i, trial in enumerate(mapping.trials):
        for name in ("hand_starts_at_m", "hand_ends_at_m"):
            if getattr(trial, name) is not None and mapping.hand.acceleration is None:
                message = "is only for a gripper that is told by its acceleration; remove it"
                yield ("trials", i, name), message
        if (drift_message := drift_complaint(trial.hand_drift)) is not None:
            yield ("trials", i, "hand_drift", "to_s"), drift_message
    if mapping.wrench is not None and not any(mapping.wrench.columns):
        yield ("wrench", "columns"), "are all null; name one, or leave wrench out"


def _duplicates(mapping: Mapping) -> Iterator[Complaint]:
    """Complaints about names and columns that two markers or trials share."""
    for section, names in (
        ("markers", [m.name for m in mapping.markers]),
        ("trials", [t.name for t in mapping.trials]),
    ):
        for i, name in enumerate(names):
            if name in names[:i]:
                message = f"{name!r} is given twice, first as entry {names.index(name) + 1}; rename"
                yield (section, i, "name"), f"{message} one"
    owners: dict[str, int] = {}
    for i, marker in enumerate(mapping.markers):
        for column in marker.columns:
            if column is not None and owners.setdefault(column, i) != i:
                first = mapping.markers[owners[column]].name
                message = f"{column!r} is also of marker {first!r}; give each its own columns"
                yield ("markers", i, "columns"), message
