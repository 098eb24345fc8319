"""Untrusted effects: classes in this process whose code runs only in sandboxes."""

from __future__ import annotations

import hashlib
import itertools
import os
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from cell.cable.effects.base import (
    COMPILED,
    Effect,
    EffectError,
    EffectFile,
    HandMotion,
    Parameter,
)
from cell.cable.effects.compiled import Loops, symbol_of, take_loops
from cell.computer.confinement import UnconfinedError
from cell.computer.sandbox import Nursery, Sandbox, SandboxEndedError, SandboxStuckError
from cell.computer.watched import PATIENCE_S, no_end

#: A folder with a file of this name has effects that nobody has read.
MARK = ".confined"
#: Time limit of loading and compiling a law, s.
LOADING_S = 120.0
#: Most sandboxes of a process; the oldest is ended first.
_MOST = 8
_LONGEST_NAME, _LONGEST_TEXT = 60, 2000
_NONSENSE = "answers neither numbers nor a mistake: mend that"
#: Functions of the engine, and which of their arguments they write to.
WRITTEN = {"balance": (0,), "integrate": (0, 9, 10)}

#: Folders and files whose effects are confined in this process, apart from marked folders.
_confined: set[Path] = set()
#: Sources of the loaded effects, as of their loading.
_sources: dict[type[Effect], bytes] = {}
_tokens = itertools.count(-2, -1)
_nursery: Nursery | None = None
_sandboxes: OrderedDict[tuple[type[Effect], ...], Sandbox] = OrderedDict()
_of_process = 0
_making = threading.RLock()


def confine_effects(place: Path) -> None:
    """From now on effects of this file or folder run in sandboxes."""
    _confined.add(place.resolve())


def is_confined(file: Path) -> bool:
    """Whether the effect of a file, resolved, runs in sandboxes."""
    return not _confined.isdisjoint((file, file.parent)) or (file.parent / MARK).exists()


def is_remote(effect: type[Effect]) -> bool:
    """Whether all code of an effect runs in sandboxes."""
    return effect.file is not None and effect.file.confined


def load_remote(file: Path, source: bytes) -> type[Effect]:
    """The one effect of a file, checked and compiled in a sandbox.

    raises  EffectError: with the file and line of the mistake, or that this computer has no sandbox
    """
    sandbox = _new(file)
    try:
        effect = _class_of(file, source, _loaded(sandbox, file, source, first=True))
    except BaseException:
        sandbox.end()
        raise
    _sources[effect] = source
    with _making:
        _keep((effect,), sandbox)
    return effect


def run_remote(name: str, own: Sequence[type[Effect]], *args: Any) -> Any:
    """Result of an engine function with remote effects; it writes to the same arrays."""
    at = next(i for i, a in enumerate(args) if isinstance(a, tuple))
    forces, moments, *others = args[at]
    names = [symbol_of(int(a)) for a in forces], [symbol_of(int(a)) for a in moments]
    copies = [a.copy() if isinstance(a, np.ndarray) else a for a in args]
    copies[at] = (*names, *others)
    what = f"{own[0].name}: a compiled hook"
    answer = _request(own, {"engine": name, "args": tuple(copies)}, what)
    results = [*answer["arrays"], answer["memory"]]
    targets = [*(args[i] for i in WRITTEN[name]), others[2]]
    for target, result in zip(targets, results, strict=True):
        if getattr(result, "shape", None) != target.shape or result.dtype != target.dtype:
            raise _error(own[0], f"{what} gives no numbers: mend that")
        target[...] = result
    return int(answer["value"])


def _request(
    own: Sequence[type[Effect]],
    request: dict[str, Any],
    what: str,
    more: Callable[[Any], tuple[bool, Any]] = lambda answer: (True, None),
) -> dict[str, Any]:
    """A sandbox's answer.  Raises EffectError: a hook's error, or the end of the sandbox."""
    try:
        answer = _sandbox(tuple(dict.fromkeys(own))).request(request, PATIENCE_S, more)
    except SandboxStuckError as error:
        raise _error(own[0], f"{what} {no_end(PATIENCE_S)}") from error
    except SandboxEndedError as error:
        raise _error(own[0], f"{what} ends the process: mend that") from error
    return _checked(own[0], answer)


def _checked(effect: type[Effect], answer: Any) -> dict[str, Any]:
    if isinstance(answer, dict) and "value" in answer:
        return answer
    assert effect.file is not None
    raise _refusal(effect.file.path, answer)


def _refusal(file: Path, answer: Any) -> EffectError:
    try:
        _, line, cause = answer["refused"]
        return EffectError(file, int(line), _text(cause))
    except (TypeError, ValueError, LookupError):
        return EffectError(file, 1, _NONSENSE)


def _error(effect: type[Effect], cause: str) -> EffectError:
    assert effect.file is not None
    return EffectError(effect.file.path, getattr(effect, "_line", 1), cause)


def _sandbox(own: tuple[type[Effect], ...]) -> Sandbox:
    """This process's sandbox with these effects; a fork does not use its parent's."""
    with _making:
        there = _own_sandboxes().get(own)
        if there is None or not there.is_there:
            assert own[0].file is not None
            there = _new(own[0].file.path)
            try:
                for effect in own:
                    assert effect.file is not None
                    source = _sources.get(effect) or effect.file.path.read_bytes()
                    _loaded(there, effect.file.path, source, first=False)
            except BaseException:
                there.end()
                raise
        _keep(own, there)
        return there


def _own_sandboxes() -> OrderedDict[tuple[type[Effect], ...], Sandbox]:
    """This process's sandboxes: a fork forgets those of its parent."""
    global _of_process
    if _of_process != os.getpid():
        _sandboxes.clear()
        _of_process = os.getpid()
    return _sandboxes


def _keep(own: tuple[type[Effect], ...], sandbox: Sandbox) -> None:
    kept = _own_sandboxes()
    kept[own] = sandbox
    kept.move_to_end(own)
    while len(kept) > _MOST:
        kept.popitem(last=False)[1].end()


def _new(file: Path) -> Sandbox:
    global _nursery
    try:
        with _making:
            if _nursery is None:
                _nursery = Nursery("cell.cable.confined:main")
            return _nursery.sandbox()
    except UnconfinedError as error:
        cause = (
            "nobody has read it, and this computer cannot run it where it can do no harm "
            f"({error}); read it, and give it as --try if you trust it"
        )
        raise EffectError(file, 1, cause) from error


def _loaded(sandbox: Sandbox, file: Path, source: bytes, *, first: bool) -> dict[str, Any]:
    """A sandbox's description of an effect that it has loaded.  Raises EffectError."""
    now: tuple[str, int, float] = "its module", 1, PATIENCE_S

    def more(answer: Any) -> tuple[bool, Any]:
        if not isinstance(answer, dict) or "doing" not in answer:
            return True, None
        nonlocal now
        try:
            what, line, seconds = answer["doing"]
            now = _text(what), int(line), min(float(seconds), LOADING_S)
        except (TypeError, ValueError) as error:
            raise EffectError(file, 1, _NONSENSE) from error
        sandbox.be_patient(now[2])
        return False, None

    try:
        text = source.decode()
    except UnicodeDecodeError as error:
        raise EffectError(file, 1, "is not UTF-8 text; save it as UTF-8") from error
    request = {"file": str(file), "text": text, "try": first}
    try:
        answer = sandbox.request(request, LOADING_S, more)
    except SandboxStuckError as error:
        raise EffectError(file, now[1], f"{now[0]} {no_end(now[2])}") from error
    except SandboxEndedError as error:
        raise EffectError(file, now[1], f"{now[0]} ends the process: mend that") from error
    if isinstance(answer, dict) and isinstance(answer.get("effect"), dict):
        return dict(answer["effect"])
    raise _refusal(file, answer)


def _text(value: object) -> str:
    """Text from a sandbox without control characters, which a terminal might execute."""
    text = "".join(c if c.isprintable() or c == "\n" else "?" for c in str(value))
    return text[:_LONGEST_TEXT]


def _name(value: object) -> str:
    if not isinstance(value, str) or not value.isidentifier() or len(value) > _LONGEST_NAME:
        raise ValueError(f"{_text(value)!r} is not a name")
    return value


def _class_of(file: Path, source: bytes, data: dict[str, Any]) -> type[Effect]:
    """This process's class of a described effect.  Raises EffectError: not an effect's."""
    sha256 = hashlib.sha256(source).hexdigest()
    try:
        name = _name(data["name"])
        parameters = tuple(
            Parameter(_name(q[0]), _text(q[1])[:_LONGEST_NAME], *q[2:]) for q in data["parameters"]
        )
        fields: dict[str, Any] = {
            "__doc__": _text(data["law"]),
            "__module__": f"cable_effect_confined_{file.stem}_{sha256[:12]}",
            "name": name,
            "parameters": parameters,
            "memory": tuple(_name(m) for m in data["memory"]),
            "dissipative": bool(data["dissipative"]),
            "smooth": bool(data["smooth"]),
            "_line": int(data["line"]),
        }
        hooks = [h for h in data["hooks"] if h in _RESULTS or h in COMPILED]
    except (ValueError, TypeError, KeyError, LookupError) as error:
        raise EffectError(file, 1, f"is no effect: {_text(error)}") from error
    effect: type[Effect] = type("Law", (Effect,), fields)
    for hook in hooks:
        call = _clamp(effect) if hook == "clamp" else _hook(effect, hook)
        if hook == "inertia" and data.get("varies_along_cable"):
            call = _inertia_along(effect)
        setattr(effect, hook, staticmethod(call))
    effect.file = EffectFile(file, sha256, confined=True)
    module = ModuleType(effect.__module__)
    vars(module)["Law"] = effect
    sys.modules[module.__name__] = module  # copies of this process name it so
    force = next(_tokens) if effect.force is not None else None
    moment = next(_tokens) if effect.moment is not None else None
    take_loops(effect, Loops(force, moment, ()))
    return effect


#: Number of values that the other hooks return; 0 = an array.
_RESULTS = {
    **{"inertia": 2, "tip_mass": 1, "point_mass": 2, "rest_curvature": 0, "grip_compliance": 2},
    **{"extra_length": 1, "clamp": 3, "camera_time": 0, "camera_points": 0},
}


def _hook(effect: type[Effect], hook: str) -> Callable[..., Any]:
    def called(cable: Any, *args: Any) -> Any:
        what = f"{effect.name}.{hook}"
        value = _value_of(effect, hook, tuple(map(float, cable)), *args)
        size = _RESULTS.get(hook, 1)
        if size == 0:
            shape = np.shape(args[0])
            if hook == "camera_time":
                shape = np.broadcast_shapes(shape, np.shape(args[1])[:-1])
            array = np.asarray(value, dtype=np.float64)
            if array.shape not in (shape, np.shape(args[0])):
                raise _error(effect, f"{what} returned shape {array.shape}: must be {shape}")
            return array
        numbers = value if isinstance(value, tuple) else (value,)
        if len(numbers) != size or not all(isinstance(v, float) for v in numbers):
            raise _error(effect, f"{what} returned {_text(value)}: must be {size} numbers")
        return numbers if size > 1 else numbers[0]

    return called


def _inertia_along(effect: type[Effect]) -> Callable[..., Any]:
    what = f"{effect.name}.inertia"

    def inertia(cable: Any, arc_length: Any, p: Any) -> Any:
        arcs = np.asarray(arc_length, dtype=np.float64)
        value = _value_of(effect, "inertia", tuple(map(float, cable)), arcs, p)
        arrays = value if isinstance(value, tuple) else ()
        shapes = [np.shape(a) for a in arrays]
        if len(arrays) != 2 or any(s not in ((), arcs.shape) for s in shapes):
            raise _error(effect, f"{what} returned shapes {shapes}: must be two of {arcs.shape}")
        return tuple(np.asarray(a, dtype=np.float64) for a in arrays)

    return inertia


def _clamp(effect: type[Effect]) -> Callable[..., Any]:
    def clamp(pose: HandMotion, p: Any) -> Callable[..., Any]:
        def moved(t_s: Any) -> Any:
            def more(answer: Any) -> tuple[bool, Any]:
                if not isinstance(answer, dict) or "pose" not in answer:
                    return True, None
                return False, tuple(np.asarray(v) for v in pose(np.asarray(answer["pose"])))

            times = np.asarray(t_s, dtype=np.float64)
            value = _value_of(effect, "clamp", pose.start_s, pose.end_s, times, p, more=more)
            arrays = value if isinstance(value, tuple) else ()
            if len(arrays) != 3 or any(np.shape(a) != times.shape for a in arrays):
                raise _error(effect, f"{effect.name}.clamp: pose(t) must be three arrays as t")
            return arrays

        return moved

    return clamp


def _value_of(
    effect: type[Effect],
    hook: str,
    *args: Any,
    more: Callable[[Any], tuple[bool, Any]] = lambda answer: (True, None),
) -> Any:
    """Result of a hook in a sandbox; its last argument has the parameters as attributes."""
    values = {name: float(value) for name, value in vars(args[-1]).items()}
    request = {"effect": effect.name, "hook": hook, "args": (*args[:-1], values)}
    return _request((effect,), request, f"{effect.name}.{hook}", more)["value"]
