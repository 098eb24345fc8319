"""Whole cycles in the simulated cell, undisturbed, paused and repeated."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cell.records.folder import read_record
from cell.records.result import Outcome
from cell.run.findings import Findings
from cell.run.machine import CellState, MachineEvent
from cell.run.plans import INSERTING, Step
from cell.run.station import Station
from cell.settings import Settings
from cell.settings.model import JawPlate, Vision
from cell.wiring.twins import hidden_cable
from drivers.interfaces import DeviceTimeoutError, Trajectory

Live = Callable[..., SimpleNamespace]


def test_three_cables_are_inserted_and_leave_complete_records(live: Live, quick: Settings) -> None:
    it = live(cycles=3, seed=7)
    results = [it.cell.run_cycle(n) for n in (1, 2, 3)]
    it.cell.close()

    assert [r.outcome for r in results] == [Outcome.INSERTED] * 3
    assert len({r.offset_m for r in results}) > 1, "different cables ask for different motions"
    assert it.twins.world.waiting == 0
    for r in results:
        assert r.margin_m is not None and r.margin_m > 0.0
        assert r.prediction_error_m is not None and r.prediction_error_m < 1e-3
        assert r.measured_miss_m == pytest.approx(r.predicted_miss_m, abs=1e-3)
        assert r.wait_s is not None and r.wait_s > 0.0
        assert set(r.seconds) == set(INSERTING.names) - (
            {"connect", "warm_up", "check_paths", "check_clocks"} if r.cycle > 1 else set()
        )
        read = read_record(Path(r.folder))
        assert read.closed
        assert read.result == r
        assert read.study is not None and read.model is not None
        assert [t.name for t in read.study.trials] == ["identify", "execute"]
        assert {f.stem for f in Path(r.folder).glob("*.jpg")} == {
            "identify_still",
            "identify_swing",
            "identify_held",
            "execute_passage",
        }
        truth = hidden_cable(quick, 7, r.cycle)
        found = np.array([r.parameters[f"rigidity_{k}"] for k in range(6)])
        s = np.linspace(0.0, quick.cable.free_length_m, 6)
        bends = s < 0.6 * quick.cable.free_length_m
        ratio = found / truth.rigidity_at(s)
        np.testing.assert_allclose(ratio[bends], 1.0, atol=0.08)


def test_the_same_seed_gives_the_same_cycle_and_another_seed_another(
    live: Live, quick: Settings
) -> None:
    a, b = (live(seed=5).cell.run_cycle(1) for _ in range(2))
    assert (a.offset_m, a.margin_m, a.parameters) == (b.offset_m, b.margin_m, b.parameters)
    assert hidden_cable(quick, 5, 1).exponent != hidden_cable(quick, 6, 1).exponent
    assert hidden_cable(quick, 5, 1).exponent != hidden_cable(quick, 5, 2).exponent


def test_time_is_spent_in_the_states_that_the_cycle_goes_through(live: Live) -> None:
    it = live()
    result = it.cell.run_cycle(1)
    assert it.cell.machine.state is CellState.COMPLETE
    in_steps = sum(result.seconds[s] for s in ("grasp", "lower", "hold_and_capture", "release"))
    assert result.state_seconds["execute"] > in_steps
    assert result.state_seconds["completing"] == pytest.approx(result.seconds["go_home"])


@pytest.mark.parametrize(
    ("pause", "resume", "state"),
    [
        (MachineEvent.HOLD, MachineEvent.UNHOLD, "held"),
        (MachineEvent.SUSPEND, MachineEvent.UNSUSPEND, "suspended"),
    ],
)
def test_a_pause_takes_effect_between_steps_and_the_moment_is_planned_anew(
    live: Live, pause: MachineEvent, resume: MachineEvent, state: str
) -> None:
    def later(it: SimpleNamespace) -> None:
        assert it.cell.machine.state.value == state
        it.twins.world.clock.sleep_s(2.0)
        threading.Timer(0.3, go_on, (it,)).start()

    def go_on(it: SimpleNamespace) -> None:
        at_s.append(time.perf_counter())
        it.cell.command(resume)

    def executes(it: SimpleNamespace) -> None:
        at_s.append(time.perf_counter())

    at_s: list[float] = []
    it = live({"simulate": lambda it: it.cell.command(pause), state: later, "execute": executes})
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED
    begin = it.steps.index(state)
    assert it.steps[begin - 1 : begin + 4] == ["choose", state, "simulate", "choose", "execute"]
    assert result.prediction_error_m is not None and result.prediction_error_m < 1e-3
    resumed_s, execute_s = at_s
    assert result.wait_s is not None and result.wait_s < execute_s - resumed_s, "a pause is no wait"
    assert result.wait_s < 3.0


def test_a_computer_too_slow_for_the_planned_moment_plans_a_later_one(live: Live) -> None:
    it = live({"choose": lambda it: it.twins.world.clock.sleep_s(0.3)})
    result = it.cell.run_cycle(1)
    assert it.steps.count("simulate") == 2
    assert result.outcome is Outcome.INSERTED


def test_a_light_cable_and_another_jaw_plate_are_seen_if_the_settings_say_so(
    live: Live, quick: Settings
) -> None:
    jaw = JawPlate(discs_m=((0.008, 0.01), (0.008, -0.012), (0.04, 0.004)), radius_m=0.003)
    vision = Vision(cable_is="light", nodes=15, jaw=jaw)
    settings = quick.model_copy(update={"vision": vision})
    result = live(settings=settings).cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED, result.fault or result.reason
    study = read_record(Path(result.folder)).study
    assert study is not None and study.arc_length_m.shape == (15,)


def test_a_cable_that_no_offset_can_insert_is_put_aside(live: Live, quick: Settings) -> None:
    high = quick.destination.model_copy(update={"y_m": (-0.065, -0.055)})
    it = live(settings=quick.model_copy(update={"destination": high}), seed=1)
    where: list[float] = []
    it.twins.gripper.release = _noting(it, where, it.twins.gripper.release)
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.REJECTED
    assert result.reason is not None and result.reason.startswith("no offset passes")
    assert result.offset_m is None and result.measured_miss_m is None
    assert result.predicted_margin_m is not None and result.predicted_margin_m < 0.0
    assert "execute" not in it.steps
    assert where[-1] == pytest.approx(quick.motion.aside.x_m, abs=1e-4)
    assert it.cell.machine.state is CellState.COMPLETE, "a rejected cable does not stop the cell"
    assert read_record(Path(result.folder)).model is not None


def _noting(it: SimpleNamespace, where: list[float], release: Callable[[], object]) -> object:
    def noted() -> object:
        where.append(it.twins.world.gripper_pose().x_m)
        return release()

    return noted


def test_a_hand_that_rests_a_little_beside_home_is_brought_there_before_it_is_filmed(
    live: Live,
) -> None:
    """Else the arm does so when it is told to lower, and no frame shows the cable at rest."""

    def push(it: SimpleNamespace) -> None:
        t_s = np.arange(0.0, 0.1, 0.002)
        it.twins.arm.follow(Trajectory(t_s, 0.0 * t_s, -1.2e-4 * t_s / t_s[-1], 0.0 * t_s))
        it.twins.world.clock.sleep_s(1.0)
        assert it.twins.arm.state().pose.y_m < -8e-5

    def look(it: SimpleNamespace) -> None:
        poses = it.twins.arm.log(0.0, it.twins.world.clock.now_s())
        assert abs(np.mean(poses.y_m[-100:])) < 2e-5

    it = live({"reset": push, "lower": look})
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED, result.fault or result.reason


def test_a_cable_that_hardly_swings_is_rejected_with_the_reason(
    live: Live, quick: Settings
) -> None:
    stiff = quick.world.model_copy(update={"rigidity_n_m2": (0.9, 1.0)})
    result = live(settings=quick.model_copy(update={"world": stiff})).cell.run_cycle(1)
    assert result.outcome is Outcome.REJECTED
    assert result.reason is not None and result.reason.startswith("little swing: the tip swings by")
    assert result.parameters == {}


def test_a_cycle_leaves_the_arm_at_home_and_the_jaws_open(live: Live) -> None:
    it = live()
    it.cell.run_cycle(1)
    home = it.twins.world.gripper_pose()
    assert (home.x_m, home.y_m) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert not it.twins.world.holds


def test_a_step_more_is_one_function_and_one_line_of_a_plan(live: Live) -> None:
    """It is done, timed, recorded and named in a fault like every other."""
    wiped_at_s: list[float] = []

    def wipe_window(station: Station, findings: Findings) -> Findings:
        wiped_at_s.append(station.devices.clock.now_s())
        station.devices.clock.sleep_s(2.0)
        return findings

    wipe = Step("wipe_window", wipe_window, every=100)
    wiping = replace(INSERTING, starting=(*INSERTING.starting, wipe))
    it = live(cycles=2)
    result = it.cell.run_cycle(100, wiping)
    assert result.outcome is Outcome.INSERTED
    assert result.seconds["wipe_window"] == pytest.approx(2.0)
    assert it.steps == [*wiping.names]
    assert it.steps[it.steps.index("wipe_window") - 1] == "start"

    def jam(station: Station, findings: Findings) -> Findings:
        raise DeviceTimeoutError("wiper", "jammed", "free it")

    jamming = replace(INSERTING, starting=(*INSERTING.starting, replace(wipe, act=jam)))
    assert it.cell.run_cycle(101, jamming).outcome is Outcome.INSERTED, "it is not due"
    assert len(wiped_at_s) == 1
    fault = it.cell.run_cycle(200, jamming).fault
    assert fault is not None
    assert (fault.step, fault.device, fault.cause) == ("wipe_window", "wiper", "jammed")
