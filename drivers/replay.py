"""Devices that replay a recording: arm, camera and gripper, on a simulated clock.

They read no files: frames, answers and paths are arguments.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.interfaces import (
    ArmMode,
    ArmState,
    CameraError,
    DeviceError,
    Frame,
    GripError,
    GripperState,
    Pose,
    Trajectory,
    revised_too_late,
)
from drivers.servo import SETTLING_LAGS
from drivers.sim.clock import SimClock

#: A path is the recorded one if no pose differs by more, m and rad.
SAME = 1e-9


class OtherMotionError(DeviceError):
    """The recording has a different motion.  Scenario: a new model chooses a different offset."""


@dataclass(frozen=True)
class RecordedPoses:
    """Measured poses that the recorded arm returned for the time from `start_s` to `end_s`."""

    start_s: float
    end_s: float
    poses: Trajectory


class ReplayArm:
    """Arm that returns the recorded answers, and accepts only the filmed motions.

    logs       answers of the recorded arm, in their order
    filmed     paths that were commanded with a start time
    revisions  changed paths that the recorded arm accepted
    """

    name = "arm"

    def __init__(
        self,
        clock: SimClock,
        home: Pose,
        rate_hz: float,
        lag_s: float,
        logs: Sequence[RecordedPoses],
        filmed: Sequence[Trajectory],
        revisions: Sequence[Trajectory] = (),
    ) -> None:
        self._clock = clock
        self._rate_hz = rate_hz
        self._lag_s = lag_s
        self._answers = logs
        self._filmed = filmed
        self._revisions = revisions
        self._mode = ArmMode.READY
        t_s = clock.now_s() - np.array([2.0, 1.0])
        self._path = Trajectory(
            t_s, np.full(2, home.x_m), np.full(2, home.y_m), np.full(2, home.angle_rad)
        )

    @property
    def lag_s(self) -> float:
        """Delay between a commanded and the executed pose, s."""
        return self._lag_s

    @property
    def rate_hz(self) -> float:
        """Rate at which poses were streamed, Hz."""
        return self._rate_hz

    def connect(self) -> None:
        """Nothing is connected."""

    def close(self) -> None:
        """Nothing is connected."""

    def state(self) -> ArmState:
        """State on the commanded path; at rest once the recorded arm has settled."""
        now_s = self._clock.now_s()
        moving = now_s < self._path.t_s[-1] + SETTLING_LAGS * self._lag_s
        return ArmState(now_s, self._path.at(now_s), 0.0, moving, self._mode)

    def check(self, path: Trajectory) -> None:
        """Accept every path: the guard has checked the limits."""

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """Raises OtherMotionError: the recording has no film of this motion."""
        if start_s is not None and not any(_same(path, filmed) for filmed in self._filmed):
            raise OtherMotionError(
                self.name,
                "the recording holds no film of this motion",
                "what was decided is compared all the same",
            )
        begin_s = self._clock.now_s() if start_s is None else start_s
        self._path = Trajectory(
            path.t_s - path.t_s[0] + begin_s, path.x_m, path.y_m, path.angle_rad
        )

    def revise(self, path: Trajectory, from_s: float) -> None:
        """Raises TooLateError: the recorded arm accepted no such change, perhaps as too late."""
        if not any(_same(path, revision) for revision in self._revisions):
            raise revised_too_late(self.name, self._clock.now_s() - from_s)
        self._path = replace(path, t_s=path.t_s - path.t_s[0] + self._path.t_s[0])

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """The recorded answer to this request; else samples of the present path.

        Requests until a frame have the same end.  Requests until now ended later in the recording,
        because computing and waiting take no time here: the next later answer is returned.
        """
        matches = [a for a in self._answers if a.start_s == start_s]
        if matches:
            later = [a for a in matches if a.end_s >= end_s]
            return (min(later, key=_end_s) if later else max(matches, key=_end_s)).poses
        grid = np.arange(np.ceil(start_s * self._rate_hz), np.floor(end_s * self._rate_hz) + 1)
        t_s = grid / self._rate_hz
        path = self._path
        columns = (np.interp(t_s, path.t_s, c) for c in (path.x_m, path.y_m, path.angle_rad))
        return Trajectory(t_s, *columns)

    def stop(self, reason: str) -> None:
        """Stay where it is until `reset`."""
        self._mode = ArmMode.STOPPED

    def reset(self) -> None:
        """Clear our own stop."""
        self._mode = ArmMode.READY


class FilmedArm(ReplayArm):
    """Arm of a film: only its measured poses are known, for the time of the film.

    gripper_log  the poses, on the clock of the film
    """

    def __init__(
        self, clock: SimClock, home: Pose, rate_hz: float, lag_s: float, gripper_log: Trajectory
    ) -> None:
        super().__init__(clock, home, rate_hz, lag_s, (), ())
        self._hand = gripper_log

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """Known poses of this time, and the next one on either side."""
        t_s = self._hand.t_s
        first = max(0, int(np.searchsorted(t_s, start_s, "right")) - 1)
        last = min(len(t_s), int(np.searchsorted(t_s, end_s)) + 1)
        if t_s[first] > end_s or t_s[-1] < start_s:
            return Trajectory(*(np.empty(0) for _ in range(4)))
        return Trajectory(*(c[first:last] for c in vars(self._hand).values()))


class ReplayCamera:
    """A camera that returns the recorded frames, film by film."""

    name = "camera"

    def __init__(self, clock: SimClock, frame_rate_hz: float, frames: Iterable[Frame]) -> None:
        self._clock = clock
        self._frame_rate_hz = frame_rate_hz
        self._frames = iter(frames)
        self._next: Frame | None = None
        self._due = 0
        self._begun = False

    @property
    def frame_rate_hz(self) -> float:
        """Frame rate of the recording, Hz."""
        return self._frame_rate_hz

    def connect(self) -> None:
        """Nothing is connected."""

    def close(self) -> None:
        """Nothing is connected."""

    def check(self) -> None:
        """Recordings do not get lost."""

    def start(self, frame_count: int) -> None:
        """Advance to the next film."""
        self.stop()
        self._due, self._begun = frame_count, False

    def read(self) -> Frame | None:
        """Raises CameraError: the recording has no more frames of this film."""
        if self._due == 0:
            return None
        frame = self._next if self._next is not None else next(self._frames, None)
        self._next = None
        if frame is None:
            raise CameraError(
                self.name, f"the recording ends {self._due} frames before its film", "see its gaps"
            )
        if frame.index == 0 and self._begun:
            self._next, missing, self._due = frame, self._due, 0
            raise CameraError(
                self.name,
                f"this film was ended {missing} frames earlier than is asked for",
                "replay it with the motion.hold that it was made with",
            )
        self._begun = True
        self._due -= 1
        self._clock.forward_to_s(frame.t_s)
        return frame

    def stop(self) -> None:
        """Skip the remaining frames of this film."""
        while self._due:
            frame = next(self._frames, None)
            if frame is None or frame.index == 0:
                self._next = frame
                break
            self._due -= 1
        self._due = 0


class ReplayGripper:
    """Gripper that holds a cable if the recorded one did."""

    name = "gripper"

    def __init__(self, clock: SimClock, holds: bool) -> None:
        self._clock = clock
        self._holds = holds
        self._closed = False

    def connect(self) -> None:
        """Nothing is connected."""

    def close(self) -> None:
        """Nothing is connected."""

    def grip(self, force_n: float) -> GripperState:
        """Raises GripError: the recorded gripper held nothing."""
        self._closed = True
        if not self._holds:
            raise GripError(self.name, "nothing is held in the recording", "see its log")
        return self.state()

    def release(self) -> GripperState:
        """Open the jaws."""
        self._closed = False
        return self.state()

    def state(self) -> GripperState:
        """Present state."""
        return GripperState(self._clock.now_s(), 0.0, self._closed and self._holds, False)


def _end_s(answer: RecordedPoses) -> float:
    return answer.end_s


def _same(path: Trajectory, other: Trajectory) -> bool:
    columns = (path.t_s - path.t_s[0], path.x_m, path.y_m, path.angle_rad)
    others = (other.t_s - other.t_s[0], other.x_m, other.y_m, other.angle_rad)
    return all(
        len(a) == len(b) and bool(np.all(np.abs(a - b) <= SAME))
        for a, b in zip(columns, others, strict=True)
    )
