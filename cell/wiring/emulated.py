"""Emulators of a cell's three devices, at the addresses that its settings name.

The emulated camera shows the hidden cables of the simulated world, swung by the true pose
of the emulated arm, and between the jaws as long as the emulated gripper holds them.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.live import SwingingCable
from cell.cable.solver import Solver
from cell.settings import Settings
from cell.settings import devices as device_settings
from cell.settings.check import STREAM
from cell.wiring.twins import camera_twin, hidden_cable
from drivers.emulators.camera import CameraEmulatorOptions, EmulatedCamera
from drivers.emulators.camera_live import ArmScene, LiveScene
from drivers.emulators.gripper import GripperProcess
from drivers.emulators.launch import EmulatedController, EmulatorError
from drivers.emulators.ur_arm import HOME_RAD
from drivers.interfaces import Pose, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.rtde_wire import DASHBOARD_PORT, FAULT_PORT, RTDE_PORT, SCRIPT_PORT
from drivers.threads import GuardedThread, only_logged
from drivers.ur_kinematics import MODELS, OutOfReachError
from drivers.ur_pose import matrix_of
from drivers.ur_versions import has_dashboard, read_version

#: Interval at which the state of the jaws is polled, s.
_POLL_S = 0.02
_ANSWER_S = 0.5
#: Time step of hidden cables, s: differs by 10 µm from the default, and runs in real time.
_STEP_S = 1e-3
#: Poses with which the cables' code is loaded: how many, s between them, m.
_LOADING, _POSE_S, _TREMBLING_M = 32, 2e-3, 2e-5


@dataclass(frozen=True)
class HiddenCableFactory:
    """Picklable factory of the `number`-th hidden cable, for another process."""

    settings: Settings
    seed: int
    number: int

    def __call__(self) -> EmulatedCable:
        """The cable at rest in the jaws."""
        return EmulatedCable(self.settings, self.seed, self.number)


_LOG = logging.getLogger(__name__)


class EmulatedCable:
    """A hidden cable with the interface that an emulated camera needs."""

    def __init__(self, settings: Settings, seed: int, number: int) -> None:
        model = hidden_cable(settings, seed, number)
        segments = settings.world.segments
        arc_length_m = np.linspace(model.cable.length_m, 0.0, segments + 1)
        self._cable = SwingingCable(model, arc_length_m, Solver(segments, _STEP_S))

    def advance(self, grip: Trajectory) -> FloatArray:
        """(T, K, 2) shapes, tip first."""
        return self._cable.advance(grip.t_s, np.column_stack([grip.x_m, grip.y_m, grip.angle_rad]))


@dataclass(frozen=True)
class CellScene:
    """Picklable factory of the scene in the camera's process; it loads the cables' code."""

    arm: ArmScene
    first: HiddenCableFactory

    def __call__(self) -> LiveScene:
        """Raises RuntimeError: the emulated arm does not run."""
        load_code(self.first())
        return self.arm()


def load_code(cable: EmulatedCable) -> None:
    """Load the code of a cable by simulating it at rest, then in a trembling gripper.

    Compiling it while the camera films would delay pictures by half a second.
    """
    t_s = _POSE_S * np.arange(1.0, _LOADING)
    x_m, y_m = np.random.default_rng(0).normal(scale=_TREMBLING_M, size=(2, len(t_s)))
    for part in np.split(np.arange(len(t_s)), [1]):
        cable.advance(Trajectory(t_s[part], x_m[part], y_m[part], np.zeros(len(part))))


class EmulatedCell:
    """The three emulators, each a process of its own, within a `with`.

    settings  with a section `emulated`
    seed      of the hidden cables; every grip takes the next one
    on_grip   called when the jaws have gripped a cable, in a thread of its own
    """

    def __init__(self, settings: Settings, seed: int) -> None:
        assert isinstance(settings.arm, device_settings.UrArmSettings)
        assert isinstance(settings.gripper, device_settings.SerialGripperSettings)
        self._settings = settings
        self._seed = seed
        self._end = threading.Event()
        self._watcher = GuardedThread("emulated jaws", self._watch, only_logged)
        self.controller = _controller(settings)
        self.gripper = GripperProcess(Path(settings.gripper.port), settings.gripper.address)
        self.camera = EmulatedCamera(*_camera(settings, HiddenCableFactory(settings, seed, 1)))
        self.cables = 0
        self.on_grip: Callable[[], None] = lambda: None

    def __enter__(self) -> Self:
        """Raises EmulatorError: an emulator does not start."""
        with contextlib.ExitStack() as stack:
            for emulator in (self.controller, self.gripper, self.camera):
                stack.enter_context(emulator)
            self._watcher.start()
            stack.callback(self._watcher.join)
            stack.callback(self._end.set)
            self._stack = stack.pop_all()
        _LOG.info("emulators started: %s", self.whereabouts().replace("\n", "; "))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        _LOG.info("emulators ended")

    def whereabouts(self) -> str:
        """Where they listen, and their processes."""
        arm = self.controller
        ports = f"RTDE {RTDE_PORT}, script {SCRIPT_PORT}"
        if has_dashboard(read_version(arm.version)[:2]):
            ports += f", dashboard {DASHBOARD_PORT}"
        return (
            f"arm      {arm.host}: {ports}; faults {FAULT_PORT} (process {arm.pid})\n"
            f"camera   {self.camera.url} (process {self.camera.pid})\n"
            f"gripper  {self.gripper.port} (process {self.gripper.pid})"
        )

    def ended(self) -> list[str]:
        """Names of the emulators whose processes have ended unexpectedly."""
        return [
            f"the emulated {name} (process {emulator.pid})"
            for name, emulator in (
                ("arm", self.controller),
                ("camera", self.camera),
                ("gripper", self.gripper),
            )
            if not emulator.alive
        ]

    def _watch(self) -> None:
        """Notify the camera whenever the jaws have gripped or released a cable."""
        held = False
        with contextlib.suppress(EmulatorError):  # one of them was killed
            while not self._end.wait(_POLL_S):
                if self.gripper.observe().held is not held:
                    held = not held
                    self.cables += held
                    event = f"cable {self.cables} is gripped" if held else "the cable is let go"
                    _LOG.info("emulated jaws: %s", event)
                    cable = HiddenCableFactory(self._settings, self._seed, self.cables)
                    self.camera.notify(cable if held else None)
                    if held:
                        self.on_grip()


def runs_already(settings: Settings) -> bool:
    """Whether emulators are there already."""
    assert isinstance(settings.arm, device_settings.UrArmSettings)
    with contextlib.suppress(OSError):
        socket.create_connection((settings.arm.host, FAULT_PORT), _ANSWER_S).close()
        return True
    return False


def _mount(arm: device_settings.UrArmSettings) -> PlaneMount:
    return PlaneMount(arm.plane_origin_m, arm.plane_x_axis, arm.plane_y_axis)


def _controller(settings: Settings) -> EmulatedController:
    """Raises EmulatorError."""
    arm, emulated = settings.arm, settings.emulated
    assert isinstance(arm, device_settings.UrArmSettings)
    assert emulated is not None
    return EmulatedController(arm.host, emulated.polyscope, arm.model, start_rad=_start(settings))


def _start(settings: Settings) -> FloatArray:
    """(6,) joints with the gripping point where cables are grasped.  Raises EmulatorError."""
    arm, home = settings.arm, settings.motion.home
    assert isinstance(arm, device_settings.UrArmSettings)
    X_BT = _mount(arm).to_base(Pose(home.x_m, home.y_m, home.angle_rad))
    try:
        return MODELS[arm.model].inverse(X_BT, np.array(HOME_RAD), matrix_of(np.array(arm.tcp)))
    except OutOfReachError as error:
        raise EmulatorError(
            f"motion.home: {error}; correct arm.plane_origin_m, its axes or arm.tcp"
        ) from error


def _camera(
    settings: Settings, first: HiddenCableFactory
) -> tuple[CellScene, CameraEmulatorOptions, tuple[str, int]]:
    """Arguments of an `EmulatedCamera`."""
    arm, camera, emulated = settings.arm, settings.camera, settings.emulated
    assert isinstance(arm, device_settings.UrArmSettings)
    assert isinstance(camera, device_settings.OpenCvCameraSettings)
    assert emulated is not None
    options = camera_twin(settings, emulated, first.seed)
    scene = ArmScene(arm.host, _mount(arm), arm.model, arm.tcp, camera=options, seed=first.seed)
    address = STREAM.fullmatch(str(camera.device))
    assert address is not None
    return (
        CellScene(scene, first),
        CameraEmulatorOptions(
            camera.width_px, camera.height_px, camera.frame_rate_hz, readout_s=emulated.readout_s
        ),
        (address[1], int(address[2])),
    )
