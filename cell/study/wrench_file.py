"""Reads and writes `wrench.csv`, what a force/torque sensor at the clamp showed in a trial."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cell.cable.geometry import Motion
from cell.cable.wrench import Gauge, Tool
from cell.study.checks import check_times
from cell.study.data import Wrench, WrenchSensor
from cell.study.table import read_table, table_text

COLUMNS = ("force_x_n", "force_y_n", "moment_nm")
FILE = "wrench.csv"

#: Beyond these a number is taken for a mistaken unit: no hand that moves a cable bears them.
LIMITS = {"force_x_n": 1e3, "force_y_n": 1e3, "moment_nm": 1e2}
UNITS = {"force_x_n": "N", "force_y_n": "N", "moment_nm": "N·m"}

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
#: Farther from the gripping point no tool has its centre of mass, m.
_Near = Annotated[float, Field(ge=-1.0, le=1.0)]


class _StrictWrench(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ToolEntry(_StrictWrench):
    """The key `wrench.tool` of `study.yaml`."""

    mass_kg: _Positive
    centre_m: tuple[_Near, _Near] = (0.0, 0.0)
    inertia_kg_m2: _NotNegative = 0.0


class SensorEntry(_StrictWrench):
    """The key `wrench` of `study.yaml`."""

    axes: Literal["plane", "hand"] = "plane"
    force_std_n: _Positive | None = None
    moment_std_nm: _Positive | None = None
    gain_std: Annotated[float, Field(ge=0.0, le=0.5)] = WrenchSensor.gain_std
    tool: ToolEntry | None = None

    def sensor(self) -> WrenchSensor:
        """The sensor that it describes."""
        tool = Tool() if self.tool is None else Tool(**self.tool.model_dump())
        gauge = Gauge(tool, self.axes == "hand")
        return WrenchSensor(gauge, self.force_std_n, self.moment_std_nm, self.gain_std)


def sensor_entry(sensor: WrenchSensor) -> Mapping[str, Any]:
    """The key `wrench` of `study.yaml`, what is usual left out."""
    tool = sensor.gauge.tool
    entry: dict[str, Any] = {}
    if sensor.gauge.turns:
        entry["axes"] = "hand"
    stated = {"force_std_n": sensor.force_std_n, "moment_std_nm": sensor.moment_std_nm}
    entry |= {key: float(value) for key, value in stated.items() if value is not None}
    if sensor.gain_std != WrenchSensor.gain_std:
        entry["gain_std"] = float(sensor.gain_std)
    if tool.mass_kg > 0.0:
        entry["tool"] = {**vars(tool), "centre_m": list(tool.centre_m)}
    return entry


def read_wrench(path: Path, grip: Motion) -> Wrench:
    """Read t_s and any of `COLUMNS`; the clock is that of the hand's log.

    raises  InputError: a column is unknown or none is there, a value or time cannot be; with line,
            column, value, limit and remedy
    """
    table = read_table(path, ("t_s",), COLUMNS)
    there = table.columns[1:]
    if not there:
        message = f"has no column of a wrench; give one or more of {', '.join(COLUMNS)}"
        raise table.error(1, None, message)
    check_times(table)
    table.check(
        ~(np.abs(table.values) > [np.inf, *(LIMITS[name] for name in there)]),
        lambda name: (
            f"is beyond ±{LIMITS[name]:g} {UNITS[name]}; give {UNITS[name]}, not m{UNITS[name]}"
        ),
    )
    t_s = table.values[:, 0]
    if t_s[-1] < grip.t_s[0] or t_s[0] > grip.t_s[-1]:
        raise table.error(
            2,
            "t_s",
            f"the wrench spans {t_s[0]:g} … {t_s[-1]:g} s, grip.csv {grip.t_s[0]:g} … "
            f"{grip.t_s[-1]:g} s, without overlap; put both on one clock, in seconds",
        )
    for name, series in zip(there, table.values[:, 1:].T, strict=True):
        seen = series[np.isfinite(series)]
        if not seen.size or np.ptp(seen) == 0.0:
            shown = f"is {seen[0]:g} in all of {seen.size} rows" if seen.size else "has no value"
            message = f"{shown}, limit: one change; a sensor shows its noise: leave the column out"
            raise table.error(2, name, message)
    values = np.full((len(t_s), len(COLUMNS)), np.nan)
    values[:, [COLUMNS.index(name) for name in there]] = table.values[:, 1:]
    return Wrench(t_s, values)


def wrench_text(wrench: Wrench) -> str:
    """The file of a wrench, without columns in which nothing was measured."""
    there = np.flatnonzero(np.isfinite(wrench.values).any(axis=0))
    names = ("t_s", *(COLUMNS[i] for i in there))
    return table_text(names, np.column_stack([wrench.t_s, wrench.values[:, there]]))
