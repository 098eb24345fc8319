"""True pose of the gripping point against simulated time: what was, and what is committed."""

from __future__ import annotations

import numpy as np

from drivers.interfaces import FloatArray, Pose, Trajectory


class Hand:
    """Poses at increasing times, linear between, held after the last; can be cut and extended."""

    def __init__(self, t_s: float, pose: Pose) -> None:
        self._t_s = np.array([t_s])
        self._poses = np.array([[pose.x_m, pose.y_m, pose.angle_rad]])

    @property
    def rests_from_s(self) -> float:
        """Time from which the hand is committed to rest."""
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
        """Commit to `path` (absolute times, beginning where the hand rests)."""
        resting = path.t_s[0] > self._t_s[-1]
        hold_t = [path.t_s[0]] if resting else []
        hold_p = self._poses[-1:] if resting else self._poses[:0]
        self._t_s = np.concatenate([self._t_s, hold_t, path.t_s[1:]])
        poses = np.stack([path.x_m, path.y_m, path.angle_rad], axis=-1)[1:]
        self._poses = np.concatenate([self._poses, hold_p, poses])

    def replace(self, t_s: float, path: Trajectory) -> None:
        """Give up what is committed after `t_s` for what `path`, absolute times, says of it."""
        here = self.at(np.array([t_s]))
        keep, later = self._t_s < t_s, path.t_s > t_s
        poses = np.stack([path.x_m, path.y_m, path.angle_rad], axis=-1)[later]
        self._t_s = np.concatenate([self._t_s[keep], [t_s], path.t_s[later]])
        self._poses = np.concatenate([self._poses[keep], here, poses])

    def halt(self, t_s: float, duration_s: float) -> None:
        """Give up what is committed after `t_s` and come to rest within `duration_s`.

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
