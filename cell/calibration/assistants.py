"""Assistants that show board, plumb line and cable to the camera: a person, or a simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board import BoardView
from calib.errors import CalibrationError
from cell.files.atomic import write_atomic

#: Views of the board.
BOARD_VIEWS = 20
#: Places of the plumb line.  One picture determines only the plane of the line and the camera; two
#: such planes intersect along gravity.
THREADS = 2

_HANG = (
    "hang a thread with a weight where the cable swings, let it come to rest, Enter; "
    "or n, if there is none: the robot's base is then taken to be level to 0.2°",
    "hang it at another place, a third of the picture's width or more away from the first, let it "
    "come to rest, Enter; or n, if it cannot be: roll then depends on how level the base stands",
)
_HOLD = (
    "hold a cable between the open jaws as it is presented in a cycle, Enter: they close; "
    "or n, if there is none: gripping point, clamp angle and length are then as typed"
)


class Assistant(Protocol):
    """Interface of an assistant, who shows the board and the plumb line to the camera."""

    def board(self, number: int, hint: str) -> None:
        """The board as the `number`-th view, from 1; `hint`: where corners are lacking."""
        ...

    def thread(self, number: int) -> bool:
        """A plumb line in the cell's plane, at the `number`-th place; False = there is none."""
        ...

    def cable(self) -> bool:
        """A cable between the open jaws, as in a cycle; False = there is none."""
        ...

    def clear(self) -> None:
        """Nothing but the cell itself."""
        ...


@dataclass(frozen=True)
class Operator:
    """Assistant who is a person at a terminal: shows on request what the camera needs.

    ask     shows a text and waits; returns the typed answer; raises EOFError: nobody is there
    raises  CalibrationError from every question: nobody is there
    """

    ask: Callable[[str], str]

    def board(self, number: int, hint: str) -> None:
        """Ask for the board."""
        self._prompt(f"view {number} of {BOARD_VIEWS}: show the board{hint}; hold it still, Enter")

    def thread(self, number: int) -> bool:
        """Ask for a plumb line."""
        typed = self._prompt(_HANG[min(number, len(_HANG)) - 1])
        return not typed.strip().lower().startswith("n")

    def cable(self) -> bool:
        """Ask for a cable."""
        return not self._prompt(_HOLD).strip().lower().startswith("n")

    def clear(self) -> None:
        """Ask for an empty scene."""
        self._prompt("take board and thread away, keep people out: the robot will move; Enter")

    def _prompt(self, words: str) -> str:
        try:
            return self.ask(words)
        except EOFError as error:
            raise CalibrationError(
                f"somebody must act: {words}", "run it at a terminal, or with --from a folder"
            ) from error


#: Callback with all views so far and the newest picture (H, W), grey levels.
OnCoverage = Callable[[Sequence[BoardView], NDArray[np.uint8]], None]

#: File in the folder of the calibration.
FILE = "coverage.jpg"
_WIDTH_PX = 960
_BEFORE, _NEWEST = (60, 220, 60), (60, 140, 255)


def coverage_picture(views: Sequence[BoardView], image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w, 3) BGR picture: corners of all views, those in this picture in orange."""
    scale = min(1.0, _WIDTH_PX / image.shape[1])
    size = (round(scale * image.shape[1]), round(scale * image.shape[0]))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    picture = np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), np.uint8)
    for number, view in enumerate(views):
        colour = _NEWEST if number == len(views) - 1 else _BEFORE
        for u, v in np.rint(view.pixels * scale).astype(int).tolist():
            cv2.circle(picture, (u, v), 3, colour, -1, cv2.LINE_AA)
    return picture


def write_coverage(folder: Path, views: Sequence[BoardView], image: NDArray[np.uint8]) -> None:
    """Write the coverage picture into the calibration's folder; a full disk keeps the old one."""
    data = cv2.imencode(".jpg", coverage_picture(views, image))[1]
    with suppress(OSError):
        write_atomic(folder / FILE, bytes(data))
