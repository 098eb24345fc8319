"""The wrench that a sensor at the clamp measures: it holds the cable and the tool."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.cable import layout as at
from cell.cable.arrays import FloatArray

#: Force x, y, and moment.
AXES = 3
#: Points that represent a wrench: its force, and its moment with a zero.
AS_POINTS = 2
#: Fewest rows of a mean.
FEWEST_ROWS = 2


@dataclass(frozen=True)
class Tool:
    """The sensor's load in addition to the cable: jaws, gripper.

    centre_m       x, y of its centre of mass from the gripping point while the clamp angle is 0
    inertia_kg_m2  about that centre
    """

    mass_kg: float = 0.0
    centre_m: tuple[float, float] = (0.0, 0.0)
    inertia_kg_m2: float = 0.0


@dataclass(frozen=True)
class Gauge:
    """A force/torque sensor between gripper and jaws.

    turns  its axes turn with the clamp angle, at 0 they are the plane's; else they are the plane's
    """

    tool: Tool = Tool()
    turns: bool = False

    def measured(
        self, cable: FloatArray, base: FloatArray, gravity_m_per_s2: tuple[float, float]
    ) -> FloatArray:
        """(steps, 3) force x, y, N, and moment about the gripping point, N·m, as it shows them.

        cable  (steps, 3) the same that the clamp exerts on the cable, in the plane's axes
        base   (steps, BASE_FIELDS) of the clamp at these times
        """
        angle = base[:, at.BASE_ANGLE]
        cos, sin = np.cos(angle), np.sin(angle)
        rows = cable + self._held(base, cos, sin, gravity_m_per_s2)
        if not self.turns:
            return rows
        x, y, moment = rows.T
        return np.column_stack([cos * x + sin * y, cos * y - sin * x, moment])

    def _held(
        self,
        base: FloatArray,
        cos: FloatArray,
        sin: FloatArray,
        gravity_m_per_s2: tuple[float, float],
    ) -> FloatArray:
        """(steps, 3) wrench on the tool, in the plane's axes."""
        tool, (along, across) = self.tool, self.tool.centre_m
        x, y = cos * along - sin * across, sin * along + cos * across
        spin, turn = base[:, at.BASE_SPIN], base[:, at.BASE_AA]
        gx, gy = gravity_m_per_s2
        fx = tool.mass_kg * (base[:, at.BASE_AX] - turn * y - spin**2 * x - gx)
        fy = tool.mass_kg * (base[:, at.BASE_AY] + turn * x - spin**2 * y - gy)
        return np.column_stack([fx, fy, x * fy - y * fx + tool.inertia_kg_m2 * turn])


@dataclass(frozen=True, eq=False)
class RowMeans:
    """Means of a sensor's rows over time spans, the same for measured and simulated values.

    t_s          (R,) times of the rows
    valid        (R, AXES) whether a row has a value of an axis
    among        (n,) indices of the means' times in a record
    first, last  (n,) the rows of each: from `first` to before `last`
    """

    t_s: FloatArray
    valid: NDArray[np.bool_]
    among: NDArray[np.intp]
    first: NDArray[np.intp]
    last: NDArray[np.intp]

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """(n, AXES) number of rows of each mean."""
        return np.asarray(self._sums(self.valid.astype(np.intp)))

    def of(self, values: FloatArray) -> FloatArray:
        """(n, AXES) means of values (R, AXES), nan where too few rows have a value."""
        sums = self._sums(np.where(self.valid, values, 0.0))
        return np.where(self.rows >= FEWEST_ROWS, sums / np.maximum(self.rows, 1), np.nan)

    def some(self, which: NDArray[np.intp]) -> RowMeans:
        """Those of the means at some indices."""
        parts = (v[which] for v in (self.among, self.first, self.last))
        return RowMeans(self.t_s, self.valid, *parts)

    def earlier(self, delay_s: float) -> RowMeans:
        """The same with the rows earlier by `delay_s`."""
        return self if delay_s == 0.0 else replace(self, t_s=self.t_s - delay_s)

    def _sums(self, values: NDArray[Any]) -> NDArray[Any]:
        total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
        return np.asarray(total[self.last] - total[self.first])


def at_places(rows: FloatArray, places: FloatArray) -> FloatArray:
    """(T, k) values of rows (rows, k) at fractional row numbers (T,): cubic, held outside."""
    last = len(rows) - 1
    places = np.clip(places, 0.0, last)
    k = np.minimum(places.astype(np.int64), max(last - 1, 0))
    u = (places - k)[:, None]
    before, after = rows[np.maximum(k - 1, 0)], rows[np.minimum(k + 2, last)]
    first, second = rows[k], rows[np.minimum(k + 1, last)]
    m1, m2 = 0.5 * (second - before), 0.5 * (after - first)
    cubic = 2.0 * (first - second) + m1 + m2
    bend = 3.0 * (second - first) - 2.0 * m1 - m2
    return np.asarray(first + u * (m1 + u * (bend + u * cubic)))


def as_points(rows: FloatArray) -> FloatArray:
    """(T, AS_POINTS, 2) points of wrenches (T, 3): (force x, force y), (moment, 0)."""
    return np.concatenate([rows, np.zeros((len(rows), 1))], axis=1).reshape(-1, AS_POINTS, 2)
