"""Shows board and plumb line to the camera of a cell that is not real."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cell.settings import Settings
from cell.settings.calibrated import board_of
from cell.simulated.shown import board_patches, board_poses, plumb_line
from drivers.sim.camera import Staging

#: How far the board is moved towards the camera and back, m.
_DEPTH_M = 0.08
#: Places of the plumb line beside the picture's middle, in widths of the picture.
_ASIDE = 0.25


class SimulatedAssistant:
    """Shows to the camera of a cell that is not real; tells it by `stage`."""

    def __init__(
        self,
        settings: Settings,
        stage: Callable[[Staging], None],
        seed: int,
        views: int,
    ) -> None:
        hidden = settings.world.camera
        view = settings.camera.view
        rng = np.random.default_rng([seed, 77])
        scale, column, row = (
            (hidden.metres_per_pixel, hidden.origin_column_px, hidden.origin_row_px)
            if hidden is not None
            else (view.metres_per_pixel, view.origin_column_px, view.origin_row_px)
            if view is not None
            else (2e-4, 0.0, 0.0)
        )
        width, height = settings.camera.width_px, settings.camera.height_px
        middle_m = np.array([(0.5 * width - column) * scale, (row - 0.5 * height) * scale, 0.0])
        self._board = board_of(settings)
        self._poses = board_poses(self._board, views, rng, middle_m, _DEPTH_M)
        aside_m = _ASIDE * width * scale
        self._threads_m = [float(middle_m[0]) - aside_m, float(middle_m[0]) + aside_m]
        self._stage = stage

    def board(self, number: int, hint: str) -> None:
        """Hold the board up."""
        pose = self._poses[(number - 1) % len(self._poses)]
        self._stage(Staging((board_patches(self._board, pose),), jaw=False))

    def thread(self, number: int) -> bool:
        """Hang a thread in the plane."""
        self._stage(Staging((plumb_line(self._threads_m[number - 1], (-0.2, 0.1)),)))
        return True

    def cable(self) -> bool:
        """The world has a cable ready."""
        return True

    def clear(self) -> None:
        """Take everything away."""
        self._stage(Staging())
