"""Drift of the gripper's position: an error that the gripper log does not show.

White acceleration noise that is integrated twice is as smooth as a motion.  An encoder at rest
shows a constant count, for all positions within that count.  So a study states such errors, and
fits and verdicts allow for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion
from cell.study.entries import Finite

#: Pieces of constant acceleration error over a motion, and the share of the error's variance below
#: which shapes are dropped.
_PIECES, _LEAST = 32, 1e-4
#: In this share of a motion an encoder's error at rest is no more.
_GONE = 0.1

_Density = Annotated[float, Field(ge=0.0, le=10.0)]


def drift_complaint(drift: HandDrift | None) -> str | None:
    """Complaint that a drift's `to_s` is not after its `from_s`; None if it is."""
    if drift is None or drift.to_s > drift.from_s:
        return None
    message = f"{drift.to_s:g} s is not after from_s, {drift.from_s:g} s; give when the gripper "
    return f"{message}rests again"


@dataclass(frozen=True)
class HandDrift:
    """Error of the gripper's position that its log does not show; entry `hand_drift` of a trial.

    The gripper is known to be at rest before `from_s` and after `to_s`.  An error by acceleration
    grows from 0 in between, its velocity 0 at both ends (zero-velocity update), and stays.  An
    encoder's is constant at either rest.

    noise_m_per_s2_per_rt_hz  (x, y) one-sided density of the acceleration's white noise, m/s²/√Hz
    gain_std    standard deviation of the sensor's sensitivity, as a share of it
    ends_known  the place after the motion is known without error
    turn_std_rad  standard deviation of the turn about `axle_m` at either rest
    clamp_turns  whether the clamp turns with the gripper's arm
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    from_s: Finite
    to_s: Finite
    noise_m_per_s2_per_rt_hz: tuple[_Density, _Density] = (0.0, 0.0)
    gain_std: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0
    ends_known: bool = False
    turn_std_rad: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    axle_m: tuple[Finite, Finite] = (0.0, 0.0)
    clamp_turns: bool = True

    @property
    def sensor(self) -> str:
        """Sensor of the gripper's position."""
        return "encoder" if self.turn_std_rad > 0.0 else "accelerometer"

    def to_plain(self) -> dict[str, Any]:
        """Entry of a study's file, without default values."""
        plain: dict[str, Any] = ENTRY.dump_python(self, mode="json", exclude_defaults=True)
        return plain

    def shapes_m(self, t_s: FloatArray, grip: Motion) -> FloatArray:
        """(shapes, T, 2) independent errors of one standard deviation, of x or y each, m."""
        errors = []
        for axis, path_m in enumerate((grip.x_m, grip.y_m)):
            shapes = self._of_axis(t_s, grip.t_s, path_m, self.noise_m_per_s2_per_rt_hz[axis])
            both = np.zeros((len(shapes), len(t_s), 2))
            both[..., axis] = shapes
            errors.append(both)
        return np.concatenate(errors)

    def turns_rad(self, t_s: FloatArray) -> FloatArray:
        """(shapes, T) independent errors of the turn of one standard deviation each, rad."""
        if self.turn_std_rad == 0.0:
            return np.zeros((0, len(t_s)))
        share = (t_s - self.from_s) / max(self.to_s - self.from_s, 1e-9)
        rests = np.stack([1.0 - share / _GONE, 1.0 - (1.0 - share) / _GONE])
        return self.turn_std_rad * np.clip(rests, 0.0, 1.0)

    def turned_m(self, turn_rad: FloatArray, places_m: FloatArray) -> FloatArray:
        """(…, 2) displacement of places (…, 2) by small turns (…) about the axle."""
        away = places_m - np.array(self.axle_m)
        return np.stack([-away[..., 1] * turn_rad, away[..., 0] * turn_rad], axis=-1)

    def largest_std_m(self, t_s: FloatArray, xy_m: FloatArray) -> float:
        """Standard deviation of x or y of a path (T, 2), where it is largest, m."""
        x_m, y_m = np.ascontiguousarray(xy_m.T)
        grip = Motion(t_s, x_m, y_m, np.zeros(len(t_s)))
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
        retained = sizes > np.sqrt(_LEAST) * max(sizes[0], 1e-300)
        at_s = np.clip(t_s, self.from_s, self.to_s)
        rows = [np.interp(at_s, grid_s, row) for row in (sizes[:, None] * shapes)[retained]]
        return np.array(rows).reshape(len(rows), len(t_s))

    def _noise_m(self, grid_s: FloatArray, density: float) -> FloatArray:
        """(pieces, grid) displacement by each piece's acceleration error, final velocity 0, m."""
        step_s = (self.to_s - self.from_s) / _PIECES
        std = density / np.sqrt(2.0 * step_s)  # of a mean over a piece
        begins_s = self.from_s + step_s * np.arange(_PIECES)
        since_s = np.clip(grid_s - begins_s[:, None], 0.0, None)
        within_s = np.minimum(since_s, step_s)
        place_m = std * within_s * (since_s - 0.5 * within_s)
        return np.asarray(place_m - place_m.mean(axis=0))


#: Reads and writes the entry of a study's file.
ENTRY = TypeAdapter(HandDrift)


def _along(errors: FloatArray, known: FloatArray) -> FloatArray:
    """Projection of independent errors (n, …) onto a sum of them (n,) that is known to be 0."""
    size = float(known @ known)
    return np.outer(known, known @ errors) / size if size > 0.0 else np.zeros_like(errors)
