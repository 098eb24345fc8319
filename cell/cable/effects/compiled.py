"""Effects → compiled loops, cached on disk; the same for the project's own and a user's.

`cell.cable.stepping.integrate` calls the loops by their addresses (`pointer`).
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import types
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from cell.cable import layout as at
from cell.cable.compiling import fingerprint
from cell.cable.effects import pointer, templates
from cell.cable.effects.base import ActiveEffect, CableData, Effect
from cell.cable.geometry import Cable

#: Most Newton iterations per step: one suffices for smooth laws; with a kink at a curvature rate of
#: 0, a rate that changes its sign needs the tangent of the other side.
_ITERATIONS, _ITERATIONS_WITH_KINK = 1, 3


@dataclass(frozen=True)
class Loops:
    """Addresses of an effect's compiled loops, None without such a hook; `alive` holds the code."""

    force: int | None
    moment: int | None
    alive: tuple[Any, ...]


_LOOPS: dict[type[Effect], Loops] = {}
#: Whether loops are cached on disk.
_on_disk = True


def disable_disk_cache() -> None:
    """From now on this process neither writes loops to disk nor reads them."""
    global _on_disk
    _on_disk = False


def take_loops(effect: type[Effect], loops: Loops) -> None:
    """Register the addresses of an effect's loops, whose code runs in another process."""
    _LOOPS[effect] = loops


def symbol_of(address: int) -> str:
    """Name of the effect whose loop has this address."""
    return next(e.name for e, loops in _LOOPS.items() if address in (loops.force, loops.moment))


def loops_of(effect: type[Effect]) -> Loops:
    """Compile, or load from disk, the loops of an effect; once per process."""
    if effect not in _LOOPS:
        _LOOPS[effect] = _build(effect)
    return _LOOPS[effect]


def _build(effect: type[Effect]) -> Loops:
    fields = tuple(p.name for p in effect.parameters)
    alive: list[Any] = []

    def build(source: str) -> int:
        module = _module(source, effect)
        alive.append(module)
        return pointer.address_of(module.loop)

    force = build(templates.force_source(effect.name, fields)) if effect.force else None
    moment = None
    if effect.moment:
        rested = effect.memory_at_rest is not None
        moment = build(templates.moment_source(effect.name, fields, effect.memory, rested))
    return Loops(force, moment, tuple(alive))


def parameters(active: ActiveEffect) -> Any:
    """The `p` of a hook: parameter values as attributes."""
    return SimpleNamespace(**active.named)


class CompiledModel(Protocol):
    """The part of a cable's model that is passed to its effects' hooks."""

    @property
    def cable(self) -> Cable:
        """The cable."""
        ...

    @property
    def effects(self) -> tuple[ActiveEffect, ...]:
        """Its effects with their values."""
        ...


def cable_data(model: CompiledModel) -> CableData:
    """The `cable` of a hook."""
    cable = model.cable
    return CableData(
        cable.width_m, cable.thickness_m, cable.line_density_kg_per_m, cable.free_length_m
    )


@dataclass(frozen=True)
class Hooks:
    """Compiled loops of the effects of a group of lanes, in the engine's form.

    iterations  most Newton iterations per step
    """

    forces: NDArray[np.int64]
    moments: NDArray[np.int64]
    rows: NDArray[np.int64]
    memory_rows: NDArray[np.int64]
    memory_count: int
    iterations: int

    def arguments(self, models: Sequence[CompiledModel], segments: int, start_s: float) -> Any:
        """Argument `effects` of the compiled functions for up to LANES models with these loops."""
        columns = [
            (*cable_data(m), *(v for a in in_steps(m.effects) for v in a.values)) for m in models
        ]
        table = at.vectors(len(columns[0]))
        table[:, : len(models)] = np.array(columns).T
        table[:, len(models) :] = table[:, :1]
        memory = at.vectors(max(1, self.memory_count) * (segments + 1)).ravel()
        return (
            self.forces,
            self.moments,
            table.ravel(),
            self.rows,
            memory,
            self.memory_rows,
            start_s,
        )


def in_steps(effects: Sequence[ActiveEffect]) -> list[ActiveEffect]:
    """The effects with a force or a moment, which the engine evaluates at every step."""
    return [a for a in effects if a.effect.force is not None or a.effect.moment is not None]


def hooks_of(effects: Sequence[ActiveEffect]) -> Hooks:
    """Loops, parameter rows and memory rows of the effects of `in_steps`, forces first."""
    forces, force_rows, moments, moment_rows, memory_rows = [], [], [], [], []
    row, memory = 4, 0
    for active in in_steps(effects):
        loops = loops_of(active.effect)
        if loops.force is not None:
            forces.append(loops.force)
            force_rows.append(row)
        if loops.moment is not None:
            moments.append(loops.moment)
            moment_rows.append(row)
            memory_rows.append(memory)
            memory += len(active.effect.memory)
        row += len(active.values)

    kinked = any(a.effect.memory and not a.effect.smooth for a in effects)

    def array(values: list[int]) -> NDArray[np.int64]:
        return np.array(values, dtype=np.int64)

    return Hooks(
        array(forces),
        array(moments),
        array(force_rows + moment_rows),
        array(memory_rows),
        memory,
        _ITERATIONS_WITH_KINK if kinked else _ITERATIONS,
    )


def _module(source: str, effect: type[Effect]) -> Any:
    """Module of `source`, in a file whose name is a hash of all inputs of its machine code."""
    if not _on_disk:
        return _run(source.replace(", cache=True", ""), effect, Path(f"{effect.name}.py"))
    defined_in = getattr(sys.modules.get(effect.__module__), "__file__", None)
    text = Path(defined_in).read_text(encoding="utf-8") if defined_in else ""
    effect_is = f"{effect.__module__}.{effect.__qualname__}"  # numba loads it by this name
    depends = [source, effect_is, text, fingerprint(), numba.__version__, np.__version__]
    key = hashlib.sha256("\0".join(depends).encode()).hexdigest()[:20]
    path = _cache_folder() / f"{effect.name}_{key}.py"
    if not path.exists():
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.parent, suffix=".tmp", delete=False
        ) as file:
            file.write(source)
        Path(file.name).replace(path)
    return _run(source, effect, path)


def _run(source: str, effect: type[Effect], path: Path) -> Any:
    """Module of a source whose `EFFECT` is an effect."""
    module = types.ModuleType(path.stem)
    module.__file__ = str(path)
    module.__dict__["EFFECT"] = effect
    sys.modules[path.stem] = module
    exec(compile(source, str(path), "exec"), module.__dict__)
    return module


def proof_of(file: Path) -> Path:
    """Marker file; it exists if this version of an effect's file has passed its trial."""
    depends = [str(file), fingerprint(), numba.__version__, np.__version__]
    key = hashlib.sha256("\0".join(depends).encode() + file.read_bytes()).hexdigest()[:20]
    return _cache_folder() / f"tried_{key}"


@lru_cache(maxsize=1)
def _cache_folder() -> Path:
    """Folder for generated loops: NUMBA_CACHE_DIR, else the user's cache, else a temporary one."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    for parent in (os.environ.get("NUMBA_CACHE_DIR"), home):
        if parent:
            folder = Path(parent) / "cable-cell"
            try:
                folder.mkdir(parents=True, exist_ok=True)
                tempfile.TemporaryFile(dir=folder).close()
            except OSError:
                continue
            return folder
    return Path(tempfile.mkdtemp(prefix="cable-cell-"))
