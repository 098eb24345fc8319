"""Checks of an effect: its hooks are called in plain Python on probe states.

Plain Python, because its exceptions carry the user's own lines; then the hooks are compiled.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
import itertools
import math
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cell.cable.effects.base import (
    COMPILED,
    Bend,
    CableData,
    Effect,
    EffectError,
    HandMotion,
    Parameter,
    Place,
)
from cell.computer.watched import PATIENCE_S
from cell.files.words import counted, error_text

#: Arguments of every hook.
HOOKS = {
    "force": ("cable", "at", "p"),
    "moment": ("cable", "at", "m", "p"),
    "memory_rate": ("cable", "at", "m", "p"),
    "memory_at_rest": ("cable", "at", "p"),
    "inertia": ("cable", "p"),
    "tip_mass": ("cable", "p"),
    "point_mass": ("cable", "p"),
    "rest_curvature": ("cable", "arc_length", "p"),
    "grip_compliance": ("cable", "p"),
    "extra_length": ("cable", "p"),
    "clamp": ("pose", "p"),
    "camera_time": ("cable", "t", "xy", "p"),
    "camera_points": ("cable", "xy", "p"),
}
#: Arguments that a hook may have instead.
OTHERWISE = {"inertia": ("cable", "arc_length", "p")}
#: Hooks whose results an effect that is off may have.
NEVER_OFF = frozenset({"memory_rate", "memory_at_rest", "clamp"})
_FIELDS = ("name", "parameters", "memory", "dissipative", "smooth", "wider")

_CABLE = CableData(0.016, 1e-4, 0.0074, 0.1)
#: Arc lengths, times and points of a picture at which hooks of arrays are called.
_ARCS_M, _TIMES_S = np.linspace(0.0, 0.1, 5), np.linspace(0.0, 0.6, 301)
_POINTS_M = np.stack([-0.1 + 0.05 * _TIMES_S, np.full(301, -0.03)], axis=-1)


#: Callback with the next task, its line, and the seconds of computing that it may take.
Doing = Callable[[str, int, float], None]

#: States of a swing at which a hook is called once more.
STATES = 4000


def check(effect: type[Effect], doing: Doing = lambda what, line, seconds: None) -> None:
    """Refuse an effect whose form, results or physics differ from its declaration.

    raises  EffectError with file and line
    """
    path, line = _where(effect)
    _check_form(effect, path, line)
    for values in _probe_values(effect):
        p = SimpleNamespace(**values)
        for hook in HOOKS:
            if getattr(effect, hook) is not None:
                doing(f"{effect.name}.{hook}", _line(effect, hook), PATIENCE_S)
                _try(effect, hook, p)
    _check_off(effect)
    if effect.dissipative:
        _check_dissipation(effect, doing)


def passed_checks(effect: type[Effect]) -> list[str]:
    """The checks that a loaded effect has passed, as texts."""
    hooks = [hook for hook in HOOKS if getattr(effect, hook) is not None]
    count = len(list(_probe_values(effect)))
    passed = [f"{hook}: finite at {counted(count, 'set')} of parameters" for hook in hooks]
    passed += [f"{hook}: compiles" for hook in hooks if hook in COMPILED]
    if {*hooks} - NEVER_OFF:
        passed += [f"off at {q.name} = {q.default:g}" for q in effect.parameters if q.amplitude]
    return [*passed, *(["adds no energy"] if effect.dissipative else [])]


def _where(effect: type[Effect]) -> tuple[Path, int]:
    try:
        _, line = inspect.getsourcelines(effect)
        return Path(inspect.getsourcefile(effect) or "?"), line
    except (OSError, TypeError):
        return Path("?"), 0


def _check_form(effect: type[Effect], path: Path, line: int) -> None:
    def refuse(cause: str, at: int = line) -> None:
        raise EffectError(path, at, f"{effect.__name__}: {cause}")

    name = getattr(effect, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        refuse(f"name = {name!r}: must be a string like 'air_drag'")
    parameters = getattr(effect, "parameters", None)
    if not isinstance(parameters, tuple) or not all(isinstance(q, Parameter) for q in parameters):
        refuse("parameters must be a tuple of Parameter; mind the comma after a single one")
    names = [q.name for q in effect.parameters]
    if len(set(names)) != len(names):
        refuse(f"parameters have the same name twice: {names}; rename one")
    wider: object = effect.wider
    if wider is not None and not (isinstance(wider, type) and issubclass(wider, Effect)):
        refuse("wider must be another effect's class")
    if not any(q.amplitude for q in effect.parameters):
        refuse("no parameter is an amplitude: nothing switches the effect off")
    if not isinstance(effect.memory, tuple) or not all(isinstance(m, str) for m in effect.memory):
        refuse("memory must be a tuple of names, such as ('flow',)")
    known = {*HOOKS, *_FIELDS}
    for key, value in vars(effect).items():
        if key.startswith("_") or key in known:
            continue
        close = difflib.get_close_matches(key, known, 1)
        hint = f"; did you mean {close[0]!r}?" if close else f"; hooks are {', '.join(HOOKS)}"
        function = value.__func__ if isinstance(value, staticmethod) else value
        code = getattr(function, "__code__", None)
        refuse(f"{key!r} is no hook{hint}", code.co_firstlineno if code else line)
    used = [h for h in HOOKS if getattr(effect, h) is not None]
    if not used:
        refuse("has no hook, so it does nothing")
    for hook in used:
        function = getattr(effect, hook)
        count, forms = function.__code__.co_argcount, [HOOKS[hook]]
        forms += [OTHERWISE[hook]] if hook in OTHERWISE else []
        if count not in map(len, forms):
            needed = " or ".join(f"({', '.join(form)})" for form in forms)
            refuse(
                f"{hook} takes {count} arguments, needs {needed}",
                function.__code__.co_firstlineno,
            )
    if bool(effect.memory) != (effect.memory_rate is not None):
        refuse("memory and memory_rate need each other")
    if effect.memory and effect.moment is None:
        refuse("memory without moment has no effect")


def _probe_values(effect: type[Effect]) -> Iterator[dict[str, float]]:
    """Defaults, starts, and each parameter at its (finite) bounds."""
    typical = {q.name: q.starts[0] for q in effect.parameters}
    yield {q.name: q.default for q in effect.parameters}
    yield typical
    for q in effect.parameters:
        for value in (*q.starts, q.low, q.high):
            if math.isfinite(value):
                yield typical | {q.name: value}


def _places() -> Iterator[Place]:
    velocities = ((0.0, 0.0), (0.3, -0.8), (-0.2, 0.1), (1.5, 1.0))
    for (vx, vy), angle, spin in itertools.product(velocities, (0.0, 0.7, -2.0), (0.0, 9.0)):
        tx, ty = -math.cos(angle), -math.sin(angle)
        yield Place(-0.05, -0.02, vx, vy, tx, ty, angle, spin, 0.06, 0.4)


def _bends() -> Iterator[Bend]:
    for curvature, rate in itertools.product((0.0, 4.0, -11.0), (0.0, 60.0, -0.1)):
        yield Bend(curvature, rate, 3e-5, 0.02)


def _calls(effect: type[Effect], hook: str, p: Any) -> list[tuple[Any, ...]]:
    """Arguments of a hook, one after another, at the probe states."""
    memory = SimpleNamespace(**dict.fromkeys(effect.memory, 0.3))
    states: dict[str, Iterable[tuple[Any, ...]]] = {
        "force": ((place,) for place in _places()),
        "moment": ((bend, memory) for bend in _bends()),
        "memory_rate": ((bend, memory) for bend in _bends()),
        "memory_at_rest": ((bend._replace(rate=0.0),) for bend in _bends()),
        "rest_curvature": [(_ARCS_M,)],
        "camera_time": [(_TIMES_S, _POINTS_M)],
        "camera_points": [(_POINTS_M,)],
    }
    if hook == "inertia" and effect.varies_along_cable():
        return [(_CABLE, _ARCS_M, p)]
    return [(_CABLE, *state, p) for state in states.get(hook, [()])]


def _try(effect: type[Effect], hook: str, p: Any) -> None:
    if hook == "clamp":
        _try_clamp(effect, p)
        return
    sizes = {"force": 2, "inertia": 2, "point_mass": 2, "grip_compliance": 2}
    sizes |= dict.fromkeys(("memory_rate", "memory_at_rest"), len(effect.memory))
    for args in _calls(effect, hook, p):
        if hook in ("rest_curvature", "camera_time", "camera_points"):
            _array(effect, hook, args)
        elif hook == "inertia" and effect.varies_along_cable():
            _inertia_along(effect, args)
        else:
            values = _numbers(effect, hook, sizes.get(hook, 0), args)
            if hook in ("tip_mass", "point_mass", "grip_compliance") and min(values) < 0.0:
                _refuse(effect, hook, f"returned {values}: must be ≥ 0")


def _try_clamp(effect: type[Effect], p: Any) -> None:
    pose = HandMotion(lambda t: (0.01 * t, -0.05 * np.tanh(9.0 * t - 2.0), 0.0 * t), 0.0, 0.6)
    moved = _call(effect, "clamp", (pose, p))
    if not callable(moved):
        _refuse(effect, "clamp", f"returned {moved!r}: must be a function of time")
    try:
        result = np.array(moved(_TIMES_S), dtype=np.float64)
    except (Exception, SystemExit) as error:
        raise _placed(error, effect, "clamp") from error
    if result.shape != (3, _TIMES_S.size) or not np.all(np.isfinite(result)):
        _refuse(effect, "clamp", f"pose(t) has shape {result.shape}, not finite (3, T)")


def _numbers(effect: type[Effect], hook: str, size: int, args: tuple[Any, ...]) -> list[float]:
    """Result of a scalar hook: `size` numbers, or one if 0."""
    result = _call(effect, hook, args)
    wanted = f"a tuple of {size} numbers" if size else "one number"
    sequence = isinstance(result, tuple)
    values = list(result) if sequence else [result]
    if sequence != bool(size) or len(values) != max(1, size):
        _refuse(effect, hook, f"returned {result!r}: must be {wanted}")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            _refuse(effect, hook, f"returned {result!r}: must be {wanted}")
        if not math.isfinite(value):
            _refuse(effect, hook, f"returned {result!r} for {args[1:]}: must be finite")
    return [float(v) for v in values]


def _array(effect: type[Effect], hook: str, args: tuple[Any, ...]) -> None:
    """Check the result of a hook of arrays: as many values as its first array has."""
    result, shape = np.asarray(_call(effect, hook, args)), args[1].shape
    if result.shape != shape and hook != "camera_time":
        _refuse(effect, hook, f"returned shape {result.shape}: must be {shape}")
    _check_finite(effect, hook, result)


def _inertia_along(effect: type[Effect], args: tuple[Any, ...]) -> None:
    """Check the result of `inertia` at arc lengths."""
    result = _call(effect, "inertia", args)
    wanted = f"(along, normal), each a number or of shape {_ARCS_M.shape}"
    if not isinstance(result, tuple) or len(result) != 2:
        _refuse(effect, "inertia", f"returned {result!r}: must be {wanted}")
    for each in map(np.asarray, result):
        if each.shape not in ((), _ARCS_M.shape):
            _refuse(effect, "inertia", f"returned shape {each.shape}: must be {wanted}")
        _check_finite(effect, "inertia", each)


def _check_finite(effect: type[Effect], hook: str, result: np.ndarray) -> None:
    if result.dtype.kind not in "fi" or not np.all(np.isfinite(result)):
        _refuse(effect, hook, "returned values that are not finite")


def _call(effect: type[Effect], hook: str, args: tuple[Any, ...]) -> Any:
    try:
        with np.errstate(all="ignore"):
            return getattr(effect, hook)(*args)
    except (Exception, SystemExit) as error:
        raise _placed(error, effect, hook) from error


def _placed(error: BaseException, effect: type[Effect], hook: str) -> EffectError:
    """The error at the line of the effect's own file where it arose."""
    path, _ = _where(effect)
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if Path(f.filename) == path]
    line = own[-1].lineno if own else _line(effect, hook)
    return EffectError(path, line or 0, f"{effect.name}.{hook}: {error_text(error)}")


def _refuse(effect: type[Effect], hook: str, cause: str) -> None:
    raise EffectError(_where(effect)[0], _line(effect, hook), f"{effect.name}.{hook} {cause}")


def _line(effect: type[Effect], hook: str) -> int:
    function: Callable[..., Any] = getattr(effect, hook)
    return int(function.__code__.co_firstlineno)


def _check_off(effect: type[Effect]) -> None:
    """At the defaults of its amplitudes the effect must be absent, whatever its other values."""
    values = {q.name: q.default if q.amplitude else q.starts[0] for q in effect.parameters}
    p = SimpleNamespace(**values)
    amplitudes = ", ".join(f"{q.name} = {q.default:g}" for q in effect.parameters if q.amplitude)
    for hook in HOOKS:
        if getattr(effect, hook) is None or hook in NEVER_OFF:
            continue
        for args in _calls(effect, hook, p):
            result = getattr(effect, hook)(*args)
            if hook == "camera_time":
                absent = np.allclose(result, args[1], rtol=0.0, atol=1e-12)
            elif hook == "camera_points":
                absent = np.allclose(result, args[1], atol=1e-12)
            else:
                results = result if isinstance(result, tuple) else (result,)
                size = 1 if hook in ("point_mass", "grip_compliance") else None
                absent = not any(np.any(value) for value in results[:size])
            if not absent:
                _refuse(effect, hook, f"is not off at {amplitudes}: mend that")


def _check_dissipation(effect: type[Effect], doing: Doing) -> None:
    for values in _probe_values(effect):
        p = SimpleNamespace(**values)
        hook = "force" if effect.moment is None else "moment"
        if getattr(effect, hook) is not None:
            doing(f"{effect.name}.{hook}", _line(effect, hook), PATIENCE_S)
        if effect.force is not None:
            for place in _places():
                fx, fy = effect.force(_CABLE, place, p)
                power = fx * place.vx + fy * place.vy
                if power > 1e-12:
                    _refuse(
                        effect,
                        "force",
                        f"feeds {power:.3g} W/m into the cable at {place} with {values}, "
                        "although declared dissipative",
                    )
        if effect.moment is not None:
            for amplitude in (0.5, 5.0):
                work, scale = _cycle_work(effect, p, amplitude)
                if work < -1e-6 * scale - 1e-18:
                    _refuse(
                        effect,
                        "moment",
                        f"feeds {-work:.3g} N per bending cycle of ±{amplitude} /m with {values}, "
                        "although declared dissipative",
                    )


def _cycle_work(effect: type[Effect], p: Any, amplitude: float) -> tuple[float, float]:
    """∮ M dκ over the last of some cycles at 4 Hz, and ∮ |M dκ|."""
    steps, cycles, omega = 400, 6, 2.0 * math.pi * 4.0
    dt = 2.0 * math.pi / omega / steps
    moment, rate_of = effect.moment, effect.memory_rate
    assert moment is not None
    z = dict.fromkeys(effect.memory, 0.0)
    work = scale = 0.0
    for k in range(steps * cycles):
        phase = omega * dt * (k + 0.5)
        at = Bend(amplitude * math.sin(phase), amplitude * omega * math.cos(phase), 3e-5, 0.02)
        before = dict(z)
        if rate_of is not None:
            nudge = 1e-6
            rates = rate_of(_CABLE, at, SimpleNamespace(**z), p)
            for j, key in enumerate(z):
                near = SimpleNamespace(**(before | {key: before[key] + nudge}))
                slope = (rate_of(_CABLE, at, near, p)[j] - rates[j]) / nudge
                share = math.expm1(slope * dt) / slope if abs(slope * dt) > 1e-9 else dt
                z[key] = before[key] + rates[j] * share
        middle = SimpleNamespace(**{key: 0.5 * (before[key] + z[key]) for key in z})
        if k >= steps * (cycles - 1):
            power = moment(_CABLE, at, middle, p) * at.rate * dt
            work, scale = work + power, scale + abs(power)
    return work, scale


def visit_many_states(effect: type[Effect]) -> None:
    """Call the compiled hooks, in plain Python, at states of a swinging cable.

    An endless loop may occur in few of them only.  Other errors of a hook are ignored here and
    reported when the effect is used.
    """
    rng = np.random.default_rng(1)
    values = list(_probe_values(effect))
    low = np.array([-0.15, -0.2, -2.0, -2.0, -1.0, -1.0, -3.2, -40.0, 0.0, 0.0])
    high = np.array([0.05, 0.1, 2.0, 2.0, 1.0, 1.0, 3.2, 40.0, 0.1, 2.0])
    for k in range(STATES):
        p = SimpleNamespace(**values[k % len(values)])
        state = [float(v) for v in rng.uniform(low, high)]
        at = Bend(60.0 * state[4], 100.0 * state[2], 3e-5, state[8])
        memory = SimpleNamespace(**dict.fromkeys(effect.memory, state[5]))
        with contextlib.suppress(Exception), np.errstate(all="ignore"):
            if effect.force is not None:
                effect.force(_CABLE, Place(*state), p)
            if effect.moment is not None:
                effect.moment(_CABLE, at, memory, p)
            if effect.memory_rate is not None:
                effect.memory_rate(_CABLE, at, memory, p)
