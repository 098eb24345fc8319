"""Effects of the grip, and masses on the cable."""

from __future__ import annotations

from typing import Any

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import CableData, Effect, HandMotion, Parameter


class PointMass(Effect):
    """Point mass with weight at a share of the free length: a ferrule, a label, a drop of glue.

    At 1 it is `tip_mass`.
    """

    name = "point_mass"
    parameters = (
        Parameter("mass_kg", "kg", 0.0, 10.0, 0.0, (2.5e-5,)),
        Parameter(
            "place", "1", 0.02, 1.0, 0.6, (0.6,), amplitude=False, scan=(0.3, 0.45, 0.75, 0.9)
        ),
    )

    @staticmethod
    def point_mass(cable: CableData, p: Any) -> tuple[float, float]:
        """Mass, kg, and arc length, m."""
        return float(p.mass_kg), float(p.place * cable.free_length_m)


class TipMass(Effect):
    """Point mass with weight at the tip: a connector, a drop of glue."""

    name = "tip_mass"
    parameters = (Parameter("mass_kg", "kg", 0.0, 10.0, 0.0, (2.5e-5,)),)
    wider = PointMass

    @staticmethod
    def tip_mass(cable: CableData, p: Any) -> float:
        """Mass, kg."""
        return float(p.mass_kg)


class GripAngle(Effect):
    """The cable sits askew between the jaws: clamp angle θ_n + δ."""

    name = "grip_angle"
    parameters = (Parameter("angle_rad", "rad", -0.5, 0.5, 0.0, (0.02, -0.02)),)

    @staticmethod
    def clamp(pose: HandMotion, p: Any) -> Any:
        """True pose against time."""

        def askew(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            x, y, angle = pose(t)
            return x, y, angle + p.angle_rad

        return askew


class GripCompliance(Effect):
    """The jaws give way: at the gripping point the cable turns by φ, φ + τ dφ/dt = c·moment.

    The parameter is the compliance c, so that 0 is a rigid grip; 1/c is the rotational stiffness.
    τ is the retardation time of the jaws' pads (Kelvin–Voigt), 0 for a spring without loss.
    """

    name = "grip_compliance"
    parameters = (
        Parameter("rad_per_n_m", "rad/(N·m)", 0.0, 1e5, 0.0, (100.0,)),
        Parameter("time_s", "s", 0.0, 1.0, 0.01, (0.01, 0.03, 0.1), amplitude=False),
    )

    @staticmethod
    def grip_compliance(cable: CableData, p: Any) -> tuple[float, float]:
        """Compliance, rad/(N·m), and retardation time, s."""
        return float(p.rad_per_n_m), float(p.time_s)


class GripSlip(Effect):
    """The cable slid between the jaws: free length L + δ, points at the same share of it."""

    name = "grip_slip"
    parameters = (Parameter("length_m", "m", -0.05, 0.05, 0.0, (0.001, -0.001)),)

    @staticmethod
    def extra_length(cable: CableData, p: Any) -> float:
        """Added free length, m."""
        return float(p.length_m)
