"""Benches for the conformance suites: each implementation with the means to break it.

A new implementation joins by adding a station to the table of its kind; the suites do not change.
With `--hardware --config FILE` the devices of these settings take the place of all others.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from drivers.clock import RealClock
from drivers.emulators.camera import StreamFaults
from drivers.emulators.robotiq import EmulatedGripper, Jaws, RobotiqFaults
from drivers.emulators.urcap import EmulatedUrcap
from drivers.files import FilesCamera, write_frames
from drivers.guard import (
    ArmLimits,
    GripperLimits,
    GuardedArm,
    GuardedCamera,
    GuardedGripper,
)
from drivers.interfaces import Arm, Camera, Clock, Frame, Gripper, Trajectory
from drivers.opencv_camera import OpenCvCamera, OpenCvOptions
from drivers.serial_gripper import SerialGripper, SerialGripperOptions
from drivers.sim.arm import ArmFaults
from drivers.sim.camera import CameraFaults
from drivers.sim.clock import SimClock
from drivers.sim.gripper import GripperFaults
from drivers.ur import UrArm
from drivers.urcap_gripper import UrcapGripper, UrcapGripperOptions

from ..conftest import GRIPPER_REPLY_S

if TYPE_CHECKING:  # the rest of the cell takes its time, and only devices that are there need it
    from cell.run.station import Station

Act = Callable[[], object]


@dataclass
class ArmBench:
    """An arm that is not connected yet.  `lose` and `controller_stop` break it, or are None."""

    arm: Arm
    clock: Clock
    make_path: Callable[..., Trajectory]
    lose: Act | None = None
    controller_stop: Act | None = None
    person_clears: Act | None = None
    refuse: Act | None = None


@dataclass
class CameraBench:
    camera: Camera
    clock: Clock
    lose: Act | None = None
    refuse: Act | None = None


@dataclass
class GripperBench:
    """A gripper with something between its jaws; `take_away` takes that out, or is None."""

    gripper: Gripper
    clock: Clock
    take_away: Act | None = None
    slip: Act | None = None
    lose: Act | None = None
    refuse: Act | None = None
    force_n: float = 20.0


def faulty(emulator: Any, faults: Callable[[], object]) -> Act:
    """Gives an emulator faults as they are then."""
    return lambda: setattr(emulator, "faults", faults())


def pulled_out(jaws: Jaws) -> Act:
    """Takes out what is between the jaws."""
    return lambda: setattr(jaws, "object_count", None)


@contextlib.contextmanager
def sim_arm(request: pytest.FixtureRequest) -> Iterator[ArmBench]:
    cell = request.getfixturevalue("cell")
    arm, now_s = cell.arm, cell.clock.now_s
    arm.close()
    yield ArmBench(
        arm,
        cell.clock,
        request.getfixturevalue("line"),
        lose=faulty(arm, lambda: ArmFaults(lost_at_s=now_s())),
        controller_stop=faulty(arm, lambda: ArmFaults(protective_stop_at_s=now_s())),
        person_clears=arm.acknowledge,
        refuse=faulty(arm, lambda: ArmFaults(refuses_to_connect=True)),
    )


@contextlib.contextmanager
def guarded_sim_arm(request: pytest.FixtureRequest) -> Iterator[ArmBench]:
    with sim_arm(request) as station:
        wide = ArmLimits(-2.0, 2.0, -2.0, 2.0, -1.0, 1.0, 2.0, 50.0, 2000.0)
        station.arm = GuardedArm(station.arm, wide)
        yield station


@contextlib.contextmanager
def ur_arm(request: pytest.FixtureRequest) -> Iterator[ArmBench]:
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")
    emulator = request.getfixturevalue("ur_emulator")
    yield ArmBench(
        UrArm(request.getfixturevalue("ur_options")),
        RealClock(),
        request.getfixturevalue("line"),
        lose=lambda: emulator.request("drop"),
        controller_stop=lambda: emulator.request("protective_stop"),
        person_clears=lambda: emulator.request("clear"),
        refuse=lambda: emulator.request("refuse", on=True),
    )


@contextlib.contextmanager
def sim_camera(request: pytest.FixtureRequest) -> Iterator[CameraBench]:
    cell = request.getfixturevalue("cell")
    camera, clock = cell.camera, cell.clock
    camera.close()
    lose = faulty(camera, lambda: CameraFaults(lost_at_s=clock.now_s()))
    refuse = faulty(camera, lambda: CameraFaults(refuses_to_connect=True))
    yield CameraBench(camera, clock, lose, refuse)


@contextlib.contextmanager
def guarded_sim_camera(request: pytest.FixtureRequest) -> Iterator[CameraBench]:
    with sim_camera(request) as station:
        station.camera = GuardedCamera(station.camera, station.clock)
        yield station


@contextlib.contextmanager
def files_camera(request: pytest.FixtureRequest) -> Iterator[CameraBench]:
    folder = request.getfixturevalue("tmp_path")
    rng = np.random.default_rng(0)
    write_frames(
        folder,
        (Frame(i, 0.005 * i, rng.integers(0, 256, (8, 8), dtype=np.uint8)) for i in range(40)),
    )
    clock = SimClock()
    camera = FilesCamera(folder, clock=clock)
    yield CameraBench(camera, clock, refuse=lambda: (folder / "frames.csv").unlink())


@contextlib.contextmanager
def opencv_camera(request: pytest.FixtureRequest) -> Iterator[CameraBench]:
    stream = request.getfixturevalue("emulated_camera")
    clock = RealClock()
    options = OpenCvOptions(stream.url, 160, 120, 200.0, exposure_s=None)
    lose = faulty(stream, lambda: StreamFaults(silent=True))
    refuse = faulty(stream, lambda: StreamFaults(refuses=True))
    yield CameraBench(OpenCvCamera(options, clock), clock, lose, refuse)


@contextlib.contextmanager
def sim_gripper(request: pytest.FixtureRequest) -> Iterator[GripperBench]:
    cell = request.getfixturevalue("cell")
    gripper, now_s = cell.gripper, cell.clock.now_s
    gripper.close()

    def take_away() -> None:
        cell.world.take()
        cell.world.drop()

    yield GripperBench(
        gripper,
        cell.clock,
        take_away,
        slip=faulty(gripper, lambda: GripperFaults(slips_at_s=now_s())),
        lose=faulty(gripper, lambda: GripperFaults(lost_at_s=now_s())),
        refuse=faulty(gripper, lambda: GripperFaults(refuses_to_connect=True)),
    )


@contextlib.contextmanager
def guarded_sim_gripper(request: pytest.FixtureRequest) -> Iterator[GripperBench]:
    with sim_gripper(request) as station:
        station.gripper = GuardedGripper(station.gripper, GripperLimits(1.0, 100.0))
        yield station


@contextlib.contextmanager
def serial_gripper(request: pytest.FixtureRequest) -> Iterator[GripperBench]:
    with EmulatedGripper() as emulator:
        options = SerialGripperOptions(emulator.port, reply_s=GRIPPER_REPLY_S)
        clock, silent = RealClock(), faulty(emulator.jaws, lambda: RobotiqFaults(silent=True))
        gone = pulled_out(emulator.jaws)
        yield GripperBench(SerialGripper(options, clock), clock, gone, gone, silent, silent)


@contextlib.contextmanager
def urcap_gripper(request: pytest.FixtureRequest) -> Iterator[GripperBench]:
    with EmulatedUrcap(Jaws(object_count=200.0)) as urcap:
        options = UrcapGripperOptions(urcap.host, urcap.port, reply_s=2.0 * GRIPPER_REPLY_S)
        clock, gone, unplug = RealClock(), pulled_out(urcap.jaws), urcap.unplug
        yield GripperBench(UrcapGripper(options, clock), clock, gone, gone, unplug, unplug)


@pytest.fixture
def real_bench(request: pytest.FixtureRequest, tmp_path: Path) -> Station:
    """The devices of the settings, not connected yet, within the settings' limits."""
    from cell.settings import load_settings
    from cell.wiring.build import cell_with, real_devices

    settings = load_settings(request.config.getoption("--config"))
    return cell_with(settings, real_devices(settings), tmp_path, lambda number, step: None)._station


@contextlib.contextmanager
def real_arm(request: pytest.FixtureRequest) -> Iterator[ArmBench]:
    """At home when a test begins, where it was brought at a quarter of a cycle's speed."""
    from cell.run.movements import slowed
    from cell.run.steps import move_to

    station = request.getfixturevalue("real_bench")
    arm = station.devices.arm
    arm.connect()
    try:
        arm.reset()
        slow = slowed(station.task, 0.25)
        move_to(station, slow.home, slow.lowering)
    finally:
        arm.close()
    home = station.task.home
    yield ArmBench(arm, station.devices.clock, partial(request.getfixturevalue("line"), start=home))


@contextlib.contextmanager
def real_camera(request: pytest.FixtureRequest) -> Iterator[CameraBench]:
    devices = request.getfixturevalue("real_bench").devices
    yield CameraBench(devices.camera, devices.clock)


@contextlib.contextmanager
def real_gripper(request: pytest.FixtureRequest) -> Iterator[GripperBench]:
    station = request.getfixturevalue("real_bench")
    yield GripperBench(station.devices.gripper, station.devices.clock, force_n=station.task.force_n)


ARMS = {"sim": sim_arm, "guarded": guarded_sim_arm, "ur": ur_arm}
CAMERAS = {
    "sim": sim_camera,
    "guarded": guarded_sim_camera,
    "files": files_camera,
    "opencv": opencv_camera,
}
GRIPPERS = {
    "sim": sim_gripper,
    "guarded": guarded_sim_gripper,
    "serial": serial_gripper,
    "urcap": urcap_gripper,
}
CLOCKS = {"sim": SimClock, "real": RealClock}
KINDS = {"arm_bench": ARMS, "camera_bench": CAMERAS, "gripper_bench": GRIPPERS, "clock": CLOCKS}
REAL = {"arm_bench": real_arm, "camera_bench": real_camera, "gripper_bench": real_gripper}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    on_hardware = metafunc.config.getoption("--hardware")
    for fixture, kinds in KINDS.items():
        if fixture in metafunc.fixturenames:
            names = ["hardware"] if on_hardware and fixture in REAL else list(kinds)
            metafunc.parametrize(fixture, names, indirect=True)


def bench_of(request: pytest.FixtureRequest, kinds: dict[str, Any], fixture: str) -> Any:
    return (REAL[fixture] if request.param == "hardware" else kinds[request.param])(request)


@pytest.fixture
def arm_bench(request) -> Iterator[ArmBench]:
    with bench_of(request, ARMS, "arm_bench") as station:
        yield station
        station.arm.close()


@pytest.fixture
def camera_bench(request) -> Iterator[CameraBench]:
    with bench_of(request, CAMERAS, "camera_bench") as station:
        yield station
        station.camera.close()


@pytest.fixture
def gripper_bench(request) -> Iterator[GripperBench]:
    with bench_of(request, GRIPPERS, "gripper_bench") as station:
        yield station
        station.gripper.close()


@pytest.fixture
def clock(request) -> Clock:
    return CLOCKS[request.param]()
