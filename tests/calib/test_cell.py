"""The joint fit of the cell: right in millimetres, honest about it, and refused when one-sided."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib.camera import fit_camera
from calib.cell import fit_cell
from calib.errors import MisfitError, OneSidedError, TooFewError, WrongScaleError
from calib.jaw_marks import Gravity, JawObservation, Plate
from calib.lens import pose
from calib.plane import PlaneView
from drivers.sim.render import JAW_MARKS_M
from tests.calib.conftest import BOARD, lens_of, standing, views_of

MARKS_M = np.array(JAW_MARKS_M)[:, :2]
FIELD = np.stack(np.meshgrid(np.linspace(-0.17, 0.03, 9), np.linspace(-0.15, 0.02, 7)), -1)
UP = np.array([0.0, 1.0, 0.0])


def hands(rng, count, *, in_plane, x_m=(-0.06, 0.02), y_m=(-0.1, 0.02), turn_rad=0.1):
    poses = []
    for _ in range(count):
        X = np.eye(4)
        tilt = np.zeros(2) if in_plane else rng.uniform(-0.35, 0.35, 2)
        turn = np.array([*tilt, rng.uniform(-turn_rad, turn_rad)])
        X[:3, :3] = cv2.Rodrigues(turn)[0]
        X[:3, 3] = [rng.uniform(*x_m), rng.uniform(*y_m), 0.0 if in_plane else rng.normal(0, 0.02)]
        poses.append(X)
    return poses


class Truth:
    """A cell whose true frames are known; P is the frame in which `eye` stands."""

    def __init__(self, rng, *, in_plane=False, **camera):
        self.eye = standing(**camera)
        self.in_plane = in_plane
        turn = np.array([0.0, 0.0, rng.normal(0, 0.005)]) if in_plane else rng.normal(0, 0.008, 3)
        self.X_BP = pose(np.concatenate([turn, np.zeros(3)]))
        self.X_TM = pose(
            np.array([0, 0, *rng.normal(0, [0.005, 1e-3, 1e-3]), 0])
            if in_plane
            else np.concatenate([rng.normal(0, 0.008, 3), rng.normal(0, 1e-3, 3)])
        )
        # the gripping point at home is the origin, where the plate lies in the plane
        self.home = self.X_BP @ np.linalg.inv(self.X_TM)
        self.marks = np.column_stack([MARKS_M, np.zeros(4), np.ones(4)])

    def shown(self, rng, poses, noise_px=0.02, arm_m=0.0, scale=1.0):
        X_PB = np.linalg.inv(self.X_BP)
        flat = self.marks * [scale, scale, scale, 1.0]
        out = []
        for k, X_BT in enumerate(poses):
            wrong = X_BT.copy()
            wrong[:3, 3] += rng.normal(0, arm_m, 3) * ([1, 1, 0] if self.in_plane else 1)
            points = (flat @ (X_PB @ wrong @ self.X_TM).T)[:, :3]
            pixels = self.eye.to_pixels(points) + rng.normal(0, noise_px, (4, 2))
            out.append(JawObservation(f"pose {k}", X_BT, pixels))
        return out

    def gravity(self, rng, places_m=(-0.08,), spread_rad=0.002):
        """A plumb line in the plane at some places, and a base that is level to `spread_rad`."""
        y = np.linspace(-0.12, 0.0, 60)
        threads = [self.eye.to_pixels(np.column_stack([np.full(60, x), y])) for x in places_m]
        return Gravity(UP, spread_rad, tuple(t + rng.normal(0, 0.05, t.shape) for t in threads))

    def off_m(self, fit):
        """(G,) distances, m, of the fitted map over the field."""
        true = PlaneView.from_pose(lens_of(self.eye), self.eye.X_CP)
        pixels = true.to_pixels(FIELD)
        return np.linalg.norm(fit.view.to_plane(pixels) - FIELD, axis=-1), fit.spread_m(pixels)


def camera_of(truth, rng):
    camera = fit_camera(views_of(truth.eye, rng, count=12), BOARD)
    return camera.lens, camera.covariance


def fitted(truth, rng, lens, count=24, places_m=(-0.08,), **how):
    poses = hands(rng, count, in_plane=truth.in_plane)
    others = hands(rng, 6, in_plane=truth.in_plane)
    return fit_cell(
        truth.shown(rng, poses, **how), truth.shown(rng, others, **how), Plate(MARKS_M), *lens,
        truth.gravity(rng, places_m), truth.home, in_plane=truth.in_plane,
    )  # fmt: skip


@pytest.mark.parametrize("in_plane", [True, False])
def test_the_map_is_right_and_says_how_right(in_plane):
    rng = np.random.default_rng(11 + in_plane)
    inside, offs, held_out = [], [], []
    for tilt in (-0.5, 0.3):
        truth = Truth(rng, in_plane=in_plane, tilt_rad=tilt, roll_rad=0.05)
        lens = camera_of(truth, rng)
        for _ in range(2):
            fit = fitted(truth, rng, lens, arm_m=1e-5)
            off, spread = truth.off_m(fit)
            inside.append(np.mean(off < 1.73 * spread))  # 95 % of a circle of both axes
            offs.append(off)
            held_out.append(np.linalg.norm(fit.held_out_m, axis=1))
            assert fit.roll()[0] == pytest.approx(truth_roll(truth), abs=5e-4)
    assert np.sqrt(np.mean(np.square(offs))) < 5e-5
    assert np.max(offs) < 1.5e-4
    assert np.mean(inside) > 0.75
    assert 2e-6 < np.sqrt(np.mean(np.square(held_out))) < 4e-5


def test_a_pose_shown_twice_is_one_and_what_is_fitted_to_is_not_held_out():
    rng = np.random.default_rng(4)
    truth = Truth(rng, in_plane=True)
    lens, gravity = camera_of(truth, rng), truth.gravity(rng)
    shown = truth.shown(rng, hands(rng, 24, in_plane=True))
    burst = [replace(o, name=f"{o.name} again", pixels=o.pixels + 0.02) for o in shown]
    fits = [
        fit_cell(poses, held_out, Plate(MARKS_M), *lens, gravity, truth.home, in_plane=True)
        for poses, held_out in ((shown, []), ([*shown, *burst], burst[:6]))
    ]
    np.testing.assert_allclose(fits[1].covariance, fits[0].covariance)
    assert len(fits[1].held_out_m) == 0
    assert len(fits[1].left_out) == 30
    assert "pose 0 again shows the same as pose 0" in fits[1].left_out[0]


def truth_roll(truth):
    return np.arctan2(truth.eye.X_CP[1, 0], truth.eye.X_CP[0, 0])


def test_a_plumb_line_at_two_places_finds_roll_though_the_base_leans():
    """At one place, whether the line leans towards a panned camera was taken for roll."""
    rng = np.random.default_rng(17)
    truth = Truth(rng, tilt_rad=0.4, pan_rad=0.1)
    lens = (lens_of(truth.eye), 1e-8 * np.eye(9))
    (_, spread_1), (roll, spread_2) = (
        fitted(truth, rng, lens, places_m=places).roll() for places in ((0.0,), (0.0, -0.15))
    )
    assert spread_2 < 0.25 * spread_1
    assert roll == pytest.approx(truth_roll(truth), abs=4.0 * spread_2)
    assert roll == pytest.approx(truth_roll(truth), abs=1e-4)


def test_the_plane_in_the_base_is_right():
    rng = np.random.default_rng(21)
    truth = Truth(rng, tilt_rad=0.25)
    fit = fitted(truth, rng, camera_of(truth, rng), arm_m=1e-5)
    off = np.linalg.inv(truth.X_BP) @ fit.X_BP
    turn_rad = np.linalg.norm(cv2.Rodrigues(off[:3, :3])[0])
    origin_m, turned_rad = fit.plane_spread()
    assert np.linalg.norm(off[:3, 3]) < min(1e-4, 3.5 * origin_m)
    assert turn_rad < 4.0 * turned_rad


def test_noise_of_the_arm_is_told_from_that_of_the_marks():
    rng = np.random.default_rng(31)
    truth = Truth(rng, in_plane=True)
    fit = fitted(truth, rng, (lens_of(truth.eye), 1e-8 * np.eye(9)), count=60, arm_m=4e-5)
    assert fit.noise_px == pytest.approx(0.02, rel=0.15)
    assert fit.arm_noise_px == pytest.approx(4e-5 / 2e-4, rel=0.2)


def test_what_cannot_give_a_cell_is_named():
    rng = np.random.default_rng(41)
    truth = Truth(rng, in_plane=True)
    lens = (lens_of(truth.eye), 1e-8 * np.eye(9))
    gravity = truth.gravity(rng)
    poses = hands(rng, 20, in_plane=True)

    def fit(shown):
        return fit_cell(shown, [], Plate(MARKS_M), *lens, gravity, truth.home, in_plane=True)

    with pytest.raises(TooFewError, match="found in 3 of at least 8 poses"):
        fit(truth.shown(rng, poses[:3]))
    line = hands(rng, 20, in_plane=True, y_m=(0.0, 1e-4))
    with pytest.raises(OneSidedError, match="on a line"):
        fit(truth.shown(rng, line))
    with pytest.raises(WrongScaleError, match=r"\+2\.0. % larger"):
        fit(truth.shown(rng, poses, scale=1.02))
    moved = truth.shown(rng, poses)
    for k, one in enumerate(moved):
        moved[k] = replace(one, pixels=one.pixels + (9.0 if k >= 12 else 0.0))
    with pytest.raises(MisfitError, match="camera and plate are tight"):
        fit(moved)
