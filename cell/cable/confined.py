"""The process inside a sandbox: loads untrusted effects, and runs their hooks and the engine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.effects import compiled
from cell.cable.effects.base import COMPILED, CableData, Effect, EffectError, HandMotion
from cell.cable.effects.check import HOOKS
from cell.cable.effects.compiled import loops_of
from cell.cable.effects.library import library, load_source, try_source, unscreened
from cell.cable.effects.own import first_line, run_engine
from cell.cable.effects.remote import WRITTEN
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.cable.statics import balance
from cell.cable.stepping import integrate
from cell.computer.confinement import MEMORY_BYTES
from cell.computer.sandbox import Channel, libraries, tend

#: Functions of the engine by name.
ENGINE: dict[str, Any] = {"balance": balance, "integrate": integrate}
#: Longest text of a law's description, characters.
_LONGEST = 2000


def main(control: int) -> NoReturn:
    """Entry point of the process that loads the engine and then forks the sandboxes."""
    _load_engine()
    tend(control, serve, libraries())


def serve(channel: Channel) -> None:
    """Serve requests until the channel is closed."""
    compiled.disable_disk_cache()
    effects: dict[str, type[Effect]] = {}
    while True:
        try:
            request = channel.receive()
        except EOFError:
            return
        try:
            answer = _done(channel, request, effects)
        except EffectError as error:
            answer = {"refused": (str(error.path), error.line, error.cause)}
        except MemoryError:
            cause = f"takes more than {MEMORY_BYTES / 1024**3:g} GiB: mend that"
            answer = {"refused": ("", 1, cause)}
        channel.send(answer)


def _done(channel: Channel, request: Any, effects: dict[str, type[Effect]]) -> dict[str, Any]:
    """Answer to one request.  Raises EffectError."""
    if "file" in request:

        def doing(what: str, line: int, seconds: float) -> None:
            channel.send({"doing": (what, line, seconds)})

        load = try_source if request["try"] else load_source
        effect = load(Path(request["file"]), request["text"].encode(), doing)
        effects[effect.name] = effect
        return {"effect": _described(effect)}
    if "hook" in request:
        effect = effects[request["effect"]]
        return {"value": _called(channel, effect, request["hook"], *request["args"])}
    args = list(request["args"])
    known = library() | unscreened() | effects
    tuple_at = next(i for i, a in enumerate(args) if isinstance(a, tuple))
    forces, moments, *others = args[tuple_at]
    addresses = (
        np.array([loops_of(known[n]).force for n in forces], dtype=np.int64),
        np.array([loops_of(known[n]).moment for n in moments], dtype=np.int64),
    )
    args[tuple_at] = (*addresses, *others)
    own = tuple(effects[n] for n in dict.fromkeys([*forces, *moments]) if n in effects)
    name = request["engine"]
    result = run_engine(ENGINE[name], own, *args)
    return {"value": int(result), "arrays": [args[i] for i in WRITTEN[name]], "memory": others[2]}


def _called(channel: Channel, effect: type[Effect], hook: str, *args: Any) -> Any:
    """Result of a hook; the gripper's pose is requested at the times that the hook needs."""
    *first, values = args
    p = SimpleNamespace(**values)
    if hook == "clamp":
        begin, end, times = first

        def pose(t_s: Any) -> Any:
            channel.send({"pose": np.asarray(t_s, dtype=np.float64)})
            return tuple(channel.receive())

        moved: Callable[[Any], Any] = effect.clamp(HandMotion(pose, begin, end), p)  # type: ignore[misc]
        return tuple(np.asarray(v, dtype=np.float64) for v in moved(times))
    cable, *others = first
    result = getattr(effect, hook)(CableData(*cable), *others, p)
    return tuple(map(_plain, result)) if isinstance(result, tuple) else _plain(result)


def _plain(value: Any) -> Any:
    return np.asarray(value, dtype=np.float64) if isinstance(value, np.ndarray) else float(value)


def _described(effect: type[Effect]) -> dict[str, Any]:
    """Description of an effect for the other process."""
    hooks = [h for h in HOOKS if getattr(effect, h) is not None]
    return {
        "name": effect.name,
        "law": (effect.__doc__ or "")[:_LONGEST],
        "parameters": [
            (
                *(q.name, q.unit, float(q.low), float(q.high), float(q.default)),
                *(tuple(map(float, q.starts)), bool(q.amplitude), bool(q.fitted)),
                tuple(map(float, q.scan)),
            )
            for q in effect.parameters
        ],
        "memory": tuple(effect.memory),
        "dissipative": bool(effect.dissipative),
        "smooth": bool(effect.smooth),
        "wider": None if effect.wider is None else effect.wider.name,
        "hooks": hooks,
        "varies_along_cable": effect.varies_along_cable(),
        "line": first_line(effect) if {*COMPILED} & {*hooks} else 1,
    }


def _load_engine() -> None:
    """Load the engine and the library's loops from disk, or compile and store them."""
    still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))
    effects = [e for e in library().values() if e.force or e.moment]
    model = CableModel.uniform(
        Cable(free_length_m=0.1, line_density_kg_per_m=0.0074, width_m=0.016, thickness_m=0.0001),
        rigidity_n_m2=3e-5,
        viscosity_n_m2_s=1e-7,
        effects=tuple(e.active() for e in effects),
    )
    simulate(model, still, np.array([0.0, 0.01]), np.array([0.1]))
