"""What an emulated camera sees: a function of time, made in the camera's own process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.interfaces import Image


class Scene(Protocol):
    """What is in front of the camera.  Lives in the camera's process; one thread uses it."""

    def picture(self, t_s: float) -> Image:
        """(H, W) picture with the middle of its exposure at `t_s` of the monotonic clock, a few
        milliseconds ago.
        """
        ...

    def keep_up(self) -> None:
        """Called many times a second, whether or not anybody looks."""
        ...

    def tell(self, message: object) -> None:
        """Something that the parent process says, e.g. that a cable was gripped."""
        ...


#: Makes a scene in the camera's process: a picklable callable.
SceneFactory = Callable[[], Scene]


@dataclass(frozen=True)
class TestCard:
    """A scene without anything: a ramp that moves by one grey level each period, so that every
    picture tells its number, modulo 256.
    """

    __test__ = False  # not a test, whatever its name

    width_px: int
    height_px: int
    rate_hz: float

    def __call__(self) -> TestCard:
        """Its own factory."""
        return self

    def picture(self, t_s: float) -> Image:
        """Grey level = column + row + number of the period."""
        columns = np.arange(self.width_px, dtype=np.int64)[None, :]
        rows = np.arange(self.height_px, dtype=np.int64)[:, None]
        shift = round(t_s * self.rate_hz) % 256
        image: Image = ((columns + shift).astype(np.uint8) + rows.astype(np.uint8)).astype(np.uint8)
        return image

    def keep_up(self) -> None:
        """Nothing happens to a test card."""

    def tell(self, message: object) -> None:
        """Nothing can be told to a test card."""
