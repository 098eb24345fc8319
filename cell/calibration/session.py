"""Devices while a cell is calibrated: the gripper at rest, pictures of it, a filmed motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

from cell.plan.paths import MotionLimits, retreat_path
from cell.settings import Settings
from cell.settings.translate import pose_of
from drivers.interfaces import (
    Arm,
    ArmMode,
    CameraError,
    Devices,
    DeviceTimeoutError,
    Frame,
    GripError,
    Image,
    Pose,
    StoppedError,
    Trajectory,
)

#: Factor by which the gripper moves to a pose slower than in a cycle.
_SLOWER = 2.0
_POLL_S, _REST_TIMEOUT_S, _CALM_S = 0.01, 3.0, 0.15
_AT_GOAL_M, _AT_GOAL_RAD = 5e-5, 1e-3
#: Largest range of an arm's reported poses at rest, m: three times its repeatability.
_AT_REST_M = 1e-4
#: Pictures of a gripper at rest that are averaged.
_PICTURES = 4
#: Time between the command and the start of a path, and margin of a film at both its ends, s.
_AHEAD_S, _MARGIN_S = 0.25, 0.15
_BROKEN_OFF = "calibration broken off"


@dataclass(frozen=True, eq=False)
class RestingView:
    """The gripper at rest: mean of its measured poses, and mean of several pictures."""

    pose: Pose
    image: Image


@dataclass(frozen=True, eq=False)
class FilmedMove:
    """A motion as commanded and as measured, on the cell's clock, and all its frames."""

    commanded: Trajectory
    gripper_log: Trajectory
    frames: tuple[Frame, ...]


@dataclass(frozen=True, eq=False)
class CalibrationSession:
    """Connected devices of a cell."""

    settings: Settings
    devices: Devices

    def go_to(self, goal: Pose) -> None:
        """Bring the gripper to rest in a pose.  Raises DeviceError."""
        arm, clock = self.devices.arm, self.devices.clock
        here = arm.state().pose
        away_m = max(abs(here.x_m - goal.x_m), abs(here.y_m - goal.y_m))
        if away_m > _AT_GOAL_M or abs(here.angle_rad - goal.angle_rad) > _AT_GOAL_RAD:
            path = retreat_path(here, goal, self.limits.slowed(_SLOWER), arm.rate_hz)
            arm.follow(path)
            self._await_rest(float(path.t_s[-1]))
        clock.sleep_s(_CALM_S)

    def rest_at(self, goal: Pose) -> RestingView:
        """The gripper at rest in a pose, and the mean of `_PICTURES` of it.

        raises  DeviceError; CameraError: the gripper moved meanwhile
        """
        self.go_to(goal)
        arm, clock = self.devices.arm, self.devices.clock
        begin_s = clock.now_s()
        image = self.picture(_PICTURES)
        clock.sleep_s(max(0.0, begin_s + 0.1 - clock.now_s()))
        log = arm.log(begin_s, clock.now_s())
        places = np.stack([log.x_m, log.y_m, log.angle_rad], axis=1)
        if len(places) < 3:
            raise CameraError(arm.name, "reports no poses at rest", "check the arm's rate")
        moved_m = float(np.ptp(places[:, :2], axis=0).max())
        if moved_m > _AT_REST_M:
            raise CameraError(
                self.devices.camera.name,
                f"the gripper moved by {moved_m * 1e3:.2f} mm while pictures were taken",
                "let the arm come to rest; check its mounting and gain",
            )
        x, y, angle = places.mean(axis=0)
        return RestingView(Pose(float(x), float(y), float(angle)), image)

    def picture(self, count: int = 1) -> Image:
        """Mean of `count` pictures."""
        camera = self.devices.camera
        camera.start(count)
        images = [frame.image for frame in self._frames()]
        if len(images) < count:
            raise CameraError(camera.name, f"only {len(images)} of {count} pictures came", "")
        if count == 1:
            return images[0]
        mean: Image = np.rint(np.mean(images, axis=0)).astype(np.uint8)
        return mean

    @contextmanager
    def holding_cable(self) -> Iterator[None]:
        """A cable between the jaws, gripped as in a cycle; released in any case.

        raises  GripError: there is no cable
        """
        try:
            self.devices.gripper.grip(self.settings.gripper.force_n)
            yield
        except BaseException:
            self.devices.arm.stop(_BROKEN_OFF)  # before the jaws open, which takes time
            raise
        finally:
            self.devices.gripper.release()

    def wait_s(self, lasts_s: float) -> None:
        """Wait on the cell's clock."""
        self.devices.clock.sleep_s(lasts_s)

    def film(self, path: Trajectory) -> FilmedMove:
        """Film a motion from before its beginning to after its end."""
        arm, camera, clock = self.devices.arm, self.devices.camera, self.devices.clock
        begin_s = clock.now_s()
        start_s = begin_s + _AHEAD_S + _MARGIN_S
        lasts_s = start_s - begin_s + float(path.t_s[-1]) + _MARGIN_S + 2.0 * arm.lag_s
        arm.follow(path, start_s)
        camera.start(int(np.ceil(lasts_s * camera.frame_rate_hz)))
        frames = tuple(self._frames())
        self._await_rest(0.0)
        commanded = Trajectory(path.t_s + start_s, path.x_m, path.y_m, path.angle_rad)
        return FilmedMove(commanded, arm.log(begin_s, clock.now_s()), frames)

    @property
    def limits(self) -> MotionLimits:
        """Limits of the gripper's motion while a cell is calibrated."""
        return MotionLimits(**self.settings.motion.insertion.model_dump())

    @property
    def home(self) -> Pose:
        """Pose in which cables are grasped."""
        return pose_of(self.settings.motion.home)

    def _frames(self) -> Iterator[Frame]:
        while (frame := self.devices.camera.read()) is not None:
            yield frame

    def _await_rest(self, lasts_s: float) -> None:
        """Wait for the end of a motion so long.  Raises StoppedError, DeviceTimeoutError."""
        arm, clock = self.devices.arm, self.devices.clock
        until_s = clock.now_s() + lasts_s + _REST_TIMEOUT_S
        clock.sleep_s(lasts_s)
        while (state := arm.state()).moving:
            if clock.now_s() > until_s:
                raise DeviceTimeoutError(arm.name, "does not come to rest", "check its path")
            clock.sleep_s(_POLL_S)
        if state.mode is not ArmMode.READY:
            raise StoppedError(arm.name, f"is in {state.mode.value}", state.mode.remedy, state.mode)


@contextmanager
def opened(
    settings: Settings, devices: Devices, *, moves: bool, say: Callable[[str], None]
) -> Iterator[CalibrationSession]:
    """Session with connected devices; jaws must be empty if the arm moves; closes at the end.

    raises  DeviceError
    """
    used = [devices.camera, *((devices.arm, devices.gripper) if moves else ())]
    with ExitStack() as stack:
        for device in used:
            stack.callback(device.close)
        if moves:
            stack.push(partial(_stopped, devices.arm))
        for device in used:
            say(f"connect {device.name}")
            device.connect()
        if moves:
            devices.arm.reset()
            if devices.gripper.state().holding:
                raise GripError(
                    devices.gripper.name, "holds something", "calibrating needs empty jaws"
                )
        yield CalibrationSession(settings, devices)


def _stopped(arm: Arm, kind: type[BaseException] | None, *_: object) -> None:
    """Stop an arm after an error."""
    if kind is not None:
        arm.stop(_BROKEN_OFF)
