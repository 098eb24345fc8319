"""The mapping's section of a wrench at the clamp: its columns in a trial's file, and its sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from cell.cable.arrays import FloatArray
from cell.files.input_error import Problem
from cell.files.yaml_document import Document
from cell.study.data import Study, Wrench
from cell.study.imports.capture import Capture
from cell.study.imports.hand_section import Finite, Name
from cell.study.wrench_file import SensorEntry, sensor_entry


class WrenchSection(SensorEntry):
    """What a study says of its sensor, and where its values are.

    columns  of force x, force y and moment; null = not measured
    newtons_per_unit, newton_metres_per_unit  negative: the sensor shows what acts on the hand
    """

    columns: Annotated[list[Name | None], Field(min_length=3, max_length=3)]
    newtons_per_unit: Finite = 1.0
    newton_metres_per_unit: Finite = 1.0

    def wrench(self, capture: Capture, t_s: FloatArray) -> Wrench | None:
        """What a file shows of it; None = nothing.  Raises InputError: there is no such column."""
        units = (self.newtons_per_unit, self.newtons_per_unit, self.newton_metres_per_unit)
        values = np.full((len(t_s), len(units)), np.nan)
        for axis, (name, unit) in enumerate(zip(self.columns, units, strict=True)):
            if name is not None:
                values[:, axis] = capture.column(name) * unit
        shown = np.isfinite(values).any(axis=1)
        return Wrench(t_s[shown], values[shown]) if shown.any() else None


def wrench_section(study: Study, names: Sequence[str]) -> WrenchSection | None:
    """The section of a study whose wrenches are in columns of these names; None = it has none."""
    wrenches = [t.wrench for t in study.trials if t.wrench is not None]
    if not wrenches:
        return None
    there = np.any([np.isfinite(w.values).any(axis=0) for w in wrenches], axis=0)
    columns = [name if seen else None for name, seen in zip(names, there, strict=True)]
    return WrenchSection(columns=columns, **sensor_entry(study.sensor))


def wrench_problems(document: Document, section: WrenchSection | None) -> list[Problem]:
    """That nothing of it is given."""
    if section is None or any(section.columns):
        return []
    message = "are all null; name one, or leave wrench out"
    return [document.problem(("wrench", "columns"), message)]
