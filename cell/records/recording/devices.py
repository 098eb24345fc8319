"""Devices that hand over to a recorder what they are told and what they say."""

from __future__ import annotations

from dataclasses import replace

from cell.records.recording import form
from cell.records.recording.recorder import Recorder
from drivers.interfaces import (
    Arm,
    ArmMode,
    ArmState,
    Camera,
    Devices,
    Frame,
    Gripper,
    GripperState,
    Trajectory,
)


def recorded_devices(devices: Devices, recorder: Recorder) -> Devices:
    """The same devices, recorded."""
    return replace(
        devices,
        arm=RecordedArm(devices.arm, recorder),
        camera=RecordedCamera(devices.camera, recorder),
        gripper=RecordedGripper(devices.gripper, recorder),
    )


class RecordedArm:
    """An arm whose paths, answers and changes of mode are recorded."""

    def __init__(self, arm: Arm, recorder: Recorder) -> None:
        self.name = arm.name
        self._arm = arm
        self._recorder = recorder
        self._mode: ArmMode | None = None

    @property
    def lag_s(self) -> float:
        """Delay between a commanded and the executed pose, s."""
        return self._arm.lag_s

    @property
    def rate_hz(self) -> float:
        """Rate at which poses are streamed, Hz."""
        return self._arm.rate_hz

    def connect(self) -> None:
        """Raises ConnectError."""
        self._arm.connect()

    def close(self) -> None:
        """Stop and disconnect."""
        self._arm.close()

    def state(self) -> ArmState:
        """Raises DeviceLostError."""
        state = self._arm.state()
        if state.mode is not self._mode:
            self._mode = state.mode
            self._recorder.event(form.ARM, {"t_s": state.t_s, "mode": state.mode.value})
        return state

    def check(self, path: Trajectory) -> None:
        """Raises LimitError; DeviceLostError."""
        self._arm.check(path)

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """Raises LimitError, StoppedError, DeviceLostError."""
        self._recorder.resume()
        told_s = self._recorder.now_s()
        self._arm.follow(path, start_s)
        begin_s = told_s if start_s is None else start_s
        self._recorder.event(form.PATH, {"start_s": start_s, **vars(path)})
        self._recorder.poses(form.COMMANDED, replace(path, t_s=path.t_s - path.t_s[0] + begin_s))

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """Measured poses."""
        poses = self._arm.log(start_s, end_s)
        self._recorder.event(form.ANSWER, {"start_s": start_s, "end_s": end_s, **vars(poses)})
        return poses

    def stop(self, reason: str) -> None:
        """Stop now; latched."""
        self._arm.stop(reason)
        self._recorder.event(form.ARM, {"t_s": self._recorder.now_s(), "mode": f"stop: {reason}"})

    def reset(self) -> None:
        """Raises StoppedError while the controller itself is stopped."""
        self._arm.reset()


class RecordedCamera:
    """A camera whose frames are recorded as they are read."""

    def __init__(self, camera: Camera, recorder: Recorder) -> None:
        self.name = camera.name
        self._camera = camera
        self._recorder = recorder
        self._wanted = 0

    @property
    def frame_rate_hz(self) -> float:
        """Frame rate that was read back from the camera, Hz."""
        return self._camera.frame_rate_hz

    def connect(self) -> None:
        """Raises ConnectError."""
        self._camera.connect()

    def close(self) -> None:
        """Release the camera."""
        self._camera.close()

    def check(self) -> None:
        """Raises DeviceLostError; CameraError."""
        self._camera.check()

    def start(self, frame_count: int) -> None:
        """Begin to record frames."""
        self._wanted = frame_count
        self._camera.start(frame_count)

    def read(self) -> Frame | None:
        """Raises CameraError, DeviceLostError."""
        frame = self._camera.read()
        if frame is not None:
            self._recorder.frame(frame)
            if frame.index == self._wanted - 1:
                self._recorder.pause()
        return frame

    def stop(self) -> None:
        """End a recording early."""
        self._camera.stop()


class RecordedGripper:
    """A gripper whose commands and answers are recorded."""

    def __init__(self, gripper: Gripper, recorder: Recorder) -> None:
        self.name = gripper.name
        self._gripper = gripper
        self._recorder = recorder

    def connect(self) -> None:
        """Raises ConnectError."""
        self._gripper.connect()

    def close(self) -> None:
        """Disconnect, leaving the jaws as they are."""
        self._gripper.close()

    def grip(self, force_n: float) -> GripperState:
        """Raises GripError, LimitError."""
        return self._recorded(f"grip with {force_n:g} N", self._gripper.grip(force_n))

    def release(self) -> GripperState:
        """Open the jaws."""
        return self._recorded("release", self._gripper.release())

    def state(self) -> GripperState:
        """Raises DeviceLostError."""
        return self._gripper.state()

    def _recorded(self, told: str, state: GripperState) -> GripperState:
        self._recorder.event(
            form.GRIPPER,
            {"told": told, "opening_m": state.opening_m, "holding": state.holding},
        )
        return state
