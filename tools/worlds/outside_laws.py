"""Laws outside the library, to be hidden in a world; typical values shift the tip.

The search terms for the last four of the ten were designed with these laws in mind; the laws of
LATER were invented after all terms.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3, STRIP_DRAG
from cell.cable.effects.base import Effect, Parameter

LAWS: dict[str, type[Effect]] = {}


def law(parameter: str, unit: str, typical: float) -> Callable[[Callable], type[Effect]]:
    """Make an effect of its hook: `force`, or `moment`, which also gets the memory."""

    def made(hook: Callable) -> type[Effect]:
        name, kind = hook.__name__, "moment" if hook.__code__.co_argcount == 4 else "force"
        amplitude = Parameter(parameter, unit, -1e3 * typical, 1e3 * typical, 0.0, (typical,))
        of = {"name": name, "parameters": (amplitude,), kind: staticmethod(hook)}
        LAWS[name] = type(name, (Effect,), {**of, "__module__": __name__})
        return LAWS[name]

    return made


@law("pull", "N/m", 4e-3)
def magnet(cable, at, p):
    dx, dy = -0.15 - at.x, -0.02 - at.y
    square = dx * dx + dy * dy + 1e-4
    pull = p.pull * 0.0025 / (square * math.sqrt(square))
    return pull * dx, pull * dy


@law("drag", "N·s³/m⁴", 0.06)
def cubic_drag(cable, at, p):
    across = at.vy * at.tx - at.vx * at.ty
    return p.drag * across**3 * at.ty, -p.drag * across**3 * at.tx


@law("drag", "N·s/m²", 0.02)
def drag_along_the_cable(cable, at, p):
    along = at.vx * at.tx + at.vy * at.ty
    return -p.drag * along * at.tx, -p.drag * along * at.ty


@law("cubic", "m²", 2e-4)
def stiffening(cable, at, m, p):
    return p.cubic * at.rigidity * at.curvature**3


@law("viscosity", "N·m³·s²", 1e-9)
def thick_viscosity(cable, at, m, p):
    return p.viscosity * abs(at.rate) * at.rate


@law("stiffness", "N/m²", 0.1)
def tether(cable, at, p):
    """Springs that pull mostly the last third of the cable to a fixed point."""
    s = at.arc_length / cable.free_length_m
    weight = p.stiffness * s**6
    return weight * (-0.08 - at.x), weight * (-0.15 - at.y)


@law("lift", "N·s²/m³", 0.02)
def lift(cable, at, p):
    """Lift force: across the velocity of a piece of cable, by the square of its speed."""
    speed = math.sqrt(at.vx * at.vx + at.vy * at.vy)
    return -p.lift * speed * at.vy, p.lift * speed * at.vx


@law("drag", "N·s²/m³", 0.015)
def wind_with_height(cable, at, p):
    """Drag in horizontal wind that is proportional to the depth."""
    vx, vy = at.vx - 4.0 * at.y, at.vy
    across = vy * at.tx - vx * at.ty
    size = p.drag * abs(across) * across
    return size * at.ty, -size * at.tx


@law("force", "N/m", 3e-3)
def shaking(cable, at, p):
    """Force of a table that shakes at 5 Hz together with the camera."""
    return p.force * math.sin(2.0 * math.pi * 5.0 * at.time), 0.0


@law("moment", "N·m⁴·s³", 1e-11)
def sudden_stiffness(cable, at, m, p):
    """Moment against bending, proportional to the third power of its rate."""
    return p.moment * at.rate**3


@law("drag", "N·s^1.5/m^2.5", 0.015)
def drag_between(cable, at, p):
    """Drag across the cable with exponent 1.5, between viscous and turbulent."""
    across = at.vy * at.tx - at.vx * at.ty
    size = p.drag * math.sqrt(abs(across)) * across
    return size * at.ty, -size * at.tx


@law("lift", "N·s²/m²", 7e-4)
def spinning_lift(cable, at, p):
    """Magnus force: across the velocity of a piece of cable that turns, as of a ball with spin."""
    return -p.lift * at.spin * at.vy, p.lift * at.spin * at.vx


@law("lift", "N·s²/m³", 0.02)
def incidence_lift(cable, at, p):
    """Lift of a plate at a small angle of incidence."""
    along, across = at.vx * at.tx + at.vy * at.ty, at.vy * at.tx - at.vx * at.ty
    size = p.lift * along * across
    return -size * at.ty, size * at.tx


@law("drag", "N·s²/m³", 0.015)
def jet(cable, at, p):
    """Drag in horizontal wind that is proportional to the square of the depth."""
    vx, vy = at.vx + 50.0 * at.y * at.y, at.vy
    across = vy * at.tx - vx * at.ty
    size = p.drag * abs(across) * across
    return size * at.ty, -size * at.tx


@law("share", "1", 0.15)
def two_slopes(cable, at, m, p):
    """Bending stiffer by a share beyond a threshold of curvature."""
    beyond = max(abs(at.curvature) - 6.0, 0.0)
    return p.share * at.rigidity * math.copysign(beyond, at.curvature)


class Puff(Effect):
    """As `draught`, from `begin_s` on, rising within 50 ms; only in worlds, no candidate."""

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
