"""Loads compiled code before the first cable is gripped."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.stepping import integrate
from cell.computer.compiling import is_to_be_compiled
from cell.computer.second_process import SecondProcess
from cell.identify.individual import IdentifyOptions, hold_trial, identify, predict_frames
from cell.identify.model_class import ModelClass
from cell.plan.choose import choose, forecast
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits, executed_motion, identification_path, insertion_path
from cell.vision.detect import VisionOptions, detect_all
from cell.vision.marks import find_jaw
from drivers.interfaces import Pose

_LOG = logging.getLogger(__name__)

_NOISE_M = 2e-5
#: Of a synthetic picture: size of a mark, and grey levels.
_MARK_PX, _DARK, _BEHIND, _LIGHT = 6.0, 30, 120, 210


@contextmanager
def second_process(computer: Executor) -> Iterator[SecondProcess | None]:
    """A second process for warming up: `computer` if it is one, else one that compiles; or None.

    None where nothing is to be compiled; a thread would share this process's compiler, and wait for
    its lock for ever where a signal has ended the other.
    """
    if isinstance(computer, SecondProcess) or not is_to_be_compiled(integrate):
        yield computer if isinstance(computer, SecondProcess) else None
        return
    _LOG.info("compiling for this processor, once: about half a minute")
    process = SecondProcess()
    try:
        yield process
    finally:
        process.shutdown(wait=False)  # it may be interrupted


@cache
def warm_up(cable: Cable, kind: ModelClass = ModelClass()) -> None:  # noqa: B008
    """Identify a synthetic cable and choose a motion for it; the results are discarded."""
    home, limits, rate_hz = Pose(0.0, 0.0), MotionLimits(), 500.0
    length_m = cable.free_length_m
    down = identification_path(home, 0.5 * length_m, limits, rate_hz, hold_s=0.5)
    t_s = np.arange(-0.2, float(down.t_s[-1]), 0.01)
    rng = np.random.default_rng(1)
    x_m, y_m = (v + rng.normal(scale=_NOISE_M, size=len(v)) for v in (down.x_m, down.y_m))
    hand = Motion(down.t_s, x_m, y_m, down.angle_rad)
    rigidity = 0.4 * cable.line_density_kg_per_m * 9.81 * length_m**3
    space = kind.space(cable)
    model = space.model(space.start(rigidity))
    arc_length_m = node_arc_lengths(length_m)
    nodes_m = simulate(model, hand, t_s, arc_length_m)[0]
    nodes_m += rng.normal(scale=_NOISE_M, size=nodes_m.shape)
    grip_m = np.column_stack([np.interp(t_s, hand.t_s, v) for v in (hand.x_m, hand.y_m)])
    trial = hold_trial(hand, t_s, nodes_m, grip_m, np.zeros(len(t_s)))
    options = IdentifyOptions(kind=kind)
    identified = identify(trial, arc_length_m, cable, options=options)
    predicted = predict_frames(trial, t_s, arc_length_m, identified, options)
    identify(trial, arc_length_m, cable, previous=identified, predicted=predicted, options=options)
    path = insertion_path(home, 0.0, 0.5 * length_m, limits, rate_hz)
    expected = forecast(identified, np.zeros(1), [executed_motion(path, 0.03)])
    hole = Destination(-1.4 * length_m, -1.3 * length_m, -length_m, length_m)
    choose(expected, identified, hole)


def warm_up_servo() -> None:
    """Simulate the lag on a synthetic path, as when measured and commanded motions are compared."""
    home = Pose(0.0, 0.0)
    executed_motion(insertion_path(home, 0.0, 0.05, MotionLimits(), 500.0), 0.03)


def warm_up_vision(options: VisionOptions) -> None:
    """Process a synthetic picture, and a second one after it."""
    image, view = made_up_picture(options)
    list(detect_all([(0.0, image), (0.01, image)], view, options))
    find_jaw(image, view, options.marks)


def made_up_picture(options: VisionOptions) -> tuple[NDArray[np.uint8], PlaneView]:
    """Synthetic picture (H, W) of the jaw and a straight cable, and its map to the plane."""
    marks = options.marks
    scale_m = marks.radius_m / _MARK_PX
    around = np.abs(marks.centres_m).max() + 5.0 * marks.radius_m
    left_px, side_px = (int(np.ceil(m / scale_m)) for m in (options.free_length_m + around, around))
    view = PlaneView.from_scale(scale_m, left_px, side_px)
    image = np.full((2 * side_px, left_px + side_px), _BEHIND, dtype=np.uint8)
    image[:, left_px:] = _DARK
    for centre in np.rint(view.to_pixels(np.array(marks.centres_m))).astype(int).tolist():
        cv2.circle(image, centre, round(_MARK_PX), _LIGHT, cv2.FILLED, cv2.LINE_AA)
    grey = _DARK if options.cable_is == "dark" else _LIGHT
    ends = view.to_pixels(np.array([[-options.free_length_m, 0.0], [0.0, 0.0]]))
    tip, grip = np.rint(ends).astype(int).tolist()
    width = max(1, round(2.5 * options.line_width_px))
    cv2.line(image, tip, grip, grey, width, cv2.LINE_AA)
    return image, view
