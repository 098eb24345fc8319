"""What a person shows the camera of a simulated cell: the calibration board, a plumb line."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board import Board
from cell.cable.arrays import FloatArray
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


def plumb_line(x_m: float, y_m: tuple[float, float], angle_rad: float = 0.0) -> Patches:
    """A thread that hangs in the plane; `angle_rad` by which gravity departs from −y, to +x."""
    low, high = y_m
    way = np.array([np.sin(angle_rad), -np.cos(angle_rad)]) * (high - low)
    side = 2e-4 * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    along = np.array([x_m, high]) + np.linspace(0.0, 1.0, 41)[:, None] * way
    corners = np.stack(
        [along[:-1] - side, along[1:] - side, along[1:] + side, along[:-1] + side], 1
    )
    return Patches(corners, np.full(40, 20.0), np.ones(40))


def board_poses(
    board: Board, count: int, rng: np.random.Generator, middle_m: FloatArray, depth_m: float
) -> list[FloatArray]:
    """(4, 4) poses in which a person holds a board: about a place, tilted to all sides.

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
    """Picture of what is shown, without the gripper."""
    behind = backdrop(patches, eye, options)
    return render(None, None, eye, options, rng, behind=behind)
