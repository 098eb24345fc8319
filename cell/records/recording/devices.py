"""Devices that report their commands and answers to a recorder."""

from __future__ import annotations

from dataclasses import replace

from cell.records.recording import form
from cell.records.recording.recorder import Recorder
from cell.records.recording.uploads import Uploads
from drivers.around import ArmAround, CameraAround, GripperAround
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

#: Time before the last frame when the recorder is told to pause, s: it finishes its writes by then.
PAUSE_BEFORE_S = 0.03


def recorded_devices(
    devices: Devices, recorder: Recorder, uploads: Uploads | None = None
) -> Devices:
    """Wrappers of devices that record their commands and answers.

    uploads  is notified whether a cable is in the jaws; None = nothing is uploaded
    """
    return replace(
        devices,
        arm=RecordedArm(devices.arm, recorder),
        camera=RecordedCamera(devices.camera, recorder),
        gripper=RecordedGripper(devices.gripper, recorder, uploads),
    )


class RecordedArm(ArmAround):
    """An arm whose paths, answers and changes of mode are recorded."""

    def __init__(self, arm: Arm, recorder: Recorder) -> None:
        super().__init__(arm)
        self._recorder = recorder
        self._mode: ArmMode | None = None

    def state(self) -> ArmState:
        """Raises DeviceLostError."""
        state = self._arm.state()
        if state.mode is not self._mode:
            self._mode = state.mode
            self._recorder.event(form.ARM, {"t_s": state.t_s, "mode": state.mode.value})
        return state

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """Raises LimitError, StoppedError, DeviceLostError."""
        self._recorder.resume()
        commanded_s = self._recorder.now_s()
        self._arm.follow(path, start_s)
        begin_s = commanded_s if start_s is None else start_s
        self._recorder.event(form.PATH, {"start_s": start_s, **vars(path)})
        self._recorder.poses(form.COMMANDED, replace(path, t_s=path.t_s - path.t_s[0] + begin_s))

    def revise(self, path: Trajectory, from_s: float) -> None:
        """Raises LimitError, StoppedError, DeviceLostError."""
        self._arm.revise(path, from_s)
        self._recorder.event(form.REVISION, {"from_s": from_s, **vars(path)})

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """Measured poses."""
        poses = self._arm.log(start_s, end_s)
        self._recorder.event(form.ANSWER, {"start_s": start_s, "end_s": end_s, **vars(poses)})
        return poses

    def stop(self, reason: str) -> None:
        """Stop now; latched."""
        self._arm.stop(reason)
        self._recorder.event(form.ARM, {"t_s": self._recorder.now_s(), "mode": f"stop: {reason}"})


class RecordedCamera(CameraAround):
    """A camera whose frames are recorded as they are read."""

    def __init__(self, camera: Camera, recorder: Recorder) -> None:
        super().__init__(camera)
        self._recorder = recorder
        self._wanted = 0

    def start(self, frame_count: int) -> None:
        """Begin to record frames."""
        self._wanted = frame_count
        self._camera.start(frame_count)

    def read(self) -> Frame | None:
        """Raises CameraError, DeviceLostError."""
        frame = self._camera.read()
        if frame is not None:
            self._recorder.frame(frame)
            if frame.index >= self._wanted - 1 - PAUSE_BEFORE_S * self._camera.frame_rate_hz:
                self._recorder.pause()
        return frame

    def stop(self) -> None:
        """Stop the camera: no more frames are needed, the decision is computed."""
        self._camera.stop()
        self._recorder.pause()


class RecordedGripper(GripperAround):
    """A gripper whose commands and answers are recorded."""

    def __init__(self, gripper: Gripper, recorder: Recorder, uploads: Uploads | None) -> None:
        super().__init__(gripper)
        self._recorder = recorder
        self._uploads = uploads
        self._closing = False

    def state(self) -> GripperState:
        """Raises DeviceLostError."""
        return self._watch_jaws(self._gripper.state())

    def grip(self, force_n: float) -> GripperState:
        """Raises GripError, LimitError."""
        if self._uploads is not None:
            self._uploads.jaws(holding=True)
        self._closing = True
        try:
            state = self._gripper.grip(force_n)
        finally:
            self._closing = False
        return self._recorded(f"grip with {force_n:g} N", state)

    def release(self) -> GripperState:
        """Open the jaws."""
        return self._recorded("release", self._gripper.release())

    def _recorded(self, command: str, state: GripperState) -> GripperState:
        self._recorder.event(
            form.GRIPPER,
            {"told": command, "opening_m": state.opening_m, "holding": state.holding},
        )
        return self._watch_jaws(state)

    def _watch_jaws(self, state: GripperState) -> GripperState:
        if self._uploads is not None and (state.holding or not self._closing):
            self._uploads.jaws(holding=state.holding)
        return state
