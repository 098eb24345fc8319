"""How long the robot waits for the computer, over many cycles at the speed of reality.

    python -m tools.bench.bench_wait [--cycles 30] [--seed 1] [--burn 1] [--recorded]
        [--plant | --pages] [--freely 0.25 [--half-mm 1]]

Every wait is printed with the longest stall of this computer in that cycle, measured by a separate
process, and the CPU time of the cell: a share of two cores while the hold is filmed, and the
remaining computation after its last frame.  `--burn` keeps a number of cores busy.  With `--plant`
the same cycles are repeated with a plant: OPC UA with five clients that subscribe every 100 ms, and
MQTT with a broker.  With `--pages` the pages are served, too, to five viewers of the live page, one
of which reads nothing.

A real camera does not need the computer to draw its pictures.  So each cycle is run twice: here
without pause, to render the pictures, and then in real time with these, by a separate process, as
`cell run` does.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from cell.cli.cell_factory import BuiltCell, PlantEnd, Products
from cell.computer.abilities import StallProbe
from cell.plant.client import Client
from cell.records.result import Result
from cell.run.archive import Archive
from cell.run.cycle import Cell
from cell.run.plans import EXECUTE, HOLD, IDENTIFY
from cell.settings import Settings, load_settings
from cell.settings.model import StartSettings
from cell.wiring.build import cell_with, twin_devices, with_recorder
from cell.wiring.twins import build_twins
from drivers.around import CameraAround
from drivers.interfaces import Camera, Frame
from drivers.priority import take_precedence
from drivers.sim.clock import SimClock
from tools.plant.around import Plant
from tools.processes import busy_cores, family
from tools.shipped_settings import FAKE
from tools.worlds.fast_cell import with_opening

#: Limit of a gripper's wait for a decision.
MOST_WAITED_MS = 50.0


@dataclass(frozen=True)
class Wait:
    """The cell's wait for the computer in one cycle, and its load.

    wait_s    from the last frame of the hold to the choice of the offset, as the cell reports it,
              plus the delay in reading that frame, which a simulated clock does not show
    behind_s  this time alone
    hold_cpu  CPU time of the cell's processes during the hold, share of two cores
    after_cpu_s  the same after the last frame, until the offset was chosen
    load      runnable processes of the machine, mean of the last minute
    stall_s   longest stall of this computer during the cycle
    """

    outcome: str
    wait_s: float
    behind_s: float
    hold_cpu: float
    after_cpu_s: float
    load: float
    stall_s: float = 0.0


class KeepingCamera(CameraAround):
    """A camera that stores its frames."""

    def __init__(self, camera: Camera, clock: SimClock) -> None:
        super().__init__(camera)
        self._clock = clock
        self.recordings: list[list[tuple[float, Frame]]] = []

    def start(self, frame_count: int) -> None:
        self._start_s = self._clock.now_s()
        self.recordings.append([])
        self._camera.start(frame_count)

    def read(self) -> Frame | None:
        frame = self._camera.read()
        if frame is not None:
            since_s = replace(frame, t_s=frame.t_s - self._start_s)
            self.recordings[-1].append((self._clock.now_s() - self._start_s, since_s))
        return frame


class PlaybackCamera(CameraAround):
    """Replays stored frames in place of those of a camera, at the speed of the clock."""

    def __init__(self, camera: Camera, clock: SimClock) -> None:
        super().__init__(camera)
        self._clock = clock
        self.recordings: list[list[tuple[float, Frame]]] = []
        self.late_s: list[list[float]] = []
        self._pending: list[tuple[float, Frame]] = []

    def stop(self) -> None:
        self._pending = []

    def start(self, frame_count: int) -> None:
        self._start_s = self._clock.now_s()
        self._pending = self.recordings.pop(0)
        self.late_s.append([])

    def read(self) -> Frame | None:
        if not self._pending:
            return None
        ready_s, frame = self._pending.pop(0)
        self._clock.forward_to_s(self._start_s + ready_s)
        self.late_s[-1].append(time.perf_counter() - ready_s)
        return replace(frame, t_s=frame.t_s + self._start_s)


def measured(
    settings: Settings, seed: int, cycles: int, to_parent: Connection, linked: Path | None = None
) -> None:
    """Run cycles on the pictures from a pipe, and send back the measured times.

    linked  folder of the records next to which the cell has its link; None = it has none
    """
    end_in_order()
    take_precedence()  # as a cell does whose devices are real
    twins = build_twins(settings, seed, cycles)
    player = PlaybackCamera(twins.camera, twins.world.clock)
    devices = replace(twin_devices(twins), camera=player)
    with tempfile.TemporaryDirectory() as runs:
        began: dict[str, tuple[float, float]] = {}
        plants: list[PlantEnd] = []

        def on_step(number: int, step: str) -> None:
            for plant in plants:
                plant.step(number, step)
            if step in (HOLD.name, IDENTIFY.name, EXECUTE.name):  # to ask takes 0.5 ms itself
                began[step] = time.perf_counter(), cpu_s()

        ended = suppress(EOFError, BrokenPipeError, ConnectionResetError)  # the other process was
        devices, how = with_recorder(settings, devices, Path(runs))
        made = cell_with(settings, devices, Path(runs), on_step, archive=Archive(how))
        with ended, closing(made) as cell, ExitStack() as link:
            if linked is not None:
                plants.append(PlantEnd(BuiltCell(cell, Products(settings)), linked, settings))
                link.enter_context(plants[0].reachable())
            for number in range(1, cycles + 1):
                player.recordings, player.late_s = to_parent.recv(), []
                began.clear()
                for plant in plants:
                    plant.reporter.cycle(number, None, None)
                result = cycle_of(cell, number)
                for plant in plants:
                    plant.reporter.result(result)
                hold = player.late_s[0]
                behind_s = hold[-1] - min(hold)
                waited_s = np.nan if result.wait_s is None else result.wait_s + behind_s
                hold = spent(began, HOLD.name, IDENTIFY.name)
                rest = spent(began, IDENTIFY.name, EXECUTE.name)
                share = hold[1] / (2.0 * hold[0])
                load = os.getloadavg()[0]
                to_parent.send(Wait(result.outcome.value, waited_s, behind_s, share, rest[1], load))


_SIGNALS: list[int] = []


def end_in_order() -> None:
    """Let SIGTERM end this process by SystemExit, so that shared resources are released."""

    def end(number: int, frame: object) -> None:
        _SIGNALS.append(number)
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, end)


def cycle_of(cell: Cell, number: int) -> Result:
    """Run a cycle; exit after it if SIGTERM was received meanwhile."""
    result = cell.run_cycle(number)
    if _SIGNALS:
        sys.exit(128 + _SIGNALS[0])
    return result


def cpu_s() -> float:
    """CPU time of this process and its children so far, s; of ended ones to 10 ms."""
    return sum(cpu_of(pid) for pid in family(os.getpid()))


def cpu_of(pid: int) -> float:
    """CPU time of a process so far, with its ended threads and children, s; 0 = there is none.

    source  proc(5), `stat`; clock_getcpuclockid(3), whose number for a process is ~pid << 3 | 2
    """
    with suppress(OSError):
        after_name = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        ended = int(after_name[13]) + int(after_name[14])
        return time.clock_gettime(~pid << 3 | 2) + ended / os.sysconf("SC_CLK_TCK")
    return 0.0


def spent(began: dict[str, tuple[float, float]], step: str, until: str) -> tuple[float, float]:
    """Time and CPU time, s, from the beginning of a step to that of `until`; nan if missing."""
    if step not in began or until not in began:
        return np.nan, np.nan
    (t0, cpu0), (t1, cpu1) = began[step], began[until]
    return t1 - t0, cpu1 - cpu0


def waits(
    cycles: int,
    seed: int,
    burners: int,
    settings: Settings | None = None,
    *,
    plant: Path | None = None,
    pages: bool = False,
) -> list[Wait]:
    """Run cycles in real time, and print and return the wait of each.

    settings  None = those of the simulated cell
    plant     folder for a plant; None = there is none
    pages     the plant has the pages, too
    """
    end_in_order()
    linked = None if plant is None else plant / "runs"
    settings = load_settings(FAKE) if settings is None else settings
    real = settings.world.model_copy(update={"real_time_factor": 1.0})
    context = get_context("spawn")
    here, there = context.Pipe()
    child = context.Process(
        target=measured,
        args=(settings.model_copy(update={"world": real}), seed, cycles, there, linked),
    )
    child.start()
    twins = build_twins(settings, seed, cycles)
    recorder = KeepingCamera(twins.camera, twins.world.clock)
    measured_waits = []
    with ExitStack() as stack:
        stack.enter_context(busy_cores(burners))
        stack.callback(child.join)
        stack.callback(here.close)
        runs = stack.enter_context(tempfile.TemporaryDirectory())
        probe = stack.enter_context(StallProbe())
        devices = replace(twin_devices(twins), camera=recorder)
        cell = cell_with(settings, devices, Path(runs), lambda number, step: None)
        stack.callback(cell.close)
        if plant is not None and linked is not None:
            names = ("opcua", "mqtt", *(["serve"] if pages else []))
            viewers = 5 if pages else 0
            around_it = Plant(plant, FAKE, linked, adapters=names, clients=5, viewers=viewers)
            stack.enter_context(around_it)
            Client(linked).connect(wait_s=300.0)
            before_s, begun_s = around_it.cpu_s(), time.monotonic()
        for number in range(1, cycles + 1):
            recorder.recordings = []
            cycle_of(cell, number)
            probe.take()
            here.send(recorder.recordings)
            recorder.recordings = []
            measured_waits.append(replace(here.recv(), stall_s=probe.take().longest_s))
            w = measured_waits[-1]
            print(
                f"  cycle {number:3d}: {w.outcome}, {w.wait_s * 1e3:6.1f} ms, of these vision "
                f"behind by {w.behind_s * 1e3:5.1f} ms; "
                f"computer's stall {w.stall_s * 1e3:5.1f} ms; "
                f"CPU {w.hold_cpu:.0%} of two cores, {w.after_cpu_s * 1e3:.1f} ms at the end; "
                f"load {w.load:.1f}",
                flush=True,
            )
        if plant is not None:
            for name, used_s in around_it.cpu_s().items():
                share = (used_s - before_s[name]) / (time.monotonic() - begun_s)
                print(f"  CPU of {name}: {share:.1%} of a core")
    return measured_waits


def summary(rows: list[Wait]) -> str:
    """Quantiles and a histogram."""
    ms = 1e3 * np.array([w.wait_s for w in rows])
    own = ms - 1e3 * np.array([w.stall_s for w in rows])
    middle, most, worst = np.nanquantile(ms, [0.5, 0.95, 1.0])
    lines = [
        f"  {len(ms)} cycles, load {np.mean([w.load for w in rows]):.1f}: median {middle:.1f} ms, "
        f"95 % within {most:.1f} ms, worst {worst:.1f} ms, first {ms[0]:.1f} ms; "
        f"{np.mean(ms <= MOST_WAITED_MS):.0%} within {MOST_WAITED_MS:g} ms",
        f"  beyond the computer's own stall: median {np.nanmedian(own):.1f} ms, 95 % within "
        f"{np.nanquantile(own, 0.95):.1f} ms",
        f"  CPU: {np.nanmedian([w.hold_cpu for w in rows]):.0%} of two cores during the hold, "
        f"{1e3 * np.nanmedian([w.after_cpu_s for w in rows]):.1f} ms after the last frame",
    ]
    edges = [0, 10, 20, 30, 40, 50, 75, 100, 200, np.inf]
    for low, high in pairwise(edges):
        count = int(np.sum((ms > low) & (ms <= high)))
        if count:
            lines.append(f"  {low:4.0f} … {high:4.0f} ms  {'█' * count} {count}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--burn", type=int, default=0, metavar="CORES")
    parser.add_argument(
        "--recorded", action="store_true", help="the same again with every frame recorded"
    )
    parser.add_argument("--plant", action="store_true", help="the same again with a plant around")
    parser.add_argument("--pages", action="store_true", help="and with pages that five look at")
    parser.add_argument(
        "--freely", type=float, metavar="S", help="the same again with motion.start.window_s"
    )
    parser.add_argument(
        "--half-mm", type=float, default=5.0, help="half the opening's height of --freely, mm"
    )
    options = parser.parse_args()
    common = options.cycles, options.seed, options.burn
    shipped = load_settings(FAKE)
    silent = shipped.model_copy(update={"recording": None})
    start = StartSettings(window_s=options.freely or 0.0)
    freely = silent.model_copy(update={"motion": silent.motion.model_copy(update={"start": start})})
    freely = with_opening(freely, options.half_mm)
    around = options.plant or options.pages
    base = waits(*common, silent)
    print(summary(base))
    with tempfile.TemporaryDirectory() as folder:
        for name, wanted, settings, plant in (
            ("recorded", options.recorded, shipped, None),
            ("freely", options.freely, freely, None),
            ("with a plant around", around, silent, Path(folder)),
        ):
            if wanted:
                print(name, flush=True)
                rows = waits(*common, settings, plant=plant, pages=options.pages)
                print(summary(rows), *compared(name, base, rows), sep="\n", flush=True)


def compared(name: str, base: list[Wait], loaded: list[Wait]) -> Iterator[str]:
    """Sentences on the ratio of each measure with and without the load."""
    for of in ("wait_s", "after_cpu_s", "hold_cpu"):
        without, with_it = (np.array([getattr(w, of) for w in ws]) for ws in (base, loaded))
        low, middle, high = np.nanquantile(with_it / without, [0.25, 0.5, 0.75])
        medians = np.nanmedian(with_it) / np.nanmedian(without)
        yield (
            f"  {name}: {of} of the same cycle {middle:.2f} × without, half of them {low:.2f} "
            f"to {high:.2f}; medians {medians:.2f} ×"
        )


if __name__ == "__main__":
    main()
