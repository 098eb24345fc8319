"""Whether a measured force can be of its trial: a force is the rate of momentum, whatever bends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.study.data import Trial, WrenchSensor

#: Where this share of what twice the integral of a force shows is the motion's, it is judged …
_SHOWN = 0.8
#: … by the factor that it has over what hand, markers and masses ask for: told beyond these, …
_TOLD = (0.5, 2.0)
#: … and refused beyond these.
_REFUSED = (-1.0 / 3.0, 30.0)
#: The cable's end is at most so many times as far from the hand as its outermost marker.
_FARTHER = 4.0


@dataclass(frozen=True)
class ForceFactor:
    """The measured force over that which moves the masses: about 1.

    column   of the file, of the axis that moves most
    refused  whether it cannot be
    """

    column: str
    factor: float
    refused: bool

    @property
    def cause(self) -> str:
        """What may be wrong, and its remedy."""
        said = f"is {self.factor:.2g} times what moves cable and tool as hand and markers show"
        if self.factor < 0.0:
            return (
                f"{said}, limit {_REFUSED[0]:.2g}: it points the other way; give the force that "
                "hand and clamp exert on the cable, which at rest points up"
            )
        if self.factor > 1.0:
            limit = _REFUSED[1] if self.refused else _TOLD[1]
            return (
                f"{said}, limit {limit:g}; give N, not mN, and the mass that the sensor carries "
                "as wrench.tool in study.yaml"
            )
        return (
            f"{said}, limit {_TOLD[0]:g}; see whether it is in N, on the clock of grip.csv, and "
            "whether wrench.tool and the cable's line density are right"
        )


def force_factor(
    trial: Trial, cable: Cable, outermost_m: float, sensor: WrenchSensor
) -> ForceFactor | None:
    """Of a trial's force; None where it is as it should be, or shows too little to tell.

    Twice integrated it is mass times the way of the centre of mass, beside a parabola by weight and
    tare.  That centre is roughly in the middle between the hand and where a straight cable through
    the outermost marker would end.

    outermost_m  arc length of that marker
    """
    if trial.wrench is None or trial.start != "equilibrium" or sensor.gauge.turns:
        return None
    t_s, way = trial.wrench.t_s, _way(trial, cable, outermost_m, sensor)
    judged = []
    for axis, column in enumerate(("force_x_n", "force_y_n")):
        force = trial.wrench.values[:, axis]
        seen = np.isfinite(force) & np.isfinite(way[:, axis])
        if np.count_nonzero(seen) > 8 and np.ptp(way[seen, axis]) > 0.0:
            factor, shown = _factor(t_s[seen], force[seen], way[seen, axis])
            if shown > _SHOWN:
                judged.append((float(np.ptp(way[seen, axis])), column, factor))
    if not judged:
        return None
    _, column, factor = max(judged)
    if _TOLD[0] <= factor <= _TOLD[1]:
        return None
    return ForceFactor(column, factor, not _REFUSED[0] <= factor <= _REFUSED[1])


def _factor(t_s: FloatArray, force: FloatArray, way: FloatArray) -> tuple[float, float]:
    """Of the force over what the way (n,), kg·m, asks for, and the share of it that is so."""
    steps = np.diff(t_s)
    force = force - force.mean()
    impulse = np.concatenate([[0.0], np.cumsum(0.5 * steps * (force[1:] + force[:-1]))])
    twice = np.concatenate([[0.0], np.cumsum(0.5 * steps * (impulse[1:] + impulse[:-1]))])
    parabola = np.linalg.qr(np.vander((t_s - t_s[0]) / (t_s[-1] - t_s[0]), 3))[0]
    left = [v - parabola @ (parabola.T @ v) for v in (twice, way)]
    factor = float(left[0] @ left[1]) / max(float(left[1] @ left[1]), 1e-300)
    power = max(float(left[0] @ left[0]), 1e-300)
    return factor, factor**2 * float(left[1] @ left[1]) / power


def _way(trial: Trial, cable: Cable, outermost_m: float, sensor: WrenchSensor) -> FloatArray:
    """(T, 2) mass times place of all that is moved, at the times of the wrench, kg·m."""
    assert trial.wrench is not None
    t_s, grip, markers = trial.wrench.t_s, trial.grip, trial.markers
    hand = np.column_stack([np.interp(t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])
    outermost = np.full(hand.shape, np.nan)
    for axis, series in enumerate(markers.xy_m[:, 0].T):
        seen = np.isfinite(series)
        if seen.any():
            inside = (t_s >= markers.t_s[0]) & (t_s <= markers.t_s[-1])
            along = np.interp(t_s, markers.t_s[seen], series[seen])
            outermost[:, axis] = np.where(inside, along, np.nan)
    mass_kg = cable.line_density_kg_per_m * cable.free_length_m
    at_end_kg = cable.connector.mass_kg if cable.connector else 0.0
    end = hand + (outermost - hand) * min(cable.length_m / max(outermost_m, 1e-9), _FARTHER)
    held = (0.5 * mass_kg + sensor.gauge.tool.mass_kg) * hand
    return np.asarray(held + (0.5 * mass_kg + at_end_kg) * end)
