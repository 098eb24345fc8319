"""Effects by name, and a user's own from a file."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from numba.core.errors import NumbaError

from cell.cable.effects import air, bending, camera, grip, hand, lens, plastic
from cell.cable.effects.base import Effect, EffectFile
from cell.cable.effects.check import check
from cell.cable.effects.compiled import loops_of
from cell.cable.effects.refused import EffectError

_FAMILIES = (air, bending, grip, hand, camera)
_RARE = (plastic, lens)


def library() -> dict[str, type[Effect]]:
    """The project's effects by name, family by family: those that may be the matter anywhere."""
    return {e.name: e for module in _FAMILIES for e in _effects_in(module)}


def unscreened() -> dict[str, type[Effect]]:
    """The project's other effects, which are only looked for where somebody has reason to."""
    return {e.name: e for module in _RARE for e in _effects_in(module)}


def load_effect(path: str | Path) -> type[Effect]:
    """The one effect defined in a Python file, checked and compiled.

    raises  EffectError: with the file and line of the mistake; FileNotFoundError
    """
    file = Path(path).resolve()
    if not file.is_file():
        raise FileNotFoundError(f"{path}: no such effect file")
    sha256 = file_sha256(file)
    name = f"cable_effect_{file.stem}_{hashlib.sha256(str(file).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise EffectError(file, 1, "is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise EffectError(file, error.lineno or 1, f"{error.msg}") from error
    except Exception as error:
        trace, line = error.__traceback__, 1
        while trace is not None:
            if trace.tb_frame.f_code.co_filename == str(file):
                line = trace.tb_lineno
            trace = trace.tb_next
        raise EffectError(file, line, f"{type(error).__name__}: {error}") from error
    found = _effects_in(module)
    if len(found) != 1:
        names = [e.__name__ for e in found]
        raise EffectError(file, 1, f"must define exactly one subclass of Effect, has {names}")
    (effect,) = found
    check(effect)
    effect.file = EffectFile(file, sha256)
    try:
        loops_of(effect)
    except NumbaError as error:
        raise EffectError(file, _first_line(effect), _short(error)) from error
    return effect


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's content, hexadecimal.  Raises OSError."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _effects_in(module: ModuleType) -> list[type[Effect]]:
    return [
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, Effect)
        and value.__module__ == module.__name__
    ]


def _first_line(effect: type[Effect]) -> int:
    hooks = (effect.force, effect.moment, effect.memory_rate, effect.memory_at_rest)
    return min(h.__code__.co_firstlineno for h in hooks if h is not None)


def _short(error: NumbaError) -> str:
    text = str(error).strip().splitlines()
    return "a hook cannot be compiled; use plain arithmetic on numbers: " + " ".join(text)[:600]
