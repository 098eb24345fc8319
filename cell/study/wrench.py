"""The wrench of a trial at the clamp: its file, its facts, and its plausibility."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, Cable, Motion, moves_from_s
from cell.cable.wrench import Gauge, Tool
from cell.files.input_error import Problem
from cell.files.plain import plain
from cell.study.check import Failure, failures, noted
from cell.study.data import Trial, Wrench, WrenchSensor
from cell.study.entries import NotNegative, Positive, SectionPart
from cell.study.series import interpolated, noise_m
from cell.study.table import check_times, read_table, table_text

COLUMNS = ("force_x_n", "force_y_n", "moment_nm")
FILE = "wrench.csv"

#: Limits beyond which a unit is assumed to be wrong: no gripper of a cable bears such loads.
LIMITS = {"force_x_n": 1e3, "force_y_n": 1e3, "moment_nm": 1e2}
UNITS = {"force_x_n": "N", "force_y_n": "N", "moment_nm": "N·m"}

#: Largest distance of a tool's centre of mass from the gripping point, m.
_Near = Annotated[float, Field(ge=-1.0, le=1.0)]


class ToolEntry(SectionPart):
    """The key `wrench.tool` of `study.yaml`."""

    mass_kg: Positive
    centre_m: tuple[_Near, _Near] = (0.0, 0.0)
    inertia_kg_m2: NotNegative = 0.0


class SensorEntry(SectionPart):
    """The key `wrench` of `study.yaml`."""

    axes: Literal["plane", "hand"] = "plane"
    force_std_n: Positive | None = None
    moment_std_nm: Positive | None = None
    gain_std: Annotated[float, Field(ge=0.0, le=0.5)] = WrenchSensor.gain_std
    tool: ToolEntry | None = None

    def sensor(self) -> WrenchSensor:
        """The sensor that it describes."""
        tool = Tool() if self.tool is None else Tool(**self.tool.model_dump())
        gauge = Gauge(tool, self.axes == "hand")
        return WrenchSensor(gauge, self.force_std_n, self.moment_std_nm, self.gain_std)


def sensor_entry(sensor: WrenchSensor) -> Mapping[str, Any]:
    """The key `wrench` of `study.yaml`, without entries that have default values."""
    tool = sensor.gauge.tool
    entry = SensorEntry(
        axes="hand" if sensor.gauge.turns else "plane",
        force_std_n=sensor.force_std_n,
        moment_std_nm=sensor.moment_std_nm,
        gain_std=sensor.gain_std,
    )
    section = entry.model_dump(exclude_defaults=True)
    if tool.mass_kg > 0.0:
        section["tool"] = {**vars(tool), "centre_m": list(tool.centre_m)}
    return section


def read_wrench(path: Path, grip: Motion) -> Wrench:
    """Read t_s and any of `COLUMNS`; the clock is that of the gripper's log.

    raises  InputError: a column is unknown or all are missing, a value or time is impossible; with
            line, column, value, limit and remedy
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
        valid = series[np.isfinite(series)]
        if not valid.size or np.ptp(valid) == 0.0:
            shown = f"is {valid[0]:g} in all of {valid.size} rows" if valid.size else "has no value"
            message = f"{shown}, limit: one change; a sensor shows its noise: leave the column out"
            raise table.error(2, name, message)
    values = np.full((len(t_s), len(COLUMNS)), np.nan)
    values[:, [COLUMNS.index(name) for name in there]] = table.values[:, 1:]
    return Wrench(t_s, values)


def wrench_text(wrench: Wrench) -> str:
    """The file of a wrench, without unmeasured columns."""
    there = np.flatnonzero(np.isfinite(wrench.values).any(axis=0))
    names = ("t_s", *(COLUMNS[i] for i in there))
    return table_text(names, np.column_stack([wrench.t_s, wrench.values[:, there]]))


#: Least share of the motion in the twice integrated force, for a force to be judged …
_SHOWN = 0.8
#: … by its ratio to the force from gripper, markers and masses: noted beyond these, …
FORCE_NOTED = (0.5, 2.0)
#: … and refused beyond these.
FORCE_REFUSED = (-1.0 / 3.0, 30.0)
#: Largest ratio of the arc lengths of the cable's end and its outermost marker.
_FARTHER = 4.0


@dataclass(frozen=True)
class ForceFactor:
    """Ratio of the measured force to the force that accelerates the cable; about 1 if correct.

    column  of the file, of the axis that moves most
    """

    column: str
    factor: float


def force_factor(
    trial: Trial, cable: Cable, outermost_m: float, sensor: WrenchSensor
) -> ForceFactor | None:
    """The force factor of a trial; None if the motion is too small to determine it.

    Twice integrated it is mass times the way of the centre of mass, plus a parabola by weight and
    tare.  That centre is roughly in the middle between the gripper and the end of a straight cable
    through the outermost marker.

    outermost_m  arc length of that marker
    """
    if trial.wrench is None or trial.start != "equilibrium" or sensor.gauge.turns:
        return None
    t_s, way = trial.wrench.t_s, _mass_moment(trial, cable, outermost_m, sensor)
    judged = []
    for axis, column in enumerate(("force_x_n", "force_y_n")):
        force = trial.wrench.values[:, axis]
        measured = np.isfinite(force) & np.isfinite(way[:, axis])
        if np.count_nonzero(measured) > 8 and np.ptp(way[measured, axis]) > 0.0:
            factor, shown = _factor(t_s[measured], force[measured], way[measured, axis])
            if shown > _SHOWN:
                judged.append((float(np.ptp(way[measured, axis])), column, factor))
    return ForceFactor(*max(judged)[1:]) if judged else None


_FORCE = "twice integrated force over that of the masses by hand and markers"
_IS_FORCE = "is {factor:.2g} times what moves cable and tool as gripper and markers show, limit"


def _beyond(force: ForceFactor, limit: float) -> Failure | None:
    """A force that is larger than a limit."""
    values = {"factor": force.factor, "limit": limit}
    return Failure(values) if force.factor > limit else None


def _points_back(force: ForceFactor, limit: float) -> Failure | None:
    """A force whose factor is less than a limit."""
    values = {"factor": force.factor, "limit": FORCE_REFUSED[0]}
    return Failure(values) if force.factor < limit else None


@noted(
    _FORCE,
    f"0; {FORCE_REFUSED[0]:.2g} is refused",
    f"{_IS_FORCE} {{limit:.2g}}: it points the other way;",
    "give the force that gripper and clamp exert on the cable, which at rest points up",
)
def force_reversed(force: ForceFactor) -> Failure | None:
    """Does the measured force have the direction of the force that moves the cable?"""
    return _points_back(force, 0.0)


@noted(
    _FORCE,
    f"{FORCE_NOTED[1]:g}; {FORCE_REFUSED[1]:g} is refused",
    f"{_IS_FORCE} {{limit:g}};",
    "give N, not mN, and the mass that the sensor carries as wrench.tool in study.yaml",
)
def force_large(force: ForceFactor) -> Failure | None:
    """Is the force no larger than what moves the masses?"""
    return _beyond(force, FORCE_NOTED[1])


@noted(
    _FORCE,
    f"{FORCE_NOTED[0]:g}",
    f"{_IS_FORCE} {{limit:g}};",
    "see whether it is in N, on the clock of grip.csv, and whether wrench.tool and the cable's "
    "line density are right",
)
def force_small(force: ForceFactor) -> Failure | None:
    """Is the force no smaller than what moves the masses?"""
    values = {"factor": force.factor, "limit": FORCE_NOTED[0]}
    return Failure(values) if 0.0 <= force.factor < FORCE_NOTED[0] else None


FORCE_REFUSALS = (
    replace(force_reversed, failure=partial(_points_back, limit=FORCE_REFUSED[0])),
    replace(force_large, failure=partial(_beyond, limit=FORCE_REFUSED[1])),
)
FORCE_NOTES = (force_reversed, force_large, force_small)


def force_problems(
    trial: Trial, cable: Cable, outermost_m: float, sensor: WrenchSensor, file: Path
) -> tuple[list[Problem], list[str]]:
    """Problems for which a trial's wrench is refused, and notes.

    outermost_m  arc length of the outermost marker
    """
    force = force_factor(trial, cable, outermost_m, sensor)
    if force is None:
        return [], []
    for _, sentence in failures(FORCE_REFUSALS, force):
        return [Problem(file, 2, None, force.column, sentence)], []
    return [], [f"{file}: {force.column} {s}" for _, s in failures(FORCE_NOTES, force)]


def _factor(t_s: FloatArray, force: FloatArray, way: FloatArray) -> tuple[float, float]:
    """Ratio of the force to that of the way (n,), kg·m, and its explained share."""
    steps = np.diff(t_s)
    force = force - force.mean()
    impulse = np.concatenate([[0.0], np.cumsum(0.5 * steps * (force[1:] + force[:-1]))])
    twice = np.concatenate([[0.0], np.cumsum(0.5 * steps * (impulse[1:] + impulse[:-1]))])
    parabola = np.linalg.qr(np.vander((t_s - t_s[0]) / (t_s[-1] - t_s[0]), 3))[0]
    residuals = [v - parabola @ (parabola.T @ v) for v in (twice, way)]
    factor = float(residuals[0] @ residuals[1]) / max(float(residuals[1] @ residuals[1]), 1e-300)
    power = max(float(residuals[0] @ residuals[0]), 1e-300)
    return factor, factor**2 * float(residuals[1] @ residuals[1]) / power


def _mass_moment(
    trial: Trial, cable: Cable, outermost_m: float, sensor: WrenchSensor
) -> FloatArray:
    """(T, 2) first moment of all moving masses, at the times of the wrench, kg·m."""
    assert trial.wrench is not None
    t_s, markers = trial.wrench.t_s, trial.markers
    hand = trial.gripper_m(t_s)
    outermost = interpolated(t_s, markers.t_s, markers.xy_m[:, 0])
    outermost[(t_s < markers.t_s[0]) | (t_s > markers.t_s[-1])] = np.nan
    mass_kg = cable.line_density_kg_per_m * cable.free_length_m
    at_end_kg = cable.connector.mass_kg if cable.connector else 0.0
    end = hand + (outermost - hand) * min(cable.length_m / max(outermost_m, 1e-9), _FARTHER)
    held = (0.5 * mass_kg + sensor.gauge.tool.mass_kg) * hand
    return np.asarray(held + (0.5 * mass_kg + at_end_kg) * end)


@dataclass(frozen=True, eq=False)
class WrenchFacts:
    """Facts of one trial's wrench: N and N·m, in the order of the columns of its file.

    rate_hz  rows a second, by the usual step
    still    rows before anything moves
    noise    (3,) of one row at rest, by second differences: slow errors do not show in it
    varies   (3,) range of the values; nan = not measured
    """

    trial: str
    rate_hz: float
    still: int
    noise: FloatArray
    varies: FloatArray

    def to_json(self) -> dict[str, Any]:
        """Plain data, without unmeasured columns; None for unknown values."""
        columns = {
            name: {"noise": plain(self.noise[i]), "varies": plain(self.varies[i])}
            for i, name in enumerate(COLUMNS)
            if np.isfinite(self.varies[i])
        }
        return {"rate_hz": self.rate_hz, "still_rows": self.still, **columns}


def wrench_facts(trial: Trial) -> WrenchFacts | None:
    """The facts of a trial's wrench; None if it has none."""
    wrench = trial.wrench
    if wrench is None:
        return None
    let_go_s = np.inf if trial.rests_until_s is None else trial.rests_until_s
    until_s = min(moves_from_s(trial.grip, ROUGHLY_STILL), let_go_s)
    still = int(np.searchsorted(wrench.t_s, until_s))
    varies = np.full(len(COLUMNS), np.nan)
    valid = np.isfinite(wrench.values).any(axis=0)
    varies[valid] = np.nanmax(wrench.values[:, valid], 0) - np.nanmin(wrench.values[:, valid], 0)
    noise = np.array([noise_m(series) for series in wrench.values[:still].T])
    rate_hz = 1.0 / float(np.median(np.diff(wrench.t_s)))
    return WrenchFacts(trial.name, rate_hz, still, noise, varies)
