"""Simulated world that the twins share: arm, gripper and cable move, the camera sees them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.interfaces import FloatArray, Pose, Trajectory
from drivers.sim.clock import SimClock

#: Fewest points of a polyline that still looks like a cable at 5 px/mm.
MIN_POINTS = 60


class CableShape(Protocol):
    """Interface of the physics of a cable in the simulated world."""

    def __call__(self, grip: Trajectory, query_s: FloatArray) -> FloatArray:
        """Shapes of the cable while its gripping point moves along `grip`.

        grip     poses since it was gripped, times on the cell's clock; the cable is in
                 equilibrium at the first pose
        query_s  (Q,) increasing times within `grip.t_s[0]..grip.t_s[-1]`
        returns  (Q, K, 2) x, y in m; K ≥ 60 points, tip first, the gripping point last
        """
        ...


@dataclass(frozen=True)
class SimView:
    """Visible poses and cables at some moments.

    t_s     (S,) moments, s
    grip    (S, 3) x, y, angle of the gripping point: m, m, rad
    cables  (S, K, 2) the cable between the jaws, m, tip first; None = nothing there
    """

    t_s: FloatArray
    grip: FloatArray
    cables: FloatArray | None


@dataclass
class _Held:
    """A cable between the jaws, and its shapes on an even grid of times from `since_s` on."""

    shape: CableShape
    since_s: float
    grid: FloatArray | None = None
    slid_s: float = np.inf
    slid_m: float = 0.0
    lost_s: float = np.inf


class SimWorld:
    """Simulated cell: one hand, the cables waiting for it, and the one that it holds.

    The cable is simulated ahead, once per motion, and stored on a grid of times; a change of
    the committed motion drops the affected part of the grid.

    clock    simulated time
    home     pose of the gripping point at the start
    grid_hz  rate of the stored shapes; between them the view interpolates with cubics
    ahead_s  how far beyond the last committed motion a simulation looks
    """

    def __init__(
        self, clock: SimClock, home: Pose, grid_hz: float = 1000.0, ahead_s: float = 1.5
    ) -> None:
        self.clock = clock
        self.lock = threading.RLock()
        self._hand = GripperTrajectory(clock.now_s(), home)
        self._grid_hz = grid_hz
        self._ahead_s = ahead_s
        self._waiting: deque[CableShape] = deque()
        self._further: Iterator[CableShape] = iter(())
        self._held: _Held | None = None
        self._last: tuple[_Held, float] | None = None  # the cable let go last, and when

    # --- the arm ------------------------------------------------------------------------------

    def gripper_pose(self) -> Pose:
        """True pose of the gripping point now."""
        return self._hand.pose(self.clock.now_s())

    def gripper_velocity(self) -> FloatArray:
        """(3,) true velocity of the gripping point now, m/s, m/s, rad/s."""
        return self._hand.velocity(self.clock.now_s())

    def gripper_rest_from_s(self) -> float:
        """Time from which the gripper is committed to rest."""
        return self._hand.rests_from_s

    def gripper_at(self, t_s: FloatArray) -> FloatArray:
        """(n,) times → (n, 3) true x, y, angle."""
        return self._hand.at(t_s)

    def commit(self, path: Trajectory) -> None:
        """Let the gripper move along `path`: absolute times from now on, from where it rests."""
        with self.lock:
            self._forget_after(float(path.t_s[0]))
            self._hand.extend(path)

    def recommit(self, path: Trajectory) -> None:
        """Let the gripper move along `path` from now on, which it has followed so far."""
        with self.lock:
            now_s = self.clock.now_s()
            self._forget_after(now_s)
            self._hand.replace(now_s, path)

    def halt(self, duration_s: float) -> None:
        """Bring the gripper to rest within `duration_s` from now."""
        with self.lock:
            now_s = self.clock.now_s()
            self._forget_after(now_s)
            self._hand.halt(now_s, duration_s)

    # --- the gripper --------------------------------------------------------------------------

    def present(self, cable: CableShape) -> None:
        """Lay out a cable; `take` takes them in the order in which they were laid out."""
        with self.lock:
            self._waiting.append(cable)

    def supply(self, cables: Iterator[CableShape]) -> None:
        """Set the source of further cables after those laid out."""
        with self.lock:
            self._further = cables

    @property
    def waiting(self) -> int:
        """Number of cables laid out."""
        return len(self._waiting)

    @property
    def holds(self) -> bool:
        """Whether a cable is between the jaws now."""
        return self._held is not None and self.clock.now_s() < self._held.lost_s

    def take(self) -> bool:
        """Close the jaws on the next cable laid out; False if there is none."""
        with self.lock:
            self.drop()
            shape = self._waiting.popleft() if self._waiting else next(self._further, None)
            if shape is None:
                return False
            self._held = _Held(shape, self.clock.now_s())
            return True

    def drop(self) -> None:
        """Open the jaws."""
        with self.lock:
            if self._held is not None:
                self._last = (self._held, min(self.clock.now_s(), self._held.lost_s))
                self._held = None

    def lose(self) -> None:
        """Let the held cable fall out of the closed jaws."""
        with self.lock:
            if self._held is not None:
                self._held.lost_s = min(self._held.lost_s, self.clock.now_s())

    def slide(self, length_m: float) -> None:
        """Pull the held cable `length_m` out of the jaws, keeping its shape."""
        with self.lock:
            if self._held is not None:
                self._held.slid_s = self.clock.now_s()
                self._held.slid_m = length_m

    # --- the camera ---------------------------------------------------------------------------

    def cable_shapes(self, t_s: FloatArray) -> SimView:
        """The scene at past times (S,), increasing.

        Raises ValueError: a moment lies in the future; the cable's callable gave wrong shapes.
        """
        with self.lock:
            if t_s[-1] > self.clock.now_s() + 1e-9:
                raise ValueError(
                    f"looked at t = {t_s[-1]:.6f} s, but it is only {self.clock.now_s():.6f} s"
                )
            grip = self._hand.at(t_s)
            held = self._held_at(float(t_s[0]), float(t_s[-1]))
            return SimView(t_s, grip, None if held is None else self._shapes(held, t_s, grip))

    def _held_at(self, first_s: float, last_s: float) -> _Held | None:
        present = None if self._held is None else (self._held, self._held.lost_s)
        for candidate in (present, self._last):
            if candidate is not None:
                held, until_s = candidate
                if held.since_s <= first_s and last_s < until_s:
                    return held
        return None

    def _shapes(self, held: _Held, t_s: FloatArray, grip: FloatArray) -> FloatArray:
        position = (t_s - held.since_s) * self._grid_hz
        grid = held.grid
        if grid is None or position[-1] > len(grid) - 3:
            grid = self._simulate(held, float(t_s[-1]))
        first = np.clip(np.floor(position).astype(int) - 1, 0, len(grid) - 4)
        shapes = _cubic(grid, first, position - first)
        slid = np.where(t_s >= held.slid_s, held.slid_m, 0.0)
        if np.any(slid > 0.0):
            out = -np.stack([np.cos(grip[:, 2]), np.sin(grip[:, 2])], axis=-1)
            moved = shapes + slid[:, None, None] * out[:, None, :]
            shapes = np.concatenate([moved, grip[:, None, :2]], axis=1)
        return shapes

    def _simulate(self, held: _Held, t_s: float) -> FloatArray:
        """Extend the grid of `held` beyond the committed motion and beyond `t_s`."""
        known = 0 if held.grid is None else len(held.grid)
        end_s = max(self._hand.rests_from_s, self.clock.now_s(), t_s) + self._ahead_s
        count = int(np.ceil((end_s - held.since_s) * self._grid_hz)) + 1
        query_s = held.since_s + np.arange(known, count) / self._grid_hz
        new = np.asarray(
            held.shape(self._hand.motion(held.since_s, float(query_s[-1])), query_s),
            dtype=np.float64,
        )
        wanted = new.ndim == 3 and (new.shape[0], new.shape[2]) == (len(query_s), 2)
        if not wanted or new.shape[1] < MIN_POINTS:
            raise ValueError(
                f"the cable's callable returned shape {new.shape} for {len(query_s)} times; "
                f"needed ({len(query_s)}, K >= {MIN_POINTS}, 2)"
            )
        held.grid = new if held.grid is None else np.concatenate([held.grid, new])
        return held.grid

    def _forget_after(self, t_s: float) -> None:
        if self._held is not None and self._held.grid is not None:
            known = int(np.floor((t_s - self._held.since_s) * self._grid_hz)) + 1
            self._held.grid = self._held.grid[:known] if known > 0 else None


def _cubic(grid: FloatArray, first: np.ndarray, u: FloatArray) -> FloatArray:
    """Lagrange cubic through grid[first..first+3] at positions `u` (S,) counted from `first`."""
    weights = np.stack(
        [
            -(u - 1) * (u - 2) * (u - 3) / 6,
            u * (u - 2) * (u - 3) / 2,
            -u * (u - 1) * (u - 3) / 2,
            u * (u - 1) * (u - 2) / 6,
        ],
        axis=-1,
    )
    nodes = grid[first[:, None] + np.arange(4)]
    return np.asarray(np.einsum("sf,sfkc->skc", weights, nodes), dtype=np.float64)


class GripperTrajectory:
    """Poses at increasing times, linear between, held after the last; can be cut and extended."""

    def __init__(self, t_s: float, pose: Pose) -> None:
        self._t_s = np.array([t_s])
        self._poses = np.array([[pose.x_m, pose.y_m, pose.angle_rad]])

    @property
    def rests_from_s(self) -> float:
        """Time from which the gripper is committed to rest."""
        return float(self._t_s[-1])

    def at(self, t_s: FloatArray) -> FloatArray:
        """(n,) times → (n, 3) x, y, angle."""
        return np.stack([np.interp(t_s, self._t_s, p) for p in self._poses.T], axis=-1)

    def pose(self, t_s: float) -> Pose:
        """Pose at a time."""
        x, y, angle = self.at(np.array([t_s]))[0]
        return Pose(float(x), float(y), float(angle))

    def velocity(self, t_s: float, span_s: float = 0.002) -> FloatArray:
        """(3,) mean velocity over the `span_s` before a time, m/s, m/s, rad/s."""
        before, now = self.at(np.array([t_s - span_s, t_s]))
        return np.asarray((now - before) / span_s, dtype=np.float64)

    def extend(self, path: Trajectory) -> None:
        """Commit to `path` (absolute times, beginning where the gripper rests)."""
        resting = path.t_s[0] > self._t_s[-1]
        hold_t = [path.t_s[0]] if resting else []
        hold_p = self._poses[-1:] if resting else self._poses[:0]
        self._t_s = np.concatenate([self._t_s, hold_t, path.t_s[1:]])
        poses = np.stack([path.x_m, path.y_m, path.angle_rad], axis=-1)[1:]
        self._poses = np.concatenate([self._poses, hold_p, poses])

    def replace(self, t_s: float, path: Trajectory) -> None:
        """Replace the committed motion after `t_s` by `path`, in absolute times."""
        here = self.at(np.array([t_s]))
        keep, later = self._t_s < t_s, path.t_s > t_s
        poses = np.stack([path.x_m, path.y_m, path.angle_rad], axis=-1)[later]
        self._t_s = np.concatenate([self._t_s[keep], [t_s], path.t_s[later]])
        self._poses = np.concatenate([self._poses[keep], here, poses])

    def halt(self, t_s: float, duration_s: float) -> None:
        """Drop the committed motion after `t_s` and come to rest within `duration_s`.

        Never later than it was committed to rest anyway.  Speed falls as half a cosine, so the
        way is half of speed times duration.
        """
        duration_s = min(duration_s, self.rests_from_s - t_s)
        if duration_s <= 1e-6:
            return
        speed = self.velocity(t_s)
        start = self.at(np.array([t_s]))
        keep = self._t_s < t_s
        after_s = np.linspace(0.0, duration_s, max(2, round(duration_s * 1000.0) + 1))
        phase = np.pi * after_s / duration_s
        way_s = 0.5 * (after_s + duration_s / np.pi * np.sin(phase))
        self._t_s = np.concatenate([self._t_s[keep], t_s + after_s])
        self._poses = np.concatenate([self._poses[keep], start + way_s[:, None] * speed])

    def motion(self, start_s: float, end_s: float) -> Trajectory:
        """Poses from `start_s` to `end_s`, at both ends and at every sample between."""
        inside = self._t_s[(self._t_s > start_s) & (self._t_s < end_s)]
        t_s = np.concatenate([[start_s], inside, [end_s]])
        x, y, angle = self.at(t_s).T
        return Trajectory(t_s, x, y, angle)
