"""A camera with known truth, and what it sees of a board."""

from __future__ import annotations

import numpy as np
import pytest

from calib.board import Board, BoardView
from calib.lens import Lens
from cell.wiring.simulated_assistant import board_poses
from drivers.sim.pinhole import Pinhole

SIZE_PX = (1280, 1024)
BOARD = Board()


def standing(**changes) -> Pinhole:
    """A camera 0.52 m before the plane, 0.2 mm per pixel, tilted, with a barrel lens."""
    how = {"focal_px": 2600.0, "tilt_rad": 0.2, "distortion": (-0.25, 0.1, 3e-4, -3e-4, 0.0)}
    return Pinhole.standing(
        metres_per_pixel=2e-4, origin_px=(1000.0, 150.0), size_px=SIZE_PX, **(how | changes)
    )


def lens_of(eye: Pinhole) -> Lens:
    return Lens(eye.focal_px, eye.focal_px, *eye.centre_px, *eye.distortion)


def middle_m() -> np.ndarray:
    return np.array([(639.5 - 1000.0) * 2e-4, (150.0 - 511.5) * 2e-4, 0.0])


def views_of(eye, rng, *, count=16, noise_px=0.03, poses=None, square=1.0, board=BOARD):
    """Corners as the camera would see them, with noise, of a board printed `square` too large."""
    poses = board_poses(board, count, rng, middle_m(), 0.08) if poses is None else poses
    views = []
    for k, X in enumerate(poses):
        pixels = eye.to_pixels(square * board.corners_m @ X[:3, :3].T + X[:3, 3])
        pixels += rng.normal(0.0, noise_px, pixels.shape)
        seen = np.all((pixels > 5) & (pixels < np.array(SIZE_PX) - 6), axis=1)
        views.append(BoardView(f"{k:02d}.png", np.flatnonzero(seen), pixels[seen], SIZE_PX, 0.9))
    return views


@pytest.fixture
def eye() -> Pinhole:
    return standing()
