"""Child process that runs ur-rtde, which may hang or crash there without harm to the cell.

Started by `drivers.ur`; speaks to it through a connection (requests, answers) and shared memory
(stop, heartbeat, samples).  Every cycle it awaits the robot's state, obeys a stop, and in step with
the controller either streams the next pose of a path or feeds the controller's watchdog.  When the
robot falls silent, or the parent goes, it ends; the controller's watchdog then stops the arm.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from drivers.interfaces import ArmMode, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.priority import bound_spinning, run_in_real_time
from drivers.ur_pose import pose_of
from drivers.ur_robot import RefusedError, Robot, RobotOptions
from drivers.ur_shared import SharedState, Slot

_DRIFT = 50e-6  # how fast two crystals may part
#: When commands are sent, in periods after the state could have come: late enough for nearly every
#: state, and far from where the controller looks for commands.  How far a period may depart.
_PHASE, _SLEW = 0.4, 0.01


class ControllerClock:
    """Estimates the phase of the controller's cycles from the arrival of its states.

    A command that comes while the controller looks for one is taken at random in this cycle or the
    next; so commands are sent in between, however the two clocks drift.

    period_s  of the controller's cycle, s
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._robot_s = 0.0
        self._offset_s = math.inf

    @property
    def robot_s(self) -> float:
        """Time stamp of the last state, on the controller's clock."""
        return self._robot_s

    @property
    def lead_s(self) -> float:
        """How long before a deadline a state is expected, s."""
        return _PHASE * self._period_s

    def state_before(self, deadline_s: float) -> float:
        """A time on the controller's clock between the stamp of the state that is expected before
        a deadline and the one before that; −inf before the first state.
        """
        return deadline_s - self.lead_s - self._offset_s - 0.5 * self._period_s

    def observe(self, robot_s: float, now_s: float) -> float:
        """Time on the cell's clock of a state that came now: by the least delay so far."""
        drift_s = _DRIFT * (robot_s - self._robot_s)
        self._offset_s = min(self._offset_s + drift_s, now_s - robot_s)
        self._robot_s = robot_s
        return robot_s + self._offset_s

    def in_step(self, deadline_s: float) -> float:
        """A deadline moved by at most a hundredth of a period towards `lead_s` after a state."""
        if not math.isfinite(self._offset_s):
            return deadline_s
        period_s = self._period_s
        late_s = deadline_s - (self._robot_s + self._offset_s + self.lead_s)
        off_s = (late_s + 0.5 * period_s) % period_s - 0.5 * period_s
        most_s = _SLEW * period_s
        return deadline_s - max(-most_s, min(most_s, off_s))


MODES = tuple(ArmMode)

_SETTLING = 8.0  # lookaheads after the end of a path until the arm rests
_CLOCKS_S = 0.1  # time of the first estimate of the clocks' offset
_EARLY_S, _POLL_S = 1e-4, 5e-5  # before a state is expected, and polling interval
_SETTING_UP_S, _CYCLING_S = 0.5, 0.03  # longest that ur-rtde may spin
_FAREWELL_S = 2


@dataclass(frozen=True)
class ChildOptions:
    """Options of the child process; see `drivers.ur.UrOptions`."""

    robot: RobotOptions
    mount: PlaneMount
    lookahead_s: float
    gain: float
    stop_m_per_s2: float
    stale_s: float


class _LostError(Exception):
    """The robot fell silent."""


@dataclass
class _Motion:
    path: Trajectory
    began_s: float
    last_s: float = 0.0  # time of the last command


class _Child:
    def __init__(self, connection: Connection, shared: SharedState, options: ChildOptions) -> None:
        self._connection = connection
        self._requests = select.poll()  # `Connection.poll` would make one in every cycle
        self._requests.register(connection, select.POLLIN)
        self._shared = shared
        self._options = options
        self._motion: _Motion | None = None
        self._mode = ArmMode.READY
        self._stops = 0.0
        self._clock = ControllerClock(options.robot.period_s)
        self._silent_s = 0.0
        self._last_t_s = -np.inf
        self._period_s = options.robot.period_s
        self._robot = Robot(options.robot, _hurry)
        self._began_s = self._measured_s = time.monotonic()

    def run(self) -> None:
        """Cycle until `close` is requested.  Raises _LostError; EOFError: the parent has gone."""
        self._look_at_mode()
        bound_spinning(_CYCLING_S)
        due_s = time.monotonic()
        while self._serve_requests():
            self._await_state(due_s)
            now_s = time.monotonic()
            self._shared.put(Slot.HEARTBEAT_S, now_s)
            self._measure(now_s)
            self._look_at_mode()
            self._robot.rest_until(due_s)
            self._check_stop()
            if self._motion is not None:
                self._stream(self._motion, time.monotonic())
            elif self._mode in (ArmMode.READY, ArmMode.REDUCED_SPEED):
                self._robot.control.kickWatchdog()
            periods = max(1, math.ceil((time.monotonic() - due_s) / self._period_s))
            due_s = self._clock.in_step(due_s + periods * self._period_s)
        self.rest()

    def _await_state(self, due_s: float) -> None:
        """Wait for the controller's next state, to know its arrival time, until `due_s` at most."""
        learns = time.monotonic() < self._began_s + _CLOCKS_S
        early_s = self._period_s if learns else self._clock.lead_s + _EARLY_S
        self._robot.rest_until(due_s - early_s)
        awaited_s = self._clock.robot_s if learns else self._clock.state_before(due_s)
        while time.monotonic() < due_s and self._robot.receive.getTimestamp() <= awaited_s:
            time.sleep(_POLL_S)

    def rest(self) -> None:
        """Stop the arm and end the program, or end this process where ur-rtde hangs instead."""
        signal.alarm(_FAREWELL_S)
        bound_spinning(_SETTING_UP_S)
        self._end_motion()
        self._robot.control.stopScript()

    def _measure(self, now_s: float) -> None:
        robot = self._robot.receive
        # checked before anything is sent: ur-rtde hangs in a call without connection
        if not (robot.isConnected() and self._robot.control.isConnected()):
            raise _LostError("the connection dropped")
        if self._robot.unknown:
            raise _LostError(self._robot.unknown)
        robot_s = robot.getTimestamp()
        # time in which this process was not run is not the controller's silence
        self._silent_s += min(now_s - self._measured_s, 2.0 * self._period_s)
        self._measured_s = now_s
        if robot_s == self._clock.robot_s:
            if self._silent_s > self._options.stale_s:
                raise _LostError(
                    f"the controller's time has not advanced for {self._silent_s:.3f} s"
                )
            return
        self._silent_s = 0.0
        t_s = self._clock.observe(robot_s, now_s)
        if now_s < self._began_s + _CLOCKS_S or t_s <= self._last_t_s:
            return
        self._last_t_s = t_s
        speed = math.hypot(*robot.getActualTCPSpeed()[:3])
        # the parent maps it to the cell's plane on request
        self._shared.write_sample([t_s, *robot.getActualTCPPose(), speed, *robot.getActualQ()])

    def _look_at_mode(self) -> None:
        moving = self._motion is not None
        self._shared.put(Slot.SPEED, self._robot.speed(moving))
        mode = self._robot.mode(moving)
        if mode is ArmMode.REDUCED_SPEED:
            if moving:
                self._shared.put(Slot.SLOWED, 1.0)
            self._end_motion()
        elif mode is not ArmMode.READY and self._mode in (ArmMode.READY, ArmMode.REDUCED_SPEED):
            if mode is ArmMode.LOCAL_CONTROL and self._robot.plays:
                self._end_motion()  # the program would go on; without its watchdog fed it soon ends
            self._motion = None
            self._shared.put(Slot.STREAMING, 0.0)
            if mode is not ArmMode.STOPPED:
                self._robot.control.kickWatchdog()  # "no command", while it still stands
        self._mode = mode
        self._shared.put(Slot.MODE, MODES.index(mode))

    def _check_stop(self) -> None:
        stops = self._shared.get(Slot.STOPS)
        if stops != self._stops:
            self._stops = stops
            self._end_motion()

    def _end_motion(self) -> None:
        if self._motion is not None:
            self._motion = None
            self._robot.control.servoStop(self._options.stop_m_per_s2)
            self._shared.put(Slot.STREAMING, 0.0)

    def _stream(self, motion: _Motion, now_s: float) -> None:
        options = self._options
        if motion.last_s > 0.0:
            self._count_period(now_s - motion.last_s)
        motion.last_s = now_s
        along_s = now_s - motion.began_s
        target = pose_of(options.mount.to_base(motion.path.at(along_s)))
        self._robot.control.servoL(
            target.tolist(), 0.0, 0.0, self._period_s, options.lookahead_s, options.gain
        )
        if along_s > motion.path.t_s[-1] + _SETTLING * options.lookahead_s:
            self._end_motion()

    def _count_period(self, period_s: float) -> None:
        self._shared.add(Slot.PERIODS)
        if period_s > 1.25 * self._period_s:
            self._shared.add(Slot.LATE_PERIODS)
        if period_s > self._shared.get(Slot.WORST_PERIOD_S):
            self._shared.put(Slot.WORST_PERIOD_S, period_s)

    # --- requests -----------------------------------------------------------------------------

    def _serve_requests(self) -> bool:
        """Act on the parent's requests; False when it wants to close."""
        while self._requests.poll(0):
            request = self._connection.recv()
            match request:
                case ("follow", Trajectory() as path, float(stops), start_s):
                    self._follow(path, stops, start_s)
                case ("revise", Trajectory() as path, float(stops), float(from_s)):
                    self._revise(path, stops, from_s)
                case ("reset",):
                    self._answer(self._reset)
                case ("close",):
                    return False
        return True

    def _follow(self, path: Trajectory, stops: float, start_s: float | None) -> None:
        # a stop that came after the parent had looked for one wins; a path is begun at its start
        now_s = time.monotonic()
        free = self._mode is ArmMode.READY and self._shared.get(Slot.SLOWED) == 0.0
        in_time = start_s is None or now_s <= start_s
        if free and in_time and stops == self._shared.get(Slot.STOPS):
            self._motion = _Motion(path, now_s if start_s is None else start_s)
            self._shared.put(Slot.STREAMING, 1.0)
            self._shared.add(Slot.FOLLOWED)
        self._shared.add(Slot.PATHS)

    def _revise(self, path: Trajectory, stops: float, from_s: float) -> None:
        # between two commands, so that each is of one path; a stop wins
        in_time = time.monotonic() <= from_s
        if self._motion is not None and in_time and stops == self._shared.get(Slot.STOPS):
            self._motion.path = path
            self._shared.add(Slot.REVISED)
        self._shared.add(Slot.REVISIONS)

    def _reset(self) -> None:
        self._robot.refresh()
        mode = self._robot.mode()
        if mode not in (ArmMode.READY, ArmMode.STOPPED):
            raise RefusedError(mode.value, "")
        if mode is ArmMode.STOPPED:
            self._robot.restart_program()
        self._silent_s = 0.0
        self._shared.put(Slot.SLOWED, 0.0)
        self._look_at_mode()

    def _answer(self, act: Callable[[], None]) -> None:
        """Do a long action, and send its result."""
        self._shared.put(Slot.HEARTBEAT_S, np.nan)
        bound_spinning(_SETTING_UP_S)
        try:
            act()
            answer: tuple[Any, ...] = ("done",)
        except RefusedError as refusal:
            answer = ("refused", refusal.cause, refusal.remedy)
        bound_spinning(_CYCLING_S)
        self._shared.put(Slot.HEARTBEAT_S, time.monotonic())
        self._connection.send(answer)


def _hurry() -> None:
    bound_spinning(_SETTING_UP_S)
    run_in_real_time()


def main() -> None:
    """Serve one arm: `python -m drivers.ur_child CONNECTION_FD MEMORY_FD`."""
    connection = Connection(int(sys.argv[1]))
    shared = SharedState(int(sys.argv[2]))
    options: ChildOptions = pickle.loads(connection.recv_bytes())
    try:
        child = _Child(connection, shared, options)
        connection.send(("done",))
    except RefusedError as refusal:
        connection.send(("refused", refusal.cause, refusal.remedy))
        os._exit(1)
    except (RuntimeError, ValueError) as error:
        connection.send(("refused", " ".join(str(error).split()), ""))
        os._exit(1)
    code = 0
    try:
        child.run()
    except _LostError as lost:
        with contextlib.suppress(OSError):  # the parent has gone too
            connection.send(("lost", str(lost)))
    except (EOFError, OSError):  # the parent has gone
        child.rest()
    except Exception:
        traceback.print_exc()  # its last line becomes the cause that the parent names
        code = 1
    os._exit(code)  # ur-rtde's own farewell hangs once the robot has gone


if __name__ == "__main__":
    main()
