"""Effects given to `cell power`: which amplitude, and of which size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cell.cable.effects.base import ActiveEffect, Effect, Parameter, after_number
from cell.lab.data.named_effects import EffectSelection, effect_named, select_effects
from cell.lab.fit.sensitivity import is_shape


@dataclass(frozen=True)
class AskedEffect:
    """One amplitude of an effect, with its other amplitudes off and a typical shape.

    size  of the parameter; None = the smallest that is found
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


def select_asked(
    asked: Sequence[str], known: Sequence[str]
) -> tuple[tuple[AskedEffect, ...], EffectSelection]:
    """Effects from texts NAME, NAME=SIZE or NAME.PARAMETER=SIZE, and the effects to try.

    NAME is of the library, or a user's own file.py.  SIZE is the parameter's value in its unit.

    known    part of the model
    raises   ValueError: unknown, of no such amplitude, known already, a size that is none or out of
             bounds; EffectError; FileNotFoundError
    """
    found = tuple(_asked(given) for given in asked)
    selection = select_effects(known)
    for given, one in zip(asked, found, strict=True):
        if one.effect.name in {e.name for e in selection.in_model}:
            raise ValueError(
                f"--try {given}: is part of the model by --with; leave one of them out"
            )
    own = {e.name: e for e in (a.effect for a in found) if e.name not in selection.candidates}
    return found, EffectSelection(selection.in_model, selection.candidates | own)


def _asked(given: str) -> AskedEffect:
    name, equals, size = given.rpartition("=") if "=" in given else (given, "", "")
    name, which = (name, "") if name.endswith(".py") else _split(name)
    effect = effect_named(name)
    parameter = _amplitude(given, effect, which)
    return AskedEffect(effect, parameter, _size(given, parameter, size) if equals else None)


def _split(name: str) -> tuple[str, str]:
    """NAME and PARAMETER of NAME.PARAMETER, of file.py.PARAMETER too."""
    before, dot, which = name.rpartition(".")
    return (before, which) if dot else (name, "")


def _amplitude(given: str, effect: type[Effect], which: str) -> Parameter:
    amplitudes = [p for p in effect.parameters if p.amplitude]
    chosen = [p for p in amplitudes if which in ("", p.name)]
    if not chosen:
        raise ValueError(
            f"--try {given}: {effect.name} has no amplitude {which!r}; "
            f"give one of: {', '.join(p.name for p in amplitudes)}"
        )
    return chosen[0]


def _size(given: str, parameter: Parameter, text: str) -> float:
    unit = after_number(parameter.unit)
    try:
        size = float(text)
    except ValueError:
        raise ValueError(
            f"--try {given}: the size {text!r} is no number; give {parameter.name}"
            f"{unit and f' in{unit}'}"
        ) from None
    if not parameter.low <= size <= parameter.high:
        raise ValueError(
            f"--try {given}: {parameter.name} = {size:g}{unit} is outside "
            f"{parameter.low:g} … {parameter.high:g}{unit}; give a size within"
        )
    if size == parameter.default:
        raise ValueError(
            f"--try {given}: {parameter.name} = {size:g}{unit} is none of the "
            f"effect; give another size, or leave it out for the smallest that is found"
        )
    return size
