"""A picture of where in the camera's field the board was seen so far, for whoever shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board import BoardView
from cell.files.atomic import write_whole

#: Told of all views so far and of the newest picture (H, W), grey levels.
Look = Callable[[Sequence[BoardView], NDArray[np.uint8]], None]

#: File in the folder of the calibration.
FILE = "coverage.jpg"
_WIDTH_PX = 960
_BEFORE, _NEWEST = (60, 220, 60), (60, 140, 255)


def coverage_picture(views: Sequence[BoardView], image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w, 3) picture, blue first: corners of all views, those in this picture in orange."""
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
    """Write the picture into the folder of the calibration; on a full disk the former one stays."""
    data = cv2.imencode(".jpg", coverage_picture(views, image))[1]
    with suppress(OSError):
        write_whole(folder / FILE, bytes(data))
