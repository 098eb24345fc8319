"""Benchmark of planar rods: CPU time to simulate tips to 50, 10 and 1 µm, by this engine and peers.

    python -m tools.bench.benchmark_rods FILE.csv [--small] [--table FOLDER]

For each task (`bench_task.rod_tasks`) and entrant (`rod_entrants.entrants`), settings are tried in
the order of their work, up to a budget of work or until 1 µm rms is reached.  Settings of a series
that no longer improves are skipped.  The cheapest within a tolerance is the
first of that order, so that two runs choose the same settings.  Times are the CPU time of all
threads, the shortest of three runs, or of one that takes a second.  Existing rows of FILE are kept.

Tips are compared with the engine's on two fine meshes, extrapolated; `reference_um` is the
finer mesh's difference from that, `peer_um` that of MuJoCo, itself extrapolated.  Two more tasks:
cost against segments, and a swing without damping, whose energy should be constant
(`energy_percent`: change over 8 s of the tip's mean square speed, relative to the reference's).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from math import inf, isfinite, nan
from pathlib import Path

import numpy as np

from cell.cable.model import CableModel
from tools.bench.bench_task import CABLE, RodTask, best_of, on_offsets, rod_tasks, tip_error
from tools.bench.rod_entrants import (
    EngineEntrant,
    RodEntrant,
    RodSetting,
    Run,
    entrants,
    versions,
)
from tools.studies.rows import added_rows, read_rows, write_measured

TOLERANCES_UM = (50.0, 10.0, 1.0)
#: A series of settings ends if two refinements gain less.
GAIN, COST_STEP_S = 0.1, 1.25e-3
SWING_S, WINDOW_S = 10.0, 2.0
#: Longest run that is measured repeatedly, s.
SLOW_S = 4.0
COMMAND = "make benchmark-rods"


@dataclass(frozen=True)
class RodExtent:
    """Extent of a benchmark.

    budget_s  budget of a search, s
    coarse    segments and step, s, of the reference; its fine mesh and step are half of them
    peer      MuJoCo's segments, and steps per period of the times, of its limit; and twice both
    segments  meshes whose cost is measured
    """

    budget_s: float = 75.0
    coarse: tuple[int, float] = (200, 2e-4)
    peer: tuple[int, int] = (40, 40)
    segments: tuple[int, ...] = (10, 20, 40, 80, 160)


FULL, SMALL = RodExtent(), RodExtent(2.0, (60, 5e-4), (10, 20), (10, 20))


@dataclass(frozen=True)
class RodRow:
    """An entrant's result with one setting.

    cpu_ms  CPU time per simulated second of a lane
    """

    task: str
    entrant: str
    versions: str
    segments: int
    step_ms: float
    kind: str
    rms_um: float
    cpu_ms: float
    rollouts_per_cpu_s: float
    rollouts_per_s: float
    run_cpu_s: float
    energy_percent: float
    reference_um: float
    peer_um: float

    @property
    def key(self) -> tuple[object, ...]:
        return self.task, self.entrant, self.segments, self.step_ms, self.kind

    @property
    def text(self) -> str:
        return f"{self.segments} segments, {self.step_ms:g} ms, {self.kind}"


@dataclass(frozen=True, eq=False)
class RodReference:
    """Tips, (lanes, times, 2), m, and their uncertainties, µm."""

    tips: np.ndarray
    own_um: float = nan
    peer_um: float = nan


def reference(task: RodTask, peer: RodEntrant | None, extent: RodExtent = FULL) -> RodReference:
    """The engine's tips, extrapolated to the limit of fine meshes and steps."""
    engine, (n, step_s) = EngineEntrant(), extent.coarse
    meshes = (n, step_s), (2 * n, step_s / 2.0)
    coarse, fine = (engine.runner(task, RodSetting(*m, "damping 0.8"))() for m in meshes)
    limit = fine + (fine - coarse) / 3.0
    own_um = 1e6 * tip_error(fine, limit)
    if peer is None:
        return RodReference(limit, own_um)
    part, (n, parts) = task.part(10), extent.peer
    tips = [
        peer.runner(part, RodSetting(segments, task.period_s / steps, "Euler"))()
        for segments, steps in ((n, parts), (2 * n, parts), (n, 2 * parts))
    ]  # second order in the mesh, first in the step
    theirs = tips[1] + (tips[1] - tips[0]) / 3.0 + 2.0 * (tips[2] - tips[0])
    return RodReference(limit, own_um, 1e6 * tip_error(theirs, limit[::10]))


def timed(run: Run) -> tuple[np.ndarray, float, float]:
    """Tips, and shortest CPU and wall time, s."""
    cpu_s, wall_s = inf, inf
    for _ in range(3):
        before = time.process_time(), time.perf_counter()
        tips = run()
        cpu_s = min(cpu_s, time.process_time() - before[0])
        wall_s = min(wall_s, time.perf_counter() - before[1])
        if wall_s > 1.0:
            break
    return tips, cpu_s, wall_s


def key_of(task: RodTask, entrant: RodEntrant, setting: RodSetting) -> tuple[object, ...]:
    """The key of the row of a setting."""
    step_ms = round(1e3 * setting.step_s, 6)
    return task.name, entrant.name, setting.segments, step_ms, setting.kind


def tried(task: RodTask, entrant: RodEntrant, setting: RodSetting, exact: RodReference) -> RodRow:
    """The row of a setting."""
    tips, cpu_s, wall_s = timed(entrant.runner(task, setting))
    lanes, energy = len(task.models), nan
    if task.times_s[-1] > SWING_S - 1.0:
        energy = 100.0 * (energy_ratio(tips, task) / energy_ratio(exact.tips, task) - 1.0)
    return RodRow(
        task.name, entrant.name, versions(entrant), setting.segments,
        round(1e3 * setting.step_s, 6), setting.kind, round(1e6 * tip_error(tips, exact.tips), 3),
        float(f"{1e3 * cpu_s / task.simulated_s:.4g}"), float(f"{lanes / cpu_s:.4g}"),
        float(f"{lanes / wall_s:.4g}"), float(f"{cpu_s:.4g}"), round(energy, 3),
        float(f"{exact.own_um:.2g}"), float(f"{exact.peer_um:.2g}"),
    )  # fmt: skip


def energy_ratio(tips: np.ndarray, task: RodTask) -> float:
    """Mean square of the tip's speed at the end over that after the motion; nan: it diverged."""
    if not np.all(np.isfinite(tips)):
        return nan
    speed = np.sum(np.diff(tips, axis=1) ** 2, axis=2).mean(axis=0)
    count, first = round(WINDOW_S / task.period_s), round(1.0 / task.period_s)
    return float(speed[-count:].mean() / speed[first : first + count].mean())


def searched(
    task: RodTask,
    entrant: RodEntrant,
    exact: Callable[[], RodReference],
    budget_s: float,
    known: dict[tuple[object, ...], RodRow],
    segments: int | None = None,
) -> Iterator[tuple[RodRow, RodSetting]]:
    """Rows in the order of their work, until the smallest tolerance is reached.

    segments  the only mesh; None = all
    """
    errors: dict[tuple[object, ...], list[float]] = {}
    for setting in sorted(entrant.settings(task), key=lambda s: s.work_s):
        if segments not in (None, setting.segments):
            continue
        series = [errors.setdefault(key, []) for key in setting.series()]
        if any(len(e) > 2 and e[-1] > (1.0 - GAIN) * e[-3] for e in series):
            continue
        budget_s -= setting.work_s
        if budget_s < 0.0:
            return
        row = known.get(key_of(task, entrant, setting)) or tried(task, entrant, setting, exact())
        yield row, setting
        if row.rms_um <= TOLERANCES_UM[-1]:
            return
        for e in series:
            e.extend([row.rms_um] * isfinite(row.rms_um))


def benchmark(
    file: Path, there: dict[str, RodEntrant], tasks: Sequence[RodTask], extent: RodExtent
) -> Iterator[RodRow]:
    """Add rows to a file: searches, cost against segments, swings without damping."""
    known = {row.key: row for row in read_rows(file, RodRow)}
    peer, usual = there.get("MuJoCo"), tasks[0]

    def fresh() -> Iterator[RodRow]:
        computed: list[RodRow] = []
        for task in tasks:
            exact = cache(lambda task=task: reference(task, peer, extent))
            for entrant in there.values():
                for row, _ in searched(task, entrant, exact, extent.budget_s, known):
                    computed.append(row)
                    yield row
        same = [(n, COST_STEP_S, kind) for n in extent.segments
                for kind in ("damping 0.8", "implicitfast")]  # fmt: skip
        yield from fixed(replace(usual, name="cost of segments"), same, there, known)
        undamped = on_offsets("undamped swing", CableModel.uniform(CABLE, 3e-5), offsets=3)
        undamped = replace(undamped, times_s=np.arange(0.0, SWING_S, usual.period_s))
        chosen = [cheapest(computed, usual.name, name, TOLERANCES_UM[0]) for name in there]
        best = [(r.segments, 1e-3 * r.step_ms, r.kind) for r in chosen if r]
        yield from fixed(undamped, best, there, known)

    rows = (row for row in fresh() if row.key not in known)
    for row in added_rows(file, RodRow, rows):
        print(f"{row.task:24} {row.entrant:10} {row.text:44} {row.rms_um:10.2f} µm "
              f"{row.cpu_ms:10.4g} ms/s", flush=True)  # fmt: skip
        yield row


def fixed(
    task: RodTask,
    settings: Sequence[tuple[int, float, str]],
    there: dict[str, RodEntrant],
    known: dict[tuple[object, ...], RodRow],
) -> Iterator[RodRow]:
    """Rows of fixed settings, by the entrants that offer their kind."""
    finest = RodSetting(80, 2.5e-4, "damping 1.0")
    exact = cache(lambda: RodReference(EngineEntrant().runner(task, finest)()))
    kinds = {name: {s.kind for s in entrant.settings(task)} for name, entrant in there.items()}
    for setting in (RodSetting(*each) for each in settings):
        for name, entrant in there.items():
            if setting.kind in kinds[name]:
                key = key_of(task, entrant, setting)
                yield known.get(key) or tried(task, entrant, setting, exact())


def ordered(rows: Sequence[RodRow], there: dict[str, RodEntrant]) -> list[RodRow]:
    """Rows by task, entrant and work: a run continued with a larger budget has them mixed."""
    tasks = rod_tasks()
    work_s = {
        key_of(task, entrant, s): s.work_s
        for task in tasks.values() for entrant in there.values() for s in entrant.settings(task)
    }  # fmt: skip
    place = {name: i for i, name in enumerate((*tasks, *there))}
    last = len(place)
    return sorted(
        rows,
        key=lambda r: (place.get(r.task, last), place.get(r.entrant, last), work_s.get(r.key, inf)),
    )


def cheapest(rows: Sequence[RodRow], task: str, name: str, within_um: float) -> RodRow | None:
    """The first row of a search that is within a tolerance."""
    mine = (r for r in rows if (r.task, r.entrant) == (task, name) and r.rms_um <= within_um)
    return next(mine, None)


def summary(
    rows: Sequence[RodRow], there: dict[str, RodEntrant], absent: dict[str, str]
) -> Iterator[dict[str, object]]:
    """A row per task: the engine's cost at each tolerance, and its peers' as multiples of it.

    The chosen settings are measured again, alternately.  A peer that does not reach a tolerance has
    its smallest error there, and the ratio of its setting.
    """
    for task in (t for t in rod_tasks().values() if any(r.task == t.name for r in rows)):
        here = [r for r in rows if r.task == task.name]
        row: dict[str, object] = {"condition": task.name}
        for limit in TOLERANCES_UM:
            chosen = {name: cheapest(here, task.name, name, limit) for name in there}
            reached = {name: r for name, r in chosen.items() if r}
            cpu_ms = _in_turns(task, reached, there)
            own = chosen["engine"]
            for name in (*there, *absent):
                mine = [r for r in here if r.entrant == name and isfinite(r.rms_um)]
                text = absent.get(name, "not run")
                best = reached.get(name) or min(mine, key=lambda r: r.rms_um, default=None)
                cost_ms = cpu_ms.get(name, best.cpu_ms if best else nan)
                ratio = f"{cost_ms / cpu_ms['engine']:.3g}" if own and best else ""
                if best:
                    few = f"best {best.rms_um:.{0 if best.rms_um >= 20.0 else 1}f} µm"
                    text = ratio if own and name in reached else few
                row[f"{name}_{limit:g}"] = text
                row[f"{name}_ratio_{limit:g}"] = ratio
                row[f"{name}_setting_{limit:g}"] = best.text if best else ""
            row[f"engine_ms_{limit:g}"] = f"{cpu_ms['engine']:.4g}" if own else ""
            row[f"rollouts_per_cpu_s_{limit:g}"] = own.rollouts_per_cpu_s if own else ""
            row[f"rollouts_per_s_{limit:g}"] = own.rollouts_per_s if own else ""
        row |= {"n": len(here), "reference_um": here[0].reference_um, "peer_um": here[0].peer_um}
        row["versions"] = " ".join(dict.fromkeys(r.versions for r in here))
        yield row


def _in_turns(
    task: RodTask, rows: dict[str, RodRow], there: dict[str, RodEntrant]
) -> dict[str, float]:
    """CPU time per simulated second of a lane, ms; for slow settings that of their row."""
    times_ms = {name: row.cpu_ms for name, row in rows.items()}
    fast = [name for name, row in rows.items() if row.run_cpu_s < SLOW_S]
    runs = [
        there[n].runner(task, RodSetting(r.segments, 1e-3 * r.step_ms, r.kind))
        for n, r in rows.items() if n in fast
    ]  # fmt: skip
    times_s = best_of(*runs, rounds=5, clock=time.process_time)
    return times_ms | {n: 1e3 * s / task.simulated_s for n, s in zip(fast, times_s, strict=True)}


def frontier(rows: Sequence[RodRow]) -> Iterator[RodRow]:
    """Rows that are better than all earlier ones of the task and entrant; and fixed settings."""
    least: dict[tuple[str, str], float] = {}
    for row in rows:
        key = row.task, row.entrant
        if row.rms_um < least.get(key, inf) or not isfinite(row.reference_um):
            least[key] = row.rms_um
            yield row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="all settings tried; one that is there goes on")
    parser.add_argument("--small", action="store_true", help="two tasks, less work; two minutes")
    parser.add_argument("--budget-s", type=float, help="work of each search, s")
    parser.add_argument("--tasks", nargs="+", choices=rod_tasks(), default=list(rod_tasks()))
    parser.add_argument("--table", type=Path, help="folder for the files of docs/measured")
    options = parser.parse_args()
    names = options.tasks[:2] if options.small else options.tasks
    extent = SMALL if options.small else FULL
    extent = replace(extent, budget_s=options.budget_s or extent.budget_s)
    options.file.parent.mkdir(parents=True, exist_ok=True)
    there, absent = entrants()
    for _ in benchmark(options.file, there, [rod_tasks()[name] for name in names], extent):
        pass
    tried_rows, table = ordered(read_rows(options.file, RodRow), there), []
    print("\nCPU time over the engine's, or the smallest error and its CPU time over the engine's")
    for row in summary(tried_rows, there, absent):
        table.append(row)
        print(f"{row['condition']}: reference within {row['reference_um']} µm, MuJoCo's limit "
              f"{row['peer_um']} µm from it")  # fmt: skip
        for limit in TOLERANCES_UM:
            ratios = ", ".join(f"{name} {row[f'{name}_{limit:g}']}" for name in (*there, *absent))
            print(f"  {limit:g} µm: {ratios}; {row[f'engine_ms_{limit:g}']} ms of CPU per second")
    if options.table:
        options.table.mkdir(parents=True, exist_ok=True)
        write_measured(options.table / "rods_summary.csv", table, COMMAND)
        best = [asdict(row) for row in frontier(tried_rows)]
        write_measured(options.table / "rods.csv", best, COMMAND)
    return 0


if __name__ == "__main__":
    sys.exit(main())
