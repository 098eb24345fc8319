"""Effects by name, and a user's own from a file."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import linecache
import re
import sys
from contextlib import ExitStack
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

from cell.cable.effects import air, bending, camera, drag, grip, hand, lens, plastic, rest
from cell.cable.effects.base import Effect, EffectError, EffectFile
from cell.cable.effects.check import HOOKS, Doing, check, visit_many_states
from cell.cable.effects.compiled import loops_of, proof_of
from cell.cable.effects.own import first_line, watch_hooks
from cell.cable.effects.remote import is_confined, load_remote
from cell.cable.effects.trial import COMPILING_S, try_effect
from cell.computer.watched import PATIENCE_S, must_end
from cell.files.words import error_text

#: Largest size of an effect's file.
MAX_BYTES = 100_000

_FAMILIES = (air, bending, grip, hand, camera)
_RARE = (plastic, lens, rest, drag)


def library() -> dict[str, type[Effect]]:
    """The project's effects by name, family by family, that every diagnosis tries."""
    return {e.name: e for module in _FAMILIES for e in _effects_in(module)}


def unscreened() -> dict[str, type[Effect]]:
    """The project's effects that a diagnosis tries only if the user names them."""
    return {e.name: e for module in _RARE for e in _effects_in(module)}


def load_effect(path: str | Path, *, trusted: bool = False) -> type[Effect]:
    """The one effect defined in a Python file, checked and compiled.

    The file is a program, and it is run: first in a process of its own, which is killed if it does
    not come to an end, then in this one.

    trusted  the program wrote the file itself: no trial in another process first; it imports
             nothing from its folder
    A file of a folder whose effects are confined is run in a sandbox only.

    raises   EffectError: with the file and line of the mistake; FileNotFoundError
    """
    file = effect_path(path)
    if file.stat().st_size > MAX_BYTES:
        raise EffectError(file, 1, f"has more than {MAX_BYTES} bytes: is it an effect?")
    if is_confined(file):
        return load_remote(file, file.read_bytes())
    proof = proof_of(file)
    if not trusted and not proof.exists():
        try_effect(file, _tried)
        proof.touch()
    with ExitStack() as step:

        def doing(what: str, line: int, seconds: float) -> None:
            """End the previous task, and have the watchdog report this one if it does not end."""
            step.close()
            if seconds <= PATIENCE_S:
                step.enter_context(must_end(f"{file}:{line}: {what}"))

        doing("its module", 1, PATIENCE_S)
        return _loaded(file, file.read_bytes(), doing, alone=trusted)


def load_source(file: Path, source: bytes, doing: Doing) -> type[Effect]:
    """The one effect of a source, checked and compiled; its file need not be there.

    raises  EffectError
    """
    linecache.cache[str(file)] = len(source), None, _lines(source), str(file)
    return _loaded(file, source, doing)


def try_source(file: Path, source: bytes, doing: Doing) -> type[Effect]:
    """As `load_source`; the hooks are also called at the states of a swing."""
    effect = load_source(file, source, doing)
    _visit(effect, doing)
    return effect


def _lines(source: bytes) -> list[str]:
    return source.decode(errors="replace").splitlines(keepends=True)


def _tried(file: Path, doing: Doing) -> None:
    """Run all of an effect's code: checks, compiling, the states of a swing."""
    _visit(_loaded(file, file.read_bytes(), doing), doing)


def _visit(effect: type[Effect], doing: Doing) -> None:
    if effect.force is None and effect.moment is None:
        return
    doing(f"{effect.name}: a hook, in some state of a swing,", first_line(effect), PATIENCE_S)
    visit_many_states(effect)


class _FromSource(SourceFileLoader):
    """Loader that compiles a source, without bytecode on disk.

    Python's own loader trusts bytecode with the same size and time stamp, to a second.
    """

    def __init__(self, name: str, path: str, source: bytes) -> None:
        super().__init__(name, path)
        self._source = source

    def get_code(self, fullname: str) -> CodeType:
        """Code of the module, from its source."""
        code: CodeType = self.source_to_code(self._source, self.path)
        return code


def _loaded(file: Path, source: bytes, doing: Doing, *, alone: bool = False) -> type[Effect]:
    """Effect of a file with this source.

    alone  the file imports no others: a copy elsewhere has the same machine code, which is cached
           by the module's name
    """
    sha256 = hashlib.sha256(source).hexdigest()
    where = sha256 if alone else hashlib.sha256(str(file).encode()).hexdigest()
    name = f"cable_effect_{file.stem}_{where[:8]}"
    loader = _FromSource(name, str(file), source)
    spec = importlib.util.spec_from_file_location(name, file, loader=loader)
    if spec is None or file.suffix != ".py":
        raise EffectError(file, 1, "is not a Python file; its name must end with .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        loader.exec_module(module)
    except SyntaxError as error:
        cause = f"is not Python: {error.msg}; mend that"
        raise EffectError(file, error.lineno or 1, cause) from error
    except UnicodeDecodeError as error:
        raise EffectError(file, 1, "is not UTF-8 text; save it as UTF-8") from error
    except (Exception, SystemExit) as error:
        trace, line = error.__traceback__, 1
        while trace is not None:
            if trace.tb_frame.f_code.co_filename == str(file):
                line = trace.tb_lineno
            trace = trace.tb_next
        cause = f"{error_text(error)}: mend that"
        raise EffectError(file, line, cause) from error
    effects = _effects_in(module)
    if len(effects) != 1:
        names = [e.__name__ for e in effects]
        raise EffectError(file, 1, f"must define exactly one subclass of Effect, has {names}")
    (effect,) = effects
    check(effect, doing)
    ours = (library() | unscreened()).get(effect.name)
    if ours is not None:
        if file_sha256(Path(inspect.getsourcefile(ours) or "")) == sha256:
            return ours  # the library's own file, or a copy of it
        _, line = inspect.getsourcelines(effect)
        cause = f"name = {effect.name!r} is the library's own effect; give yours another name"
        raise EffectError(file, line, cause)
    effect.file = EffectFile(file, sha256)
    try:
        if effect.force is not None or effect.moment is not None:
            doing(f"{effect.name}: compiling its hooks", first_line(effect), COMPILING_S)
        loops_of(effect)
    except Exception as error:  # numba raises much that is no NumbaError
        raise EffectError(file, _line_of(error, file, effect), _short(error)) from error
    watch_hooks(effect, HOOKS)
    return effect


def effect_path(path: str | Path) -> Path:
    """The resolved path of an effect file.  Raises FileNotFoundError: it is none."""
    file = Path(path).resolve()
    if not file.is_file():
        what = "is a folder, not an effect" if file.is_dir() else "no such effect"
        raise FileNotFoundError(f"{path}: {what} file; give the path of a Python file")
    return file


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


def _line_of(error: Exception, file: Path, effect: type[Effect]) -> int:
    """Line of the effect's file that numba names last, the innermost; else that of a hook."""
    named = re.findall(rf'{re.escape(str(file))}"?,? (?:line |\()(\d+)', str(error))
    return int(named[-1]) if named else first_line(effect)


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return "a hook cannot be compiled; use plain arithmetic on numbers: " + text[:600]
