"""What is asked of a camera is checked alike for all of them, before one is opened."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from drivers.genicam_camera import GenicamOptions
from drivers.opencv_camera import OpenCvOptions


@pytest.mark.parametrize("options", [OpenCvOptions, partial(GenicamOptions, Path("maker.cti"))])
@pytest.mark.parametrize("name", ["width_px", "height_px", "frame_rate_hz", "exposure_s"])
def test_what_no_camera_can_do_is_refused_by_name(
    options: Callable[..., object], name: str
) -> None:
    for value in (0, -1, float("nan")):
        with pytest.raises(ValueError, match=rf"camera\.{name} = {value}: must be > 0"):
            options(**{name: value})
    options(exposure_s=None)
