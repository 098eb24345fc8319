"""One frame of the side camera → the nodes of the cable, or why there are none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.vision.curve import arc_lengths
from cell.vision.marks import JawMarks, JawPose, find_jaw, pixels_per_metre
from cell.vision.ridge import Picture
from cell.vision.sighting import Sighting, Unseen
from cell.vision.trace import another_line, trace_cable

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

_DENSE = 401  # points along the cable, 0.25 mm apart


@dataclass(frozen=True)
class VisionOptions:
    """What the cable and the jaw look like.

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
    background: Image | None = None,
    previous: Sighting | None = None,
) -> Sighting:
    """What one frame says of the cable.

    image        (H, W) grey levels
    background   (H, W) the scene without jaw and cable; takes static lines and texture off
    previous     that of the frame before: the jaw is looked for there first; only saves time
    returns      a sighting; `unseen` names the reason if there are no nodes.  Does not guess.
    raises       ValueError: the image is not (H, W) uint8, or the background has another shape
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"image is {image.shape} {image.dtype}; needs (H, W) uint8")
    if background is not None and background.shape != image.shape:
        raise ValueError(f"background is {background.shape}, image {image.shape}")
    unusable = _unusable(image)
    if unusable is not None:
        return _unseen(t_s, unusable, None, options)
    near, near_rad = (
        (None, None) if previous is None else (previous.grip_m, previous.clamp_angle_rad)
    )
    jaw = find_jaw(image, view, options.marks, near, near_rad)
    if jaw is None:
        return _unseen(t_s, Unseen.NO_JAW, None, options)

    picture = Picture(image, background, 1 if options.cable_is == "light" else -1)
    grip_px = view.to_pixels(jaw.grip_m)
    scale = pixels_per_metre(view, grip_px)
    direction = np.array([np.cos(jaw.angle_rad), np.sin(jaw.angle_rad)])
    outward = view.to_pixels(jaw.grip_m - 1e-3 * direction) - grip_px
    outward /= np.linalg.norm(outward)
    length_px = options.free_length_m * scale
    trace = trace_cable(
        picture,
        grip_px,
        outward,
        length_px=length_px,
        min_contrast=options.min_contrast,
        width_px=options.line_width_px,
    )
    if isinstance(trace, Unseen):
        return _unseen(t_s, trace, jaw, options)

    dense_px = trace.curve.at(np.linspace(0.0, 1.0, _DENSE))
    dense_m = view.to_plane(dense_px)
    s = arc_lengths(dense_m)
    length_m = float(s[-1])
    off = abs(length_m - options.free_length_m) / options.length_tolerance_m
    if off > 1.0:
        return _unseen(t_s, Unseen.WRONG_LENGTH, jaw, options, length_m)
    if another_line(picture, grip_px, outward, dense_px, trace.contrast, length_px):
        return _unseen(t_s, Unseen.TWO_CABLES, jaw, options, length_m)
    at = np.linspace(length_m, 0.0, options.nodes)
    nodes = np.stack([np.interp(at, s, dense_m[:, 0]), np.interp(at, s, dense_m[:, 1])], axis=1)
    quality = trace.seen_share * min(1.0, trace.signal_to_noise / 5.0)
    quality *= float(np.exp(-((trace.misfit_px / 0.5) ** 2) - 0.5 * off**2))
    return Sighting(t_s, nodes, jaw.grip_m, jaw.angle_rad, quality, length_m=length_m)


def detect_all(
    frames: Iterable[tuple[float, Image]],
    view: PlaneView,
    options: VisionOptions,
    background: Image | None = None,
) -> Iterator[Sighting]:
    """One sighting per (time, image), in order, each looked for around the one before."""
    previous: Sighting | None = None
    for t_s, image in frames:
        previous = detect(image, t_s, view, options, background, previous)
        yield previous


def _unusable(image: Image) -> Unseen | None:
    """Whether so much is black, blank or saturated that nothing can be measured."""
    coarse = image[::16, ::16]
    if np.mean(coarse >= 254) > 0.5:
        return Unseen.SATURATED
    dark, light = np.percentile(coarse, [1.0, 99.0])
    if light < 15.0 or light - dark < 10.0:
        return Unseen.EMPTY
    return None


def _unseen(
    t_s: float,
    reason: Unseen,
    jaw: JawPose | None,
    options: VisionOptions,
    length_m: float = float("nan"),
) -> Sighting:
    grip = np.full(2, np.nan) if jaw is None else jaw.grip_m
    angle = float("nan") if jaw is None else jaw.angle_rad
    nodes = np.full((options.nodes, 2), np.nan)
    return Sighting(t_s, nodes, grip, angle, 0.0, reason, length_m)
