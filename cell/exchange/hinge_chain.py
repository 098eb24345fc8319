"""A chain of hinges with springs, as numbers: what a file of another program says of a cable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Spring:
    """Of one hinge: a D + b D² + c D³ beyond a dead band, D in rad from it; moments in N·m.

    low_rad, high_rad  ends of the dead band, from the bend free of load
    """

    low_rad: float
    high_rad: float
    coefficients: tuple[float, float, float]

    def __call__(self, angle_rad: FloatArray) -> FloatArray:
        """Moment that turns the hinge back, N·m, at bends from that free of load, rad."""
        d = np.where(
            angle_rad > self.high_rad,
            angle_rad - self.high_rad,
            np.minimum(angle_rad - self.low_rad, 0.0),
        )
        a, b, c = self.coefficients
        return np.asarray(d * (a + d * (b + d * c)))


@dataclass(frozen=True, eq=False)
class HingeChain:
    """What a file says of a chain of n hinges.  SI units; arc lengths from the clamp.

    length_m            of the cable
    arc_length_m        (n,) of the hinges
    curvature_length_m  (n,) bend over curvature
    springs             of every hinge
    rest_rad            (n,) bends free of load
    damping_n_m_s       (n,)
    density_kg_per_m    that has weight
    lines               (n,) where the hinges stand in the file
    notes               what of the file is not read
    """

    length_m: float
    arc_length_m: FloatArray
    curvature_length_m: FloatArray
    springs: tuple[tuple[Spring, ...], ...]
    rest_rad: FloatArray
    damping_n_m_s: FloatArray
    density_kg_per_m: float
    width_m: float
    thickness_m: float
    gravity_m_per_s2: float
    lines: tuple[int, ...]
    notes: tuple[str, ...]
