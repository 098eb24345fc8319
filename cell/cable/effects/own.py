"""Errors in a user's own effect: a watchdog knows the running hook; errors have file and line."""

from __future__ import annotations

import functools
import inspect
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba import typeof

from cell.cable.effects.base import COMPILED, Effect, EffectError
from cell.cable.effects.remote import is_remote, run_remote
from cell.computer.watched import must_end
from cell.files.words import error_text


def with_compiled_hooks(effects: Iterable[type[Effect]]) -> tuple[type[Effect], ...]:
    """The users' own effects among these that have a force or a moment, which are compiled."""
    return tuple(e for e in effects if e.file is not None and (e.force or e.moment))


def run_engine(function: Any, own: tuple[type[Effect], ...], *args: Any) -> Any:
    """Result of a compiled function that calls compiled hooks, also those of a user's effects.

    raises  EffectError: what a hook raised
    """
    if not own:
        return function(*args)
    if any(is_remote(e) for e in own):
        return run_remote(function.__name__, own, *args)
    if not function.signatures:  # compiled outside the time limit
        function.compile(tuple(typeof(a) for a in args))  # type: ignore[no-untyped-call]
    with _at_work(own, "a compiled hook"):
        return function(*args)


def watch_hooks(effect: type[Effect], hooks: Iterable[str]) -> None:
    """Wrap the uncompiled hooks of a user's effect, so that they report when they run."""
    for hook in hooks:
        function = getattr(effect, hook)
        if function is not None and hook not in COMPILED:
            setattr(effect, hook, staticmethod(_watched(effect, hook, function)))


def first_line(effect: type[Effect]) -> int:
    """Line of the effect's file where its first compiled hook begins."""
    hooks = (getattr(effect, name) for name in COMPILED)
    return min(int(h.__code__.co_firstlineno) for h in hooks if h is not None)


def _watched(effect: type[Effect], hook: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def watched(*args: Any) -> Any:
        with _at_work((effect,), hook):
            result = function(*args)
        return _watched(effect, hook, result) if callable(result) else result

    return watched


@contextmanager
def _at_work(own: tuple[type[Effect], ...], hook: str) -> Iterator[None]:
    """Context of a user's hooks: watched, and with errors raised as EffectError with their line."""
    effect = own[0]
    assert effect.file is not None
    path = effect.file.path
    compiled = hook not in vars(Effect)
    hooked = None if compiled else inspect.unwrap(getattr(effect, hook))
    line = first_line(effect) if hooked is None else hooked.__code__.co_firstlineno
    which = " or ".join(f"{e.name} ({e.file.path})" for e in own[1:] if e.file is not None)
    what = f"{effect.name}: {hook}" if compiled else f"{effect.name}.{hook}"
    if which:
        what += f", or one of {which},"
    with must_end(f"{path}:{line}: {what}"):
        try:
            yield
        except EffectError:
            raise
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            lines = [f.lineno for f in frames if Path(f.filename) == path]
            cause = f"{what}: {error_text(error)}"
            raise EffectError(path, (lines[-1] if lines else line) or line, cause) from error
