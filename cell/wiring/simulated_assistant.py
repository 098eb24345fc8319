"""Shows board and plumb line to the camera of a simulated or emulated cell."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board import Board
from cell.cable.arrays import FloatArray
from cell.settings import Settings
from cell.settings.calibrated import board_of
from drivers.sim.camera import Staging
from drivers.sim.pinhole import Pinhole
from drivers.sim.render import Patches, RenderOptions, backdrop, render

Image = NDArray[np.uint8]

_WHITE, _BLACK = 205.0, 22.0
_EDGE_PARTS = 4  # an edge is straight on the board, not in a distorted picture
_BORDER_SQUARES = 0.6  # paper around the pattern


def board_patches(board: Board, X_PB: FloatArray, warp_m: tuple[float, float] = (0, 0)) -> Patches:
    """The board at its (4, 4) pose X_PB in the plane; bowed by `warp_m` as in `CameraFit`."""
    width, height = board.size_m
    border = _BORDER_SQUARES * board.square_m
    paper = np.array(
        [[-border, -border], [width + border, -border],
         [width + border, height + border], [-border, height + border]]
    )  # fmt: skip
    flat = np.concatenate([paper[None], board.black_m()])
    parts = np.linspace(0.0, 1.0, _EDGE_PARTS, endpoint=False)[:, None]
    edges = np.roll(flat, -1, axis=1) - flat
    corners = (flat[:, :, None] + parts * edges[:, :, None]).reshape(len(flat), -1, 2)
    bow = 1.0 - (2.0 * corners / (width, height) - 1.0) ** 2
    solid = np.concatenate([corners, (bow @ np.array(warp_m))[..., None]], axis=2)
    levels = np.full(len(flat), _BLACK - _WHITE)
    levels[0] = _WHITE
    hides = np.zeros(len(flat))
    hides[0] = 1.0
    return Patches(solid @ X_PB[:3, :3].T + X_PB[:3, 3], levels, hides)


def plumb_line(x_m: float, y_m: tuple[float, float]) -> Patches:
    """A thread that hangs in the plane."""
    low, high = y_m
    way, side = np.array([0.0, low - high]), np.array([2e-4, 0.0])
    along = np.array([x_m, high]) + np.linspace(0.0, 1.0, 41)[:, None] * way
    corners = np.stack(
        [along[:-1] - side, along[1:] - side, along[1:] + side, along[:-1] + side], 1
    )
    return Patches(corners, np.full(40, 20.0), np.ones(40))


def board_poses(
    board: Board, count: int, rng: np.random.Generator, middle_m: FloatArray, depth_m: float
) -> list[FloatArray]:
    """(4, 4) poses of a board held by a person: around a point, tilted in all directions.

    depth_m  how far it is moved towards the camera and back
    """
    width, height = board.size_m
    poses = []
    for k in range(count):
        around = 2.0 * np.pi * (k + rng.uniform(0.0, 0.5)) / count * 3.0
        tilt = rng.uniform(0.15, 0.6)
        axis = tilt * np.array([np.cos(around), np.sin(around), 0.0])
        turn = cv2.Rodrigues(axis)[0] @ cv2.Rodrigues(np.array([0.0, 0.0, rng.normal(0, 0.15)]))[0]
        X = np.eye(4)
        X[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0])
        shift = np.array([*rng.uniform(-0.04, 0.04, 2), rng.uniform(-1.0, 1.0) * depth_m])
        X[:3, 3] = middle_m + shift - X[:3, :3] @ [width / 2, height / 2, 0.0]
        poses.append(X)
    return poses


def photograph_board(
    eye: Pinhole,
    patches: Sequence[Patches],
    options: RenderOptions,
    rng: np.random.Generator,
) -> Image:
    """Picture of the patches, without the gripper."""
    behind = backdrop(patches, eye, options)
    return render(None, None, eye, options, rng, behind=behind)


#: How far the board is moved towards the camera and back, m.
_DEPTH_M = 0.08
#: Offsets of the plumb line from the picture's middle, in widths of the picture.
_ASIDE = 0.25


class SimulatedAssistant:
    """Assistant of a simulated cell: shows board and plumb line to its camera by `stage`."""

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
        """Remove all objects."""
        self._stage(Staging())
