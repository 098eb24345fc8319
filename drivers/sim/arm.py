"""Twin of an arm: follows paths with a lag, measures with noise, and has faults."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from drivers.interfaces import (
    ArmMode,
    ArmState,
    ConnectError,
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
from drivers.servo import servo_response
from drivers.sim.world import SimWorld

_NOISE_BLOCK = 1024


@dataclass(frozen=True)
class ArmFaults:
    """Faults of an arm; times on the cell's clock, None = never.

    Silence lasts until `faults` is set again, a controller's stop until `acknowledge`.
    """

    refuses_to_connect: bool = False
    lost_at_s: float | None = None  # the connection drops
    frozen_at_s: float | None = None  # the controller's time stamps no longer advance
    protective_stop_at_s: float | None = None
    safeguard_stop_at_s: float | None = None
    emergency_stop_at_s: float | None = None
    local_control: bool = False
    reduced_speed: bool = False  # set in motion, it breaks the motion off


@dataclass(frozen=True)
class ArmTwinOptions:
    """Properties of the simulated arm.

    lag_s           lag that the arm reports
    true_lag_s      its true lag; None = as reported
    rate_hz         rate of poses streamed and logged
    noise_m         standard deviation of a measured coordinate
    noise_rad       standard deviation of the measured angle
    stop_s          time in which a stop brings it to rest
    fault_stop_s    the same for a controller's own stop and for its watchdog
    """

    lag_s: float = 0.03
    true_lag_s: float | None = None
    rate_hz: float = 500.0
    noise_m: float = 10e-6
    noise_rad: float = 2e-5
    stop_s: float = 0.1
    fault_stop_s: float = 0.05


@dataclass(frozen=True)
class _Followed:
    """A path on the cell's clock, the lag with which it is followed, and where the gripper
    rested."""

    path: Trajectory
    lag_s: float
    start: Pose

    def response(self) -> Trajectory:
        return servo_response(self.path, self.lag_s, start=self.start)


class SimArm:
    """An arm in a simulated world."""

    def __init__(
        self,
        world: SimWorld,
        options: ArmTwinOptions | None = None,
        seed: int = 0,
        name: str = "arm",
    ) -> None:
        self.name = name
        self._world = world
        self._clock = world.clock
        self._options = options if options is not None else ArmTwinOptions()
        self._seed = seed
        self._faults = ArmFaults()
        self._connected = False
        self._stop_reason: str | None = None
        self._controller_stop: ArmMode | None = None
        self._lost: str | None = None
        self._happened: set[ArmMode] = set()
        self._followed: _Followed | None = None

    @property
    def lag_s(self) -> float:
        """Delay between a commanded and the executed pose, as reported, s."""
        return self._options.lag_s

    @property
    def rate_hz(self) -> float:
        """Rate at which poses are streamed, Hz."""
        return self._options.rate_hz

    @property
    def faults(self) -> ArmFaults:
        """Active faults; may be set at any time."""
        return self._faults

    @faults.setter
    def faults(self, faults: ArmFaults) -> None:
        with self._world.lock:
            self._faults = faults
            self._lost = None
            self._happened.clear()
            for field in fields(faults):
                if field.name.endswith("_at_s"):
                    t_s = getattr(faults, field.name)
                    if t_s is not None and t_s > self._clock.now_s():
                        self._clock.call_at(t_s, self._let_faults_happen)
            self._let_faults_happen()

    def acknowledge(self) -> None:
        """Clear the controller's own stop, as a person does at the pendant."""
        with self._world.lock:
            self._controller_stop = None

    def connect(self) -> None:
        """Raises ConnectError."""
        if self._faults.refuses_to_connect:
            raise ConnectError(self.name, "the controller refuses the connection", _LOST_REMEDY)
        if self._lost is not None:
            raise ConnectError(self.name, self._lost, _LOST_REMEDY)
        self._connected = True

    def close(self) -> None:
        """Stop and disconnect."""
        with self._world.lock:
            self._world.halt(self._options.stop_s)
            self._connected = False

    def state(self) -> ArmState:
        """Raises DeviceLostError."""
        with self._world.lock:
            self._check_alive()
            now_s = self._clock.now_s()
            moving = now_s < self._world.gripper_rest_from_s()
            speed = float(np.hypot(*self._world.gripper_velocity()[:2])) if moving else 0.0
            latest = self.log(now_s - 1.0 / self.rate_hz, now_s)
            return ArmState(float(latest.t_s[-1]), latest.at(now_s), speed, moving, self._mode())

    def check(self, path: Trajectory) -> None:
        """Raises DeviceLostError; this arm reaches everything."""
        with self._world.lock:
            self._check_alive()

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """Raises LimitError: still moving, too late; StoppedError; DeviceLostError."""
        with self._world.lock:
            self._check_ready()
            now_s = self._clock.now_s()
            if now_s < self._world.gripper_rest_from_s():
                raise LimitError(self.name, "still moving", "wait until it rests, or stop it")
            begin_s = now_s if start_s is None else start_s
            if begin_s < now_s:
                raise too_late(self.name, now_s - begin_s)
            absolute = Trajectory(
                path.t_s - path.t_s[0] + begin_s, path.x_m, path.y_m, path.angle_rad
            )
            true_lag_s = self._options.true_lag_s
            lag_s = self._options.lag_s if true_lag_s is None else true_lag_s
            self._followed = _Followed(absolute, lag_s, self._world.gripper_pose())
            self._world.commit(self._followed.response())

    def revise(self, path: Trajectory, from_s: float) -> None:
        """Raises LimitError: no path is followed, too late; StoppedError; DeviceLostError."""
        with self._world.lock:
            self._check_ready()
            now_s, followed = self._clock.now_s(), self._followed
            if followed is None or now_s >= self._world.gripper_rest_from_s():
                raise nothing_to_revise(self.name)
            if from_s < now_s:
                raise revised_too_late(self.name, now_s - from_s)
            t_s = path.t_s - path.t_s[0] + followed.path.t_s[0]
            self._followed = replace(followed, path=replace(path, t_s=t_s))
            self._world.recommit(self._followed.response())

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """Measured poses of the past, on the arm's own even grid of times."""
        with self._world.lock:
            end_s = min(end_s, self._clock.now_s())
            index = np.arange(
                max(0, int(np.ceil(start_s * self.rate_hz - 1e-6))),
                int(np.floor(end_s * self.rate_hz + 1e-6)) + 1,
            )
            t_s = index / self.rate_hz
            x, y, angle = (self._world.gripper_at(t_s) + self._measurement_noise(index)).T
            return Trajectory(t_s, x, y, angle)

    def stop(self, reason: str) -> None:
        """Decelerate now and stay stopped until `reset`."""
        self._latch(reason)  # before anything that might wait
        with self._world.lock:
            self._latch(reason)  # a reset under way may have cleared it meanwhile
            self._world.halt(self._options.stop_s)

    def reset(self) -> None:
        """Raises StoppedError while the controller itself is stopped; DeviceLostError."""
        with self._world.lock:
            self._check_alive()
            mode = self._mode()
            if mode not in (ArmMode.READY, ArmMode.STOPPED):
                cause = f"the controller reports {mode.value}"
                raise StoppedError(self.name, cause, mode.remedy, mode)
            self._stop_reason = None

    def _latch(self, reason: str) -> None:
        if self._stop_reason is None:
            self._stop_reason = reason

    def _mode(self) -> ArmMode:
        if self._controller_stop is not None:
            return self._controller_stop
        if self._faults.local_control:
            return ArmMode.LOCAL_CONTROL
        if self._faults.reduced_speed:
            return ArmMode.REDUCED_SPEED
        return ArmMode.READY if self._stop_reason is None else ArmMode.STOPPED

    def _check_alive(self) -> None:
        if self._lost is not None:
            raise DeviceLostError(self.name, self._lost, _LOST_REMEDY)
        if not self._connected:
            raise DeviceLostError(self.name, "not connected", "connect first")

    def _check_ready(self) -> None:
        self._check_alive()
        mode = self._mode()
        if mode is not ArmMode.READY:
            cause = self._stop_reason if mode is ArmMode.STOPPED else mode.value
            raise StoppedError(self.name, f"stopped: {cause}", mode.remedy, mode)

    def _let_faults_happen(self) -> None:
        """Bring the twin into the state that its faults ask for by now."""
        with self._world.lock:
            faults = self._faults
            if self._came(faults.lost_at_s):
                self._lose("the connection dropped")
            if self._came(faults.frozen_at_s):
                self._lose("the controller's time stamps do not advance")
            if faults.reduced_speed and self._clock.now_s() < self._world.gripper_rest_from_s():
                self.stop(ArmMode.REDUCED_SPEED.value)
            for t_s, mode in (
                (faults.emergency_stop_at_s, ArmMode.EMERGENCY_STOP),
                (faults.protective_stop_at_s, ArmMode.PROTECTIVE_STOP),
                (faults.safeguard_stop_at_s, ArmMode.SAFEGUARD_STOP),
            ):
                if self._came(t_s) and mode not in self._happened:
                    self._happened.add(mode)
                    self._controller_stop = mode
                    self.stop(mode.value)
                    self._world.halt(self._options.fault_stop_s)

    def _came(self, t_s: float | None) -> bool:
        return t_s is not None and t_s <= self._clock.now_s()

    def _lose(self, cause: str) -> None:
        """Fall silent; the controller's own watchdog stops the arm."""
        if self._connected and self._lost is None:
            self._world.halt(self._options.fault_stop_s)
        self._lost = self._lost or cause
        self._connected = False

    def _measurement_noise(self, index: np.ndarray) -> FloatArray:
        """(n, 3) noise of log samples `index`; the same sample always has the same noise."""
        blocks = index // _NOISE_BLOCK
        out = np.empty((len(index), 3))
        for block in np.unique(blocks):
            rng = np.random.default_rng([self._seed, int(block)])
            noise = rng.standard_normal((_NOISE_BLOCK, 3))
            here = blocks == block
            out[here] = noise[index[here] % _NOISE_BLOCK]
        o = self._options
        return out * (o.noise_m, o.noise_m, o.noise_rad)


_LOST_REMEDY = ArmMode.LOST.remedy
