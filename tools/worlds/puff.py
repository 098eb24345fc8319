"""A draught that begins at a moment: an effect of worlds alone, which no model knows."""

# mypy: ignore-errors

from __future__ import annotations

from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3, STRIP_DRAG
from cell.cable.effects.base import Effect, Parameter


class Puff(Effect):
    """As `draught`, from `begin_s` on; it rises within 50 ms."""

    name = "puff"
    parameters = (
        Parameter("wind_x_m_per_s", "m/s", -10.0, 10.0, 0.0, (0.5,)),
        Parameter("wind_y_m_per_s", "m/s", -10.0, 10.0, 0.0, (0.5,)),
        Parameter("begin_s", "s", 0.0, 100.0, 0.0, (0.0,), amplitude=False, fitted=False),
    )

    @staticmethod
    def force(cable, at, p):
        """Force per metre, N/m."""
        u = min(max((at.time - p.begin_s) / 0.05, 0.0), 1.0)
        still = at.vy * at.tx - at.vx * at.ty
        blown = still - u * (p.wind_y_m_per_s * at.tx - p.wind_x_m_per_s * at.ty)
        f = -0.5 * AIR_DENSITY_KG_PER_M3 * STRIP_DRAG * cable.width_m
        f *= abs(blown) * blown - abs(still) * still
        return -f * at.ty, f * at.tx
