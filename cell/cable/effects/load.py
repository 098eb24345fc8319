"""What hangs on a cable between its clamp and its tip."""

from __future__ import annotations

from typing import Any

from cell.cable.effects.base import CableData, Effect, Parameter


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
