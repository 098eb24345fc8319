"""Whoever moves the arm, or opens the jaws, waits until it rests: but not for ever."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cell.plan.paths import path_to
from cell.run import steps
from cell.run.findings import Findings
from cell.run.station import Station
from cell.run.waiting import await_rest
from cell.settings import load_settings
from cell.wiring.build import cell_with, twin_devices
from cell.wiring.twins import build_twins
from drivers.interfaces import ArmState, DeviceTimeoutError, GripperState

FAKE = Path(__file__).parents[3] / "config" / "fake.yaml"
Stations = Callable[[float], Station]


@pytest.fixture
def settling(tmp_path: Path) -> Stations:
    """A station whose arm has come to the end of its path, one lag late, and still settles."""

    def build(lag_s: float) -> Station:
        settings = load_settings(FAKE)
        arm = settings.arm.model_copy(update={"lag_s": lag_s})
        settings = settings.model_copy(update={"arm": arm})
        twins = build_twins(settings, 1, 1)
        station = cell_with(settings, twin_devices(twins), tmp_path, lambda number, step: None)
        it = station._station
        for device in (it.devices.arm, it.devices.camera, it.devices.gripper):
            device.connect()
        path = path_to(it.task.lowered, it.devices.arm.state().pose, it.task.lowering, 500.0)
        assert path is not None
        it.devices.arm.follow(path)
        it.devices.clock.sleep_s(float(path.t_s[-1]) + lag_s)
        assert it.devices.arm.state().moving
        return it

    return build


@pytest.mark.parametrize("lag_s", [0.01, 0.03, 0.3])
def test_the_next_motion_begins_when_the_arm_has_settled(settling: Stations, lag_s: float) -> None:
    it = settling(lag_s)
    steps.move_to(it, it.task.aside, it.task.lowering)
    state = it.devices.arm.state()
    assert not state.moving
    here = (state.pose.x_m, state.pose.y_m)
    assert here == pytest.approx((it.task.aside.x_m, it.task.aside.y_m), abs=1e-4)


def test_the_jaws_open_when_the_arm_has_settled(
    settling: Stations, monkeypatch: pytest.MonkeyPatch
) -> None:
    it = settling(0.1)
    moving: list[bool] = []
    release = it.devices.gripper.release

    def noting() -> GripperState:
        moving.append(it.devices.arm.state().moving)
        return release()

    monkeypatch.setattr(it.devices.gripper, "release", noting)
    steps.let_go(it, Findings())
    assert moving == [False]


def test_an_arm_that_never_rests_is_named_with_what_to_look_at(
    settling: Stations, monkeypatch: pytest.MonkeyPatch
) -> None:
    it = settling(0.03)
    begun_s, state = it.devices.clock.now_s(), it.devices.arm.state

    def restless() -> ArmState:
        now = state()
        return ArmState(now.t_s, now.pose, 0.01, True, now.mode)

    monkeypatch.setattr(it.devices.arm, "state", restless)
    for wait in (
        lambda: await_rest(it),
        lambda: steps.move_to(it, it.task.aside, it.task.lowering),
        lambda: steps.let_go(it, Findings()),
    ):
        with pytest.raises(DeviceTimeoutError, match=r"arm: still moves 1\.2 s after its") as e:
            wait()
        assert "speed slider" in e.value.remedy
    assert np.isclose(it.devices.clock.now_s() - begun_s, 3 * 1.25, atol=0.2)
