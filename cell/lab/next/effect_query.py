"""Effects that a command asks about: amplitude, and size if stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cell.cable.effects.base import ActiveEffect, Effect, Parameter, after_number
from cell.lab.data.named_effects import EffectSelection, effect_named, select_effects
from cell.lab.fit.sensitivity import is_shape


@dataclass(frozen=True)
class EffectQuery:
    """One amplitude of an effect, with its other amplitudes off and a typical shape.

    size  of the parameter; None = the smallest detectable one
    """

    effect: type[Effect]
    parameter: Parameter
    size: float | None

    def at(self, size: float) -> ActiveEffect:
        """The effect with this amplitude."""
        values = (
            size if p is self.parameter else p.starts[0] if is_shape(p) else p.default
            for p in self.effect.parameters
        )
        return ActiveEffect(self.effect, tuple(map(float, values)))

    @property
    def typical(self) -> float:
        """Typical size."""
        return self.parameter.starts[0]


def effect_queries(
    texts: Sequence[str], in_model: Sequence[str]
) -> tuple[tuple[EffectQuery, ...], EffectSelection]:
    """Effects from texts NAME, NAME=SIZE or NAME.PARAMETER=SIZE, and the effects to try.

    NAME is of the library, or a user's own file.py.  SIZE is the parameter's value in its unit.

    in_model  effects of the model
    raises    ValueError: unknown, of no such amplitude, in the model already, a size that is no
              number or out of bounds; EffectError; FileNotFoundError
    """
    queries = tuple(_query(text) for text in texts)
    selection = select_effects(in_model)
    for text, query in zip(texts, queries, strict=True):
        if query.effect.name in {e.name for e in selection.in_model}:
            raise ValueError(f"--try {text}: is part of the model by --with; leave one of them out")
    own = {e.name: e for e in (a.effect for a in queries) if e.name not in selection.candidates}
    return queries, EffectSelection(selection.in_model, selection.candidates | own)


def _query(text: str) -> EffectQuery:
    name, equals, size = text.rpartition("=") if "=" in text else (text, "", "")
    amplitude = ""
    if "." in name and not name.endswith(".py"):  # NAME.PARAMETER, of file.py.PARAMETER too
        name, _, amplitude = name.rpartition(".")
    effect = effect_named(name)
    parameter = _amplitude(text, effect, amplitude)
    return EffectQuery(effect, parameter, _size(text, parameter, size) if equals else None)


def _amplitude(text: str, effect: type[Effect], name: str) -> Parameter:
    amplitudes = [p for p in effect.parameters if p.amplitude]
    chosen = [p for p in amplitudes if name in ("", p.name)]
    if not chosen:
        raise ValueError(
            f"--try {text}: {effect.name} has no amplitude {name!r}; "
            f"give one of: {', '.join(p.name for p in amplitudes)}"
        )
    return chosen[0]


def _size(argument: str, parameter: Parameter, text: str) -> float:
    unit = after_number(parameter.unit)
    try:
        size = float(text)
    except ValueError:
        raise ValueError(
            f"--try {argument}: the size {text!r} is no number; give {parameter.name}"
            f"{unit and f' in{unit}'}"
        ) from None
    if not parameter.low <= size <= parameter.high:
        raise ValueError(
            f"--try {argument}: {parameter.name} = {size:g}{unit} is outside "
            f"{parameter.low:g} … {parameter.high:g}{unit}; give a size within"
        )
    if size == parameter.default:
        raise ValueError(
            f"--try {argument}: {parameter.name} = {size:g}{unit} is none of the "
            f"effect; give another size, or leave it out for the smallest that is found"
        )
    return size
