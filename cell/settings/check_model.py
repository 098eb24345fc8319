"""Checks the section `model` of the settings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cell.cable.effects import Effect, EffectError, file_sha256
from cell.cable.effects.base import after_number
from cell.files.input_error import did_you_mean
from cell.files.yaml_document import Complaint, Key
from cell.identify.model_class import effect_from, known_effects
from cell.settings.model import KnownParameter, ModelEffect, ModelSettings, Settings
from cell.settings.translate import cable_of, model_class_of

_KEY: Key = ("model", "effects")


def model_problems(settings: Settings) -> Iterator[Complaint]:
    """Every mistake in the section `model`, each at its place."""
    model = settings.model
    known: set[str] = set()
    wrong = False
    for i, entry in enumerate(model.effects):
        complaints = [*_effect_problems(model, i, entry, known)]
        wrong = wrong or bool(complaints)
        yield from complaints
    if settings.identification.method == "paper" and (model.effects or model.prior):
        message = "'paper' knows neither effects nor priors; use 'map', or leave out `model`"
        yield ("identification", "method"), message
    if wrong:
        return
    held = {
        f"{effect_from(entry.effect).name}.{key}"
        for entry in model.effects
        for key, stated in entry.parameters.items()
        if isinstance(stated, KnownParameter)
    }
    for i, name in enumerate(model.prior.names if model.prior else ()):
        if name in held:
            message = f"{name} is `fixed` above; take it out of the prior, with its row and column"
            yield ("model", "prior", "names", i), message
            wrong = True
    if not wrong:
        try:
            model_class_of(model).space(cable_of(settings))
        except ValueError as error:
            yield ("model", "prior"), str(error)


def _effect_problems(
    model: ModelSettings,
    i: int,
    entry: ModelEffect,
    known: set[str],
) -> Iterator[Complaint]:
    """Mistakes of one entry; adds the name of an existing effect to `known`."""
    place: Key = (*_KEY, i, "effect")
    try:
        if not entry.effect.endswith(".py") and entry.effect not in known_effects():
            guess = did_you_mean(entry.effect, list(known_effects()))
            yield place, f"{entry.effect!r}: unknown effect{guess}"
            return
        effect = effect_from(entry.effect)
        now = file_sha256(Path(entry.effect)) if entry.effect.endswith(".py") else None
    except (EffectError, OSError) as error:
        yield place, str(error)
        return
    if entry.sha256 is not None and entry.sha256 != now:
        message = (
            f"{entry.effect} is not the file that this model was learned with (its SHA-256 is "
            f"{now}); restore it, or leave out `sha256` to use it as it is"
            if now
            else f"{entry.effect} is no file; leave out `sha256`"
        )
        yield (*_KEY, i, "sha256"), message
    if effect.name in known:
        yield place, f"{effect.name} is given twice; remove one"
    known.add(effect.name)
    yield from _parameter_problems(model, (*_KEY, i, "parameters"), entry, effect)


def _parameter_problems(
    model: ModelSettings, place: Key, entry: ModelEffect, effect: type[Effect]
) -> Iterator[Complaint]:
    parameters = {p.name: p for p in effect.parameters}
    in_prior = set(model.prior.names) if model.prior else set()
    for key, stated in entry.parameters.items():
        name = f"{effect.name}.{key}"
        if key not in parameters:
            guess = did_you_mean(key, list(parameters))
            yield (*place, key), f"{effect.name} has no such parameter{guess}"
        elif isinstance(stated, KnownParameter):
            p = parameters[key]
            if not p.low <= stated.fixed <= p.high:
                message = f"{stated.fixed:g}{after_number(p.unit)}: must be {p.low:g} … {p.high:g}"
                yield (*place, key, "fixed"), message
        elif (stated == "prior") != (name in in_prior):
            message = (
                f"'prior', but model.prior.names has no {name!r}; name it there, or write 'fitted'"
                if stated == "prior"
                else f"'fitted', but model.prior has {name!r}; write 'prior'"
            )
            yield (*place, key), message
