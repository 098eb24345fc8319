"""Physically admissible force and moment laws as source text, for single effects or one file."""

from __future__ import annotations

from dataclasses import dataclass

from cell.cable.effects.base import Parameter

#: Reference distance of a point's pull, m.
REFERENCE_DISTANCE_M = 0.05
#: Reference speed, m/s, curvature, 1/m, and its rate, 1/(m·s), of nonlinear laws: their size then
#: does not depend on their shape.
REFERENCE_SPEED, REFERENCE_CURVATURE, REFERENCE_RATE = 0.5, 10.0, 30.0
#: Powers below one are rounded within these shares of the reference.
ROUNDED = 2e-3
#: Near the jaw weights are rounded within this share of the length: negative powers are finite.
NEAR_JAW = 0.02
#: Prefix of the names of effects with a single term; no effect of the library has it.
NAMESPACE = "law_"
_WEIGHTED = "weighted along the cable as (s/L)^m, of which c = (m + 1)/(m + 2) is the mean place"


@dataclass(frozen=True)
class Term:
    """One force or moment law, as source text.

    law          for the docstring
    lines        Python that uses `at`, `p`, `cable`
    dissipative  whether it can only take energy out
    hook         "force" (adds to fx, fy, N/m) or "moment" (adds to moment, N·m)
    """

    name: str
    law: str
    numbers: tuple[Parameter, ...]
    lines: tuple[str, ...]
    dissipative: bool = False
    hook: str = "force"

    @property
    def effect(self) -> str:
        """Name of the effect that is this term alone."""
        return f"{NAMESPACE}{self.name}"


def admissible(box_m: tuple[float, float, float, float]) -> tuple[Term, ...]:
    """Terms that respect symmetry and dissipation.

    box_m  bounding box of the observed cable: x low, x high, y low, y high, m

    Fields depend on the place only and derive from a potential; drags oppose the velocity they
    depend on, in moving air the velocity relative to it; lifts do no work; bending terms are odd
    in curvature and its rate, so that turning the strip over changes nothing.
    """

    return (
        *_fields(box_m),
        *_drags(),
        *_lifts(),
        _sheared_wind(box_m),
        *_moments(),
        *_viscosities(),
    )


def _size(name: str, unit: str, typical: float, positive: bool = False) -> Parameter:
    low = 0.0 if positive else -1e4 * typical
    return Parameter(name, unit, low, 1e4 * typical, 0.0, (typical,))


def _power(name: str, *starts: float) -> Parameter:
    """Exponent of a speed or a rate."""
    return Parameter(name, "1", 0.2, 5.0, starts[0], starts, amplitude=False)


def _centre(name: str, *starts: float) -> Parameter:
    """Mean place of a force along the cable, as a share of its length.

    Its bounds include 0.5, a force that is uniform along the cable.
    """
    return Parameter(name, "1", 0.35, 0.98, starts[0], starts, amplitude=False)


def _weight(centre: str) -> tuple[str, str]:
    """Source lines of `weight`, the relative force at a place of the cable, with mean 1."""
    return (
        f"power = (2.0 * p.{centre} - 1.0) / (1.0 - p.{centre})",
        f"weight = (power + 1.0) * ((at.arc_length / cable.free_length_m) ** 2 + {NEAR_JAW**2:g}) "
        "** (0.5 * power)",
    )


def _fields(box_m: tuple[float, float, float, float]) -> tuple[Term, ...]:
    """Forces per metre that depend on the place."""
    return (
        Term(
            "constant_field",
            "constant force (a, b) per metre",
            (_size("field_x", "N/m", 1e-3), _size("field_y", "N/m", 1e-3)),
            ("fx += p.field_x", "fy += p.field_y"),
        ),
        Term(
            "gradient_field",
            "linear force field from the potential −(a x²/2 + b x y + c y²/2) per metre",
            (
                _size("slope_xx", "N/m²", 1e-2),
                _size("slope_xy", "N/m²", 1e-2),
                _size("slope_yy", "N/m²", 1e-2),
            ),
            (
                "fx += p.slope_xx * at.x + p.slope_xy * at.y",
                "fy += p.slope_xy * at.x + p.slope_yy * at.y",
            ),
        ),
        Term(
            "spring",
            f"force (a − k x, b − k y) per metre, that of a spring to a point, {_WEIGHTED}",
            (
                _size("spring_x", "N/m", 1e-3),
                _size("spring_y", "N/m", 1e-3),
                _size("stiffness", "N/m²", 1e-2),
                _centre("spring_centre", 0.5, 0.75, 0.9),
            ),
            (
                *_weight("spring_centre"),
                "fx += weight * (p.spring_x - p.stiffness * at.x)",
                "fy += weight * (p.spring_y - p.stiffness * at.y)",
            ),
        ),
        _attractor(box_m),
    )


def _drags() -> tuple[Term, ...]:
    """Forces per metre against the velocity."""
    return (
        Term(
            "drag_along",
            "drag c v_t per metre along the cable",
            (_size("drag_along", "N·s/m²", 5e-3, True),),
            (
                "along = at.vx * at.tx + at.vy * at.ty",
                "fx -= p.drag_along * along * at.tx",
                "fy -= p.drag_along * along * at.ty",
            ),
            True,
        ),
        Term(
            "power_drag",
            f"drag c |v_n|^n per metre across the cable, stated at {REFERENCE_SPEED:g} m/s",
            (_size("power_drag", "N/m", 5e-3, True), _power("drag_exponent", 3.0, 1.5, 0.5)),
            (
                f"across = (at.vy * at.tx - at.vx * at.ty) / {REFERENCE_SPEED:g}",
                f"size = (across * across + {ROUNDED**2:g}) ** (0.5 * (p.drag_exponent - 1.0))",
                "fx += p.power_drag * size * across * at.ty",
                "fy -= p.power_drag * size * across * at.tx",
            ),
            True,
        ),
        Term(
            "crossflow_drag",
            "drag c |v_t| v_n per metre across the cable: it grows with the speed along it",
            (_size("crossflow_drag", "N·s²/m³", 1e-2, True),),
            (
                "along = abs(at.vx * at.tx + at.vy * at.ty)",
                "across = at.vy * at.tx - at.vx * at.ty",
                "fx += p.crossflow_drag * along * across * at.ty",
                "fy -= p.crossflow_drag * along * across * at.tx",
            ),
            True,
        ),
    )


def _lifts() -> tuple[Term, ...]:
    """Forces per metre that depend on speed and do no work against it."""
    speed = f"((at.vx * at.vx + at.vy * at.vy) / {REFERENCE_SPEED**2:g} + {ROUNDED**2:g})"
    return (
        Term(
            "lift_across_path",
            f"lift l |v|^n per metre across the velocity, stated at {REFERENCE_SPEED:g} m/s",
            (_size("path_lift", "N/m", 5e-3), _power("path_exponent", 2.0, 1.0)),
            (
                f"size = {speed} ** (0.5 * (p.path_exponent - 1.0)) / {REFERENCE_SPEED:g}",
                "fx -= p.path_lift * size * at.vy",
                "fy += p.path_lift * size * at.vx",
            ),
        ),
        Term(
            "lift_across_cable",
            f"lift l |v|^n per metre to one side of the cable, stated at {REFERENCE_SPEED:g} m/s",
            (_size("side_lift", "N/m", 5e-3), _power("side_exponent", 2.0, 1.0)),
            (
                f"size = {speed} ** (0.5 * p.side_exponent)",
                "fx -= p.side_lift * size * at.ty",
                "fy += p.side_lift * size * at.tx",
            ),
        ),
    )


def _sheared_wind(box_m: tuple[float, float, float, float]) -> Term:
    """Drag in a wind that changes with place."""
    x, y = 0.5 * (box_m[0] + box_m[1]), 0.5 * (box_m[2] + box_m[3])
    winds, shears = (0.0, 0.3, -0.3), (0.0, 4.0, -4.0)
    return Term(
        "sheared_wind",
        "drag c |w| w per metre across the cable, w its velocity in a wind "
        f"(a + b (y − {y:.3g}), c + d (x − {x:.3g}))",
        (
            _size("wind_drag", "N·s²/m³", 1.5e-2, True),
            Parameter("wind_x", "m/s", -5.0, 5.0, 0.0, winds, amplitude=False),
            Parameter("wind_y", "m/s", -5.0, 5.0, 0.0, winds, amplitude=False),
            Parameter("shear_xy", "1/s", -50.0, 50.0, 0.0, shears, amplitude=False),
            Parameter("shear_yx", "1/s", -50.0, 50.0, 0.0, (0.0,), amplitude=False),
        ),
        (
            f"ux = at.vx - p.wind_x - p.shear_xy * (at.y - ({y:.6g}))",
            f"uy = at.vy - p.wind_y - p.shear_yx * (at.x - ({x:.6g}))",
            "across = uy * at.tx - ux * at.ty",
            "size = p.wind_drag * abs(across) * across",
            "fx += size * at.ty",
            "fy -= size * at.tx",
        ),
    )


def _moments() -> tuple[Term, ...]:
    """Terms of bending moment."""
    reference = f"{REFERENCE_CURVATURE**2:g}"
    return (
        Term(
            "curved_stiffness",
            "moment EI b κ · κ²/(1 + u κ²): stiffness that changes with curvature, without end or "
            f"up to a level, stated at {REFERENCE_CURVATURE:g} 1/m",
            (
                Parameter("stiffer", "1", -0.9, 20.0, 0.0, (0.02,)),
                Parameter("levels", "m²", -1e-4, 1.0, 0.0, (0.0, 0.01, 0.1), amplitude=False),
            ),
            (
                "square = at.curvature * at.curvature",
                f"share = square / (1.0 + p.levels * square) * "
                f"(1.0 + p.levels * {reference}) / {reference}",
                "moment += p.stiffer * at.rigidity * at.curvature * share",
            ),
            hook="moment",
        ),
        Term(
            "dry_bending",
            "moment M κ̇/√(κ̇² + r²): friction without memory",
            (
                _size("dry_moment", "N·m", 1e-6, True),
                Parameter("dry_rate", "1/(m·s)", 0.1, 100.0, 5.0, (5.0,), amplitude=False),
            ),
            ("moment += p.dry_moment * at.rate / (at.rate**2 + p.dry_rate**2) ** 0.5",),
            True,
            hook="moment",
        ),
    )


def _viscosities() -> tuple[Term, ...]:
    """Terms of bending moment that are not linear in its rate."""
    return (
        Term(
            "curved_viscosity",
            "moment C κ² κ̇: viscosity that grows with curvature",
            (_size("curved_viscosity", "N·m⁴·s", 1e-9, True),),
            ("moment += p.curved_viscosity * at.curvature**2 * at.rate",),
            True,
            hook="moment",
        ),
        Term(
            "power_viscosity",
            f"moment C |κ̇|^n against the rate, stated at {REFERENCE_RATE:g} 1/(m·s)",
            (_size("power_viscosity", "N·m", 1e-6, True), _power("rate_exponent", 2.0, 3.0, 0.5)),
            (
                f"rate = at.rate / {REFERENCE_RATE:g}",
                f"size = (rate * rate + {ROUNDED**2:g}) ** (0.5 * (p.rate_exponent - 1.0))",
                "moment += p.power_viscosity * size * rate",
            ),
            True,
            hook="moment",
        ),
    )


def _attractor(box_m: tuple[float, float, float, float]) -> Term:
    x0, x1, y0, y1 = box_m
    margin = 0.5 * max(x1 - x0, y1 - y0)
    places = [
        tuple(low - margin + (high - low + 2.0 * margin) * i / 9.0 for i in range(10))
        for low, high in ((x0, x1), (y0, y1))
    ]
    limits = [(p[0] - 4.0 * margin, p[-1] + 4.0 * margin) for p in places]
    middle = (0.5 * (x0 + x1), 0.5 * (y0 + y1))
    return Term(
        "point",
        f"pull towards a point, k (d/r) (r₀/r)^n per metre, r² = |d|² + core², "
        f"r₀ = {REFERENCE_DISTANCE_M:g} m, {_WEIGHTED}",
        (
            Parameter("pull", "N/m", -100.0, 100.0, 0.0, (1e-2,)),
            Parameter("point_x_m", "m", *limits[0], middle[0], places[0], amplitude=False),
            Parameter("point_y_m", "m", *limits[1], middle[1], places[1], amplitude=False),
            Parameter("fall_off", "1", 0.5, 8.0, 2.0, (2.0,), amplitude=False),
            Parameter("core_m", "m", 1e-3, 0.1, 0.01, (0.01,), amplitude=False),
            _centre("pull_centre", 0.5, 0.9),
        ),
        (
            "dx = p.point_x_m - at.x",
            "dy = p.point_y_m - at.y",
            "r = (dx * dx + dy * dy + p.core_m**2) ** 0.5",
            *_weight("pull_centre"),
            f"pull = p.pull * weight * ({REFERENCE_DISTANCE_M:g} / r) ** p.fall_off / r",
            "fx += pull * dx",
            "fy += pull * dy",
        ),
    )
