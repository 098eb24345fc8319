"""Measuring cycles: the motion that the lab asks for, filmed and recorded, the cable put back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.lab.next.motion_file import load_motion
from cell.plan.measuring import Measuring
from cell.records.folder import read_record
from cell.records.result import Outcome
from cell.run.machine import CellState, MachineEvent
from cell.run.plans import measuring
from cell.settings import Settings, load_settings
from cell.study.folder import read_study
from cell.wiring.twins import hidden_cable

from .conftest import said

Live = Callable[..., SimpleNamespace]

TILTED = """\
format: cell-motion/1
purpose: tell air_drag from natural_curvature
start: {x_m: -0.01, y_m: 0.0, angle_rad: 0.5}
still_s: 0.2
moves:
  - {x_m: -0.01, y_m: -0.05, angle_rad: 0.5, duration_s: 0.27}
hold_s: 0.4
"""


@pytest.fixture(scope="module")
def quick_config(sharp_config: Path) -> Path:
    """Here it counts how exactly pictures measure."""
    return sharp_config


@pytest.fixture(scope="module")
def quick(quick_config: Path) -> Settings:
    return load_settings(quick_config)


@pytest.fixture
def motion_file(tmp_path: Path) -> Path:
    path = tmp_path / "tilted.yaml"
    path.write_text(TILTED, encoding="utf-8")
    return path


@pytest.fixture
def tilted(motion_file: Path, quick: Settings) -> Measuring:
    return load_motion(motion_file, quick)


def test_the_motion_is_filmed_and_the_cable_is_let_go_at_home(
    live: Live, quick: Settings, tilted: Measuring
) -> None:
    it = live(seed=3)
    result = it.cell.run_cycle(1, measuring(tilted))
    assert result.outcome is Outcome.MEASURED
    assert it.steps == [
        *("warm_up", "connect", "check_paths", "reset", "start"),
        *("grasp", "approach", "measure", "go_back", "release", "go_home"),
    ]
    assert it.cell.machine.state is CellState.COMPLETE
    assert not it.twins.world.holds
    home = it.twins.world.gripper_pose()
    assert (home.x_m, home.y_m, home.angle_rad) == pytest.approx((0.0, 0.0, 0.0), abs=2e-4)

    read = read_record(Path(result.folder))
    assert read.closed and read.result == result and read.study is not None
    (trial,) = read.study.trials
    assert (trial.name, trial.role, trial.start) == ("tilted", "fit", "equilibrium")
    assert {f.stem for f in Path(result.folder).glob("*.jpg")} == {
        "measure_still",
        "measure_swing",
        "measure_held",
    }
    # The camera saw the jaw tilted, the move was made, and the trial is of this very cable: it
    # began at rest and did what the hidden cable does under this motion.
    assert np.median(trial.grip.angle_rad) == pytest.approx(0.5, abs=2e-3)
    assert trial.grip.y_m[-1] - trial.grip.y_m[0] == pytest.approx(-0.05, abs=1e-4)
    still = trial.markers.t_s < 0.2
    assert np.ptp(trial.markers.xy_m[still, 0], axis=0).max() < 2e-4
    truth = hidden_cable(quick, 3, 1)
    nodes_m = simulate(truth, trial.grip, trial.markers.t_s, read.study.arc_length_m)[0]
    assert np.nanmax(np.linalg.norm(nodes_m - trial.markers.xy_m, axis=-1)) < 5e-4


def test_a_cable_can_be_inserted_after_another_was_measured(live: Live, tilted: Measuring) -> None:
    it = live(cycles=2, seed=7)
    assert it.cell.run_cycle(1, measuring(tilted)).outcome is Outcome.MEASURED
    assert it.cell.run_cycle(2).outcome is Outcome.INSERTED


@pytest.mark.parametrize("step", ["approach", "measure", "go_back"])
def test_after_a_stop_with_the_clamp_tilted_the_hand_finds_home(
    live: Live, tilted: Measuring, step: str
) -> None:
    def soon(it: SimpleNamespace) -> None:
        clock = it.twins.world.clock
        clock.call_at(
            clock.now_s() + 0.4, lambda: it.cell.command(MachineEvent.STOP, "guard opened")
        )

    it = live({step: soon}, cycles=2)
    result = it.cell.run_cycle(1, measuring(tilted))
    assert result.outcome is Outcome.FAILED
    assert result.fault is not None and result.fault.step == step
    assert it.twins.world.gripper_rest_from_s() <= it.twins.world.clock.now_s()
    it.cell.acknowledge()
    assert it.cell.run_cycle(2, measuring(tilted)).outcome is Outcome.MEASURED


def test_a_cable_that_leaves_the_picture_is_not_measured(
    live: Live, quick: Settings, tilted: Measuring
) -> None:
    view = quick.camera.view.model_copy(update={"origin_column_px": 300.0})
    camera = quick.camera.model_copy(update={"view": view})
    it = live(settings=quick.model_copy(update={"camera": camera}))
    result = it.cell.run_cycle(1, measuring(tilted))
    assert result.outcome is Outcome.REJECTED
    assert result.reason is not None and "keep the motion inside the picture" in result.reason


def test_a_cycle_and_a_measuring_cycle_of_a_cable_become_one_study(
    quick_config: Path, motion_file: Path, tmp_path: Path
) -> None:
    runs, folders = tmp_path / "runs", []
    for extra in ((), ("--motion", motion_file)):
        code, out, err = said("run", "-c", quick_config, "--json", "--runs", runs, *extra)
        assert (code, err) == (0, "")
        folders.append(json.loads(out)["folder"])
    assert json.loads(out)["outcome"] == "measured"
    code, out, err = said("study", *folders, "-o", tmp_path / "gathered")
    assert (code, err) == (0, "")
    study = read_study(tmp_path / "gathered")
    assert [t.name.partition("_")[2] for t in study.trials] == ["identify", "execute", "tilted"]
    assert [t.role for t in study.trials] == ["fit", "validate", "validate"]


def test_a_motion_beyond_the_limits_ends_with_2_and_nothing_moves(
    quick_config: Path, motion_file: Path, tmp_path: Path
) -> None:
    motion_file.write_text(TILTED.replace("y_m: -0.05", "y_m: -0.25"), encoding="utf-8")
    runs = tmp_path / "runs"
    code, out, err = said("run", "-c", quick_config, "--motion", motion_file, "--runs", runs)
    assert (code, out) == (2, "")
    assert f"{motion_file}:6:18: moves[0].y_m: takes the gripper to y_m = -0.25" in err
    assert not runs.exists()


def test_an_effect_hidden_in_the_world_is_found_through_the_pictures(
    quick_config: Path, motion_file: Path, tmp_path: Path
) -> None:
    hidden = tmp_path / "hidden.yaml"
    text = quick_config.read_text(encoding="utf-8")
    hidden.write_text(
        text.replace("effects: {}", "effects: {air_drag: {drag_coefficient: 2.0}}"), "utf-8"
    )
    runs, study, out = (tmp_path / name for name in ("runs", "study", "diagnosis.json"))
    for extra in ((), ("--motion", motion_file)):
        assert said("run", "-c", hidden, "--runs", runs, *extra)[0] == 0
    assert said("study", *sorted(runs.iterdir()), "-o", study)[0] == 0
    assert said("diagnose", study, "--json", out)[0] == 0
    diagnosis = json.loads(out.read_text(encoding="utf-8"))
    assert diagnosis["verdict"] == "missing"
    assert diagnosis["missing"][0]["effect"] == "air_drag"
    assert diagnosis["ranking"][0]["effect"] == "air_drag"
    drag = diagnosis["missing"][0]["parameters"]["drag_coefficient"]
    assert drag["low"] < 2.0 < drag["high"]
    assert diagnosis["missing"][0]["heldout_rms_m"] < 0.2 * diagnosis["baseline"]["heldout_rms_m"]
