"""Wrappers that pass every call on to an arm, camera or gripper: bases for limits and recorders."""

from __future__ import annotations

from drivers.interfaces import Arm, ArmState, Camera, Frame, Gripper, GripperState, Trajectory


class ArmAround:
    """Passes every call on to an arm.  Errors are those of the arm."""

    def __init__(self, arm: Arm) -> None:
        self.name = arm.name
        self._arm = arm

    @property
    def lag_s(self) -> float:
        """Delay between a commanded and the executed pose, s."""
        return self._arm.lag_s

    @property
    def rate_hz(self) -> float:
        """Rate at which poses are streamed, Hz."""
        return self._arm.rate_hz

    def connect(self) -> None:
        """See `Arm`."""
        self._arm.connect()

    def close(self) -> None:
        """See `Arm`."""
        self._arm.close()

    def state(self) -> ArmState:
        """See `Arm`."""
        return self._arm.state()

    def check(self, path: Trajectory) -> None:
        """See `Arm`."""
        self._arm.check(path)

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """See `Arm`."""
        self._arm.follow(path, start_s)

    def revise(self, path: Trajectory, from_s: float) -> None:
        """See `Arm`."""
        self._arm.revise(path, from_s)

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """See `Arm`."""
        return self._arm.log(start_s, end_s)

    def stop(self, reason: str) -> None:
        """See `Arm`."""
        self._arm.stop(reason)

    def reset(self) -> None:
        """See `Arm`."""
        self._arm.reset()


class CameraAround:
    """Passes every call on to a camera.  Errors are those of the camera."""

    def __init__(self, camera: Camera) -> None:
        self.name = camera.name
        self._camera = camera

    @property
    def frame_rate_hz(self) -> float:
        """Frame rate that was read back from the camera, Hz."""
        return self._camera.frame_rate_hz

    def connect(self) -> None:
        """See `Camera`."""
        self._camera.connect()

    def close(self) -> None:
        """See `Camera`."""
        self._camera.close()

    def check(self) -> None:
        """See `Camera`."""
        self._camera.check()

    def start(self, frame_count: int) -> None:
        """See `Camera`."""
        self._camera.start(frame_count)

    def read(self) -> Frame | None:
        """See `Camera`."""
        return self._camera.read()

    def stop(self) -> None:
        """See `Camera`."""
        self._camera.stop()


class GripperAround:
    """Passes every call on to a gripper.  Errors are those of the gripper."""

    def __init__(self, gripper: Gripper) -> None:
        self.name = gripper.name
        self._gripper = gripper

    def connect(self) -> None:
        """See `Gripper`."""
        self._gripper.connect()

    def close(self) -> None:
        """See `Gripper`."""
        self._gripper.close()

    def grip(self, force_n: float) -> GripperState:
        """See `Gripper`."""
        return self._gripper.grip(force_n)

    def release(self) -> GripperState:
        """See `Gripper`."""
        return self._gripper.release()

    def state(self) -> GripperState:
        """See `Gripper`."""
        return self._gripper.state()
