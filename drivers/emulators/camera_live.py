"""The scene of an emulated cell: the jaw where the arm really is, and the cable in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from drivers.interfaces import FloatArray, Image, Path
from drivers.sim.camera import CameraTwinOptions, photograph
from drivers.sim.world import View

#: Poses and shapes older than this are forgotten.
_KEPT_S = 1.0


class PoseFeed(Protocol):
    """Poses of the gripping point as they are measured: where the emulated arm really is."""

    def __call__(self) -> Path | None:
        """Poses since the last call, times on the monotonic clock; None = fewer than two."""
        ...


class LiveCable(Protocol):
    """A cable that is moved along as the poses come."""

    def advance(self, grip: Path) -> FloatArray:
        """Shapes at the times of `grip`, which continues the one before; (T, K, 2) m, tip first.

        The first call begins with the cable in equilibrium at the first pose.
        """
        ...


#: Tells a `LiveScene` that a new cable is gripped from now on.
CableFactory = Callable[[], LiveCable]


class LiveScene:
    """The jaw where the poses say it is, and the cable that swings from it.

    Between the poses jaw and cable are interpolated by cubics; after the last known pose the last
    ones stand still.
    """

    def __init__(self, poses: PoseFeed, options: CameraTwinOptions, seed: int = 0) -> None:
        self._poses = poses
        self._options = options
        self._rng = np.random.default_rng(seed)
        self._cable: LiveCable | None = None
        self._t_s = np.empty(0)
        self._grip = np.empty((0, 3))
        self._shapes: FloatArray | None = None
        self._shapes_t_s = np.empty(0)

    def tell(self, message: object) -> None:
        """A `CableFactory` = gripped; None = let go.  Raises TypeError: anything else."""
        if message is not None and not callable(message):
            raise TypeError(f"{message!r} is neither a cable's factory nor None")
        self._cable = None if message is None else message()
        self._shapes, self._shapes_t_s = None, np.empty(0)

    def picture(self, t_s: float) -> Image:
        """Raises RuntimeError: no poses are known."""
        self._follow()
        if len(self._t_s) < 2:
            raise RuntimeError("no poses came: is the emulated arm running?")
        span_s = max(self._options.picture.exposure_s, 1e-4)
        moments_s = t_s + span_s * np.array([-0.5, 0.0, 0.5])
        grip = _cubic(self._t_s, self._grip, moments_s)
        cables = None
        if self._shapes is not None:
            cables = _cubic(self._shapes_t_s, self._shapes, moments_s)
        return photograph(View(moments_s, grip, cables), self._options, self._rng)

    def _follow(self) -> None:
        """Take in the new poses, and move the cable along."""
        new = self._poses()
        if new is None:
            return
        self._t_s = np.concatenate([self._t_s, new.t_s])
        grip = np.stack([new.x_m, new.y_m, new.angle_rad], axis=-1)
        self._grip = np.concatenate([self._grip, grip])
        keep = self._t_s > self._t_s[-1] - _KEPT_S
        self._t_s, self._grip = self._t_s[keep], self._grip[keep]
        if self._cable is not None:
            shapes = self._cable.advance(new)
            old = self._shapes if self._shapes is not None else shapes[:0]
            self._shapes = np.concatenate([old, shapes])
            self._shapes_t_s = np.concatenate([self._shapes_t_s, new.t_s])
            keep = self._shapes_t_s > self._shapes_t_s[-1] - _KEPT_S
            self._shapes, self._shapes_t_s = self._shapes[keep], self._shapes_t_s[keep]


def _cubic(t_s: FloatArray, values: FloatArray, at_s: FloatArray) -> FloatArray:
    """(S, …) values (T, …) at times (S,), by Lagrange cubics; held outside of t_s."""
    count = min(4, len(t_s))
    at_s = np.clip(at_s, t_s[0], t_s[-1])
    first = np.clip(np.searchsorted(t_s, at_s) - count // 2, 0, len(t_s) - count)
    nodes = first[:, None] + np.arange(count)
    times = t_s[nodes]
    weights = np.ones_like(times)
    for j in range(count):
        for k in range(count):
            if k != j:
                weights[:, j] *= (at_s - times[:, k]) / (times[:, j] - times[:, k])
    return np.asarray(np.einsum("sf,sf...->s...", weights, values[nodes]), dtype=np.float64)
