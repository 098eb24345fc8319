"""Every device × every step of a cycle × every fault, against the emulators: `make fault-trials`.

A trial injects a fault when a step begins (in steps that move: when the arm moves) and demands:
the cell stops and names device, step and remedy; the record is closed and agrees; the jaws still
hold the cable; and after the person's repair and acknowledgement the next cycle inserts.
Then processes of the cell are killed at random moments, and the emulated arm must stand 200 ms
later.  A table for each device and fault is printed, and written as CSV with `-o`.

With `--revising` all insertions are corrected in flight, and the faults of the step `execute`
happen while a change of its path is sent to the arm.  With `--plant` OPC UA with five clients, MQTT
with a broker, and the handshake follow the cell meanwhile.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.cli.cell_factory import BuiltCell, PlantEnd, Products
from cell.plan import correction
from cell.plan.correction import Tail
from cell.plan.response import Deviation, Response
from cell.records.folder import read_record
from cell.records.result import Outcome, Result
from cell.run.cycle import Cell
from cell.run.machine import MachineEvent
from cell.run.plans import INSERTING
from cell.settings import Settings, load_settings
from cell.wiring.build import cell_with, real_devices
from cell.wiring.emulated import EmulatedCell
from drivers.interfaces import Trajectory
from drivers.recording import CaptureOptions
from drivers.serial_gripper import SerialGripperOptions
from tools.faults.fault_kills import STILL_S, KilledProcess, kill_somebody
from tools.faults.fault_kinds import KINDS, FaultTrial, Victim
from tools.faults.fault_table import (
    COLUMNS,
    failures,
    markdown,
    stop_percentiles_ms,
    summary,
    table,
)
from tools.faults.short_cycles import short_cycles
from tools.plant.around import Plant
from tools.studies.rows import write_measured

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "docs" / "measured" / "fault_trials.csv"
BAR_S = 0.1
#: Waits and hold, s.
SHORT = {"calm_s": 0.1, "still_s": 0.3, "hold_s": 0.5, "decide_s": 0.5, "settle_s": 0.1}
#: Time limit of the gripper's driver for an answer, as shipped; in the gripper's own trials.
SHIPPED_S = SerialGripperOptions("").reply_s
#: Steps in which a fault is delayed until the arm moves.
MOVING = ("lower", "execute", "go_home")
#: Steps that do not change whether a cable is held.
HOLDING = tuple(step.name for step in INSERTING.steps if step.holding)


def all_trials() -> list[FaultTrial]:
    trials = []
    for kind in KINDS:
        steps = INSERTING.names
        if kind.fault == "refuses to connect":
            steps = ("connect",)
        elif kind.drops_cable:
            steps = ("grasp", *HOLDING)
        excluded = {"warm_up", "start"} | (set() if kind.at_connect else {"connect"})
        trials += [FaultTrial(kind, s) for s in dict.fromkeys(steps) if s not in excluded]
    return trials


class FaultRig:
    """Emulators, real drivers and the cell around them.

    revising  a fault in `execute` is delayed until a change of its path is sent to the arm
    """

    def __init__(
        self, settings: Settings, emulated: EmulatedCell, runs: Path, *, revising: bool = False
    ) -> None:
        self.settings, self.emulated = settings, emulated
        self.devices = real_devices(settings)
        self.victim = Victim(emulated, lambda: int(self.devices.arm._child.process.pid))
        self.stopped_s: list[float] = []
        self.began_s: dict[str, float] = {}
        self.trial: FaultTrial | None = None
        self.number = 0
        self.patience_s = settings.gripper.reply_s
        stop = self.devices.arm.stop

        def timed_stop(reason: str) -> None:
            self.stopped_s.append(time.monotonic())
            stop(reason)

        self.devices.arm.stop = timed_stop  # type: ignore[method-assign]
        self.filmed_s = 0.0
        start = self.devices.camera.start

        def timed_start(frame_count: int) -> None:
            self.filmed_s = time.monotonic()
            start(frame_count)

        self.devices.camera.start = timed_start  # type: ignore[method-assign]
        self.revising = revising
        self.revisions = 0
        revise = self.devices.arm.revise

        def revise_amid_a_fault(path: Trajectory, from_s: float) -> None:
            trial, self.revisions = self.trial, self.revisions + 1
            if trial is not None and trial.given_s is None and trial.step == "execute":
                threading.Thread(target=self._give, args=(trial,), daemon=True).start()
            revise(path, from_s)

        self.devices.arm.revise = revise_amid_a_fault  # type: ignore[method-assign]
        self.cell: Cell = cell_with(settings, self.devices, runs, self._on_step)
        self.plant = PlantEnd(BuiltCell(self.cell, Products(settings)), runs, settings)

    def be_patient(self, device: str = "") -> None:
        """Extend the time limits of the drivers of gripper and camera, except that of `device`."""
        gripper, camera = self.devices.gripper, self.devices.camera
        reply_s = SHIPPED_S if device == "gripper" else self.patience_s
        gripper._options = replace(gripper._options, reply_s=reply_s)
        if gripper._bus is not None:
            gripper._bus.serial.timeout = reply_s
        lost_s = CaptureOptions().lost_after_s
        if device != "camera":
            lost_s = max(lost_s, self.patience_s)
        camera._options = replace(camera._options, lost_after_s=lost_s)
        if camera._stream is not None:
            camera._stream._options = camera._options

    def cycle(self) -> Result:
        self.number += 1
        self.began_s = {}
        if not self.cell.machine.can(MachineEvent.RESET):
            self.cell.acknowledge()
            self.plant.reporter.acknowledged("", "")
        self.plant.reporter.cycle(self.number, None, None)
        result = self.cell.run_cycle(self.number)
        self.plant.reporter.result(result)
        return result

    def _on_step(self, number: int, step: str) -> None:
        self.began_s[step] = time.monotonic()
        self.plant.step(number, step)
        trial = self.trial
        if trial is None or trial.given_s is not None or step != trial.step:
            return
        if step == "execute" and self.revising:
            return
        if step in MOVING:
            threading.Thread(target=self._give_in_motion, args=(trial,), daemon=True).start()
        else:
            self._give(trial)

    def _give_in_motion(self, trial: FaultTrial) -> None:
        until_s = time.monotonic() + 3.0
        while self.speed_m_per_s() < 0.05 and time.monotonic() < until_s:
            time.sleep(0.005)
        self._give(trial)

    def _give(self, trial: FaultTrial) -> None:
        trial.held_before = self.emulated.gripper.observe().held
        trial.given_s = time.monotonic()
        trial.kind.cause(self.victim)

    def speed_m_per_s(self) -> float:
        speed = self.emulated.controller.request("state")["speed"]
        return float(np.linalg.norm(speed[:3]))


def run_trial(bench: FaultRig, trial: FaultTrial) -> None:
    """Run a cycle with the fault, the next one if that did not use the device, and one after it."""
    trial.begin()
    if trial.step == "connect":
        bench.cell.close()
    bench.cell._steps.repeat([trial.step])  # also if it is done in the first cycle only
    bench.trial = trial
    bench.stopped_s.clear()
    bench.be_patient(trial.kind.device)
    result = bench.cycle()
    if result.outcome is not Outcome.FAILED:
        result = bench.cycle()
    ended_s = time.monotonic()
    bench.trial = None
    if trial.given_s is None:
        why = f"{result.outcome.value} {result.reason} {result.fault}"
        trial.wrong.append(f"the fault was never given: {why}")
    else:
        judge(bench, trial, result)
    bench.emulated.controller.request("refuse", on=False)
    trial.kind.repair(bench.victim)
    time.sleep(max(0.0, STILL_S - (time.monotonic() - ended_s)))
    bench.be_patient()
    after = bench.cycle()
    if after.outcome is not Outcome.INSERTED:
        trial.wrong.append(f"the next cycle: {after.outcome.value} {after.reason} {after.fault}")
        bench.cell.close()


def judge(bench: FaultRig, trial: FaultTrial, result: Result) -> None:
    assert trial.given_s is not None
    fault = result.fault
    if fault is None:
        trial.wrong.append(f"not noticed: {result.outcome.value}")
        return
    trial.noticed = fault.step
    if fault.device != trial.kind.device:
        trial.wrong.append(f"{fault.device} was named: {fault.cause}")
    if not fault.remedy:
        trial.wrong.append(f"no remedy for: {fault.cause}")
    record = read_record(Path(result.folder))
    if not record.closed or record.result != result or record.step != fault.step:
        trial.wrong.append("the record does not say so")
    # the fault of an idle device is detected when it is used
    needed_s = max(trial.given_s, bench.began_s.get(fault.step, 0.0))
    if trial.kind.fault == "freezes" and trial.kind.device == "camera":
        needed_s = max(needed_s, bench.filmed_s)  # nobody compares pictures that are not recorded
    after = [t for t in bench.stopped_s if t >= trial.given_s]
    if not after:
        trial.wrong.append("the arm was not stopped")
    elif fault.step != "connect":  # before, nothing can be stopped
        trial.reaction_s = max(0.0, after[0] - needed_s)
    time.sleep(STILL_S)
    state = bench.emulated.controller.request("state")
    trial.moved_on_s = max(0.0, state["last_moved_s"] - needed_s)
    if trial.moved_on_s > STILL_S:
        trial.wrong.append(f"the arm moved {trial.moved_on_s:.3f} s later")
    held = bench.emulated.gripper.observe().held
    if trial.held_before and fault.step in HOLDING and not held and not trial.kind.drops_cable:
        trial.wrong.append("the cable was let go")


def small_change(
    answers: Response, deviation: Deviation, destination: object, from_s: float, *arguments: object
) -> Tail:
    """Correction for trials: 0.3 mm up, at every decision."""
    return Tail(from_s, 3e-4, 0.0, 0.2, 1.0, 0.0, 1.0, answers.nodes_m[:, 0] + deviation.tip_m)


# --- all of it ------------------------------------------------------------------------------------


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[], help="words that a trial's name contains")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--host", default="127.0.0.77", help="address of the emulated arm")
    parser.add_argument(
        "--patience-s",
        type=float,
        default=SHIPPED_S,
        help="with gripper and camera outside their own trials; more on a busy computer",
    )
    parser.add_argument("--attempts", type=int, default=1, help="of a trial that fails")
    parser.add_argument("--bar-ms", type=float, default=1e3 * BAR_S, help="p99 from fault to stop")
    parser.add_argument("--revising", action="store_true", help="while paths are changed in flight")
    parser.add_argument("--plant", action="store_true", help="with all adapters beside the cell")
    parser.add_argument("-o", "--output", type=Path, help=f"e.g. {TABLE.relative_to(ROOT)}")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # children end, too
    only = arguments.only or [""]
    chosen = [t for t in all_trials() if any(word in t.name for word in only)]
    kills: list[KilledProcess] = []
    if arguments.revising:
        chosen = [t for t in chosen if t.step == "execute"]
        correction.best_tail = small_change  # type: ignore[assignment]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = short_cycles(
            folder, arguments.host, arguments.patience_s, own_patience=False, **SHORT
        )
        settings = load_settings(config)
        if arguments.revising:
            settings = settings.model_copy(update={"feedback": "on"})
        with EmulatedCell(settings, seed=1) as emulated, ExitStack() as around:
            bench = FaultRig(settings, emulated, folder / "runs", revising=arguments.revising)
            link = around.enter_context(ExitStack())
            if arguments.plant:
                around.enter_context(Plant(folder / "plant", config, folder / "runs", clients=5))
                link.enter_context(bench.plant.reachable())
            bench.cycle()
            for number, trial in enumerate(chosen, 1):
                run_trial(bench, trial)
                while trial.wrong and trial.attempts < arguments.attempts:
                    print(f"         again: {'; '.join(trial.wrong)}", flush=True)
                    run_trial(bench, trial)
                stop = "" if trial.reaction_s is None else f"{1e3 * trial.reaction_s:5.0f} ms"
                verdict = "passed" if not trial.wrong else "; ".join(trial.wrong)
                print(f"{number:3d}/{len(chosen)} {trial.name:48s} {stop:9s} {verdict}", flush=True)
            link.close()
            bench.cell.close()
            if arguments.revising:
                print(f"{bench.revisions} changes of paths were told")
            rng = random.Random(1)
            for number in range(arguments.kills):
                victim = ("cell", "child", "both")[number % 3]
                kills.append(kill_somebody(emulated, config, folder / "runs", victim, rng))
                print(kills[-1], flush=True)
    lines = table(chosen, kills, arguments.bar_ms)
    print("\n".join([*summary(chosen, kills), "", markdown(lines), "", *failures(chosen)]))
    if arguments.output is not None:
        command = " ".join(["python -m tools.faults.fault_trials", *sys.argv[1:]])
        rows = [dict(zip(COLUMNS, line, strict=True)) for line in lines]
        write_measured(arguments.output, rows, command)
    slow = stop_percentiles_ms(chosen, 99.0)[0] > arguments.bar_ms
    moved = any(k.moved_on_s > STILL_S for k in kills)
    return int(any(t.wrong for t in chosen) or slow or moved)


if __name__ == "__main__":
    raise SystemExit(main())
