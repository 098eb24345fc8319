"""One frame of the side camera → the nodes of the cable, or the reason why there are none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from threading import local
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.vision.compiling import compiled, hypot, inline, part
from cell.vision.discs import (
    DiscMemory,
    Marks,
    disc_memory,
    find_body,
    scale_at,
    to_pixels,
    to_plane,
)
from cell.vision.marks import NEXT_FRAME_M, JawMarks, compiled_view, disc_marks
from cell.vision.ridge import GreyImage, RidgeStart, crossings, find_start, follow
from cell.vision.sighting import UNSEEN, Sighting, Unseen
from cell.vision.spline import at
from cell.vision.trace import (
    ARC_RAD,
    DENSE,
    SEEN,
    STEP_PX,
    CableAppearance,
    TraceMemory,
    cable_appearance,
    trace_cable,
    trace_memory,
)

_SHARES = (0.3, 0.5, 0.7, 0.9)  # of the cable's length, radii of the arcs
_CABLE_PX = 8.0  # a crossing nearer to the cable is the cable itself
_APART_PX = 6.0  # a point of another line nearer to the cable does not count
_EVERY_POINT = 4  # stride over the dense points of the cable in comparisons


@part
def another_line(picture, memory, grip, outward, contrast, length):  # type: ignore[no-untyped-def]
    """Whether a second line of similar contrast and length runs near the cable.

    Arcs about the gripping point are searched for lines; a line that crosses them away from the
    cable is followed both ways, and counts if it is longer than a fifth of the cable.
    memory    see `TraceMemory`; `dense` holds the cable
    contrast  typical of the cable, grey levels; length: expected, px
    """
    middle = np.arctan2(outward[1], outward[0])
    crossing = memory.crossing
    for share in _SHARES:
        arc = (grip[0], grip[1], share * length, middle, ARC_RAD)
        count = crossings(picture, arc, memory.scratch, crossing)
        for n in range(count):
            u, v, strength = crossing[n, 0], crossing[n, 1], crossing[n, 2]
            if strength <= 0.5 * contrast or _distance(u, v, memory.dense) < _CABLE_PX:
                continue
            distance = hypot(u - grip[0], v - grip[1])
            ru, rv = (u - grip[0]) / distance, (v - grip[1]) / distance
            total = _apart(picture, memory, (u, v), (ru, rv), contrast, length)
            total += _apart(picture, memory, (u, v), (-ru, -rv), contrast, length)
            if total > 0.2 * length:
                return True
    return False


@part
def _apart(picture, memory, place, heading, contrast, length):  # type: ignore[no-untyped-def]
    """Length, px, of a line from a place, as far as it is away from the cable."""
    start = find_start(picture, place, heading, 2.0, 1.0, memory.scratch)
    if start.contrast < 0.5 * contrast:
        return 0.0
    line = memory.line[: min(int(0.3 * length / STEP_PX) + 2, len(memory.line))]
    start = RidgeStart(start.u, start.v, start.du, start.dv, contrast)
    count, _ = follow(picture, start, 0.4, STEP_PX, 10.0, line, memory.scratch)
    if count < 2:
        return 0.0
    apart = 0
    for n in range(count):
        apart += _distance(line[n, 0], line[n, 1], memory.dense) > _APART_PX
    return STEP_PX * apart


@inline
def _distance(u, v, dense):  # type: ignore[no-untyped-def]
    """Distance of a place to the nearest dense point."""
    nearest = np.inf
    for k in range(0, len(dense), _EVERY_POINT):
        du, dv = u - dense[k, 0], v - dense[k, 1]
        nearest = min(nearest, du * du + dv * dv)
    return np.sqrt(nearest)


_EVERY = 16  # stride over columns and rows in the check whether a picture is usable

_NO_JAW = UNSEEN.index(Unseen.NO_JAW)
_TWO_CABLES = UNSEEN.index(Unseen.TWO_CABLES)
_WRONG_LENGTH = UNSEEN.index(Unseen.WRONG_LENGTH)
_SATURATED = UNSEEN.index(Unseen.SATURATED)
_EMPTY = UNSEEN.index(Unseen.EMPTY)


class Appearance(NamedTuple):
    """The appearance of jaw and cable, as compiled code takes it; see `VisionOptions`."""

    marks: Marks
    cable: CableAppearance
    free_length_m: float
    length_tolerance_m: float


class FrameMemory(NamedTuple):
    """Memory for the evaluation of a picture; a thread needs its own."""

    discs: DiscMemory
    trace: TraceMemory
    histogram: NDArray[np.int64]
    arc_length_m: FloatArray


class FrameResult(NamedTuple):
    """Reason for no nodes (index in `UNSEEN`, −1 = nodes), the jaw, quality and length."""

    code: int
    x_m: float
    y_m: float
    angle_rad: float
    quality: float
    length_m: float


def frame_memory(shape: tuple[int, int], appearance: Appearance) -> FrameMemory:
    """Memory for pictures (H, W)."""
    return FrameMemory(
        disc_memory(shape, len(appearance.marks.centres_m)),
        trace_memory(float(np.hypot(*shape))),
        np.empty(256, np.int64),
        np.empty(DENSE),
    )


@part
def nodes_in_frame(picture, view, appearance, memory, previous, nodes):  # type: ignore[no-untyped-def]
    """Detect jaw and cable in one picture; writes the nodes.

    picture  see `GreyImage`
    view     see `ImageView`
    previous  place, m, and angle of the jaw in the frame before; nan = unknown
    nodes    (N, 2) are written, tip first, m; nan where unseen
    returns  a `FrameResult`
    """
    _nothing(nodes)
    code = _unusable(picture.image, memory.histogram)
    if code >= 0:
        return FrameResult(code, np.nan, np.nan, np.nan, 0.0, np.nan)
    jaw = find_body(picture.image, view, appearance.marks, memory.discs, previous, NEXT_FRAME_M)
    if jaw.marks == 0:
        return FrameResult(_NO_JAW, np.nan, np.nan, np.nan, 0.0, np.nan)
    x, y, angle = jaw.x_m, jaw.y_m, jaw.angle_rad
    grip = to_pixels(view, x, y)
    length = appearance.free_length_m * scale_at(view, grip[0], grip[1])
    ahead = to_pixels(view, x - 1e-3 * np.cos(angle), y - 1e-3 * np.sin(angle))
    norm = hypot(ahead[0] - grip[0], ahead[1] - grip[1])
    outward = ((ahead[0] - grip[0]) / norm, (ahead[1] - grip[1]) / norm)
    trace = trace_cable(picture, appearance.cable, memory.trace, grip, outward, length)
    if trace.code != SEEN:
        return FrameResult(trace.code, x, y, angle, 0.0, np.nan)
    length_m = _in_plane(view, memory, nodes)
    off = abs(length_m - appearance.free_length_m) / appearance.length_tolerance_m
    code = -1
    if off > 1.0:
        code = _WRONG_LENGTH
    elif another_line(picture, memory.trace, grip, outward, trace.contrast, length):
        code = _TWO_CABLES
    if code >= 0:
        _nothing(nodes)
        return FrameResult(code, x, y, angle, 0.0, length_m)
    quality = trace.detected_share * min(1.0, trace.signal_to_noise / 5.0)
    quality *= np.exp(-((trace.misfit_px / 0.5) ** 2) - 0.5 * off * off)
    return FrameResult(-1, x, y, angle, quality, length_m)


@compiled
def frame_values(picture, view, appearance, memory, previous, nodes):  # type: ignore[no-untyped-def]
    """The values of `nodes_in_frame`'s result as a plain tuple, for Python.

    To return a named tuple numba runs Python; a signal that is raised there ends the process.
    """
    result = nodes_in_frame(picture, view, appearance, memory, previous, nodes)
    return result.code, result.x_m, result.y_m, result.angle_rad, result.quality, result.length_m


@inline
def _nothing(nodes):  # type: ignore[no-untyped-def]
    for n in range(len(nodes)):
        nodes[n, 0], nodes[n, 1] = np.nan, np.nan


@part
def _in_plane(view, memory, nodes):  # type: ignore[no-untyped-def]
    """Nodes at equal arc length, tip first, in the plane; returns the cable's length, m."""
    dense, s = memory.trace.dense, memory.arc_length_m
    x0, y0 = 0.0, 0.0
    for k in range(DENSE):
        u, v, _, _ = at(memory.trace.pieces, k / (DENSE - 1))
        dense[k, 0], dense[k, 1] = u, v
        x, y = to_plane(view, u, v)
        s[k] = 0.0 if k == 0 else s[k - 1] + hypot(x - x0, y - y0)
        x0, y0 = x, y
    length, count = s[-1], len(nodes)
    k = 0
    for n in range(count - 1, -1, -1):
        place = length * (1.0 - n / (count - 1))
        while k < DENSE - 2 and s[k + 1] < place:
            k += 1
        share = min(max((place - s[k]) / (s[k + 1] - s[k]), 0.0), 1.0)
        ax, ay = to_plane(view, dense[k, 0], dense[k, 1])
        bx, by = to_plane(view, dense[k + 1, 0], dense[k + 1, 1])
        nodes[n, 0], nodes[n, 1] = ax + share * (bx - ax), ay + share * (by - ay)
    return length


@part
def _unusable(image, histogram):  # type: ignore[no-untyped-def]
    """Code of a picture so black, blank or saturated that nothing can be measured, or −1."""
    height, width = image.shape
    for level in range(256):
        histogram[level] = 0
    count = 0
    for row in range(0, height, _EVERY):
        for column in range(0, width, _EVERY):
            histogram[image[row, column]] += 1
            count += 1
    if histogram[254] + histogram[255] > 0.5 * count:
        return _SATURATED
    light, dark = _quantile(histogram, count, 0.99), _quantile(histogram, count, 0.01)
    if light < 15.0 or light - dark < 10.0:
        return _EMPTY
    return -1


@part
def _quantile(histogram, count, share):  # type: ignore[no-untyped-def]
    """Grey level of a quantile of the pixels, interpolated between two levels."""
    place = share * (count - 1)
    rank = int(place)
    below, level = 0, -1
    while below <= rank:
        level += 1
        below += histogram[level]
    following = level
    if below <= rank + 1 and rank + 1 < count:
        following += 1
        while histogram[following] == 0:
            following += 1
    return level + (place - rank) * (following - level)


Image = NDArray[np.uint8]

_OF_THREAD = local()


@dataclass(frozen=True)
class VisionOptions:
    """The appearance of cable and jaw, and parameters of their detection.

    free_length_m        from the gripping point to the tip, as the cable was gripped
    length_tolerance_m   largest error of the measured length; beyond it the line is not the cable
    nodes                at equal arc length, tip first
    cable_is             darker or lighter than its background
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
    """Detect jaw and cable in one frame.

    image        (H, W) grey levels
    previous     sighting in the frame before, where the search for the jaw starts; only saves time
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
    result = FrameResult(*values)
    return Sighting(
        t_s,
        nodes_m,
        np.array([result.x_m, result.y_m]),
        result.angle_rad,
        result.quality,
        None if result.code < 0 else UNSEEN[result.code],
        result.length_m,
    )


def detect_all(
    frames: Iterable[tuple[float, Image]],
    view: PlaneView,
    options: VisionOptions,
) -> Iterator[Sighting]:
    """One sighting per (time, image), in order; each search starts from the one before."""
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
