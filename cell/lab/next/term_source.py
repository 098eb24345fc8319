"""The source of a file with an effect that is a sum of terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from cell.cable.effects.base import Parameter
from cell.lab.next.terms import Term


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
