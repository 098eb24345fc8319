"""Drag of air by any power of the speed."""

from __future__ import annotations

from typing import Any

from cell.cable.effects.base import CableData, Effect, Parameter, Place


class PowerDrag(Effect):
    """c v_n |v_n|^(p − 1) per metre against the normal velocity v_n, c that at 1 m/s.

    Between viscous flow (p = 1) and separated flow (p = 2): a strip of 16 mm at 0.1 to 1 m/s has
    Reynolds numbers of 100 to 1000, where C_d still falls with the speed.
    Source: Hoerner, Fluid-Dynamic Drag, 1965, ch. 3.
    """

    name = "power_drag"
    parameters = (
        Parameter("drag_n_s_per_m2", "N·s/m²", 0.0, 10.0, 0.0, (0.012,)),
        Parameter("power", "1", 1.0, 3.0, 1.5, (1.5,), amplitude=False),
    )
    dissipative = True

    @staticmethod
    def force(cable: CableData, at: Place, p: Any) -> tuple[float, float]:
        """Force per metre, N/m."""
        across = at.vy * at.tx - at.vx * at.ty
        f = -p.drag_n_s_per_m2 * across * abs(across) ** (p.power - 1.0)
        return -f * at.ty, f * at.tx
