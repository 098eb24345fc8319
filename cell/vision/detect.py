"""One frame of the side camera → the nodes of the cable, or why there are none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from threading import local
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.vision.frame_nodes import Appearance, FrameMemory, FrameResult, frame_memory, frame_values
from cell.vision.marks import JawMarks, compiled_view, disc_marks
from cell.vision.ridge import GreyImage
from cell.vision.sighting import UNSEEN, Sighting
from cell.vision.trace import cable_appearance

Image = NDArray[np.uint8]

_OF_THREAD = local()


@dataclass(frozen=True)
class VisionOptions:
    """The appearance of cable and jaw, and what is measured of them.

    free_length_m        from the gripping point to the tip, as the cable was gripped
    length_tolerance_m   a measured length further off means that something else was followed
    nodes                at equal arc length, tip first
    cable_is             darker or lighter than what is behind it
    min_contrast         of the cable over three pixels, grey levels; less counts as no cable
    line_width_px        standard deviation of the cable's profile, blur included
    """

    free_length_m: float
    length_tolerance_m: float = 0.003
    nodes: int = 11
    cable_is: Literal["dark", "light"] = "dark"
    min_contrast: float = 5.0
    line_width_px: float = 1.0
    marks: JawMarks = field(default_factory=JawMarks)

    def __post_init__(self) -> None:
        if not self.free_length_m > 0.0:
            raise ValueError(f"vision.free_length_m = {self.free_length_m}: must be > 0")
        if self.nodes < 2:
            raise ValueError(f"vision.nodes = {self.nodes}: must be ≥ 2")


def detect(
    image: Image,
    t_s: float,
    view: PlaneView,
    options: VisionOptions,
    previous: Sighting | None = None,
) -> Sighting:
    """Find jaw and cable in one frame.

    image        (H, W) grey levels
    previous     that of the frame before: the jaw is looked for there first; only saves time
    returns      a sighting; `unseen` names the reason if there are no nodes.  Does not guess.
    raises       ValueError: the image is not (H, W) uint8
    """
    if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
        raise ValueError(f"image is {image.shape} {image.dtype}; needs (H, W) uint8")
    near = (np.nan, np.nan, np.nan)
    if previous is not None:
        x_m, y_m = previous.grip_m.tolist()
        near = (x_m, y_m, previous.clamp_angle_rad)
    picture = GreyImage.of(image, 1 if options.cable_is == "light" else -1)
    nodes_m = np.empty((options.nodes, 2))
    values = frame_values(
        picture,
        compiled_view(view),
        _appearance(options),
        _memory(image.shape, options),
        near,
        nodes_m,
    )
    found = FrameResult(*values)
    return Sighting(
        t_s,
        nodes_m,
        np.array([found.x_m, found.y_m]),
        found.angle_rad,
        found.quality,
        None if found.code < 0 else UNSEEN[found.code],
        found.length_m,
    )


def detect_all(
    frames: Iterable[tuple[float, Image]],
    view: PlaneView,
    options: VisionOptions,
) -> Iterator[Sighting]:
    """One sighting per (time, image), in order, each looked for around the one before."""
    previous: Sighting | None = None
    for t_s, image in frames:
        previous = detect(image, t_s, view, options, previous)
        yield previous


@lru_cache(maxsize=8)
def _appearance(options: VisionOptions) -> Appearance:
    return Appearance(
        disc_marks(options.marks),
        cable_appearance(options.min_contrast, options.line_width_px),
        float(options.free_length_m),
        float(options.length_tolerance_m),
    )


def _memory(shape: tuple[int, int], options: VisionOptions) -> FrameMemory:
    """Memory for pictures of one size, a thread's own."""
    if getattr(_OF_THREAD, "key", None) != (shape, options):
        _OF_THREAD.memory = frame_memory(shape, _appearance(options))
        _OF_THREAD.key = (shape, options)
    memory: FrameMemory = _OF_THREAD.memory
    return memory
