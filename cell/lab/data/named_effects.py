"""Effects that a command line names, from the library or from a user's own files."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cell.cable.effects import Effect, library
from cell.cable.effects.remote import confine_effects
from cell.cable.effects.untrusted import check_untrusted
from cell.identify.model_class import effect_from, known_effects
from cell.lab.data.work import Progress, no_progress


@dataclass(frozen=True)
class EffectSelection:
    """The effects that a command works with: those in the model, and candidates.

    in_model    part of the model from the start
    candidates  by name: effects that may be missing, the library's included
    """

    in_model: tuple[type[Effect], ...]
    candidates: dict[str, type[Effect]]

    @property
    def own(self) -> dict[str, type[Effect]]:
        """A user's own effects by name, from files."""
        effects = (*self.in_model, *self.candidates.values())
        return {e.name: e for e in effects if e.file is not None}


def select_effects(in_model: Sequence[str], candidates: Sequence[str] = ()) -> EffectSelection:
    """Effects by name, or from a user's own files (`….py`); candidates join the library.

    raises  ValueError: unknown, a duplicate, or of a library effect's name; EffectError;
            FileNotFoundError
    """
    effects: dict[str, type[Effect]] = {}
    options = [("--with", name) for name in in_model] + [("--try", name) for name in candidates]
    for option, name in options:
        effect = effect_named(name)
        if effect.name in effects:
            raise ValueError(
                f"{option} {name}: another effect {effect.name!r} is given too; leave one out, "
                "or rename one (`name = …` in its file)"
            )
        effects[effect.name] = effect
    chosen = list(effects.values())
    added = {e.name: e for e in chosen[len(in_model) :]}
    return EffectSelection(tuple(chosen[: len(in_model)]), library() | added)


def select_for_diagnosis(tried: Sequence[str], known: Sequence[str]) -> EffectSelection:
    """As `select_effects`, for a diagnosis: effects to try, and effects of the model.

    raises  ValueError: an effect to try is in the library
    """
    for name in tried:
        if name in library():
            raise ValueError(
                f"{name}: is tried anyway; --with {name}, or `known`, makes it part of the model"
            )
    return select_effects(known, tried)


def candidates_in(folder: Path, progress: Progress = no_progress) -> tuple[list[str], list[str]]:
    """Valid effect files in a folder, in order; and notes on the refused ones.

    A file that could do more than compute is not run.  The others run in sandboxes, now and later.
    raises  ValueError: it is no folder, or holds no Python file
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise ValueError(f"{folder}: {what}; give a folder with effect files (*.py)")
    files = sorted(folder.glob("*.py"))
    if not files:
        raise ValueError(f"{folder}: holds no effect (*.py); give a folder with effect files")
    confine_effects(folder)
    good, refused, names = list[str](), list[str](), dict[str, Path]()
    for number, file in enumerate(files):
        progress("checking candidates", number, len(files))
        try:
            check_untrusted(file)
            name = effect_named(str(file)).name
        except ValueError as error:  # EffectError among them
            refused.append(f"left out: {error}")
            continue
        if name in names:
            refused.append(f"left out: {file}: is called {name!r} as {names[name]} is; rename one")
            continue
        names[name] = file
        good.append(str(file))
    return good, refused


def effect_named(text: str) -> type[Effect]:
    """The effect with a name, or of a user's own file.

    raises  as `select_effects`
    """
    effects = known_effects()
    if text.endswith(".py"):
        effect = effect_from(text)
        if effect.name in library():
            raise ValueError(
                f"{text}: its name {effect.name!r} is that of an effect of the library; "
                "rename it (`name = …` in the file)"
            )
        return effect
    if text not in effects:
        close = difflib.get_close_matches(text, effects, 1, 0.5)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(effects)}"
        raise ValueError(f"{text}: no such effect; {hint}; your own as its file.py")
    return effects[text]
