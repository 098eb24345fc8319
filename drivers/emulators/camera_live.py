"""The scene of an emulated cell: the jaw where the arm really is, and the cable in it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from drivers.emulators.camera_poses import RtdePoses
from drivers.interfaces import FloatArray, Image, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.sim.camera import CameraTwinOptions, Staging, photograph
from drivers.sim.render import LightArray
from drivers.sim.world import SimView
from drivers.ur_kinematics import MODELS
from drivers.ur_pose import matrix_of

_HISTORY_S = 0.4  # older poses and shapes are dropped; no older pictures are rendered
_FIRST_POSE_S = 5.0
_PORTION_S = 0.05  # longest motion per simulation call of a cable
_PATIENCE_S = 0.03  # longer than any pose is under way


class PoseFeed(Protocol):
    """Source of the measured poses of an emulated arm's gripping point."""

    def __call__(self) -> Trajectory | None:
        """Poses since the last call, times on the monotonic clock, at least one; None = none."""
        ...


class LiveCable(Protocol):
    """Cable that is simulated step by step as poses arrive; it keeps its own state."""

    def advance(self, grip: Trajectory) -> FloatArray:
        """Shapes at the times of `grip`, which continues the one before; (T, K, 2) m, tip first.

        The first call begins with the cable in equilibrium at the first pose.  A call has about
        10 ms of poses and must take less than 2 ms.
        """
        ...


@dataclass(frozen=True)
class ArmScene:
    """Makes a `LiveScene` in front of an emulated arm; picklable.

    host, mount, model, tcp  as of the arm's driver
    camera                   true pose of the camera, and appearance of its pictures
    """

    host: str
    mount: PlaneMount
    model: str = "UR5e"
    tcp: tuple[float, ...] = (0.0,) * 6
    camera: CameraTwinOptions = field(kw_only=True)
    seed: int = 0

    def __call__(self) -> LiveScene:
        """Raises RuntimeError: the emulated arm does not run."""
        X_FT = matrix_of(np.array(self.tcp))
        scene = LiveScene(
            RtdePoses(self.host, self.mount, MODELS[self.model], X_FT), self.camera, self.seed
        )
        scene.wait_for_pose(_FIRST_POSE_S)
        return scene


class LiveScene:
    """The jaw where the poses say it is, and the cable that swings from it.

    Between the poses jaw and cable are interpolated by cubics; after the last known pose they
    stand still.
    """

    def __init__(self, poses: PoseFeed, camera: CameraTwinOptions, seed: int = 0) -> None:
        self._poses = poses
        self._camera = camera
        self._rng = np.random.default_rng(seed)
        self._cable: LiveCable | None = None
        self._staging = Staging()
        self._behind: LightArray | None = None
        self._grip = _Track()
        self._shape = _Track()
        self._new_s, self._new = np.empty(0), np.empty((0, 3))  # poses new to the cable

    def wait_for_pose(self, longest_s: float) -> None:
        """Wait until it is known where the arm is.  Raises RuntimeError: not in time."""
        until_s = time.monotonic() + longest_s
        while self._grip.empty:
            if time.monotonic() > until_s:
                raise RuntimeError(f"no pose came within {longest_s} s: does the arm run?")
            time.sleep(0.005)
            self.keep_up()

    def notify(self, message: object) -> None:
        """A factory of a `LiveCable` = gripped; None = let go; a `Staging` = shown from now on.

        raises  TypeError: anything else
        """
        if isinstance(message, Staging):
            self._staging, self._behind = message, message.light(self._camera)
            return
        if message is not None and not callable(message):
            raise TypeError(f"{message!r} is neither a cable's factory nor None")
        self._swing()  # the motion so far is not the new cable's
        self._cable = None if message is None else message()
        self._shape = _Track()

    def picture(self, t_s: float) -> Image:
        """Waits a little for the pose at that time, unless none has come for longer.

        Raises RuntimeError: no pose is known.
        """
        self.keep_up()
        if self._grip.empty:
            raise RuntimeError("no pose is known")
        while t_s - _PATIENCE_S < self._grip.end_s < t_s:
            if time.monotonic() > t_s + _PATIENCE_S:
                break
            time.sleep(0.001)
            self.keep_up()
        self._swing()
        span_s = max(self._camera.picture.exposure_s, 1e-4)
        moments_s = t_s + span_s * np.array([-0.5, 0.0, 0.5])
        cables = None if self._shape.empty else self._shape.at(moments_s)
        return photograph(
            SimView(moments_s, self._grip.at(moments_s), cables),
            self._camera,
            self._rng,
            jaw=self._staging.jaw,
            behind=self._behind,
        )

    def keep_up(self) -> None:
        """Take in the new poses; move the cable along while no picture is taken."""
        new = self._poses()
        if new is None:
            return
        poses = np.stack([new.x_m, new.y_m, new.angle_rad], axis=-1)
        self._grip.add(new.t_s, poses)
        self._new_s = np.concatenate([self._new_s, new.t_s])
        self._new = np.concatenate([self._new, poses])
        if self._new_s[-1] - self._new_s[0] > _PORTION_S:
            self._swing()

    def _swing(self) -> None:
        """Move the cable along with the poses that are new to it; each call has its price."""
        t_s, poses = self._new_s, self._new
        self._new_s, self._new = np.empty(0), np.empty((0, 3))
        if self._cable is not None and len(t_s) > 0:
            self._shape.add(t_s, self._cable.advance(Trajectory(t_s, *poses.T)))


class _Track:
    """Values of the last second against time."""

    def __init__(self) -> None:
        self._t_s = np.empty(0)
        self._values = np.empty(0)

    @property
    def empty(self) -> bool:
        return len(self._t_s) == 0

    @property
    def end_s(self) -> float:
        """Time of the last."""
        return float(self._t_s[-1])

    def add(self, t_s: FloatArray, values: FloatArray) -> None:
        """(T,) increasing times after all others, (T, …) values."""
        if not self.empty:
            t_s = np.concatenate([self._t_s, t_s])
            values = np.concatenate([self._values, values])
        keep = t_s > t_s[-1] - _HISTORY_S
        self._t_s, self._values = t_s[keep], values[keep]

    def at(self, t_s: FloatArray) -> FloatArray:
        """(S, …) values at times (S,), by Lagrange cubics; held outside."""
        count = min(4, len(self._t_s))
        t_s = np.clip(t_s, self._t_s[0], self._t_s[-1])
        first = np.searchsorted(self._t_s, t_s) - count // 2
        nodes = np.clip(first, 0, len(self._t_s) - count)[:, None] + np.arange(count)
        times_s = self._t_s[nodes]
        # factor k of node j's polynomial is (t − tₖ) / (tⱼ − tₖ), and 1 for k = j
        self_s = np.eye(count)
        apart_s = times_s[:, :, None] - times_s[:, None, :] + self_s
        factors = np.where(self_s, 1.0, (t_s[:, None] - times_s)[:, None, :]) / apart_s
        weights = factors.prod(axis=2)
        return np.asarray(np.einsum("sf,sf...->s...", weights, self._values[nodes]))
