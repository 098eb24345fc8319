"""Base of an effect: named, bounded parameters with units, and the hooks that it needs."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from cell.cable.arrays import FloatArray

#: Hooks that run in every step, compiled.
COMPILED = ("force", "moment", "memory_rate", "memory_at_rest")


def after_number(unit: str) -> str:
    """A unit as it stands behind its number; nothing for a pure number, whose unit is 1."""
    return "" if unit == "1" else f" {unit}"


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    low, high  physical bounds
    default    value when none is given.  Of an amplitude it is the value that switches the effect
               off, so that a model with the effect there equals the model without
    starts     values worth starting a fit from, the most typical first
    scan       further values for the screen, with the other parameters at their first start: of a
               parameter whose fit converges from near only, such as a frequency
    amplitude  whether the effect is off at `default`
    fitted     False: a known constant of the set-up, left at its default unless given
    """

    name: str
    unit: str
    low: float
    high: float
    default: float
    starts: tuple[float, ...]
    amplitude: bool = True
    fitted: bool = True
    scan: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"parameter {self.name!r} is not a name")
        guesses = {"starts": self.starts, "scan": self.scan}
        labelled = [(label, value) for label, values in guesses.items() for value in values]
        for label, value in (("default", self.default), *labelled):
            if not self.low <= value <= self.high:
                raise ValueError(
                    f"parameter {self.name}: {label} {value} outside {self.low} … {self.high}"
                )
        if not self.starts:
            raise ValueError(f"parameter {self.name}: needs at least one value in `starts`")
        if self.scan and self.amplitude:
            raise ValueError(
                f"parameter {self.name}: an amplitude has no `scan`, it is found by slopes"
            )


@dataclass(frozen=True)
class EffectFile:
    """File of a user's own effect: resolved path and SHA-256 of its content, hexadecimal.

    confined  nobody has read it: all its code runs in sandboxes
    """

    path: Path
    sha256: str
    confined: bool = False


class CableData(NamedTuple):
    """Datasheet of the cable, as hooks see it: `cable`."""

    width_m: float
    thickness_m: float
    line_density_kg_per_m: float
    free_length_m: float


class Place(NamedTuple):
    """State of a short piece of cable, as `force` sees it: `at`.

    Still air and the cell's plane: x right, y up.  The tangent (tx, ty) points away from the
    grip; the normal is (−ty, tx); `spin` = dθ/dt.  `time`, s, is 0 at the trial's first frame; an
    execution continues the time of the hold before it.
    """

    x: float
    y: float
    vx: float
    vy: float
    tx: float
    ty: float
    angle: float
    spin: float
    arc_length: float
    time: float


class Bend(NamedTuple):
    """State of bending at one place, as `moment` and `memory_rate` see it: `at`."""

    curvature: float
    rate: float
    rigidity: float
    arc_length: float


@dataclass(frozen=True)
class HandMotion:
    """Pose of the gripper against time, smooth; logged from `start_s` to `end_s`, held outside."""

    function: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
    start_s: float
    end_s: float

    def __call__(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, y, m, and clamp angle, rad, at times (…)."""
        return self.function(t_s)


class Effect:
    """Base of all effects; a class is an effect, it is never instantiated.

    Hooks are static methods; numba compiles those marked *, so they are plain arithmetic on
    scalars.  `p` has the parameters as attributes, `m` the memory variables, `cable` is
    `CableData`.

    force(cable, at: Place, p) -> (fx, fy)*            N/m
    moment(cable, at: Bend, m, p) -> M*                N·m, added to the cable's own
    memory_rate(cable, at: Bend, m, p) -> (rates, …)*  one per name in `memory`, 1/s
    memory_at_rest(cable, at: Bend, p) -> (values, …)* memory of a cable that has long been still
    inertia(cable, p) -> (along, normal)               kg/m added to the strip's, without weight
    inertia(cable, arc_length, p) -> (along, normal)   the same at arc lengths; arrays, or numbers
    tip_mass(cable, p) -> kg                           point mass with weight at the tip
    point_mass(cable, p) -> (kg, m)                    the same at an arc length
    rest_curvature(cable, arc_length, p) -> κ₀         1/m, arrays
    grip_compliance(cable, p) -> (c, τ)                rad/(N·m) and s at the gripping point
    extra_length(cable, p) -> m                        added to the free length
    clamp(pose: HandMotion, p) -> t -> (x, y, angle)         the gripper's true pose, arrays
    camera_time(cable, t, xy, p) -> t                  when the points (…, 2) of a picture were
                                                       there; t (…) is the picture's time
    camera_points(cable, xy, p) -> xy                  where the camera sees points (…, 2)

    wider  a more general effect of which this one is a special case: if it explains more, this
           effect's law is an approximation only

    `file` is set by `load_effect` on a user's own effect; the project's have none.
    """

    name: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    memory: ClassVar[tuple[str, ...]] = ()
    dissipative: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    file: ClassVar[EffectFile | None] = None
    wider: ClassVar[type[Effect] | None] = None

    force: ClassVar[Callable[..., Any] | None] = None
    moment: ClassVar[Callable[..., Any] | None] = None
    memory_rate: ClassVar[Callable[..., Any] | None] = None
    memory_at_rest: ClassVar[Callable[..., Any] | None] = None
    inertia: ClassVar[Callable[..., Any] | None] = None
    tip_mass: ClassVar[Callable[..., Any] | None] = None
    point_mass: ClassVar[Callable[..., Any] | None] = None
    rest_curvature: ClassVar[Callable[..., Any] | None] = None
    grip_compliance: ClassVar[Callable[..., Any] | None] = None
    extra_length: ClassVar[Callable[..., Any] | None] = None
    clamp: ClassVar[Callable[..., Any] | None] = None
    camera_time: ClassVar[Callable[..., Any] | None] = None
    camera_points: ClassVar[Callable[..., Any] | None] = None

    @classmethod
    def varies_along_cable(cls) -> bool:
        """Whether its `inertia` has the arc length as an argument."""
        hook = inspect.unwrap(cls.inertia) if cls.inertia is not None else None
        return hook is not None and hook.__code__.co_argcount == 3

    @classmethod
    def active(cls, **values: float) -> ActiveEffect:
        """This effect with parameter values; the others have their default."""
        known = {p.name: p for p in cls.parameters}
        for name in values:
            if name not in known:
                raise ValueError(f"{cls.name} has no parameter {name!r}; it has {list(known)}")
        return ActiveEffect(cls, tuple(float(values.get(n, p.default)) for n, p in known.items()))


@dataclass(frozen=True)
class ActiveEffect:
    """An effect and the values of its parameters, in the order of `effect.parameters`."""

    effect: type[Effect]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        name = self.effect.name
        if len(self.values) != len(self.effect.parameters):
            raise ValueError(
                f"{name} has {len(self.effect.parameters)} parameters, {len(self.values)} given"
            )
        for parameter, value in zip(self.effect.parameters, self.values, strict=True):
            if not math.isfinite(value) or not parameter.low <= value <= parameter.high:
                unit = after_number(parameter.unit)
                raise ValueError(
                    f"{name}.{parameter.name} = {value:g}{unit}: "
                    f"must be {parameter.low:g} … {parameter.high:g}{unit}"
                )

    @property
    def named(self) -> dict[str, float]:
        """Values by parameter name."""
        return {p.name: v for p, v in zip(self.effect.parameters, self.values, strict=True)}


class EffectError(ValueError):
    """An effect cannot be used.  Scenario: a hook returns one number where two are needed."""

    def __init__(self, path: str | Path, line: int, cause: str) -> None:
        super().__init__(f"{path}:{line}: {cause}")
        self.path = Path(path)
        self.line = line
        self.cause = cause
