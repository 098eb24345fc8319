"""The calibration board as a PDF, to be printed."""

from __future__ import annotations

from pathlib import Path

from calib.board import Board
from calib.board_pdf import board_pdf
from cell.files.atomic import write_whole


def write_board(
    path: Path, columns: int, rows: int, square_m: float, *, dictionary: str, legacy: bool
) -> None:
    """Write a board of so many squares as a PDF to scale, with rulers to check the printout.

    dictionary  of OpenCV's markers
    legacy      whether its pattern is that before OpenCV 4.6
    raises      ValueError: such a board is impossible
    """
    board = Board(columns, rows, square_m, dictionary=dictionary, legacy=legacy)
    write_whole(path, board_pdf(board))
