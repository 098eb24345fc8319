"""Forces and moments that physics admits, as text: single effects to try, or one file to keep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cell.cable.effects.base import Parameter

#: Distance at which a point's pull is stated, m.
REFERENCE_DISTANCE_M = 0.05


@dataclass(frozen=True)
class Term:
    """One law.

    hook         "force" (adds to fx, fy, N/m) or "moment" (adds to moment, N·m)
    law          for the docstring
    lines        Python that uses `at`, `p`, `cable`
    dissipative  whether it can only take energy out
    """

    name: str
    hook: str
    law: str
    numbers: tuple[Parameter, ...]
    lines: tuple[str, ...]
    dissipative: bool = False


def admissible(box_m: tuple[float, float, float, float]) -> tuple[Term, ...]:
    """Terms that respect symmetry and dissipation.

    box_m  x low, x high, y low, y high of where the cable has been seen, m

    Fields depend on the place only and derive from a potential; drags oppose the velocity they
    depend on; bending terms are odd in curvature and its rate, so that turning the strip over
    changes nothing.
    """

    return (*_forces(box_m), *_moments())


def _one(name: str, unit: str, typical: float, positive: bool = False) -> Parameter:
    low = 0.0 if positive else -1e4 * typical
    return Parameter(name, unit, low, 1e4 * typical, 0.0, (typical,))


def _forces(box_m: tuple[float, float, float, float]) -> tuple[Term, ...]:
    """Terms of force per metre."""
    return (
        Term(
            "constant_field",
            "force",
            "constant force (a, b) per metre",
            (_one("field_x", "N/m", 1e-3), _one("field_y", "N/m", 1e-3)),
            ("fx += p.field_x", "fy += p.field_y"),
        ),
        Term(
            "gradient_field",
            "force",
            "linear force field from the potential −(a x²/2 + b x y + c y²/2) per metre",
            (
                _one("slope_xx", "N/m²", 1e-2),
                _one("slope_xy", "N/m²", 1e-2),
                _one("slope_yy", "N/m²", 1e-2),
            ),
            (
                "fx += p.slope_xx * at.x + p.slope_xy * at.y",
                "fy += p.slope_xy * at.x + p.slope_yy * at.y",
            ),
        ),
        Term(
            "spring",
            "force",
            "force (a − k x, b − k y) per metre, that of a spring to a point, weighted along the "
            "cable as (m + 1)(s/L)^m",
            (
                _one("spring_x", "N/m", 1e-3),
                _one("spring_y", "N/m", 1e-3),
                _one("stiffness", "N/m²", 1e-2),
                Parameter("share", "1", 0.01, 50.0, 0.05, (0.05, 2.0, 8.0), amplitude=False),
            ),
            (
                "part = (p.share + 1.0) * (at.arc_length / cable.free_length_m) ** p.share",
                "fx += part * (p.spring_x - p.stiffness * at.x)",
                "fy += part * (p.spring_y - p.stiffness * at.y)",
            ),
        ),
        _attractor(box_m),
        Term(
            "drag_along",
            "force",
            "drag c v_t per metre along the cable",
            (_one("drag_along", "N·s/m²", 5e-3, True),),
            (
                "along = at.vx * at.tx + at.vy * at.ty",
                "fx -= p.drag_along * along * at.tx",
                "fy -= p.drag_along * along * at.ty",
            ),
            True,
        ),
        Term(
            "drag_cubic",
            "force",
            "drag c v_n³ per metre across the cable",
            (_one("drag_cubic", "N·s³/m⁴", 5e-3, True),),
            (
                "across = at.vy * at.tx - at.vx * at.ty",
                "fx += p.drag_cubic * across**3 * at.ty",
                "fy -= p.drag_cubic * across**3 * at.tx",
            ),
            True,
        ),
    )


def _moments() -> tuple[Term, ...]:
    """Terms of bending moment."""
    return (
        Term(
            "cubic_bending",
            "moment",
            "moment EI b κ³",
            (_one("cubic", "m²", 1e-4),),
            ("moment += p.cubic * at.rigidity * at.curvature**3",),
        ),
        Term(
            "dry_bending",
            "moment",
            "moment M κ̇/√(κ̇² + r²): friction without memory",
            (
                _one("dry_moment", "N·m", 1e-6, True),
                Parameter("dry_rate", "1/(m·s)", 0.1, 100.0, 5.0, (5.0,), amplitude=False),
            ),
            ("moment += p.dry_moment * at.rate / (at.rate**2 + p.dry_rate**2) ** 0.5",),
            True,
        ),
        Term(
            "curved_viscosity",
            "moment",
            "moment C κ² κ̇: viscosity that grows with curvature",
            (_one("curved_viscosity", "N·m⁴·s", 1e-9, True),),
            ("moment += p.curved_viscosity * at.curvature**2 * at.rate",),
            True,
        ),
        Term(
            "quadratic_viscosity",
            "moment",
            "moment C |κ̇| κ̇",
            (_one("quadratic_viscosity", "N·m³·s²", 1e-9, True),),
            ("moment += p.quadratic_viscosity * abs(at.rate) * at.rate",),
            True,
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
        "force",
        f"pull towards a point, k (d/r) (r₀/r)^n per metre, r² = |d|² + core², "
        f"r₀ = {REFERENCE_DISTANCE_M:g} m, weighted along the cable as (m + 1)(s/L)^m",
        (
            Parameter("pull", "N/m", -100.0, 100.0, 0.0, (1e-2,)),
            Parameter("point_x_m", "m", *limits[0], middle[0], places[0], amplitude=False),
            Parameter("point_y_m", "m", *limits[1], middle[1], places[1], amplitude=False),
            Parameter("fall_off", "1", 0.5, 8.0, 2.0, (2.0,), amplitude=False),
            Parameter("core_m", "m", 1e-3, 0.1, 0.01, (0.01,), amplitude=False),
            Parameter("focus", "1", 0.01, 50.0, 0.05, (0.05, 8.0), amplitude=False),
        ),
        (
            "dx = p.point_x_m - at.x",
            "dy = p.point_y_m - at.y",
            "r = (dx * dx + dy * dy + p.core_m**2) ** 0.5",
            "weight = (p.focus + 1.0) * (at.arc_length / cable.free_length_m) ** p.focus",
            f"pull = p.pull * weight * ({REFERENCE_DISTANCE_M:g} / r) ** p.fall_off / r",
            "fx += pull * dx",
            "fy += pull * dy",
        ),
    )


def effect_source(
    name: str, terms: Sequence[Term], about: str, values: Mapping[str, float] | None = None
) -> str:
    """Python file with one effect made of terms.

    values  found: amplitudes start there, other parameters have them as defaults
    """
    known = values or {}
    numbers = [_at(n, known) for term in terms for n in term.numbers]
    laws = "\n".join(f"    {t.law[0].upper()}{t.law[1:]}." for t in terms)
    parameters = "\n".join(
        f"        Parameter({n.name!r}, {n.unit!r}, {n.low:.6g}, {n.high:.6g}, {n.default:.8g}, "
        f"({', '.join(f'{s:.8g}' for s in n.starts)},), amplitude={n.amplitude}),"
        for n in numbers
    )
    hooks = "".join(
        _hook(kind, [t for t in terms if t.hook == kind])
        for kind in ("force", "moment")
        if any(t.hook == kind for t in terms)
    )
    title = "".join(part.title() for part in name.split("_"))
    return (
        f'"""{about}"""\n\n'
        "from cell.cable.effects import Effect, Parameter\n\n\n"
        f'class {title}(Effect):\n    """{about}\n\n{laws}\n    """\n\n'
        f"    name = {name!r}\n"
        f"    parameters = (\n{parameters}\n    )\n"
        f"    dissipative = {all(t.dissipative for t in terms)}\n{hooks}"
    )


def _hook(kind: str, terms: Sequence[Term]) -> str:
    head, start, end = {
        "force": ("force(cable, at, p)", "fx, fy = 0.0, 0.0", "return fx, fy"),
        "moment": ("moment(cable, at, m, p)", "moment = 0.0", "return moment"),
    }[kind]
    body = [start, *(line for t in terms for line in t.lines), end]
    return f"\n    @staticmethod\n    def {head}:\n" + "".join(f"        {b}\n" for b in body)


def _at(number: Parameter, values: Mapping[str, float]) -> Parameter:
    if number.name not in values:
        return number
    value = min(max(values[number.name], number.low), number.high)
    if number.amplitude:
        return replace(number, starts=(value if value != 0.0 else number.starts[0],))
    return replace(number, default=value, starts=(value,))
