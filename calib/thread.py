"""Detects a plumb line: the difference between pictures with it and without it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.errors import TooFewError
from drivers.interfaces import FloatArray

Image = NDArray[np.uint8]

_HALF_PX = 6
_LEAST_ROWS = 60


def find_thread(image: Image, without: Image) -> FloatArray:
    """(N, 2) pixels along a thread that is darker or lighter than its background.

    raises  TooFewError: no thread of some length
    """
    change = np.abs(image.astype(np.float64) - without)
    change -= np.median(change, axis=1, keepdims=True)
    noise = 1.4826 * np.median(np.abs(change))
    points = []
    for row, line in enumerate(change):
        peak = int(np.argmax(line))
        if line[peak] < 10.0 * max(noise, 1.0) or not _HALF_PX <= peak < len(line) - _HALF_PX:
            continue
        part = np.maximum(line[peak - _HALF_PX : peak + _HALF_PX + 1] - 4.0 * noise, 0.0)
        offset = float(part @ np.arange(-_HALF_PX, _HALF_PX + 1) / part.sum())
        points.append((peak + offset, float(row)))
    pixels = np.array(points).reshape(-1, 2)
    if len(pixels) >= _LEAST_ROWS:
        for _ in range(3):  # without points off a nearly straight line
            bend = np.polyfit(pixels[:, 1], pixels[:, 0], 2)
            off = np.abs(pixels[:, 0] - np.polyval(bend, pixels[:, 1]))
            pixels = pixels[off < max(0.5, 3.0 * 1.4826 * float(np.median(off)))]
    if len(pixels) < _LEAST_ROWS:
        raise TooFewError(
            f"the thread was found in {len(pixels)} of at least {_LEAST_ROWS} rows of the picture",
            "hang it before something of another brightness, and let it come to rest",
        )
    return pixels
