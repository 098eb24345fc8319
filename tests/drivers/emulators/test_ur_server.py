"""The unmodified ur-rtde against the emulated controller, over loopback."""

from __future__ import annotations

import socket
import subprocess
import sys
import time

import pytest

from drivers.emulators.launch import EmulatedController, EmulatorError
from drivers.rtde_wire import PackageType, Packet, Splitter
from tests.waiting import wait_until

rtde_control = pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")
rtde_receive = pytest.importorskip("rtde_receive")
dashboard_client = pytest.importorskip("dashboard_client")

SERVO = (0.0, 0.0, 0.002, 0.03, 300.0)


@pytest.fixture
def emulator(ur_emulator):
    """The one controller of these tests, in order; no program runs."""
    return ur_emulator


_LOADED = """
from drivers import ur_kinematics as kinematics
from drivers.emulators.ur_controller import ControllerOptions
from drivers.emulators.ur_server import UrServer

server = UrServer({host!r}, ControllerOptions())
for function in (kinematics._newton, kinematics._follow_chain):
    print(function.__name__, len(function.signatures))
joints = server.controller.joints
joints.joints_at(joints.tool())
print("then", len(kinematics._newton.signatures), len(kinematics._follow_chain.signatures))
"""


def test_kinematics_are_loaded_before_anybody_connects(loopback) -> None:
    """They were loaded in the first command of a motion: the controller was silent for 41 ms."""
    done = subprocess.run(
        [sys.executable, "-c", _LOADED.format(host=loopback)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines() == ["_newton 1", "_follow_chain 1", "then 1 1"]


def events(emulator: EmulatedController, since_s: float) -> list[str]:
    """What has happened since a moment of our clock, which is the emulator's too."""
    return [e["what"] for e in emulator.request("state")["events"] if e["t_s"] >= since_s]


def refuses(host: str, port: int = 30004) -> bool:
    """Whether nobody listens there."""
    try:
        socket.create_connection((host, port), 1.0).close()
    except ConnectionRefusedError:
        return True
    return False


def test_the_real_client_moves_and_measures(emulator) -> None:
    begin_s, written = time.monotonic(), emulator.request("state")["servo_writes"]
    control = rtde_control.RTDEControlInterface(emulator.host)
    receive = rtde_receive.RTDEReceiveInterface(
        emulator.host, -1.0, ["timestamp", "actual_TCP_pose"]
    )
    start = receive.getActualTCPPose()
    goal = list(start)
    goal[2] -= 0.02
    assert control.moveL(goal, 0.5, 2.0)
    assert receive.getActualTCPPose() == pytest.approx(goal, abs=1e-4)
    began = receive.getTimestamp()
    assert control.setWatchdog(10.0)
    for _ in range(50):
        assert control.servoL(start, *SERVO)
        time.sleep(0.002)
    assert 0.05 < receive.getTimestamp() - began < 1.0
    assert control.servoStop(10.0)
    assert receive.getActualTCPPose() == pytest.approx(start, abs=2e-3)
    control.stopScript()
    control.disconnect()
    receive.disconnect()
    state = emulator.request("state")
    assert state["runtime"] == "STOPPED"
    assert state["servo_writes"] - written == 50
    assert "program ended: stopped by command" in events(emulator, begin_s)


def test_a_client_that_dies_leaves_the_arm_stopped_by_the_watchdog(emulator) -> None:
    program = (
        "import rtde_control, time\n"
        "from drivers.priority import run_in_real_time\n"
        "run_in_real_time()\n"
        f"c = rtde_control.RTDEControlInterface('{emulator.host}')\n"
        "c.setWatchdog(20.0)\n"
        "while True:\n"
        "    c.speedL([0, 0, -0.02, 0, 0, 0], 1.0, 0.0)\n"
        "    time.sleep(0.002)\n"
    )
    client = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL)
    try:
        wait_until(lambda: emulator.request("state")["speed"][2] < -0.01, 10.0)
    finally:
        killed_s = time.monotonic()
        client.kill()
        client.wait(30)
    wait_until(lambda: emulator.request("state")["runtime"] == "STOPPED")
    time.sleep(0.2)
    assert emulator.request("state")["last_moved_s"] - killed_s < 0.2


def test_dashboard_client_and_safety(emulator) -> None:
    dashboard = dashboard_client.DashboardClient(emulator.host)
    dashboard.connect()
    assert dashboard.polyscopeVersion() == "5.12.2.1101534"
    assert dashboard.isInRemoteControl()
    receive = rtde_receive.RTDEReceiveInterface(emulator.host, -1.0, ["safety_status_bits"])
    emulator.request("protective_stop")
    wait_until(lambda: receive.getSafetyStatusBits() & 1 << 2)
    assert "PROTECTIVE_STOP" in dashboard.safetymode()
    emulator.request("clear")
    wait_until(lambda: receive.getSafetyStatusBits() == 1)
    receive.disconnect()
    dashboard.disconnect()


def test_local_control_keeps_the_client_out(emulator) -> None:
    emulator.request("local", on=True)
    with pytest.raises(Exception, match="enable remote control"):
        rtde_control.RTDEControlInterface(emulator.host)


def test_a_refusing_controller_refuses_until_told_otherwise(emulator) -> None:
    emulator.request("refuse", on=True)
    assert refuses(emulator.host)
    emulator.request("refuse", on=False)
    assert not refuses(emulator.host)


def test_a_power_cycle_comes_back(emulator) -> None:
    emulator.request("power_cycle", seconds=0.2)
    assert refuses(emulator.host)
    wait_until(lambda: not refuses(emulator.host))


def test_two_controllers_side_by_side(emulator, loopback) -> None:
    with EmulatedController(loopback, version="5.6.0.1") as other:
        other.request("protective_stop")
        assert emulator.request("state")["safety"] == "NORMAL"
        assert other.request("state")["safety"] == "PROTECTIVE_STOP"


def raw_client(emulator: EmulatedController) -> socket.socket:
    return socket.create_connection((emulator.host, 30004), 2.0)


def test_names_that_are_unknown_or_taken_are_told(emulator) -> None:
    def ask(client: socket.socket, packet: Packet) -> bytes:
        client.sendall(packet.encoded())
        splitter, answers = Splitter(), []
        while not answers:
            answers = splitter.feed(client.recv(4096))
        return answers[0].payload

    first, second = raw_client(emulator), raw_client(emulator)
    claim = Packet(PackageType.INPUT_SETUP, b"input_int_register_0,")
    assert ask(first, claim) == b"\x01INT32"
    assert ask(first, claim) == b"\x02INT32"
    assert ask(second, claim) == b"\x00IN_USE"
    outputs = Packet(PackageType.OUTPUT_SETUP, b"\x40\x7f\x40" + bytes(5) + b"timestamp,nonsense,")
    assert ask(second, outputs) == b"\x01DOUBLE,NOT_FOUND"
    first.close()
    # free again once the first has gone
    wait_until(lambda: ask(second, claim) == b"\x01INT32", 2.0)
    second.close()


def test_garbage_from_a_client_closes_only_its_connection(emulator) -> None:
    begin_s = time.monotonic()
    client = raw_client(emulator)
    client.sendall(b"\x00\x00\x00garbage")
    assert client.recv(100) == b""
    client.close()
    assert any("connection closed" in e for e in events(emulator, begin_s))


def test_frozen_it_says_nothing_and_then_goes_on(emulator) -> None:
    client = socket.create_connection((emulator.host, 29999), 0.3)
    assert client.recv(100).startswith(b"Connected")
    emulator.request("freeze", seconds=0.5)
    client.sendall(b"running\n")
    with pytest.raises(TimeoutError):
        client.recv(100)
    client.settimeout(2.0)
    assert client.recv(100) == b"Program running: false\n"
    client.close()


def test_an_unknown_fault_is_an_error(emulator) -> None:
    with pytest.raises(EmulatorError, match="no_such_fault"):
        emulator.request("no_such_fault")


def test_it_ends_with_whoever_started_it(loopback) -> None:
    program = (
        "from drivers.emulators.launch import EmulatedController\n"
        f"e = EmulatedController('{loopback}').__enter__()\n"
        "print(e._process.pid, flush=True)\n"
        "import os; os._exit(0)\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=True
    )
    assert int(out.stdout) > 0
    wait_until(lambda: refuses(loopback, 39999), 5.0, lambda: "the emulator outlived its starter")


def test_serves_loopback_only() -> None:
    out = subprocess.run(
        [sys.executable, "-m", "drivers.emulators.ur_server", "--host", "0.0.0.0"],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert out.returncode == 2 and "loopback addresses only" in out.stderr


def test_a_second_one_at_an_address_is_refused_in_one_line(
    emulator, capfd: pytest.CaptureFixture[str]
) -> None:
    """As by a second `cell emulate`."""
    with (
        pytest.raises(EmulatorError, match=r"Address already in use.*another `cell emulate`"),
        EmulatedController(emulator.host),
    ):
        raise AssertionError
    assert capfd.readouterr().err == ""
