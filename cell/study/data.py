"""A study in memory: one cable, its trials, detected markers and logged grip poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable, Motion, Start
from cell.cable.wrench import Gauge, RowMeans
from cell.study.hand_drift import HandDrift


@dataclass(frozen=True, eq=False)
class Source:
    """Origin of measurements: file, lines, and names of the markers there.

    lines    (T,) counted from 1
    numbers  (markers,) of the columns' names
    names    (markers,) of the markers in the file; empty = none, columns are numbered
    """

    file: Path
    lines: NDArray[np.intp]
    numbers: NDArray[np.intp]
    names: tuple[str, ...] = ()

    def column(self, marker: int, axis: int) -> str:
        """Name of the column of a marker's x (0) or y (1)."""
        if self.names:
            return f"{self.names[marker]} {'xy'[axis]}"
        return f"{'xy'[axis]}{self.numbers[marker]}_m"

    def marker(self, marker: int) -> str:
        """Name of a marker."""
        return self.names[marker] if self.names else f"marker {self.numbers[marker]}"


@dataclass(frozen=True)
class Markers:
    """Points on the cable: `t_s` (T,), `xy_m` (T, markers, 2), nan where not detected.

    Markers are in the order of the study's `arc_length_m`.

    source  None = not read from a file
    """

    t_s: FloatArray
    xy_m: FloatArray
    source: Source | None = field(default=None, repr=False, compare=False)

    def line(self, row: int) -> int:
        """Line of a row in its file, or in the file as it would be written."""
        return row + 2 if self.source is None else int(self.source.lines[row])


@dataclass(frozen=True)
class Wrench:
    """Record of a force/torque sensor at the clamp: `t_s` (T,), `values` (T, 3).

    values  force x, y, N, and moment about the gripping point, N·m, that hold cable and tool, up
            to an unknown constant tare; nan where not measured
    """

    t_s: FloatArray
    values: FloatArray


@dataclass(frozen=True)
class WrenchSensor:
    """The force/torque sensor of a study: its load, its axes, its noise if that is stated.

    force_std_n, moment_std_nm  standard deviation in one row; None = estimated from frames at rest
    gain_std  standard deviation of its gain about 1, and of the cable's mass about the
              datasheet's: both scale the forces
    """

    gauge: Gauge = Gauge()  # noqa: RUF009
    force_std_n: float | None = None
    moment_std_nm: float | None = None
    gain_std: float = 0.02


@dataclass(frozen=True)
class Trial:
    """One motion of the grip and the markers of the cable meanwhile, on one clock.

    hand_drift  error of an integrated grip position; None = its log is complete
    wrench  record of a sensor at the clamp, if there was one
    row_means  if it is among the markers, as in the lab: which values are means of its rows
    drifts     whether it begins `moving` without a statement, and so slowly that frames before the
               gripper moves show the noise about a smooth course
    """

    name: str
    role: Literal["fit", "validate"]
    start: Start
    grip: Motion
    markers: Markers
    release_s: float | None = None
    hand_drift: HandDrift | None = None
    wrench: Wrench | None = None
    row_means: RowMeans | None = None
    drifts: bool = False

    @property
    def source(self) -> Source:
        """Place of its markers in files, or in files as they would be written."""
        frames, markers = self.markers.xy_m.shape[:2]
        file = Path(self.name) / "markers.csv"
        return self.markers.source or Source(file, np.arange(frames) + 2, np.arange(markers))

    def gripper_m(self, t_s: FloatArray) -> FloatArray:
        """(T, 2) gripping point at times (T,)."""
        grip = self.grip
        return np.column_stack([np.interp(t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])

    @property
    def release_complaint(self) -> str | None:
        """Complaint that the cable is let go outside the record; None if it is not."""
        if self.release_s is None:
            return None
        first_s, last_s = min(self.grip.t_s[0], self.markers.t_s[0]), self.markers.t_s[-1]
        if first_s <= self.release_s <= last_s:
            return None
        return (
            f"{self.release_s:g} s is outside the record, {first_s:g} … {last_s:g} s; give when "
            "the cable is let go, on the clock of t_s, in seconds"
        )

    @property
    def bent(self) -> bool:
        """Whether the cable begins away from its equilibrium in an unknown shape."""
        return self.start in ("held", "moving")

    @property
    def rests_until_s(self) -> float | None:
        """Time until which more than its grip holds the cable still; −∞ if it never rests."""
        return -np.inf if self.start == "moving" and not self.drifts else self.release_s


@dataclass(frozen=True)
class Study:
    """The measurements of one cable.

    arc_length_m  (markers,) from the gripping point; in a study that was read, the largest is first
    notes         sentences on the measurements for readers of results
    filmed        markers are places along a centre line in the cell's pictures; their position
                  along it is no measurement
    pull_m_per_s2  acceleration as the cable's stiffness, where gravity in the plane is weak;
                  None = gravity is.  See `cell.study.clocks`
    arc_length_std_m  (markers,) standard deviation of arc lengths; None = they are exact
    sensor         of the trials' wrenches, if any has one
    copies         names of trials that are one recording; only one of each is among the trials
    """

    name: str
    cable: Cable
    arc_length_m: FloatArray
    trials: tuple[Trial, ...]
    gravity_m_per_s2: tuple[float, float] = (0.0, -9.81)
    noise_std_m: float | None = None
    notes: tuple[str, ...] = ()
    filmed: bool = False
    pull_m_per_s2: float | None = None
    arc_length_std_m: FloatArray | None = None
    sensor: WrenchSensor = WrenchSensor()
    copies: tuple[tuple[str, ...], ...] = ()

    @property
    def scale_m_per_s2(self) -> float:
        """Acceleration that sets the time scale of the cable's swing: gravity, or the pull."""
        if self.pull_m_per_s2 is not None:
            return self.pull_m_per_s2
        return float(np.hypot(*self.gravity_m_per_s2))

    def role(self, role: Literal["fit", "validate"]) -> tuple[Trial, ...]:
        """Trials of a role, in order."""
        return tuple(t for t in self.trials if t.role == role)

    def with_places(self, change: Callable[[Trial], FloatArray]) -> Study:
        """The study with markers (times, markers, 2), m, from a function of each trial."""
        trials = [replace(t, markers=replace(t.markers, xy_m=change(t))) for t in self.trials]
        return replace(self, trials=tuple(trials))
