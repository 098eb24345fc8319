"""How a cable is held, from lines of known shape, and from a rendered picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.cable_line import CableLine, measure_line
from calib.errors import CalibrationError, MisfitError, TooFewError
from calib.grip import GripView, fit_grip
from calib.lens import Lens
from calib.plane import PlaneView
from cell.settings import load_settings
from cell.wiring.twins import cable_shape, hidden_cable
from drivers.interfaces import Trajectory
from drivers.sim.pinhole import Pinhole
from drivers.sim.render import LIGHT_ON_DARK, RenderOptions, render

VIEW = PlaneView.from_scale(2e-4, 1000.0, 150.0)
POINT_M, ASKEW_RAD, LENGTH_M = np.array([2e-4, -3e-4]), 0.015, 0.1
TURNS = (0.3, 0.5, 0.7, 0.9)


def shape(turn: float) -> np.ndarray:
    """(K, 2) a hidden cable at rest in a gripper at the origin, from the gripping point."""
    settings = load_settings(Path("config/fake.yaml"))
    hold_s, still = np.array([0.0, 0.1]), np.zeros(2)
    held = Trajectory(hold_s, still, still, still + turn)
    return cable_shape(hidden_cable(settings, 3, 1), 200)(held, hold_s)[0, ::-1]


@pytest.fixture(scope="module")
def shapes() -> list[np.ndarray]:
    return [shape(turn) for turn in TURNS]


def views(shapes, slide_m: float = 0.0, noise_m: float = 4e-6) -> list[GripView]:
    """Two of each shape, with noise; `slide_m` further out from one to the next."""
    rng, found = np.random.default_rng(5), []
    for k, (turn, line) in enumerate(zip(TURNS * 2, shapes * 2, strict=True)):
        angle = turn - ASKEW_RAD
        c, s = np.cos(angle), np.sin(angle)
        marks_m = -np.array([[c, -s], [s, c]]) @ POINT_M
        out = np.array([np.cos(turn), np.sin(turn)]) * slide_m * k
        smooth = np.vstack([line[:1], line - out]) if slide_m else line
        steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        clear = (along > 0.001) & (along < along[-1] - 0.0006)
        points = smooth[clear] + rng.normal(0.0, noise_m, (np.count_nonzero(clear), 2))
        measured = CableLine(points, along[clear], smooth, smooth[0], smooth[-1], 0.02)
        found.append(GripView(f"{k}", np.array([*marks_m, angle]), measured))
    return found


def test_a_bent_cable_tells_its_angle_at_the_jaw(shapes):
    fit = fit_grip(views(shapes), 5e-6)
    off = np.abs(fit.mean - [*POINT_M, ASKEW_RAD, LENGTH_M])
    assert np.all(off < [1e-5, 1e-5, 0.002, 1e-4])
    assert np.all(off < 2.0 * fit.half_95)
    # its chord over the first tenth is far from that
    chord = np.array([np.arctan2(-(m[20] - m[0])[1], -(m[20] - m[0])[0]) for m in shapes])
    assert np.min(np.abs(chord - TURNS)) > 0.01


def test_a_cable_that_slides_is_told_by_its_pose(shapes):
    with pytest.raises(MisfitError, match=r"moved in the jaws: its free length .*grip harder"):
        fit_grip(views(shapes, slide_m=2e-4))


def test_one_wrong_end_is_set_aside(shapes):
    seen = views(shapes)
    line = seen[2].line
    short = replace(line, smooth_m=line.smooth_m[:-2], tip_m=line.smooth_m[-3])
    seen[2] = replace(seen[2], line=short)
    fit = fit_grip(seen)
    assert fit.used.tolist() == [True, True, False, *[True] * 5]
    assert fit.mean[3] == pytest.approx(LENGTH_M, abs=1e-4)


def test_four_poses_are_too_few(shapes):
    with pytest.raises(TooFewError, match="measured in 4 of at least 5 poses"):
        fit_grip(views(shapes)[:4])


@pytest.mark.parametrize("look", [RenderOptions(), LIGHT_ON_DARK], ids=["dark", "light"])
def test_a_line_is_measured_to_a_hundredth_of_a_millimetre(shapes, look):
    true = shapes[1]
    rng = np.random.default_rng(2)
    image = render(true[::-1], (0.0, 0.0, TURNS[1]), VIEW.homography, look, rng)
    rough = true[::20] + rng.normal(0.0, 1e-4, (11, 2))
    line = measure_line(image, VIEW, rough, TURNS[1], 1.0, dark=look is not LIGHT_ON_DARK)
    assert np.linalg.norm(line.edge_m - true[0]) < 1e-4
    assert np.linalg.norm(line.tip_m - true[-1]) < 1e-4
    nearest = np.linalg.norm(line.points_m[:, None] - true[None], axis=2).min(axis=1)
    assert np.median(nearest) < 1.5e-4  # half of the true line's spacing, 0.25 mm
    ways = np.gradient(true, axis=0)
    at = np.linalg.norm(line.points_m[:, None] - true[None], axis=2).argmin(axis=1)
    off = line.points_m - true[at]
    across = (off[:, 1] * ways[at, 0] - off[:, 0] * ways[at, 1]) / np.linalg.norm(ways[at], axis=1)
    assert np.sqrt(np.mean(across**2)) < 3e-5


def test_a_jaw_seen_from_the_side_is_not_taken_for_a_longer_cable(shapes):
    """Its edge is not square to the cable in the picture: measured across the cable it was up to
    1.5 px further out."""
    eye = Pinhole.standing(
        metres_per_pixel=2e-4, origin_px=(1000.0, 150.0), size_px=(1280, 1024), focal_px=2600.0,
        tilt_rad=-0.5, pan_rad=-0.1,
    )  # fmt: skip
    lens = Lens(eye.focal_px, eye.focal_px, *eye.centre_px, *eye.distortion)
    view, rng = PlaneView.from_pose(lens, eye.X_CP), np.random.default_rng(2)
    out_m = []
    for turn, true in zip(TURNS, shapes, strict=True):
        image = render(true[::-1], (0.0, 0.0, turn), eye, RenderOptions(), rng)
        line = measure_line(image, view, true[::20], turn, 1.0, dark=True)
        out_m.append(-line.edge_m @ [np.cos(turn), np.sin(turn)])
    assert abs(np.mean(out_m)) < 5e-5


def test_a_picture_without_the_cable_is_refused(shapes):
    image = render(
        None, (0.0, 0.0, TURNS[1]), VIEW.homography, RenderOptions(), np.random.default_rng(2)
    )
    with pytest.raises(CalibrationError, match=r"too little of its length|does not end where"):
        measure_line(image, VIEW, shapes[1][::20], TURNS[1], 1.0, dark=True)
