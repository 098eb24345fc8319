"""Laws that are not in the library, to be hidden in a world; typical values shift the tip.

The search terms for the last four of the ten were designed with these laws in mind; the laws of
LATER were invented after all terms.
"""

# mypy: ignore-errors

from __future__ import annotations

import math

from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3, STRIP_DRAG
from cell.cable.effects.base import Effect, Parameter


def _amplitude(name: str, unit: str, typical: float) -> tuple[Parameter, ...]:
    return (Parameter(name, unit, -1e3 * typical, 1e3 * typical, 0.0, (typical,)),)


class Magnet(Effect):
    name = "magnet"
    parameters = _amplitude("pull", "N/m", 4e-3)

    @staticmethod
    def force(cable, at, p):
        dx, dy = -0.15 - at.x, -0.02 - at.y
        square = dx * dx + dy * dy + 1e-4
        pull = p.pull * 0.0025 / (square * math.sqrt(square))
        return pull * dx, pull * dy


class CubicDrag(Effect):
    name = "cubic_drag"
    parameters = _amplitude("drag", "N·s³/m⁴", 0.06)

    @staticmethod
    def force(cable, at, p):
        across = at.vy * at.tx - at.vx * at.ty
        return p.drag * across**3 * at.ty, -p.drag * across**3 * at.tx


class DragAlong(Effect):
    name = "drag_along_the_cable"
    parameters = _amplitude("drag", "N·s/m²", 0.02)

    @staticmethod
    def force(cable, at, p):
        along = at.vx * at.tx + at.vy * at.ty
        return -p.drag * along * at.tx, -p.drag * along * at.ty


class CubicBending(Effect):
    name = "stiffening"
    parameters = _amplitude("cubic", "m²", 2e-4)

    @staticmethod
    def moment(cable, at, m, p):
        return p.cubic * at.rigidity * at.curvature**3


class QuadraticViscosity(Effect):
    name = "thick_viscosity"
    parameters = _amplitude("viscosity", "N·m³·s²", 1e-9)

    @staticmethod
    def moment(cable, at, m, p):
        return p.viscosity * abs(at.rate) * at.rate


class Tether(Effect):
    """Springs that pull mostly the last third of the cable to a fixed point."""

    name = "tether"
    parameters = _amplitude("stiffness", "N/m²", 0.1)

    @staticmethod
    def force(cable, at, p):
        s = at.arc_length / cable.free_length_m
        weight = p.stiffness * s**6
        return weight * (-0.08 - at.x), weight * (-0.15 - at.y)


class Lift(Effect):
    """Lift force: across the velocity of a piece of cable, by the square of its speed."""

    name = "lift"
    parameters = _amplitude("lift", "N·s²/m³", 0.02)

    @staticmethod
    def force(cable, at, p):
        speed = math.sqrt(at.vx * at.vx + at.vy * at.vy)
        return -p.lift * speed * at.vy, p.lift * speed * at.vx


class WindWithHeight(Effect):
    """Drag in horizontal wind that is proportional to the depth."""

    name = "wind_with_height"
    parameters = _amplitude("drag", "N·s²/m³", 0.015)

    @staticmethod
    def force(cable, at, p):
        vx, vy = at.vx - 4.0 * at.y, at.vy
        across = vy * at.tx - vx * at.ty
        size = p.drag * abs(across) * across
        return size * at.ty, -size * at.tx


class Shaking(Effect):
    """Force of a table that shakes at 5 Hz together with the camera."""

    name = "shaking"
    parameters = _amplitude("force", "N/m", 3e-3)

    @staticmethod
    def force(cable, at, p):
        return p.force * math.sin(2.0 * math.pi * 5.0 * at.time), 0.0


class SpeedyStiffness(Effect):
    """Moment against bending, proportional to the third power of its rate."""

    name = "sudden_stiffness"
    parameters = _amplitude("moment", "N·m⁴·s³", 1e-11)

    @staticmethod
    def moment(cable, at, m, p):
        return p.moment * at.rate**3


class DragBetween(Effect):
    """Drag across the cable with exponent 1.5, between viscous and turbulent."""

    name = "drag_between"
    parameters = _amplitude("drag", "N·s^1.5/m^2.5", 0.015)

    @staticmethod
    def force(cable, at, p):
        across = at.vy * at.tx - at.vx * at.ty
        size = p.drag * math.sqrt(abs(across)) * across
        return size * at.ty, -size * at.tx


class SpinningLift(Effect):
    """Magnus force: across the velocity of a piece of cable that turns, as of a ball with spin."""

    name = "spinning_lift"
    parameters = _amplitude("lift", "N·s²/m²", 7e-4)

    @staticmethod
    def force(cable, at, p):
        return -p.lift * at.spin * at.vy, p.lift * at.spin * at.vx


class IncidenceLift(Effect):
    """Lift of a plate at a small angle of incidence."""

    name = "incidence_lift"
    parameters = _amplitude("lift", "N·s²/m³", 0.02)

    @staticmethod
    def force(cable, at, p):
        along, across = at.vx * at.tx + at.vy * at.ty, at.vy * at.tx - at.vx * at.ty
        size = p.lift * along * across
        return -size * at.ty, size * at.tx


class Jet(Effect):
    """Drag in horizontal wind that is proportional to the square of the depth."""

    name = "jet"
    parameters = _amplitude("drag", "N·s²/m³", 0.015)

    @staticmethod
    def force(cable, at, p):
        vx, vy = at.vx + 50.0 * at.y * at.y, at.vy
        across = vy * at.tx - vx * at.ty
        size = p.drag * abs(across) * across
        return size * at.ty, -size * at.tx


class TwoSlopes(Effect):
    """Bending stiffer by a share beyond a threshold of curvature."""

    name = "two_slopes"
    parameters = _amplitude("share", "1", 0.15)

    @staticmethod
    def moment(cable, at, m, p):
        beyond = max(abs(at.curvature) - 6.0, 0.0)
        return p.share * at.rigidity * math.copysign(beyond, at.curvature)


class Puff(Effect):
    """As `draught`, from `begin_s` on, rising within 50 ms; only in worlds, never to be found."""

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


LATER = ("drag_between", "spinning_lift", "incidence_lift", "jet", "two_slopes")

LAWS: dict[str, type[Effect]] = {
    law.name: law
    for law in (
        Magnet, CubicDrag, DragAlong, CubicBending, QuadraticViscosity,
        Tether, Lift, WindWithHeight, Shaking, SpeedyStiffness,
        DragBetween, SpinningLift, IncidenceLift, Jet, TwoSlopes,
    )
}  # fmt: skip
