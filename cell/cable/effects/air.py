"""Still and moving air around the strip."""

from __future__ import annotations

from typing import Any

from cell.cable.effects.base import CableData, Effect, Parameter, Place
from cell.cable.effects.drag import PowerDrag

AIR_DENSITY_KG_PER_M3 = 1.2

#: Drag coefficient of a strip across the wind; it is larger at small amplitudes.
STRIP_DRAG = 2.0


class AirDrag(Effect):
    """½ρ C_d w |v_n| v_n per metre against the normal velocity v_n.

    Source: Keulegan & Carpenter, J. Res. NBS 60 (1958) 423, for plates in oscillating flow.
    """

    name = "air_drag"
    parameters = (Parameter("drag_coefficient", "1", 0.0, 50.0, 0.0, (2.0,)),)
    dissipative = True
    wider = PowerDrag

    @staticmethod
    def force(cable: CableData, at: Place, p: Any) -> tuple[float, float]:
        """Force per metre, N/m."""
        across = at.vy * at.tx - at.vx * at.ty
        f = -0.5 * AIR_DENSITY_KG_PER_M3 * p.drag_coefficient * cable.width_m
        f *= abs(across) * across
        return -f * at.ty, f * at.tx


class LinearAirDrag(Effect):
    """c v_n per metre against the normal velocity v_n: drag of slow or viscous flow."""

    name = "linear_air_drag"
    parameters = (Parameter("drag_n_s_per_m2", "N·s/m²", 0.0, 10.0, 0.0, (0.005,)),)
    dissipative = True
    wider = PowerDrag

    @staticmethod
    def force(cable: CableData, at: Place, p: Any) -> tuple[float, float]:
        """Force per metre, N/m."""
        f = -p.drag_n_s_per_m2 * (at.vy * at.tx - at.vx * at.ty)
        return -f * at.ty, f * at.tx


class AddedMass(Effect):
    """Air carried along by the strip: inertia per metre without weight, π/4·ρ w² in theory.

    `along` is the share that also resists motion along the strip: 0 for a flat plate in an ideal
    fluid, 1 for what clings to the cable; the measured studies at hand show 1.
    Source: Brennen, A Review of Added Mass and Fluid Inertial Forces, 1982, table of flat plates.
    """

    name = "added_mass"
    parameters = (
        Parameter("kg_per_m", "kg/m", 0.0, 1.0, 0.0, (0.00025,)),
        Parameter("along", "1", 0.0, 1.0, 1.0, (1.0,), amplitude=False, fitted=False),
    )

    @staticmethod
    def inertia(cable: CableData, p: Any) -> tuple[float, float]:
        """Inertia along and normal, kg/m."""
        return p.along * p.kg_per_m, p.kg_per_m


class CrossFlow(Effect):
    """Quadratic drag in a steady wind less that in still air, C_d = 2: zero without wind.

    Beside `air_drag` the two add up to drag against the relative velocity.
    """

    name = "draught"
    parameters = (
        Parameter("wind_x_m_per_s", "m/s", -10.0, 10.0, 0.0, (0.1, -0.1)),
        Parameter("wind_y_m_per_s", "m/s", -10.0, 10.0, 0.0, (0.1, -0.1)),
    )

    @staticmethod
    def force(cable: CableData, at: Place, p: Any) -> tuple[float, float]:
        """Force per metre, N/m."""
        still = at.vy * at.tx - at.vx * at.ty
        blown = still - (p.wind_y_m_per_s * at.tx - p.wind_x_m_per_s * at.ty)
        f = -0.5 * AIR_DENSITY_KG_PER_M3 * STRIP_DRAG * cable.width_m
        f *= abs(blown) * blown - abs(still) * still
        return -f * at.ty, f * at.tx
