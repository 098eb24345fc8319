"""Bending that stays."""

from __future__ import annotations

import math
from typing import Any

from cell.cable.effects.base import Bend, CableData, Effect, Parameter


class PlasticSet(Effect):
    """Bent tighter than a radius R the cable keeps a set κ_p: M = −EI κ_p, the moment levels off.

    dκ_p/dκ = (R z)² where κ̇ and z = κ − κ_p have the same sign, else 0; R = 0 = never.
    A cable at rest at the start was bent from straight, once.
    Source: Bouc–Wen with β = γ = ½, n = 2 (Wen, J. Eng. Mech. Div. ASCE 102 (1976) 249), whose
    first loading is z = tanh(R κ)/R.
    """

    name = "plastic_set"
    parameters = (Parameter("radius_m", "m", 0.0, 1.0, 0.0, (0.03, 0.06)),)
    memory = ("set",)
    dissipative = True
    smooth = False

    @staticmethod
    def moment(cable: CableData, at: Bend, m: Any, p: Any) -> float:
        """Bending moment, N·m; the memory is κ_p/R², 1/m³."""
        return float(-at.rigidity * p.radius_m**2 * m.set)

    @staticmethod
    def memory_rate(cable: CableData, at: Bend, m: Any, p: Any) -> tuple[float]:
        """Rate of the memory."""
        z = at.curvature - p.radius_m**2 * m.set
        return (0.5 * (at.rate * z * z + abs(at.rate) * abs(z) * z),)

    @staticmethod
    def memory_at_rest(cable: CableData, at: Bend, p: Any) -> tuple[float]:
        """Memory of a cable bent once."""
        bent = p.radius_m * at.curvature
        if abs(bent) < 1e-2:
            return (at.curvature**3 * (1.0 - 0.4 * bent * bent) / 3.0,)
        return ((at.curvature - math.tanh(bent) / p.radius_m) / p.radius_m**2,)
