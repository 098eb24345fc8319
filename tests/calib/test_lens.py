"""The lens against OpenCV's own implementation, and there and back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from calib.lens import Lens
from calib.plane import PlaneView, fit_homography
from drivers.sim.pinhole import Pinhole
from drivers.sim.render import RenderOptions, render

LENSES = st.builds(
    Lens,
    fx_px=st.floats(1500.0, 3500.0),
    fy_px=st.floats(1500.0, 3500.0),
    cx_px=st.floats(600.0, 680.0),
    cy_px=st.floats(480.0, 540.0),
    k1=st.floats(-0.3, 0.1),
    k2=st.floats(-0.1, 0.1),
    p1=st.floats(-1e-3, 1e-3),
    p2=st.floats(-1e-3, 1e-3),
)
PIXELS = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 1023, 7)), axis=-1)
STANDING = {"metres_per_pixel": 2e-4, "origin_px": (1000.0, 150.0), "size_px": (1280, 1024)}


@settings(max_examples=40, deadline=None)
@given(lens=LENSES)
def test_distortion_is_opencv_s_and_is_taken_off_again(lens):
    ideal = lens.ideal(PIXELS)
    assert_allclose(lens.distorted(ideal), PIXELS, atol=1e-7)
    rays = (ideal - [lens.cx_px, lens.cy_px]) / [lens.fx_px, lens.fy_px]
    rays3 = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2).reshape(-1, 3)
    theirs, _ = cv2.projectPoints(rays3, np.zeros(3), np.zeros(3), lens.matrix, lens.numbers[4:])
    assert_allclose(theirs.reshape(PIXELS.shape), PIXELS, atol=1e-6)


def test_a_pixel_in_which_nothing_can_be_seen_is_nan():
    fish = Lens(300.0, 300.0, 640.0, 512.0, k1=-0.3)
    assert np.all(np.isnan(fish.ideal(np.array([[0.0, 0.0]]))))
    assert np.all(np.isfinite(fish.ideal(np.array([[600.0, 500.0]]))))


def standing(**changes) -> tuple[Pinhole, PlaneView]:
    eye = Pinhole.standing(**STANDING, focal_px=2600.0, **changes)
    lens = Lens(eye.focal_px, eye.focal_px, *eye.centre_px, *eye.distortion)
    return eye, PlaneView.from_pose(lens, eye.X_CP)


def test_a_square_camera_without_distortion_is_the_typed_view():
    _, view = standing()
    typed = PlaneView.from_scale(2e-4, 1000.0, 150.0)
    assert_allclose(view.to_plane(PIXELS), typed.to_plane(PIXELS), atol=1e-12)


def test_a_tilted_camera_looks_down_and_a_rolled_one_turns_the_picture():
    eye, _ = standing(tilt_rad=0.2)
    there = np.linalg.inv(eye.X_CP)[:3, 3]
    assert there[1] > 0.0  # above what it looks at …
    assert there[2] > 0.4  # … and before the plane
    _, rolled = standing(roll_rad=0.1)
    _, square = standing()
    up = np.array([[0.0, 0.0], [0.0, 0.01]])
    a, b = (np.diff(v.to_pixels(up), axis=0)[0] for v in (square, rolled))
    turned = np.arctan2(b[1], b[0]) - np.arctan2(a[1], a[0])  # rows go down: positive = clockwise
    assert turned == pytest.approx(0.1, abs=1e-3)


@settings(max_examples=20, deadline=None)
@given(
    tilt=st.floats(-0.52, 0.52), pan=st.floats(-0.3, 0.3), roll=st.floats(-0.5, 0.5),
    k1=st.floats(-0.3, 0.1),
)  # fmt: skip
def test_pixels_to_plane_and_back_with_tilt_and_distortion(tilt, pan, roll, k1):
    eye, view = standing(
        tilt_rad=tilt, pan_rad=pan, roll_rad=roll, distortion=(k1, 0.02, 5e-4, -5e-4, 0.0)
    )
    points = view.to_plane(PIXELS)
    assert_allclose(view.to_pixels(points), PIXELS, atol=1e-6)
    assert_allclose(eye.to_pixels(points), PIXELS, atol=1e-6)  # the renderer's own: OpenCV


def test_a_rendered_disc_lies_where_the_map_says():
    eye, view = standing(tilt_rad=0.5, roll_rad=0.05, distortion=(-0.3, 0.1, 0.0, 0.0, 0.0))
    options = RenderOptions(
        background_level=0.0, texture_level=0.0, bright_object=False, plate_level=0.0,
        marks_m=((0.0, 0.0, 0.001),), read_noise=0.0, shot_noise=0.0,
    )  # fmt: skip
    rows, columns = np.mgrid[:1024, :1280]
    for place in np.array([[-0.16, -0.14], [0.02, 0.01], [-0.1, 0.0]]):
        image = render(None, (*place, 0.0), eye, options, np.random.default_rng(0)).astype(float)
        seen = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
        assert_allclose(view.to_plane(seen), place, atol=2e-6)


def test_a_plane_fitted_through_a_known_lens_is_exact():
    eye, view = standing(tilt_rad=0.3, distortion=(-0.25, 0.0, 0.0, 0.0, 0.0))
    points = np.stack(np.meshgrid(np.linspace(-0.15, 0.02, 5), np.linspace(-0.15, 0.01, 4)), -1)
    points = points.reshape(-1, 2)
    pixels = eye.to_pixels(points)
    assert view.lens is not None
    through = PlaneView(fit_homography(view.lens.ideal(pixels), points), view.lens)
    assert_allclose(through.to_plane(pixels), points, atol=1e-9)
    without = PlaneView(fit_homography(pixels, points))
    assert np.abs(without.to_plane(pixels) - points).max() > 1e-4  # a lens is needed
