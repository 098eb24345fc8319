"""The board: its PDF keeps the scale, it is found where it is, and wrong ones are named."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib.board import Board, board_pdf, find_board
from calib.errors import WrongBoardError
from cell.wiring.simulated_assistant import board_patches, photograph_board
from drivers.sim.render import RenderOptions
from tests.calib.conftest import BOARD, lens_of, middle_m


def shown(eye, board=BOARD, tilt=0.3, **look):
    X = np.eye(4)
    X[:3, :3] = cv2.Rodrigues(np.array([tilt, 0.1, 0.0]))[0] @ np.diag([1.0, -1.0, -1.0])
    X[:3, 3] = middle_m() - X[:3, :3] @ [*(0.5 * np.array(board.size_m)), 0.0]
    options = RenderOptions(**look)
    image = photograph_board(eye, [board_patches(board, X)], options, np.random.default_rng(0))
    return image, X


@pytest.mark.parametrize("legacy", [False, True])
def test_corners_are_found_where_they_are(eye, legacy):
    board = Board(11, 8, legacy=legacy)
    image, X = shown(eye, board)
    view = find_board(image, board, lens=lens_of(eye))
    assert len(view.ids) > 60
    true = eye.to_pixels(board.corners_m[view.ids] @ X[:3, :3].T + X[:3, 3])
    off = np.linalg.norm(view.pixels - true, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.06
    assert view.blur_px == pytest.approx(0.8, abs=0.3)


def test_a_blurred_picture_says_so(eye):
    image, _ = shown(eye, lens_blur_px=3.0)
    view = find_board(image, BOARD)
    assert view.blur_px == pytest.approx(3.0, rel=0.3)


def test_the_pdf_is_to_scale_and_shows_the_board():
    """Its rectangles, drawn at 10 pixels per mm, are the board that OpenCV finds."""
    pdf = board_pdf(BOARD).decode("ascii")
    boxes = np.array(re.findall(r"^([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re f$", pdf, re.M), float)
    mm = boxes / 72.0 * 25.4
    page = np.array(re.search(r"MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf).groups(), float)
    page_mm = page / 72.0 * 25.4
    image = np.full(np.ceil(10 * page_mm[::-1]).astype(int), 255, np.uint8)
    for x, y, w, h in mm:
        rows = np.rint(10 * np.array([page_mm[1] - y - h, page_mm[1] - y])).astype(int)
        columns = np.rint(10 * np.array([x, x + w])).astype(int)
        image[slice(*rows), slice(*columns)] = 0
    view = find_board(image, BOARD)
    assert len(view.ids) == len(BOARD.corners_m)
    far = np.linalg.norm(view.pixels[0] - view.pixels[-1])
    assert far / 10.0 == pytest.approx(
        1e3 * np.linalg.norm(BOARD.corners_m[0] - BOARD.corners_m[-1]), abs=0.05
    )
    assert int(re.search(r"startxref\n(\d+)", pdf).group(1)) == pdf.index("xref\n0 5")
    ruler_mm = [float(v) / 72.0 * 25.4 for v in re.findall(r"w ([\d.]+) [\d.]+ m", pdf)]
    assert max(np.diff(sorted(ruler_mm[:25]))) == pytest.approx(10.0, abs=0.01)


def test_wrong_boards_are_named(eye):
    image, _ = shown(eye)
    with pytest.raises(WrongBoardError, match="mirrored"):
        find_board(image[:, ::-1].copy(), BOARD)
    with pytest.raises(WrongBoardError, match="dictionary 4X4_50, not 5X5_100"):
        find_board(image, replace(BOARD, dictionary="5X5_100"))
    even = Board(11, 8)
    with pytest.raises(WrongBoardError, match="legacy"):
        find_board(shown(eye, even)[0], replace(even, legacy=True))


def test_no_board_is_none(eye):
    options = RenderOptions()
    assert find_board(photograph_board(eye, [], options, np.random.default_rng(0)), BOARD) is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"dictionary": "9X9"}, "must be one of"),
        ({"columns": 2}, "at least 3"),
        ({"square_m": 0.0}, "must be > 0"),
        ({"columns": 30, "rows": 20}, "take a larger dictionary"),
    ],
)
def test_impossible_boards_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Board(**values)
