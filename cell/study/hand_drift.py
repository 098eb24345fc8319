"""How far a hand may be from where it is said to be, if its place was integrated from acceleration.

White noise of acceleration that is integrated twice is smooth, as a motion is: nothing in a log of
places shows it.  So a study states it, and what is fitted or claimed allows for it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from cell.cable.geometry import Motion

FloatArray = NDArray[np.float64]

#: Pieces of constant acceleration error over a motion, and shapes that are left out of the error's
#: variance with less than this share.
_PIECES, _LEAST = 32, 1e-4

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Density = Annotated[float, Field(ge=0.0, le=10.0)]


class HandDriftSection(BaseModel):
    """Entry `hand_drift` of a trial."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    from_s: _Finite
    to_s: _Finite
    noise_m_per_s2_per_rt_hz: tuple[_Density, _Density]
    gain_std: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0
    ends_known: bool = False

    def drift(self) -> HandDrift:
        """As used."""
        return HandDrift(**self.model_dump())


@dataclass(frozen=True)
class HandDrift:
    """Error of a hand's place that grows from 0 while the hand moves, and stays after it.

    The hand is known to be at rest before `from_s` and after `to_s`: the error of its velocity is 0
    there (zero-velocity update).

    noise_m_per_s2_per_rt_hz  (x, y) one-sided density of the acceleration's white noise, m/s²/√Hz
    gain_std    standard deviation of the sensor's sensitivity, as a share of it
    ends_known  the place after the motion is known without error
    """

    from_s: float
    to_s: float
    noise_m_per_s2_per_rt_hz: tuple[float, float]
    gain_std: float = 0.0
    ends_known: bool = False

    def to_plain(self) -> dict[str, Any]:
        """As in a study's file."""
        given = asdict(self)
        return given | {"noise_m_per_s2_per_rt_hz": list(self.noise_m_per_s2_per_rt_hz)}

    def shapes_m(self, t_s: FloatArray, grip: Motion) -> FloatArray:
        """(shapes, T, 2) independent errors of one standard deviation, of x or y each, m."""
        found = []
        for axis, path_m in enumerate((grip.x_m, grip.y_m)):
            shapes = self._of_axis(t_s, grip.t_s, path_m, self.noise_m_per_s2_per_rt_hz[axis])
            both = np.zeros((len(shapes), len(t_s), 2))
            both[..., axis] = shapes
            found.append(both)
        return np.concatenate(found)

    def largest_std_m(self, t_s: FloatArray, xy_m: FloatArray) -> float:
        """Standard deviation of x or y of a path (T, 2), where it is largest, m."""
        grip = Motion(t_s, *np.ascontiguousarray(xy_m.T), np.zeros(len(t_s)))
        variance = np.sum(self.shapes_m(t_s, grip) ** 2, axis=0)
        return float(np.sqrt(variance.max(initial=0.0)))

    def _of_axis(
        self, t_s: FloatArray, log_s: FloatArray, path_m: FloatArray, density: float
    ) -> FloatArray:
        """(shapes, T) of one coordinate: principal components of its covariance."""
        grid_s = np.linspace(self.from_s, self.to_s, 4 * _PIECES + 1)
        moved_m = np.interp(grid_s, log_s, path_m) - np.interp(self.from_s, log_s, path_m)
        errors = np.vstack([self._noise_m(grid_s, density), self.gain_std * moved_m])
        if self.ends_known:
            errors = errors - _along(errors, errors[:, -1])
        _, sizes, shapes = np.linalg.svd(errors, full_matrices=False)
        kept = sizes > np.sqrt(_LEAST) * max(sizes[0], 1e-300)
        at_s = np.clip(t_s, self.from_s, self.to_s)
        rows = [np.interp(at_s, grid_s, row) for row in (sizes[:, None] * shapes)[kept]]
        return np.array(rows).reshape(len(rows), len(t_s))

    def _noise_m(self, grid_s: FloatArray, density: float) -> FloatArray:
        """(pieces, grid) what each piece's acceleration error does, velocity 0 at the end, m."""
        step_s = (self.to_s - self.from_s) / _PIECES
        std = density / np.sqrt(2.0 * step_s)  # of a mean over a piece
        begins_s = self.from_s + step_s * np.arange(_PIECES)
        since_s = np.clip(grid_s - begins_s[:, None], 0.0, None)
        within_s = np.minimum(since_s, step_s)
        place_m = std * within_s * (since_s - 0.5 * within_s)
        return place_m - place_m.mean(axis=0)


def _along(errors: FloatArray, known: FloatArray) -> FloatArray:
    """What independent errors (n, …) share with a sum of them (n,) that is known to be 0."""
    size = float(known @ known)
    return np.outer(known, known @ errors) / size if size > 0.0 else np.zeros_like(errors)
