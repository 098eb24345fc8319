"""The cable as an object: its datasheet, the motion of its grip, and where its nodes are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray

if TYPE_CHECKING:
    from cell.cable.splines import Spline

MotionSplines: TypeAlias = "tuple[Spline, Spline, Spline]"

#: Densities of anything that is sold as a cable, from foam to gold, kg/m³.
PLAUSIBLE_DENSITY_KG_PER_M3 = (20.0, 25_000.0)

#: How a cable begins: at rest; held straight along the clamp angle until it is let go; held bent
#: until then; in motion.  In the last two its state is given as places and velocities of modes.
Start = Literal["equilibrium", "straight", "held", "moving"]

#: Standard gravity in the cell's plane (x right, y up), m/s².
GRAVITY_M_PER_S2 = (0.0, -9.81)


@dataclass(frozen=True)
class Connector:
    """A rigid body at the end of a cable, fixed in line with it; its centre of mass is its middle.

    inertia_kg_m2  about its centre, for turns in the cell's plane
    """

    mass_kg: float
    length_m: float
    inertia_kg_m2: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"cable.connector.{name} = {value}: must be finite and > 0")

    @staticmethod
    def rod(mass_kg: float, length_m: float) -> Connector:
        """One whose mass is spread evenly over its length."""
        return Connector(mass_kg, length_m, mass_kg * length_m**2 / 12.0)


@dataclass(frozen=True)
class Cable:
    """Datasheet of a cable: what is the same for all its individuals.

    free_length_m  from the gripping point to the end, or to the connector: what bends
    """

    free_length_m: float
    line_density_kg_per_m: float
    width_m: float
    thickness_m: float
    connector: Connector | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name == "connector":
                continue
            if not isinstance(value, int | float | np.integer | np.floating):
                raise TypeError(f"cable.{name} = {value!r}: must be a number")
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"cable.{name} = {value}: must be finite and > 0")

    @property
    def length_m(self) -> float:
        """From the gripping point to the tip, which is the connector's end if there is one."""
        return self.free_length_m + (self.connector.length_m if self.connector else 0.0)

    @property
    def loaded_density_kg_per_m(self) -> float:
        """Mass per free length, the connector's included."""
        carried = self.connector.mass_kg / self.free_length_m if self.connector else 0.0
        return self.line_density_kg_per_m + carried

    @property
    def numbers(self) -> dict[str, float]:
        """All numbers by their keys in a study's description; 0 for a missing connector's."""
        numbers = {
            f.name: float(getattr(self, f.name)) for f in fields(self) if f.name != "connector"
        }
        for f in fields(Connector):
            numbers[f"connector.{f.name}"] = float(getattr(self.connector, f.name, 0.0))
        return numbers

    def to_dict(self) -> dict[str, Any]:
        """Plain data; `from_dict` reads it back."""
        data = {f.name: float(getattr(self, f.name)) for f in fields(self) if f.name != "connector"}
        return data | ({"connector": dict(vars(self.connector))} if self.connector else {})

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Cable:
        """Back from `to_dict`.  Raises TypeError, ValueError: an entry is missing, or no number."""
        entries = dict(data)
        connector = entries.pop("connector", None)
        return Cable(**entries, connector=None if connector is None else Connector(**connector))

    def implausible(self) -> str | None:
        """Message that these numbers cannot be a cable's, mostly a mistaken unit; None if they can.

        The message is about `line_density_kg_per_m`, whose unit is the most easily mistaken.
        """
        low, high = PLAUSIBLE_DENSITY_KG_PER_M3
        density = self.line_density_kg_per_m / (self.width_m * self.thickness_m)
        if low <= density <= high:
            return None
        return (
            f"{self.line_density_kg_per_m:g} kg/m over width {self.width_m:g} m × thickness "
            f"{self.thickness_m:g} m is {density:.3g} kg/m³, not {low:g} … {high:g}; "
            "give kg/m, not g/m, and metres, not millimetres"
        )


@dataclass(frozen=True)
class Motion:
    """Pose of the gripping point against time: arrays of shape (T,), T ≥ 2, t increasing.

    `angle_rad` is the clamp angle θ_n: 0 = level, positive = pointing down.
    raises  ValueError: not arrays of 64-bit floats, of unequal shapes, not finite, not increasing
    """

    t_s: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    angle_rad: FloatArray

    def __post_init__(self) -> None:
        for name in ("t_s", "x_m", "y_m", "angle_rad"):
            value = getattr(self, name)
            if not isinstance(value, np.ndarray) or value.dtype != np.float64:
                raise ValueError(f"motion.{name} is no array of 64-bit floats")
            if value.ndim != 1 or value.shape != np.shape(self.t_s):
                raise ValueError(f"motion.{name} has shape {value.shape}, t_s {self.t_s.shape}")
            if not np.all(np.isfinite(value)):
                raise ValueError(f"motion.{name}[{int(np.argmin(np.isfinite(value)))}] not finite")
        if len(self.t_s) < 2 or np.any(np.diff(self.t_s) <= 0.0):
            raise ValueError("motion.t_s needs at least 2 times, strictly increasing")

    @cached_property
    def splines(self) -> MotionSplines:
        """x, y and angle as C² functions of time, free of the log's noise."""
        from cell.cable.splines import fit  # compiled, which settings have no need of

        x, y, angle = (fit(self.t_s, v) for v in (self.x_m, self.y_m, self.angle_rad))
        return x, y, angle

    def later(self, delay_s: float) -> Motion:
        """The same poses a delay later, or earlier if it is negative; splines are fitted again."""
        return Motion(self.t_s + delay_s, self.x_m, self.y_m, self.angle_rad)


@dataclass(frozen=True)
class SmoothedMotion(Motion):
    """A motion with known splines, whose noise level comes from another motion."""

    smoothed: MotionSplines = field(kw_only=True, repr=False, compare=False)

    @cached_property
    def splines(self) -> MotionSplines:
        """The splines that it was made with."""
        return self.smoothed


def node_arc_lengths(free_length_m: float, nodes: int = 11) -> FloatArray:
    """(nodes,) arc lengths from the gripping point, tip first as in the paper, m."""
    return np.linspace(free_length_m, 0.0, nodes)


#: Largest distance from its start at which a gripper counts as still, by axis of a `Motion`, m and
#: rad: above the noise and vibration of an arm that is held, below what swings a cable visibly.
STILL: Mapping[str, float] = {"x_m": 1e-4, "y_m": 1e-4, "angle_rad": 2e-3}
#: The same for measurements of unknown origin, whose log may be far noisier.
ROUGHLY_STILL: Mapping[str, float] = {"x_m": 1e-3, "y_m": 1e-3, "angle_rad": 0.01}


#: Samples of a log in a row that a gripper must be away: one or two are a glitch of the log.
AWAY_SAMPLES = 3


def away_from(
    motion: Motion, samples: slice, still: Mapping[str, float] = STILL
) -> NDArray[np.bool_]:
    """(T,) whether the gripper is not still, compared with its median place in some samples."""
    away = np.zeros(len(motion.t_s), dtype=bool)
    for name, limit in still.items():
        value = getattr(motion, name)
        away |= np.abs(value - np.median(value[samples])) > limit
    return away


def moves_from_s(motion: Motion, still: Mapping[str, float] = STILL) -> float:
    """Time at which the gripper first leaves where it began, s; `inf` if it never does.

    Samples of the log that are wrong by more than the limit, `AWAY_SAMPLES` − 1 of them in a row
    at most, are no motion.
    """
    first = slice(0, max(1, min(10, len(motion.t_s) // 10)))
    away = away_from(motion, first, still)
    ahead = np.concatenate([away, np.repeat(away[-1:], AWAY_SAMPLES - 1)])
    stays = np.lib.stride_tricks.sliding_window_view(ahead, AWAY_SAMPLES).all(axis=1)
    return float(motion.t_s[stays.argmax()]) if stays.any() else float("inf")
