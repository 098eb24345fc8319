"""A UR controller through ur-rtde's three clients; any call may hang when the connection drops."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.clock import sleep_until
from drivers.interfaces import ArmMode
from drivers.priority import Pollers, own_threads
from drivers.rtde_client import RtdeClient
from drivers.ur_claim import ClaimedError, claim
from drivers.ur_dashboard import RemoteControl
from drivers.ur_versions import Version, has_dashboard, identify, refusal

_PLAYING = 2  # runtime state
_RUNNING = 7  # robot mode: powered, brakes released
# safety status bits: protective; safeguard; system, robot, any emergency; violation, fault, stopped
_PROTECTIVE, _SAFEGUARD, _EMERGENCY, _OTHER = 1 << 2, 1 << 4, 0b111 << 5, 0b111 << 8
_FULL_SPEED = 0.995
_OUTPUTS = [
    "timestamp",
    "actual_q",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "runtime_state",
    "safety_status_bits",
    "robot_mode",
    "speed_scaling",
    "target_speed_fraction",
]
#: Largest delay of ur-rtde's clients while this process sleeps, s.
_POLLING_SLACK_S = 4e-4
_STANDSTILL_M = 2e-4
_STANDSTILL_S = 0.1
_PROGRAM_S = 5.0
#: Longest time until a controller detects the end of a connection, s.
_FREED_S = 1.0
_NO_LIBRARY = (
    "pip install 'ur-rtde>=1.6'; it is made for Python 3.11 and 3.12 on Linux x86-64, and must be "
    "built from source elsewhere"
)


@dataclass(frozen=True)
class RobotOptions:
    """Address of a robot and its allowed version; see `drivers.ur.UrOptions`.

    pid  process that commands it
    """

    host: str
    pid: int
    tcp: tuple[float, ...]
    period_s: float
    watchdog_hz: float
    allow_version: Version | None


class RefusedError(Exception):
    """A request that cannot be met in the present state: cause and remedy."""

    def __init__(self, cause: str, remedy: str) -> None:
        super().__init__(cause)
        self.cause = cause
        self.remedy = remedy


class Robot:
    """A connected controller.

    before_threads  called once everything is loaded, before the clients start their threads
    raises          RefusedError: no ur-rtde, no controller, a version that is not allowed, another
                    program that commands it, or the robot cannot start
    """

    def __init__(
        self, options: RobotOptions, before_threads: Callable[[], None] = lambda: None
    ) -> None:
        try:
            import rtde_control
            import rtde_receive
        except ImportError as error:
            raise RefusedError(f"ur-rtde cannot be loaded ({error})", _NO_LIBRARY) from error

        before_threads()
        before = own_threads()
        self._options = options
        version = _allowed_version(options)
        self._claim = _claimed(options)
        self._pendant = _pendant(options.host, version)
        self.receive = rtde_receive.RTDEReceiveInterface(
            options.host, 1.0 / options.period_s, _OUTPUTS
        )
        self._check_can_start()
        self.control = rtde_control.RTDEControlInterface(options.host, 1.0 / options.period_s)
        self._pollers = Pollers(own_threads() - before, _POLLING_SLACK_S)
        if self._pendant is not None:
            self._pendant.begin()
        self._prepare()

    def rest_until(self, due_s: float) -> None:
        """Sleep until a time of the monotonic clock; ur-rtde's threads then poll gently."""
        with self._pollers.eased():
            sleep_until(due_s)

    def speed(self, moving: bool) -> float:
        """Share of the full speed: of the slider, and in motion of the controller's own limiter."""
        slider = self.receive.getTargetSpeedFraction()
        return float(slider * self.receive.getSpeedScaling() if moving else slider)

    def mode(self, moving: bool = False) -> ArmMode:
        """READY, or why the controller does not let the program run; STOPPED = it has ended."""
        bits = self.receive.getSafetyStatusBits()
        if bits & _EMERGENCY:
            return ArmMode.EMERGENCY_STOP
        if bits & _SAFEGUARD:
            return ArmMode.SAFEGUARD_STOP
        if bits & (_PROTECTIVE | _OTHER):
            return ArmMode.PROTECTIVE_STOP
        if self.receive.getRobotMode() != _RUNNING:
            return ArmMode.POWER_OFF
        if self._pendant is not None and not self._pendant.is_remote:
            return ArmMode.LOCAL_CONTROL
        if not self.plays:
            return ArmMode.STOPPED
        if self.speed(moving) < _FULL_SPEED:
            return ArmMode.REDUCED_SPEED
        return ArmMode.READY

    @property
    def plays(self) -> bool:
        """Whether a program runs, as it may though the pendant has control."""
        return bool(self.receive.getRuntimeState() == _PLAYING)

    @property
    def unknown(self) -> str:
        """Why remote control is unknown; "" = it is known, or there is no dashboard."""
        return "" if self._pendant is None else self._pendant.unknown

    def refresh(self) -> None:
        """Poll the dashboard now.  Raises RefusedError: it does not answer."""
        if self._pendant is not None:
            try:
                self._pendant.request()
            except OSError as error:
                raise RefusedError(f"the dashboard: {error}", ArmMode.LOST.remedy) from error

    def restart_program(self) -> None:
        """Upload the program anew without the old command starting with it.

        Raises RefusedError: it does not run, or the arm moves.
        """
        self.control.kickWatchdog()  # leaves "no command" in the register, see hardware trap 4
        self._end_programs()
        self.control.reuploadScript()
        if not _in_time(lambda: self.plays):
            raise RefusedError("the program does not start", self._start_remedy())
        before = np.array(self.receive.getActualTCPPose()[:3])
        self._prepare()
        until_s = time.monotonic() + _STANDSTILL_S
        while time.monotonic() < until_s:
            self.control.kickWatchdog()
            moved_m = float(np.linalg.norm(np.array(self.receive.getActualTCPPose()[:3]) - before))
            if moved_m > _STANDSTILL_M:
                self.control.stopScript()
                raise RefusedError(
                    f"the arm moved {moved_m * 1e3:.1f} mm by itself after the program started",
                    "look at the pendant's log",
                )
            time.sleep(0.005)

    def _prepare(self) -> None:
        self.control.setTcp(list(self._options.tcp))
        self.control.setWatchdog(self._options.watchdog_hz)

    def _end_programs(self) -> None:
        """End a running program without a dashboard: ur-rtde would crash in its own request."""
        if self._pendant is not None or not self.control.isProgramRunning():
            return
        self.control.stopScript()
        if not _in_time(lambda: not self.control.isProgramRunning()):
            raise RefusedError("another program runs", "stop it at the pendant, then reset")

    def _start_remedy(self) -> str:
        if self._pendant is not None:
            return "look at the pendant's log"
        return (
            "PolyScope X does not tell why: at the pendant, release the brakes, choose the control "
            "mode in which other computers may start programs, allow RTDE and the real-time client "
            "interface under Settings, Security, Services; then look at its log"
        )

    def _check_can_start(self) -> None:
        mode = self.mode()
        if mode not in (ArmMode.READY, ArmMode.STOPPED, ArmMode.REDUCED_SPEED):
            raise RefusedError(f"the controller reports {mode.value}", mode.remedy)


def _allowed_version(options: RobotOptions) -> Version:
    """The controller's version, read first because ur-rtde can hang on unknown ones."""
    try:
        version = identify(options.host).release
    except OSError as error:
        raise RefusedError(str(error), ArmMode.LOST.remedy) from error
    if (refused := refusal(version, options.allow_version)) is not None:
        raise RefusedError(refused.cause, refused.remedy)
    return version


def _pendant(host: str, version: Version) -> RemoteControl | None:
    """Remote control; None = no dashboard: a failed start then names it as a possible cause."""
    if not has_dashboard(version):
        return None
    try:
        return RemoteControl(host)
    except OSError as error:
        raise RefusedError(f"the dashboard: {error}", ArmMode.LOST.remedy) from error


def _claimed(options: RobotOptions) -> RtdeClient:
    """The claim to command the controller; it ends with this process.

    A claim of this program is of a connection that has just ended, and soon disappears.
    """
    until_s = time.monotonic() + _FREED_S
    while True:
        try:
            return claim(options.host, options.pid)
        except ClaimedError as error:
            owner = error.commander
            ours = owner is not None and owner.here and owner.pid == options.pid
            if not ours or time.monotonic() > until_s:
                raise RefusedError(str(error), error.remedy) from error
        except OSError as error:
            raise RefusedError(str(error), ArmMode.LOST.remedy) from error
        time.sleep(0.005)


def _in_time(holds: Callable[[], bool]) -> bool:
    until_s = time.monotonic() + _PROGRAM_S
    while not holds():
        if time.monotonic() > until_s:
            return False
        time.sleep(0.005)
    return True
