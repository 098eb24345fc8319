"""Every way in which a cable may end, through the real drivers, and that the next one is taken.

One cell, connected once, takes one cable after another; what is done to them is done at the
emulated camera.  Faults are those of the `fault_trials`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from cell.lab.next.motion_file import load_motion
from cell.plan import correction
from cell.records.folder import read_record
from cell.records.result import Outcome, Result
from cell.run import corrector
from cell.run.cycle import Cell
from cell.run.machine import CellState, MachineEvent
from cell.run.plans import INSERTING, Plan, measuring
from cell.settings import Settings, load_settings
from cell.wiring.build import cell_with, real_devices
from drivers.interfaces import Pose
from drivers.sim.camera import Staging

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")

from cell.wiring.emulated import EmulatedCell, HiddenCableFactory

pytestmark = pytest.mark.real_time

LEVEL = """\
format: cell-motion/1
purpose: see it once more
start: {x_m: -0.01, y_m: 0.0, angle_rad: 0.0}
still_s: 0.4
moves:
  - {x_m: -0.01, y_m: -0.05, angle_rad: 0.0, duration_s: 0.3}
hold_s: 0.4
"""

Act = Callable[["Line"], None]


@dataclass
class Line:
    """A cell with emulated devices; `at` maps a step's name to what happens when it begins."""

    settings: Settings
    emulated: EmulatedCell
    runs: Path
    at: dict[str, Act] = field(default_factory=dict)
    let_go: dict[int, Pose] = field(default_factory=dict)
    number: int = 0

    def __post_init__(self) -> None:
        self.devices = real_devices(self.settings)
        self.cell: Cell = cell_with(self.settings, self.devices, self.runs, self._on_step)

    def cycle(self, plan: Plan = INSERTING, at: dict[str, Act] | None = None) -> Result:
        self.number += 1
        if not self.cell.machine.can(MachineEvent.RESET):  # a busy computer upset the test before
            self.cell.acknowledge()
        self.at = dict(at or {})
        return self.cell.run_cycle(self.number, plan)

    def _on_step(self, number: int, step: str) -> None:
        if step in self.at:
            self.at.pop(step)(self)
        if step == "go_home":
            self.let_go[number] = self.devices.arm.state().pose


@pytest.fixture(scope="module")
def line(light_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Line]:
    settings = load_settings(light_config)
    with EmulatedCell(settings, seed=1) as emulated:
        it = Line(settings, emulated, tmp_path_factory.mktemp("runs"))
        yield it
        it.cell.close()


def other(**world: tuple[float, float]) -> Act:
    """The cable between the jaws is exchanged for the first of another world."""

    def act(it: Line) -> None:
        changed = it.settings.world.model_copy(update=world)
        settings = it.settings.model_copy(update={"world": changed})
        it.emulated.camera.notify(HiddenCableFactory(settings, 1, 1))

    return act


def another(rigidity_n_m2: float) -> Act:
    """The cable between the jaws is exchanged for one of that rigidity."""
    return other(rigidity_n_m2=(rigidity_n_m2, 1.001 * rigidity_n_m2))


#: The first cable, were it to come to rest sooner: a second try waits for that.
the_first_but_calm = other(damping_ratio=(0.15, 0.151))


def the_first(it: Line) -> None:
    """The cable between the jaws is exchanged for the first, which is known to go in."""
    it.emulated.camera.notify(HiddenCableFactory(it.settings, 1, 1))


def cover(it: Line) -> None:
    """Without the jaw nothing is found in a picture."""
    it.emulated.camera.notify(Staging(jaw=False))


def uncover(it: Line) -> None:
    it.emulated.camera.notify(Staging())


def cover_while_at_rest(it: Line) -> None:
    cover(it)
    threading.Timer(it.settings.motion.still_s, uncover, (it,)).start()


REJECTED: dict[str, dict[str, Act]] = {
    "little swing: the tip swings by": {"lower": another(0.9)},
    "no offset passes with probability": {"lower": another(6.0e-6)},
    "no still frames": {"lower": cover_while_at_rest},
    "unseen frames: the cable is seen in": {"hold_and_capture": cover, "release": uncover},
}


@pytest.mark.parametrize("reason", REJECTED)
def test_a_rejected_cable_is_put_aside(line: Line, reason: str) -> None:
    result = line.cycle(at=REJECTED[reason])
    assert (result.outcome, result.fault) == (Outcome.REJECTED, None)
    assert result.reason is not None and result.reason.startswith(reason)
    check_put_aside(line, result)


def test_a_missed_cable_is_put_aside(line: Line) -> None:
    result = line.cycle(at={"lower": the_first, "simulate": another(1.0e-3)})
    assert (result.outcome, result.fault) == (Outcome.MISSED, None)
    assert result.reason is not None and result.reason.startswith("the tip missed")
    check_put_aside(line, result)
    study = read_record(Path(result.folder)).study
    assert study is not None
    assert [t.name for t in study.trials] == ["identify", "execute"]


@pytest.fixture
def seeing(line: Line, monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    """The same cell, which looks while it inserts and may try twice.

    It decides once, and has 0.3 s: what follows a decision is tested on a busy computer, too.
    """
    monkeypatch.setattr(correction, "AHEAD_S", (0.5,))
    monkeypatch.setattr(corrector, "DEAD_S", (0.3,))
    station = line.cell._station
    line.cell._station = replace(station, task=replace(station.task, feedback=True, retries=1))
    yield line
    line.cell._station = station


def test_a_cable_stopped_in_front_of_the_opening_is_tried_again(
    seeing: Line, hopeless: Callable[[int], None]
) -> None:
    hopeless(1)
    result = seeing.cycle(at={"lower": the_first_but_calm})
    assert (result.outcome, result.fault) == (Outcome.INSERTED, None), result.reason
    assert len(result.stops) == 1 and result.corrections == ()
    study = read_record(Path(result.folder)).study
    assert study is not None
    stopped = study.trials[-1]
    assert stopped.name == "execute_try_1"
    assert np.nanmin(stopped.markers.xy_m[:, 0, 0]) > seeing.settings.destination.x_m[1]


def test_a_cable_stopped_again_is_put_aside(seeing: Line, hopeless: Callable[[int], None]) -> None:
    hopeless(9)
    result = seeing.cycle(at={"lower": the_first_but_calm})
    assert (result.outcome, result.fault) == (Outcome.REJECTED, None)
    assert result.reason is not None and result.reason.startswith("stopped in front of the opening")
    assert len(result.stops) == 1
    check_put_aside(seeing, result)


def check_put_aside(line: Line, result: Result) -> None:
    here, aside = line.let_go[result.cycle], line.settings.motion.aside
    assert (here.x_m, here.y_m) == pytest.approx((aside.x_m, aside.y_m), abs=5e-4)
    assert not line.emulated.gripper.observe().held
    assert line.cell.machine.state is CellState.COMPLETE, "the next cable can be taken"


def test_after_all_these_a_cable_is_held_resumed_and_inserted(line: Line) -> None:
    def hold(it: Line) -> None:
        it.cell.command(MachineEvent.HOLD, "somebody asks")

    def resume(it: Line) -> None:
        threading.Timer(0.3, it.cell.command, (MachineEvent.UNHOLD,)).start()

    result = line.cycle(at={"lower": the_first, "simulate": hold, "held": resume})
    assert (result.outcome, result.fault) == (Outcome.INSERTED, None), result.reason
    assert result.state_seconds["held"] > 0.25


def test_a_cable_is_only_measured(line: Line, tmp_path: Path) -> None:
    motion = tmp_path / "level.yaml"
    motion.write_text(LEVEL, encoding="utf-8")
    result = line.cycle(measuring(load_motion(motion, line.settings)))
    assert (result.outcome, result.fault) == (Outcome.MEASURED, None), result.reason
    study = read_record(Path(result.folder)).study
    assert study is not None and [t.name for t in study.trials] == ["level"]


def test_a_dry_run_ends_without_a_cable(line: Line) -> None:
    taken = line.emulated.cables
    result = line.cycle(line.cell.rehearsal(INSERTING, 1.0))
    assert result.fault is None
    assert result.outcome in (Outcome.REHEARSED, Outcome.UNFIT), "its figures are a busy computer's"
    assert result.checks
    assert line.emulated.cables == taken
