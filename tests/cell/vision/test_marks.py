"""The jaw from its marks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.lens import Lens
from calib.plane import PlaneView
from cell.vision.discs import _block_means, to_pixels, to_plane
from cell.vision.marks import JawMarks, compiled_view, find_jaw, pixels_per_metre
from drivers.sim.render import JAW_MARKS_M, RenderOptions, render

from .entries import entry

VIEW = PlaneView.from_scale(2e-4, 640.0, 512.0)


def test_the_twin_paints_the_marks_that_vision_looks_for():
    marks = JawMarks()
    assert tuple((x, y) for x, y, _ in JAW_MARKS_M) == marks.centres_m
    assert {radius for _, _, radius in JAW_MARKS_M} == {marks.radius_m}


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(-0.08, 0.08),
    y=st.floats(-0.06, 0.06),
    angle=st.floats(-3.1, 3.1),
)
def test_any_pose_is_found_to_a_fiftieth_of_a_pixel_and_a_hundredth_of_a_degree(x, y, angle):
    image = render(None, (x, y, angle), VIEW.homography, RenderOptions(), np.random.default_rng(0))
    jaw = find_jaw(image, VIEW, JawMarks())
    assert jaw is not None
    assert jaw.marks == 4
    assert jaw.grip_m == pytest.approx([x, y], abs=5e-6)
    assert jaw.angle_rad == pytest.approx(angle, abs=2e-4)
    near = find_jaw(image, VIEW, JawMarks(), previous_m=np.array([x + 0.005, y]))
    assert near is not None
    assert near.grip_m == pytest.approx([x, y], abs=5e-6)
    for before_rad in (None, 0.3):
        astray = find_jaw(image, VIEW, JawMarks(), np.array([0.12, 0.1]), before_rad)
        assert astray is not None
        assert astray.grip_m == pytest.approx([x, y], abs=5e-6)


def test_the_jaw_is_looked_for_where_the_frame_before_showed_it():
    """Another jaw in the picture does not matter then, nor how the jaw moves between frames."""
    pose, other = (0.03, 0.06, 0.3), (-0.05, -0.04, 0.3)
    one, two = (
        render(None, p, VIEW.homography, RenderOptions(), np.random.default_rng(0))
        for p in (pose, other)
    )
    both = one.copy()
    column = VIEW.to_pixels(np.array([[0.0, 0.0]]))[0, 0]
    both[:, : int(column) - 20] = two[:, : int(column) - 20]
    before = np.array([pose[0] + 0.002, pose[1] + 0.003])
    jaw = find_jaw(both, VIEW, JawMarks(), before, pose[2] + 0.02)
    assert jaw is not None
    assert jaw.grip_m == pytest.approx(pose[:2], abs=5e-6)
    assert jaw.angle_rad == pytest.approx(pose[2], abs=2e-4)


@pytest.mark.parametrize("hidden", range(4))
def test_three_of_four_marks_suffice_and_two_do_not(hidden):
    pose = (0.01, 0.02, 0.4)
    image = render(None, pose, VIEW.homography, RenderOptions(), np.random.default_rng(0))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, s], [-s, c]])

    def hide(image, which):
        at = VIEW.to_pixels(np.array(JawMarks().centres_m[which]) @ turn + np.array(pose[:2]))
        hidden = image.copy()
        cv2.circle(hidden, tuple(np.rint(at).astype(int).tolist()), 16, 35, -1)
        return hidden

    one = hide(image, hidden)
    jaw = find_jaw(one, VIEW, JawMarks())
    assert jaw is not None
    assert jaw.marks == 3
    assert jaw.grip_m == pytest.approx(pose[:2], abs=2e-5)
    assert jaw.angle_rad == pytest.approx(pose[2], abs=5e-4)
    assert find_jaw(hide(one, (hidden + 1) % 4), VIEW, JawMarks()) is None


def test_other_light_discs_do_not_mislead():
    pose = (-0.02, 0.03, -0.3)
    image = render(None, pose, VIEW.homography, RenderOptions(), np.random.default_rng(0))
    rng = np.random.default_rng(4)
    for _ in range(25):
        at = rng.integers([40, 700], [1240, 990])
        cv2.circle(image, tuple(at.tolist()), 22, 30, -1)
        cv2.circle(image, tuple(at.tolist()), 12, 220, -1)
    jaw = find_jaw(image, VIEW, JawMarks())
    assert jaw is not None
    assert jaw.grip_m == pytest.approx(pose[:2], abs=5e-6)


@pytest.mark.parametrize("lens", [None, Lens(1300.0, 1310.0, 640.0, 500.0, -0.2, 0.1, 1e-3, -1e-3)])
def test_the_compiled_view_is_that_of_the_calibration(lens):
    view = PlaneView(
        np.array([[2.0e-4, 1.0e-5, -0.13], [8.0e-6, -2.1e-4, 0.105], [3.0e-5, -4.0e-5, 1.0]]), lens
    )
    pixels = np.random.default_rng(6).uniform([0.0, 0.0], [1280.0, 1024.0], (50, 2))
    places = np.array([entry(to_plane)(compiled_view(view), u, v) for u, v in pixels])
    assert places == pytest.approx(view.to_plane(pixels), abs=1e-12)
    back = np.array([entry(to_pixels)(compiled_view(view), x, y) for x, y in places])
    assert back == pytest.approx(pixels, abs=1e-7)


def test_marks_that_could_be_mistaken_for_each_other_are_refused():
    with pytest.raises(ValueError, match="must differ by"):
        JawMarks(centres_m=((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01)))
    with pytest.raises(ValueError, match="2 jaw marks"):
        JawMarks(centres_m=((0.0, 0.0), (0.01, 0.0)))


@given(scale=st.floats(1e-5, 1e-2))
def test_the_scale_of_a_square_view_is_its_inverse(scale):
    view = PlaneView.from_scale(scale, 3.0, 4.0)
    assert pixels_per_metre(view, np.array([10.0, 20.0])) == pytest.approx(1.0 / scale, rel=1e-9)


@pytest.mark.parametrize("shrink", [2, 3, 4, 5, 6, 8])
def test_means_of_blocks_are_rounded_as_opencv_rounds_them(shrink: int) -> None:
    """Halves rounded up moved a disc's edge, and the nodes of a noisy frame by up to 4 µm."""
    rng = np.random.default_rng(shrink)
    picture = rng.integers(0, 256, (60 * shrink, 80 * shrink)).astype(np.uint8)
    coarse = np.empty((60, 80), np.uint8)
    entry(_block_means)(picture, shrink, np.empty(picture.shape[1], np.int32), coarse)
    expected = cv2.resize(picture, (80, 60), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(coarse, expected)
