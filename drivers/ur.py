"""Universal Robots arm over RTDE, by way of a supervised child process.

ur-rtde crashes or hangs when a connection drops, and waits with the interpreter's lock held; so it
runs in `drivers.ur_child`, and the parent checks every deadline.  After any failure of the child
the controller's own watchdog stops the arm.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
import time
from dataclasses import dataclass

import numpy as np

from drivers.interfaces import (
    ArmMode,
    ArmState,
    ConnectError,
    DeviceError,
    DeviceLostError,
    FloatArray,
    LimitError,
    Pose,
    StoppedError,
    Trajectory,
    nothing_to_revise,
    revised_too_late,
    too_late,
)
from drivers.plane_mount import PlaneMount
from drivers.ur_child import MODES, ChildOptions
from drivers.ur_kinematics import MODELS, check_reach
from drivers.ur_pose import matrices_of, matrix_of
from drivers.ur_process import ChildProcess, start_child
from drivers.ur_robot import RobotOptions
from drivers.ur_shared import COLUMNS, SharedColumn, Slot
from drivers.ur_versions import Version

_LOST_REMEDY = ArmMode.LOST.remedy
_RESET_S = 10.0
_CLOSE_S = 2.0
_POLL_S = 5e-4
_MODEL_TOLERANCE_M = 0.015
_MOVING_M_PER_S = 0.001


@dataclass(frozen=True)
class UrOptions:
    """Address of a UR arm, its cell plane, and how it is driven.

    tcp             pose of the gripping point's frame on the flange: m and rotation vector, rad;
                    its x and y axes are the plane's when the clamp angle is 0
    lag_s           measured with this lookahead
    watchdog_hz     lowest rate of commands before the controller stops the arm
    stop_m_per_s2   deceleration of a stop
    connect_s       time that connecting may take
    stale_s         silence of the controller that counts as lost
    silent_s        silence of the child that counts as lost
    off_plane_m, tilt_rad   how far from the plane the tool may be when a motion starts
    allow_version   PolyScope version, major and minor, that the user allows though it is not
                    proved; None = proved ones only
    """

    host: str
    mount: PlaneMount
    tcp: tuple[float, ...] = (0.0,) * 6
    model: str = "UR5e"
    rate_hz: float = 500.0
    lookahead_s: float = 0.03
    gain: float = 300.0
    lag_s: float = 0.034
    watchdog_hz: float = 20.0
    stop_m_per_s2: float = 10.0
    connect_s: float = 10.0
    stale_s: float = 0.04
    silent_s: float = 0.06
    off_plane_m: float = 0.002
    tilt_rad: float = 0.01
    allow_version: Version | None = None

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"arm.model = {self.model}: must be one of {', '.join(MODELS)}")
        if len(self.tcp) != 6:
            raise ValueError(f"arm.tcp has {len(self.tcp)} numbers, 6 are needed")


class UrArm:
    """A UR arm.  `stop`, `state` and `log` may be called from any thread."""

    def __init__(self, options: UrOptions, name: str = "arm") -> None:
        self.name = name
        self._options = options
        self._child: ChildProcess | None = None
        self._lock = threading.RLock()
        self._stop_reason: str | None = None
        self._paths = 0
        self._log = np.empty((0, COLUMNS))
        self._lost = "not connected"

    @property
    def lag_s(self) -> float:
        """Measured delay between a commanded and the executed pose, s."""
        return self._options.lag_s

    @property
    def rate_hz(self) -> float:
        """Rate at which poses are streamed, Hz."""
        return self._options.rate_hz

    def connect(self) -> None:
        """Start the child, upload the program.  Raises ConnectError."""
        with self._lock:
            self.close()
            child = self._start_child()
            try:
                self._await_done(child, self._options.connect_s)
                self._await_first_sample(child)
                self._check_model(child)
            except ConnectError:
                child.end()
                raise
            self._child, self._paths = child, 0
            if self._stop_reason is not None:
                child.shared.add(Slot.STOPS)

    def close(self) -> None:
        """Stop and disconnect."""
        with self._lock:
            child, self._child = self._child, None
            self._lost = "not connected"
            if child is not None:
                self._log = child.shared.samples()
                with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                    child.connection.send(("close",))
                    child.process.wait(_CLOSE_S)
                child.end()

    def state(self) -> ArmState:
        """Raises DeviceLostError."""
        with self._lock:
            child = self._alive()
            (sample,) = child.shared.samples(1)
            speed = float(sample[SharedColumn.SPEED_M_PER_S])
            return ArmState(
                float(sample[SharedColumn.T_S]),
                self._pose(sample),
                speed,
                self._busy(child) or speed > _MOVING_M_PER_S,
                self._mode(child),
            )

    def check(self, path: Trajectory) -> None:
        """Raises LimitError: out of reach, or a joint too fast; DeviceLostError."""
        with self._lock:
            (sample,) = self._alive().shared.samples(1)
            self._check_reach(_from_zero(path), sample[SharedColumn.Q1_RAD :])

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """Raises LimitError: still moving, off the plane, out of reach, too late; StoppedError."""
        with self._lock:
            child = self._alive()
            shared = child.shared
            stops = shared.get(Slot.STOPS)
            self._check_ready(child)
            if self._busy(child):
                raise LimitError(self.name, "still moving", "wait until it rests, or stop it")
            (sample,) = shared.samples(1)
            self._check_on_plane(sample)
            begun = _from_zero(path)
            self._check_reach(begun, sample[SharedColumn.Q1_RAD :])
            now_s = time.monotonic()
            if start_s is not None and start_s < now_s:
                raise too_late(self.name, now_s - start_s)
            self._paths += 1
            accepted = shared.get(Slot.FOLLOWED)
            self._send(child, ("follow", begun, stops, start_s))
            while shared.get(Slot.PATHS) != self._paths:  # at the child's next period
                self._alive()
                time.sleep(_POLL_S)
            if shared.get(Slot.FOLLOWED) > accepted:
                return
            self._check_ready(child)
            if start_s is None:
                raise StoppedError(self.name, "was stopped as it was told", ArmMode.STOPPED.remedy)
            raise too_late(self.name, time.monotonic() - start_s)

    def revise(self, path: Trajectory, from_s: float) -> None:
        """Raises LimitError: no path is followed, out of reach, too late; StoppedError."""
        with self._lock:
            child = self._alive()
            shared = child.shared
            stops = shared.get(Slot.STOPS)
            self._check_ready(child)
            if not self._busy(child):
                raise nothing_to_revise(self.name)
            (sample,) = shared.samples(1)
            begun = _from_zero(path)
            self._check_reach(begun, sample[SharedColumn.Q1_RAD :])
            if from_s < time.monotonic():
                raise revised_too_late(self.name, time.monotonic() - from_s)
            commanded, accepted = shared.get(Slot.REVISIONS), shared.get(Slot.REVISED)
            self._send(child, ("revise", begun, stops, float(from_s)))
            while shared.get(Slot.REVISIONS) == commanded:  # at the child's next period
                self._alive()
                time.sleep(_POLL_S)
            if shared.get(Slot.REVISED) > accepted:
                return
            self._check_ready(child)
            if not self._busy(child):
                raise nothing_to_revise(self.name)
            raise revised_too_late(self.name, time.monotonic() - from_s)

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """Measured poses; the robot's own time stamps, brought to the cell's clock."""
        with self._lock:
            log = self._log if self._child is None else self._child.shared.samples_since(start_s)
        t_s = log[:, SharedColumn.T_S]
        chosen = log[(t_s >= start_s) & (t_s <= end_s)]
        poses = self._options.mount.each_to_plane(matrices_of(_tool_of(chosen)))
        return Trajectory(chosen[:, SharedColumn.T_S].copy(), *(v.copy() for v in poses.T))

    def stop(self, reason: str) -> None:
        """Decelerate now and stay stopped until `reset`."""
        if self._stop_reason is None:
            self._stop_reason = reason
        child = self._child  # no lock: a stop waits for nobody
        if child is not None:
            child.shared.add(Slot.STOPS)

    def reset(self) -> None:
        """Raises StoppedError while the controller itself is stopped; DeviceLostError."""
        with self._lock:
            child = self._alive()
            # cleared before the answer comes, so that a stop meanwhile stays latched
            reason, self._stop_reason = self._stop_reason, None
            try:
                self._reset(child)
            except DeviceError:
                if self._stop_reason is None:
                    self._stop_reason = reason
                raise

    # --- the child ----------------------------------------------------------------------------

    def _reset(self, child: ChildProcess) -> None:
        self._send(child, ("reset",))
        answer = self._receive(child, _RESET_S)
        if answer[0] == "refused":
            cause, remedy = answer[1:]
            mode = ArmMode(cause) if cause in set(ArmMode) else ArmMode.STOPPED
            if mode is not ArmMode.STOPPED:
                cause, remedy = self._cause(child, mode), mode.remedy
            raise StoppedError(self.name, f"the controller reports {cause}", remedy, mode)

    def _start_child(self) -> ChildProcess:
        o = self._options
        robot = RobotOptions(
            host=o.host,
            pid=os.getpid(),
            tcp=o.tcp,
            period_s=1.0 / o.rate_hz,
            watchdog_hz=o.watchdog_hz,
            allow_version=o.allow_version,
        )
        options = ChildOptions(
            robot=robot,
            mount=o.mount,
            lookahead_s=o.lookahead_s,
            gain=o.gain,
            stop_m_per_s2=o.stop_m_per_s2,
            stale_s=o.stale_s,
        )
        return start_child(options)

    def _await_done(self, child: ChildProcess, seconds: float) -> None:
        try:
            if not child.connection.poll(seconds):
                raise ConnectError(
                    self.name,
                    f"no answer from {self._options.host} within {seconds:.1f} s",
                    _LOST_REMEDY,
                )
            answer = child.connection.recv()
        except (EOFError, OSError):
            raise ConnectError(self.name, child.last_words(), _LOST_REMEDY) from None
        if answer[0] == "refused":
            raise ConnectError(
                self.name, f"{self._options.host}: {answer[1]}", answer[2] or _LOST_REMEDY
            )

    def _await_first_sample(self, child: ChildProcess) -> None:
        until_s = time.monotonic() + 1.0
        while child.shared.get(Slot.SAMPLES) < 1.0 or child.shared.get(Slot.HEARTBEAT_S) == 0.0:
            if time.monotonic() > until_s or child.process.poll() is not None:
                raise ConnectError(self.name, "the controller sends no poses", _LOST_REMEDY)
            time.sleep(0.002)

    def _alive(self) -> ChildProcess:
        """The child, if it and the robot are well.  Raises DeviceLostError."""
        child = self._child
        if child is None:
            remedy = "connect first" if self._lost == "not connected" else _LOST_REMEDY
            raise DeviceLostError(self.name, self._lost, remedy)
        silent_s = time.monotonic() - child.shared.get(Slot.HEARTBEAT_S)
        if child.process.poll() is not None:
            self._lose(child, child.farewell())
        if silent_s > self._options.silent_s:
            self._lose(child, f"the arm's process has been silent for {silent_s:.3f} s")
        return child

    def _lose(self, child: ChildProcess, cause: str) -> None:
        self._log = child.shared.samples()
        self._child, self._lost = None, cause
        child.end()
        raise DeviceLostError(self.name, cause, _LOST_REMEDY)

    def _send(self, child: ChildProcess, request: tuple[object, ...]) -> None:
        try:
            child.connection.send(request)
        except OSError:
            self._lose(child, child.farewell())

    def _receive(self, child: ChildProcess, seconds: float) -> tuple[str, ...]:
        try:
            if child.connection.poll(seconds):
                answer: tuple[str, ...] = child.connection.recv()
                if answer[0] != "lost":
                    return answer
                self._lose(child, answer[1])
        except (EOFError, OSError):
            self._lose(child, child.farewell())
        self._lose(child, f"no answer within {seconds:.1f} s")
        raise AssertionError("_lose raises")

    # --- judgement ----------------------------------------------------------------------------

    def _mode(self, child: ChildProcess) -> ArmMode:
        mode = MODES[int(child.shared.get(Slot.MODE))]
        stopped = self._stop_reason is not None or child.shared.get(Slot.SLOWED) != 0.0
        return ArmMode.STOPPED if mode is ArmMode.READY and stopped else mode

    def _check_ready(self, child: ChildProcess) -> None:
        mode = self._mode(child)
        if mode is not ArmMode.READY:
            cause = f"stopped: {self._cause(child, mode)}"
            slowed = child.shared.get(Slot.SLOWED) != 0.0
            kind = ArmMode.REDUCED_SPEED if mode is ArmMode.STOPPED and slowed else mode
            raise StoppedError(self.name, cause, mode.remedy, kind)

    def _cause(self, child: ChildProcess, mode: ArmMode) -> str:
        match mode:
            case ArmMode.REDUCED_SPEED:
                return f"{mode.value}: {child.shared.get(Slot.SPEED):.0%} of the full speed"
            case ArmMode.STOPPED if child.shared.get(Slot.SLOWED) != 0.0:
                return "it was slowed in motion"
            case ArmMode.STOPPED:
                return self._stop_reason or "program ended"
        return mode.value

    def _busy(self, child: ChildProcess) -> bool:
        shared = child.shared
        return shared.get(Slot.PATHS) != self._paths or shared.get(Slot.STREAMING) != 0.0

    def _check_model(self, child: ChildProcess) -> None:
        (sample,) = child.shared.samples(1)
        model = MODELS[self._options.model]
        X_BT = model.forward(sample[SharedColumn.Q1_RAD :], matrix_of(np.array(self._options.tcp)))
        there, here = self._options.mount.to_plane(X_BT), self._pose(sample)
        apart_m = float(np.hypot(there.x_m - here.x_m, there.y_m - here.y_m))
        if apart_m > _MODEL_TOLERANCE_M:
            raise ConnectError(
                self.name,
                f"joints and tool of a {model.name} put it {apart_m * 1e3:.0f} mm from where it is",
                "check arm.model and arm.tcp",
            )

    def _check_on_plane(self, sample: FloatArray) -> None:
        o = self._options
        off_m, tilt_rad = o.mount.off_plane(matrix_of(_tool_of(sample)))
        if off_m > o.off_plane_m or tilt_rad > o.tilt_rad:
            raise LimitError(
                self.name,
                f"the tool is {off_m * 1e3:.1f} mm off the cell's plane and tilted by "
                f"{tilt_rad:.3f} rad, allowed {o.off_plane_m * 1e3:.1f} mm and "
                f"{o.tilt_rad:.3f} rad",
                "jog it to its start; nothing was moved",
            )

    def _pose(self, sample: FloatArray) -> Pose:
        return self._options.mount.to_plane(matrix_of(_tool_of(sample)))

    def _check_reach(self, path: Trajectory, q_rad: FloatArray) -> None:
        model, X_FT = MODELS[self._options.model], matrix_of(np.array(self._options.tcp))
        check_reach(path, q_rad, model, X_FT, self._options.mount, self.name)


def _tool_of(samples: FloatArray) -> FloatArray:
    """(…, 14) samples → (…, 6) the tool's pose."""
    return samples[..., SharedColumn.TCP : SharedColumn.TCP + 6]


def _from_zero(path: Trajectory) -> Trajectory:
    """The path with its times counted from its beginning."""
    return Trajectory(path.t_s - path.t_s[0], path.x_m, path.y_m, path.angle_rad)
