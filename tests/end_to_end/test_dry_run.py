"""Dry runs: all motions with empty jaws, at any speed; whatever is not right is said."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from cell.lab.next.motion_file import load_motion
from cell.records.folder import read_record
from cell.records.result import Outcome, Result
from cell.run.machine import CellState, MachineEvent
from cell.run.plans import INSERTING, measuring
from cell.run.waiting import POLL_S
from cell.settings import Settings
from cell.wiring.build import cell_with, twin_devices
from cell.wiring.twins import build_twins
from drivers.interfaces import Pose
from drivers.servo import SETTLING_LAGS
from drivers.sim.arm import ArmFaults, ArmTwinOptions, SimArm
from drivers.sim.camera import CameraFaults

from .conftest import said

Live = Callable[..., SimpleNamespace]


def check(result: Result, what: str) -> float:
    (found,) = (c.found for c in result.checks if c.what == what)
    return found


@pytest.fixture(scope="module")
def dry_runs(quick: Settings, tmp_path_factory: pytest.TempPathFactory) -> dict[float, Result]:
    """Results at full speed and at a third of it."""
    runs = tmp_path_factory.mktemp("runs")

    def one(speed: float) -> Result:
        twins = build_twins(quick, 1, 0)
        cell = cell_with(quick, twin_devices(twins), runs, lambda number, step: None)
        return cell.run_cycle(1, cell.rehearsal(INSERTING, speed))

    return {speed: one(speed) for speed in (1.0, 0.3)}


@pytest.mark.parametrize("speed", [1.0, 0.3])
def test_a_cell_in_order_is_rehearsed_and_everything_is_recorded(
    dry_runs: dict[float, Result], quick: Settings, speed: float
) -> None:
    result = dry_runs[speed]
    assert (result.outcome, result.speed, result.fault) == (Outcome.REHEARSED, speed, None)
    assert check(result, "arm: lag") == pytest.approx(0.03, abs=1e-3)
    assert check(result, "gripper: smallest x") == pytest.approx(-quick.motion.advance_m, abs=1e-4)
    deepest_m = quick.motion.lower_m + quick.motion.offsets.last_m
    assert check(result, "gripper: smallest y") == pytest.approx(-deepest_m, abs=1e-4)
    read = read_record(Path(result.folder))
    assert read.closed and read.result == result and read.study is None
    pictures = sorted(Path(result.folder).glob("*.jpg"))
    assert [p.stem.split("_", 1)[1] for p in pictures[:4]] == [
        "go_down_begin",
        "go_down_end",
        "go_in_begin",
        "go_in_end",
    ]
    assert len(pictures) == 8


def test_a_slow_dry_run_is_slower_by_as_much(
    dry_runs: dict[float, Result], quick: Settings
) -> None:
    full, slow = dry_runs[1.0], dry_runs[0.3]
    allowed = quick.motion.lowering.velocity_m_per_s
    assert 0.3 * allowed < check(full, "gripper: largest speed") < 1.02 * allowed
    assert check(slow, "gripper: largest speed") < 0.3 * 1.02 * allowed
    rests_s = 2 * (SETTLING_LAGS * 0.03 + POLL_S)  # twice it waits for the arm to rest
    moves_s = full.seconds["go_home"] - rests_s
    assert slow.seconds["go_home"] - rests_s == pytest.approx(moves_s / 0.3, rel=0.03)


def test_pictures_show_where_arm_and_camera_see_the_hand(dry_runs: dict[float, Result]) -> None:
    picture = cv2.imread(str(Path(dry_runs[1.0].folder) / "2_go_in_end.jpg"))
    assert picture is not None
    picture = picture[:466]  # the legend below it has the same colours
    blue, green, red = (picture[:, :, i].astype(int) for i in range(3))
    by_camera = np.argwhere((green - red > 80) & (green - blue > 80)).mean(axis=0)
    by_arm = np.argwhere((red - blue > 80) & (green - blue > 60)).max(axis=1)
    assert len(by_arm)
    # the end of the first stroke: 50 mm down and 50 mm left of column 625, row 93.75, at 0.32 mm
    assert by_camera == pytest.approx([250.0, 468.75], abs=1.9)


def test_the_jaws_stay_as_they_are_and_no_cable_is_taken(live: Live) -> None:
    it = live()

    def refuse(*_: object) -> None:
        raise AssertionError("the jaws were moved")

    it.twins.gripper.grip = it.twins.gripper.release = refuse
    result = it.cell.run_cycle(1, it.cell.rehearsal(INSERTING, 1.0))
    assert result.outcome is Outcome.REHEARSED
    assert it.twins.world.waiting == 1
    once = ("go_down", "go_in", "go_aside", "go_home")
    before = ("warm_up", "connect", "reset", "start", "check_paths", "go_home")
    assert it.steps == [*before, *once, *once, "go_home"]
    home = it.twins.world.gripper_pose()
    assert (home.x_m, home.y_m) == pytest.approx((0.0, 0.0), abs=2e-4)
    assert it.cell.machine.state is CellState.COMPLETE


def test_jaws_that_hold_something_are_not_moved_about(live: Live) -> None:
    it = live({"reset": lambda it: it.twins.world.take()})
    result = it.cell.run_cycle(1, it.cell.rehearsal(INSERTING, 1.0))
    assert result.outcome is Outcome.FAILED and result.fault is not None
    assert (result.fault.step, result.fault.device) == ("reset", "gripper")
    assert "empty" in result.fault.remedy
    assert it.twins.world.holds, "what is held stays held"


def test_a_path_beyond_the_limits_is_named_before_anything_moves(
    live: Live, quick: Settings
) -> None:
    """Only the last offset leaves the box, which no check of single settings would let through."""
    low = quick.limits.model_copy(update={"y_m": (-0.088, 0.02)})
    it = live(settings=quick.model_copy(update={"limits": low}))
    result = it.cell.run_cycle(1, it.cell.rehearsal(INSERTING, 0.5))
    assert result.fault is not None and result.fault.step == "check_paths"
    assert "on the way 'go in'" in result.fault.cause and "y = -0.088" in result.fault.cause
    assert it.twins.world.gripper_pose() == Pose(0.0, 0.0, 0.0)


def test_the_way_home_is_slow_too(live: Live, quick: Settings, tmp_path: Path) -> None:
    """At first commissioning the gripper is anywhere; nothing may be fast, not even the first
    move."""
    elsewhere = quick.motion.model_copy(update={"home": quick.motion.aside})
    twins = build_twins(quick.model_copy(update={"motion": elsewhere}), 1, 0)
    fastest: list[float] = []

    def on_step(number: int, step: str) -> None:
        if step == "go_down":
            log = twins.arm.log(0.0, twins.world.clock.now_s())
            fastest.append(float(np.abs(np.diff(log.y_m[::10])).max() / 0.02))

    cell = cell_with(quick, twin_devices(twins), tmp_path / "runs", on_step)
    cell.run_cycle(1, cell.rehearsal(INSERTING, 0.2))
    assert 0.01 < fastest[0] < 0.2 * quick.motion.lowering.velocity_m_per_s * 1.05


def test_what_is_not_right_makes_the_cell_unfit_and_names_the_remedy(
    quick: Settings, tmp_path: Path
) -> None:
    twins = build_twins(quick, 1, 0)
    late = SimArm(twins.world, ArmTwinOptions(lag_s=0.03, true_lag_s=0.045), seed=1)
    twins.camera.faults = CameraFaults(stamp_error_s=0.007)
    devices = twin_devices(twins)
    cell = cell_with(
        quick, type(devices)(late, *list(vars(devices).values())[1:]), tmp_path, lambda n, s: None
    )
    result = cell.run_cycle(1, cell.rehearsal(INSERTING, 1.0))
    assert result.outcome is Outcome.UNFIT
    remedies = {c.what: c.remedy for c in result.checks if not c.right}
    assert set(remedies) == {"arm: lag", "camera: timestamps late by"}
    assert "0.045" in remedies["arm: lag"] and "0.007" in remedies["camera: timestamps late by"]
    assert result.reason is not None and "arm: lag" in result.reason


@pytest.mark.parametrize("step", ["check_paths", "go_down", "go_in", "go_aside"])
def test_a_stop_in_any_step_stops_and_a_lost_arm_aborts(live: Live, step: str) -> None:
    it = live({step: lambda it: it.cell.command(MachineEvent.STOP, "guard opened")})
    result = it.cell.run_cycle(1, it.cell.rehearsal(INSERTING, 1.0))
    assert result.fault is not None and result.fault.step == step
    assert it.cell.machine.state is CellState.STOPPED
    assert it.twins.world.gripper_rest_from_s() <= it.twins.world.clock.now_s()

    lost = live({step: lambda it: setattr(it.twins.arm, "faults", ArmFaults(lost_at_s=0.0))})
    result = lost.cell.run_cycle(1, lost.cell.rehearsal(INSERTING, 1.0))
    assert result.fault is not None and (result.fault.step, result.fault.device) == (step, "arm")
    assert lost.cell.machine.state is CellState.ABORTED


def test_it_can_be_held_between_motions(live: Live) -> None:
    def later(it: SimpleNamespace) -> None:
        threading.Timer(0.05, it.cell.command, (MachineEvent.UNHOLD,)).start()

    it = live({"go_down": lambda it: it.cell.command(MachineEvent.HOLD), "held": later})
    assert it.cell.run_cycle(1, it.cell.rehearsal(INSERTING, 1.0)).outcome is Outcome.REHEARSED
    assert it.steps[it.steps.index("held") - 1] == "go_down"


def test_a_cycle_with_a_cable_follows_a_dry_run(live: Live) -> None:
    it = live()
    assert it.cell.run_cycle(1, it.cell.rehearsal(INSERTING, 1.0)).outcome is Outcome.REHEARSED
    result = it.cell.run_cycle(2)
    assert result.outcome is Outcome.INSERTED
    assert "warm_up" in result.seconds and result.speed is None


def test_a_measuring_motion_is_rehearsed(live: Live, quick: Settings, tmp_path: Path) -> None:
    path = tmp_path / "tilted.yaml"
    path.write_text(
        "format: cell-motion/1\nstart: {x_m: -0.01, y_m: 0.0, angle_rad: 0.5}\nstill_s: 0.2\n"
        "moves:\n  - {x_m: -0.01, y_m: -0.05, angle_rad: 0.5, duration_s: 0.27}\nhold_s: 0.4\n",
        encoding="utf-8",
    )
    it = live()
    plan = measuring(load_motion(path, quick))
    result = it.cell.run_cycle(1, it.cell.rehearsal(plan, 0.5))
    assert result.outcome is Outcome.REHEARSED
    assert {"go_to_start", "go_through"} <= set(result.seconds) and "go_in" not in result.seconds


def test_the_command_prints_a_table_and_ends_with_0(quick_config: Path, tmp_path: Path) -> None:
    code, out, err = said(
        "run", "-c", quick_config, "--dry-run", "--speed", 0.5, "--runs", tmp_path / "runs"
    )
    assert (code, err) == (0, "")
    for words in ("dry run at 50% of the speed: rehearsed", "arm: lag", "right", "check paths"):
        assert words in out
    assert "…" not in out.replace(" … ", ""), "80 columns are enough"


def test_json_and_a_cell_that_is_unfit(quick_config: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    text = quick_config.read_text(encoding="utf-8")
    wrong.write_text(
        text.replace("lag_s: 0.03", "lag_s: 0.03\n  noise_m: 0.00015"), encoding="utf-8"
    )
    code, out, err = said("run", "-c", wrong, "--dry-run", "--json", "--runs", tmp_path / "runs")
    assert code == 1
    result = json.loads(out)
    assert (result["outcome"], result["speed"]) == ("unfit", 1.0)
    assert {"what", "found", "unit", "low", "high", "remedy"} == set(result["checks"][0])
    assert "arm: off its path: " in err and "arm.gain" in err


@pytest.mark.parametrize("speed", ["0.1", "0.99"])
def test_a_cable_is_never_moved_slowly(quick_config: Path, tmp_path: Path, speed: str) -> None:
    code, out, err = said("run", "-c", quick_config, "--speed", speed, "--runs", tmp_path / "runs")
    assert (code, out) == (2, "")
    assert f"--speed {speed}: only with --dry-run" in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("speed", ["0", "1.5", "-1"])
def test_a_speed_that_is_none_is_refused(quick_config: Path, tmp_path: Path, speed: str) -> None:
    code, _, err = said("run", "-c", quick_config, "--dry-run", f"--speed={speed}")
    assert code == 2 and "speed" in err
