"""The real ur-rtde driver against the emulated controller: what is peculiar to it."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.interfaces import (
    ArmMode,
    ConnectError,
    DeviceLostError,
    LimitError,
    StoppedError,
    TooLateError,
)
from drivers.plane_mount import PlaneMount
from drivers.ur import UrArm
from drivers.ur_shared import COLUMNS, SIZE_BYTES, SharedState, Slot
from tests.waiting import wait_until

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")


@pytest.fixture
def arm(ur_options):
    it = UrArm(ur_options)
    it.connect()
    yield it
    it.close()


def set_moving(arm: UrArm, line, duration_s: float = 1.5) -> None:
    start = arm.state().pose
    arm.follow(line(dy_m=-0.05, start=start, duration_s=duration_s))
    wait_until(lambda: arm.state().pose.y_m < start.y_m - 0.01)


def lost(arm: UrArm) -> DeviceLostError:
    deadline = time.monotonic() + 2.0
    with pytest.raises(DeviceLostError) as error:
        while time.monotonic() < deadline:
            arm.state()
            time.sleep(0.001)
    return error.value


def signalled(arm: UrArm, given: signal.Signals) -> float:
    os.kill(arm._child.process.pid, given)
    return time.monotonic()


#: What breaks, and when it was broken: by the emulator's own account, which shares our clock.
BREAKS = {
    "drop": lambda arm, emulator: emulator.request("drop")["t_s"],
    "freeze": lambda arm, emulator: emulator.request("freeze", seconds=1.0)["t_s"],
    "power cycle": lambda arm, emulator: emulator.request("power_cycle", seconds=0.3)["t_s"],
    "child killed": lambda arm, emulator: signalled(arm, signal.SIGKILL),
    "child stopped": lambda arm, emulator: signalled(arm, signal.SIGSTOP),
}


@pytest.mark.parametrize("fault", BREAKS)
def test_a_break_is_named_soon_the_arm_rests_and_comes_back(
    arm, ur_emulator, ur_options, line, fault
) -> None:
    set_moving(arm, line)
    broke_s = BREAKS[fault](arm, ur_emulator)
    error = lost(arm)
    assert time.monotonic() - broke_s < 0.1
    assert "then reset" in error.remedy
    time.sleep(1.2 if fault == "freeze" else 0.5)
    assert ur_emulator.request("state")["last_moved_s"] - broke_s < 0.2
    wait_until(lambda: _connects(arm))
    arm.follow(line(dx_m=-0.01, start=arm.state().pose))
    wait_until(lambda: not arm.state().moving)


def _connects(arm: UrArm) -> bool:
    try:
        arm.connect()
    except ConnectError:
        return False
    return True


def test_garbage_never_leaves_the_arm_moving(arm, ur_emulator, line) -> None:
    """ur-rtde may take random bytes for poses, crash or hang; the arm must rest either way."""
    set_moving(arm, line)
    for _ in range(5):
        ur_emulator.request("garbage", size=200)
    garbage_s = time.monotonic()
    lost(arm)
    assert time.monotonic() - garbage_s < 0.3
    time.sleep(0.4)
    assert ur_emulator.request("state")["last_moved_s"] - garbage_s < 0.3


def begun(ur_options, tmp_path, then: str) -> subprocess.Popen[str]:
    """Another process that connects the arm, does this, and lives."""
    program = tmp_path / "cell.py"
    program.write_text(
        "import pickle, sys, time\n"
        "import numpy as np\n"
        "from drivers.interfaces import Trajectory\n"
        "from drivers.ur import UrArm\n"
        "arm = UrArm(pickle.loads(bytes.fromhex(sys.argv[1])))\n"
        f"arm.connect()\n{then}time.sleep(60)\n"
    )
    command = [sys.executable, str(program), pickle.dumps(ur_options).hex()]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_the_death_of_the_cell_leaves_the_arm_stopped(ur_options, ur_emulator, tmp_path) -> None:
    cell = begun(
        ur_options,
        tmp_path,
        "pose, t = arm.state().pose, np.linspace(0.0, 5.0, 50)\n"
        "arm.follow(Trajectory(t, pose.x_m + 0 * t, pose.y_m - 0.02 * t, 0 * t))\n",
    )
    try:
        wait_until(lambda: abs(ur_emulator.request("state")["speed"][2]) > 0.015, 15.0)
    finally:
        killed_s = time.monotonic()
        cell.kill()
        cell.communicate(timeout=30)
    time.sleep(0.5)
    state = ur_emulator.request("state")
    assert state["last_moved_s"] - killed_s < 0.2
    assert state["runtime"] == "STOPPED"


@pytest.mark.parametrize("also", ["drop", "freeze"])
def test_the_child_outlives_neither_cell_nor_controller(
    ur_options, ur_emulator, tmp_path, also
) -> None:
    with begun(ur_options, tmp_path, "print(arm._child.process.pid, flush=True)\n") as cell:
        child = int(cell.stdout.readline())
        cell.kill()
    ur_emulator.request(also, **({"seconds": 8.0} if also == "freeze" else {}))
    wait_until(lambda: not Path(f"/proc/{child}").exists(), 6.0)


def test_ctrl_c_at_the_terminal_does_not_reach_the_child(arm) -> None:
    """It goes to all of the terminal's group; the child is stopped by its parent, in order."""
    assert os.getpgid(arm._child.process.pid) != os.getpgrp()
    assert os.getsid(arm._child.process.pid) != os.getsid(0)


def test_a_stop_reaches_the_controller_soon(arm, ur_emulator, line) -> None:
    set_moving(arm, line)
    asked_s = time.monotonic()
    arm.stop("test")
    wait_until(lambda: not arm.state().moving)
    events = ur_emulator.request("state")["events"]
    (stop_s,) = [e["t_s"] for e in events if e["what"] == "servo stop" and e["t_s"] > asked_s]
    assert stop_s - asked_s < 0.1


@pytest.mark.parametrize(
    ("op", "mode"),
    [
        ("protective_stop", ArmMode.PROTECTIVE_STOP),
        ("safeguard_stop", ArmMode.SAFEGUARD_STOP),
        ("emergency_stop", ArmMode.EMERGENCY_STOP),
    ],
)
def test_after_a_controllers_stop_nothing_moves_by_itself(arm, ur_emulator, line, op, mode) -> None:
    """Hardware trap 4: the last pose must not be replayed when the program starts anew."""
    set_moving(arm, line)
    ur_emulator.request(op)
    wait_until(lambda: arm.state().mode is mode)
    with pytest.raises(StoppedError, match=mode.value):
        arm.follow(line(start=arm.state().pose))
    time.sleep(0.1)
    rest = arm.state().pose
    ur_emulator.request("clear")
    wait_until(lambda: arm.state().mode is ArmMode.STOPPED)
    arm.reset()
    assert arm.state().mode is ArmMode.READY
    time.sleep(0.2)
    assert arm.state().pose.y_m == pytest.approx(rest.y_m, abs=1e-4)


def test_local_control_is_a_state_with_a_remedy(arm, ur_emulator, line) -> None:
    ur_emulator.request("local", on=True)
    ur_emulator.request("end_program")
    wait_until(lambda: arm.state().mode is ArmMode.LOCAL_CONTROL)
    for act in (arm.reset, lambda: arm.follow(line(start=arm.state().pose))):
        with pytest.raises(StoppedError, match="remote control"):
            act()
    ur_emulator.request("local", on=False)
    arm.reset()
    assert arm.state().mode is ArmMode.READY


def test_local_control_in_motion_stops_the_arm_though_the_controller_would_go_on(
    arm, ur_emulator, line
) -> None:
    set_moving(arm, line)
    asked_s = time.monotonic()
    ur_emulator.request("local", on=True)
    wait_until(lambda: arm.state().mode is ArmMode.LOCAL_CONTROL)
    wait_until(lambda: not arm.state().moving)
    rest = arm.state().pose
    events = ur_emulator.request("state")["events"]
    stopped_s = [e["t_s"] for e in events if e["what"] == "servo stop"][-1]
    assert 0.0 < stopped_s - asked_s < 0.7, "it is asked twice a second"
    for act in (arm.reset, lambda: arm.follow(line(start=rest))):
        with pytest.raises(StoppedError, match="local_control; switch the pendant to remote"):
            act()
    ur_emulator.request("local", on=False)
    arm.reset()
    time.sleep(0.2)
    assert arm.state().pose.y_m == pytest.approx(rest.y_m, abs=1e-4)
    arm.follow(line(dy_m=0.01, start=rest))
    wait_until(lambda: not arm.state().moving)
    assert arm.state().pose.y_m == pytest.approx(rest.y_m + 0.01, abs=2e-4)


def test_a_dashboard_that_closes_once_is_asked_again_and_one_that_is_gone_is_a_lost_arm(
    arm, ur_emulator
) -> None:
    ur_emulator.request("drop", ports=[29999])
    time.sleep(0.8)
    assert arm.state().mode is ArmMode.READY
    ur_emulator.request("refuse", on=True)
    ur_emulator.request("drop", ports=[29999])
    with pytest.raises(DeviceLostError, match="the dashboard does not tell who has control: Conn"):
        wait_until(lambda: arm.state().mode is not ArmMode.READY)


def test_a_slider_below_full_speed_is_a_state_with_a_remedy(arm, ur_emulator, line) -> None:
    ur_emulator.request("speed_fraction", value=0.4)
    wait_until(lambda: arm.state().mode is ArmMode.REDUCED_SPEED)
    for act in (arm.reset, lambda: arm.follow(line(start=arm.state().pose))):
        with pytest.raises(StoppedError, match=r"40% of the full speed; set the speed slider to"):
            act()
    time.sleep(0.5)
    assert ur_emulator.request("state")["runtime"] == "PLAYING", "its watchdog is fed all the same"
    ur_emulator.request("speed_fraction", value=1.0)
    wait_until(lambda: arm.state().mode is ArmMode.READY)
    arm.follow(line(dy_m=-0.01, start=arm.state().pose))
    wait_until(lambda: not arm.state().moving)


@pytest.mark.parametrize("what", ["speed_fraction", "speed_scaling"])
def test_a_motion_that_is_slowed_is_broken_off_and_stays_so(arm, ur_emulator, line, what) -> None:
    set_moving(arm, line)
    asked_s = time.monotonic()
    ur_emulator.request(what, value=0.7)
    wait_until(lambda: not arm.state().moving)
    rest = arm.state().pose
    stops = [e["t_s"] for e in ur_emulator.request("state")["events"] if e["what"] == "servo stop"]
    assert 0.0 < stops[-1] - asked_s < 0.1
    ur_emulator.request(what, value=1.0)
    wait_until(lambda: arm.state().mode is ArmMode.STOPPED)
    with pytest.raises(StoppedError, match="it was slowed in motion; acknowledge and reset"):
        arm.follow(line(start=rest))
    arm.reset()
    time.sleep(0.2)
    assert arm.state().mode is ArmMode.READY
    assert arm.state().pose.y_m == pytest.approx(rest.y_m, abs=1e-4)
    arm.follow(line(dy_m=0.01, start=rest))
    wait_until(lambda: not arm.state().moving)
    assert arm.state().pose.y_m == pytest.approx(rest.y_m + 0.01, abs=2e-4)


def test_an_arm_without_power_or_with_its_brakes_on_says_so(arm, ur_emulator) -> None:
    ur_emulator.request("end_program")
    ur_emulator.request("brakes", on=True)
    wait_until(lambda: arm.state().mode is ArmMode.POWER_OFF)
    with pytest.raises(StoppedError, match="power_off; power on and release the brakes"):
        arm.reset()
    ur_emulator.request("brakes", on=False)
    wait_until(lambda: arm.state().mode is ArmMode.STOPPED)
    arm.reset()
    assert arm.state().mode is ArmMode.READY
    ur_emulator.request("brakes", on=True)
    arm.close()
    with pytest.raises(ConnectError, match="power_off; power on and release the brakes"):
        arm.connect()
    ur_emulator.request("brakes", on=False)


def test_a_program_that_ended_can_be_started_anew(arm, ur_emulator, line) -> None:
    ur_emulator.request("end_program")
    wait_until(lambda: arm.state().mode is ArmMode.STOPPED)
    with pytest.raises(StoppedError, match="program ended"):
        arm.follow(line(start=arm.state().pose))
    arm.reset()
    assert arm.state().mode is ArmMode.READY


def test_the_dashboard_is_asked_now_and_then_not_in_every_cycle(arm, ur_emulator) -> None:
    before = ur_emulator.request("state")["dashboard_lines"]
    time.sleep(0.6)
    assert 1 <= ur_emulator.request("state")["dashboard_lines"] - before <= 4


def test_the_log_is_in_order_from_the_first_sample_on_and_not_from_the_future(arm) -> None:
    time.sleep(0.3)
    t_s = arm.log(0.0, float("inf")).t_s
    assert len(t_s) > 20
    assert np.all(np.diff(t_s) > 0.0)
    assert t_s[-1] <= time.monotonic()


def test_an_idle_arm_feeds_the_watchdog(arm, ur_emulator) -> None:
    time.sleep(0.5)
    assert arm.state().mode is ArmMode.READY
    assert ur_emulator.request("state")["runtime"] == "PLAYING"


def test_out_of_reach_and_too_fast_are_refused_before_anything_is_sent(
    arm, ur_emulator, line
) -> None:
    start = arm.state().pose
    sent = ur_emulator.request("state")["servo_writes"]
    for act in (arm.check, arm.follow):
        with pytest.raises(LimitError, match=r"UR5e does not reach.*nothing was moved"):
            act(line(start=replace(start, y_m=2.5)))
    with pytest.raises(LimitError, match=r"a joint turns at"):  # stretching out its elbow
        arm.follow(line(dy_m=1.5, start=start, duration_s=10.0))
    with pytest.raises(LimitError, match=r"a joint turns at .* rad/s, allowed 3.14"):
        arm.follow(line(dy_m=-0.3, start=start, duration_s=0.1))
    assert ur_emulator.request("state")["servo_writes"] == sent
    assert arm.state().mode is ArmMode.READY


def test_a_tool_off_the_plane_is_refused(ur_options, ur_emulator, line) -> None:
    x, y, z = ur_options.mount.origin_m
    off = PlaneMount((x + 0.01, y, z), ur_options.mount.x_axis, ur_options.mount.y_axis)
    arm = UrArm(replace(ur_options, mount=off))
    arm.connect()
    try:
        with pytest.raises(LimitError, match=r"10.0 mm off the cell's plane"):
            arm.follow(line(start=arm.state().pose))
    finally:
        arm.close()


def test_a_wrong_model_is_noticed(ur_options) -> None:
    with pytest.raises(
        ConnectError, match=r"UR10e put it \d+ mm from where it is; check arm.model"
    ):
        UrArm(replace(ur_options, model="UR10e")).connect()
    with pytest.raises(ValueError, match="must be one of UR3e, UR5e, UR10e"):
        replace(ur_options, model="UR5")


@pytest.fixture
def newer(ur_options, ur_emulator):
    """Connects the arm to a controller whose software is another one."""
    arms: list[UrArm] = []

    def connect(version: str, allow_version: tuple[int, int] | None = None) -> UrArm:
        ur_emulator.request("version", version=version)
        arms.append(UrArm(replace(ur_options, allow_version=allow_version)))
        arms[-1].connect()
        return arms[-1]

    yield connect
    for arm in arms:
        arm.close()
    ur_emulator.request("version", version="5.12.2.1101534")


def test_a_controller_of_another_version_is_refused(newer, ur_emulator) -> None:
    named = r"PolyScope 5.22, unknown: .*issue 334.*; install PolyScope 5.6 to 5.21; or take"
    with pytest.raises(ConnectError, match=named):
        newer("5.22.0.1")
    assert ur_emulator.request("state")["runtime"] == "STOPPED"


@pytest.mark.parametrize(("version", "allowed"), [("5.26.0.1", (5, 26)), ("10.13.0.1", (10, 13))])
def test_an_allowed_version_moves_stops_and_starts_again(
    newer, ur_emulator, line, version, allowed
) -> None:
    """With the dashboard of PolyScope 5 and without one, as PolyScope X is."""
    arm = newer(version, allowed)
    asked = ur_emulator.request("state")["dashboard_lines"]
    arm.follow(line(dy_m=-0.01, start=arm.state().pose))
    wait_until(lambda: not arm.state().moving)
    ur_emulator.request("protective_stop")
    wait_until(lambda: arm.state().mode is ArmMode.PROTECTIVE_STOP)
    with pytest.raises(StoppedError, match="find the cause, unlock at the pendant"):
        arm.reset()
    ur_emulator.request("clear")
    wait_until(lambda: arm.state().mode is ArmMode.STOPPED)
    arm.reset()
    arm.follow(line(dy_m=0.01, start=arm.state().pose))
    wait_until(lambda: not arm.state().moving)
    told = ur_emulator.request("state")["dashboard_lines"] - asked
    assert (told > 0) is version.startswith("5.")


def test_what_polyscope_x_does_not_tell_is_said_to_a_person(newer, ur_emulator) -> None:
    arm = newer("10.12.0.1", (10, 12))
    ur_emulator.request("end_program")
    ur_emulator.request("local", on=True)
    wait_until(lambda: arm.state().mode is ArmMode.STOPPED)  # whether it is local, nobody tells
    with pytest.raises(StoppedError, match="program does not start; PolyScope X does not tell"):
        arm.reset()
    ur_emulator.request("local", on=False)
    arm.reset()
    assert arm.state().mode is ArmMode.READY


def test_a_stopped_controller_is_not_connected_to(ur_options, ur_emulator) -> None:
    ur_emulator.request("protective_stop")
    with pytest.raises(ConnectError, match="reports protective_stop; find the cause, unlock"):
        UrArm(ur_options).connect()


def test_a_log_outlives_the_connection(arm, line) -> None:
    began_s = time.monotonic()
    time.sleep(0.05)
    arm.close()
    assert len(arm.log(began_s, time.monotonic()).t_s) > 5


def test_nothing_leaks_over_many_connections(ur_options, ur_emulator) -> None:
    arm = UrArm(ur_options)

    def handles() -> int:
        return len(os.listdir("/proc/self/fd"))  # noqa: PTH208  # faster than pathlib, and counts

    arm.connect()
    arm.close()
    before, threads = handles(), threading.active_count()
    for _ in range(5):
        arm.connect()
        arm.close()
    assert handles() <= before + 1
    assert threading.active_count() == threads


def test_poses_are_those_of_the_plane(arm) -> None:
    pose = arm.state().pose
    assert (pose.x_m, pose.y_m) == pytest.approx((0.5, 0.5), abs=1e-4)


class _Told:
    """A child process of which only the answers are played: `act` on what it is told."""

    def __init__(self, act) -> None:
        with tempfile.TemporaryFile() as file:
            file.truncate(SIZE_BYTES)
            self.shared = SharedState(file.fileno())
        self.shared.put(Slot.HEARTBEAT_S, np.inf)
        self.process = self.connection = self
        self._act = act

    def send(self, request) -> None:
        self._request = request

    def poll(self, seconds: float | None = None) -> bool | None:
        return None if seconds is None else True

    def recv(self):
        return self._act(self._request, self.shared)


def test_a_stop_during_a_reset_is_not_cleared_by_it(ur_options) -> None:
    arm = UrArm(ur_options)

    def act(request, shared):
        arm.stop("the watch")
        return ("done",)

    arm._child = _Told(act)
    arm.stop("operator")
    arm.reset()
    assert arm._mode(arm._child) is ArmMode.STOPPED
    with pytest.raises(StoppedError, match="the watch"):
        arm._check_ready(arm._child)


def test_a_reset_that_is_refused_leaves_the_stop(ur_options) -> None:
    arm = UrArm(ur_options)
    arm._child = _Told(lambda request, shared: ("refused", "the arm moved", "look"))
    arm.stop("operator")
    with pytest.raises(StoppedError, match="the arm moved"):
        arm.reset()
    with pytest.raises(StoppedError, match="operator"):
        arm._check_ready(arm._child)


def test_a_path_that_the_child_hears_of_too_late_is_an_error(ur_options, line, monkeypatch) -> None:
    arm = UrArm(ur_options)
    arm._child = told = _Told(None)
    start_s = time.monotonic() + 0.5

    def send(request) -> None:
        told.shared.add(Slot.PATHS)  # and not `FOLLOWED`
        monkeypatch.setattr(time, "monotonic", lambda: start_s + 0.02)

    told.send = send
    told.shared.write_sample(np.zeros(COLUMNS))
    monkeypatch.setattr(UrArm, "_check_on_plane", lambda *_: None)
    monkeypatch.setattr(UrArm, "_check_reach", lambda *_: None)
    with pytest.raises(TooLateError, match=r"20.0 ms after .*nothing was moved"):
        arm.follow(line(), start_s)
    assert not arm._busy(told)
