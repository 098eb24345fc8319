"""A simulated cell with a rigid cable: physics is not what these tests are about."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers.emulators.camera import CameraEmulatorOptions, EmulatedCamera, StreamFaults, TestCard
from drivers.emulators.launch import EmulatedController
from drivers.interfaces import FloatArray, Pose, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.sim.arm import SimArm
from drivers.sim.camera import CameraTwinOptions, SimCamera
from drivers.sim.clock import SimClock
from drivers.sim.gripper import SimGripper
from drivers.sim.render import RenderOptions
from drivers.sim.world import SimWorld
from drivers.ur import UrOptions
from drivers.ur_kinematics import UR5E
from drivers.ur_pose import pose_of

HOME = Pose(0.5, 0.5, 0.0)
#: An emulated gripper that is a thread of these tests may answer so late, s: on a busy computer the
#: 35 ms of a real line passed twice in a row.
GRIPPER_REPLY_S = 0.15
SCALE_M_PER_PX = 0.001  # coarse pictures are quick pictures


@dataclass
class StraightCable:
    """A cable that stays straight behind the gripper; counts how often it is simulated."""

    length_m: float = 0.1
    points: int = 61
    calls: list[tuple[Trajectory, FloatArray]] = field(default_factory=list)

    def __call__(self, grip: Trajectory, query_s: FloatArray) -> FloatArray:
        self.calls.append((grip, query_s))
        x, y, angle = (
            np.interp(query_s, grip.t_s, v) for v in (grip.x_m, grip.y_m, grip.angle_rad)
        )
        back = self.length_m * np.linspace(1.0, 0.0, self.points)
        out = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.stack([x, y], axis=-1)[:, None] - back[:, None] * out[:, None]


@dataclass
class SimCell:
    clock: SimClock
    world: SimWorld
    arm: SimArm
    camera: SimCamera
    gripper: SimGripper
    cable: StraightCable

    def connect(self) -> SimCell:
        for device in (self.arm, self.camera, self.gripper):
            device.connect()
        return self


@pytest.fixture
def cell() -> SimCell:
    clock = SimClock()
    world = SimWorld(clock, HOME)
    cable = StraightCable()
    world.present(cable)
    homography = np.array(
        [
            [SCALE_M_PER_PX, 0.0, 0.36],
            [0.0, -SCALE_M_PER_PX, 0.6],
            [0.0, 0.0, 1.0],
        ]
    )
    picture = RenderOptions(width_px=200, height_px=200, thickness_m=0.002)
    return SimCell(
        clock,
        world,
        SimArm(world, seed=1),
        SimCamera(world, CameraTwinOptions(homography, picture), seed=2),
        SimGripper(world),
        cable,
    ).connect()


@pytest.fixture(scope="module")
def emulated_controller(free_loopback: Callable[[], str]) -> Iterator[EmulatedController]:
    with EmulatedController(free_loopback()) as emulator:
        yield emulator


@pytest.fixture
def ur_emulator(emulated_controller: EmulatedController) -> Iterator[EmulatedController]:
    """An emulated controller in order, with its arm at (0.5, 0.5) of the plane of `ur_options`."""
    emulated_controller.request("clear")
    emulated_controller.request("home")
    for what in ("speed_fraction", "speed_scaling"):
        emulated_controller.request(what, value=1.0)
    yield emulated_controller
    emulated_controller.request("refuse", on=False)
    emulated_controller.request("local", on=False)
    emulated_controller.request("freeze", seconds=0.0)


@pytest.fixture
def ur_options(ur_emulator: EmulatedController) -> UrOptions:
    X_BF = UR5E.forward(np.array([0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0]))
    x, y, z = X_BF[:3, 3] - 0.5 * np.array([0.0, -1.0, 0.0]) - 0.5 * np.array([0.0, 0.0, 1.0])
    mount = PlaneMount((x, y, z), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
    X_FT = np.eye(4)
    X_FT[:3, :3] = X_BF[:3, :3].T @ mount.X_BP[:3, :3]
    return UrOptions(ur_emulator.host, mount, tuple(pose_of(X_FT)))


PathMaker = Callable[..., Trajectory]


@pytest.fixture
def line() -> PathMaker:
    """Smooth straight path from home: a fifth-order polynomial at 500 Hz."""

    def make(
        dx_m: float = 0.0,
        dy_m: float = 0.0,
        duration_s: float = 0.4,
        start: Pose = HOME,
        dangle_rad: float = 0.0,
    ) -> Trajectory:
        t_s = np.linspace(0.0, duration_s, round(duration_s * 500) + 1)
        u = t_s / duration_s
        s = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
        return Trajectory(
            t_s, start.x_m + dx_m * s, start.y_m + dy_m * s, start.angle_rad + dangle_rad * s
        )

    return make


@pytest.fixture(scope="session")
def camera_process() -> Iterator[EmulatedCamera]:
    options = CameraEmulatorOptions(width_px=160, height_px=120, frame_rate_hz=200.0)
    with EmulatedCamera(TestCard(160, 120, 200.0), options) as camera:
        yield camera


@pytest.fixture
def emulated_camera(camera_process: EmulatedCamera) -> Iterator[EmulatedCamera]:
    """A camera of 160 × 120 pixels at 200 Hz, without faults at first."""
    yield camera_process
    camera_process.faults = StreamFaults()
