"""Effects that are only looked for where they are named."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Bend, CableData, Effect, Parameter, Place


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


class LensPerspective(Effect):
    """The cable's plane is tilted to the picture: all is narrower, what is further away is smaller.

    `turn_rad` about the vertical through the picture's centre, positive = right side further away;
    `nod_rad` about the level, positive = top further away.  A pinhole at `distance_m` calibrated
    for a plane that is not tilted.  Source: Hartley & Zisserman, Multiple View Geometry, 2004,
    ch. 6.
    """

    name = "lens_perspective"
    parameters = (
        Parameter("turn_rad", "rad", -0.5, 0.5, 0.0, (0.05, -0.05)),
        Parameter("nod_rad", "rad", -0.5, 0.5, 0.0, (0.05, -0.05)),
        Parameter("distance_m", "m", 0.05, 100.0, 0.5, (0.5,), amplitude=False, fitted=False),
        Parameter("centre_x_m", "m", -10.0, 10.0, -0.05, (-0.05,), amplitude=False, fitted=False),
        Parameter("centre_y_m", "m", -10.0, 10.0, -0.03, (-0.03,), amplitude=False, fitted=False),
    )

    @staticmethod
    def camera_points(cable: CableData, xy: FloatArray, p: Any) -> FloatArray:
        """Points as seen, m."""
        x, y = xy[..., 0] - p.centre_x_m, xy[..., 1] - p.centre_y_m
        across, up = x * np.cos(p.turn_rad), y * np.cos(p.nod_rad)
        up = up - x * np.sin(p.turn_rad) * np.sin(p.nod_rad)
        deep = x * np.sin(p.turn_rad) * np.cos(p.nod_rad) + y * np.sin(p.nod_rad)
        nearer = p.distance_m / (p.distance_m + deep)
        return np.stack([p.centre_x_m + nearer * across, p.centre_y_m + nearer * up], axis=-1)


#: Places along the cable, evenly spaced from end to end.
_PLACES = 6


class RestShape(Effect):
    """Rest shape of any kind: κ₀(s) piecewise linear, free at evenly spaced places."""

    name = "rest_shape"
    parameters = tuple(
        Parameter(f"curvature_{i}_1_per_m", "1/m", -100.0, 100.0, 0.0, (1.0,))
        for i in range(_PLACES)
    )

    @staticmethod
    def rest_curvature(cable: CableData, arc_length: FloatArray, p: Any) -> FloatArray:
        """Curvature free of load, 1/m."""
        place = np.asarray(arc_length) / cable.free_length_m * (_PLACES - 1)
        curvature = np.zeros_like(place)
        for i in range(_PLACES):
            near = np.clip(1.0 - np.abs(place - i), 0.0, None)
            curvature += getattr(p, f"curvature_{i}_1_per_m") * near
        return curvature


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
