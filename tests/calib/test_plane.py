"""The plane's homography: exact on exact points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from calib.plane import PlaneView, fit_homography

TILTED = PlaneView(
    np.array([[2.0e-4, 1.0e-5, -0.13], [8.0e-6, -2.1e-4, 0.105], [3.0e-5, -4.0e-5, 1.0]])
)


def grid(columns=5, rows=4):
    u, v = np.meshgrid(np.linspace(50, 1230, columns), np.linspace(40, 980, rows))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@given(
    column=st.floats(0, 1280),
    row=st.floats(0, 1024),
    scale=st.floats(1e-5, 1e-2),
    x=st.floats(-1, 1),
)
def test_pixels_to_plane_and_back(column, row, scale, x):
    pixel = np.array([column, row])
    for view in (TILTED, PlaneView.from_scale(scale, 100.0 * x, 200.0)):
        assert_allclose(view.to_pixels(view.to_plane(pixel)), pixel, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(entries=st.lists(st.floats(-1.0, 1.0), min_size=8, max_size=8))
def test_any_homography_is_recovered_from_exact_points(entries):
    change = np.array([*entries, 0.0]).reshape(3, 3) * np.array(
        [[1e-4, 1e-4, 0.1], [1e-4, 1e-4, 0.1], [2e-4, 2e-4, 0.0]]
    )
    view = PlaneView(TILTED.homography + change)
    w = grid() @ view.homography[2, :2] + 1.0
    assume(w.min() > 0.2)
    assume(abs(np.linalg.det(view.homography)) > 1e-8)
    found = fit_homography(grid(), view.to_plane(grid()))
    assert_allclose(found, view.homography, rtol=1e-4, atol=1e-7)
    off_m = PlaneView(found).to_plane(grid()) - view.to_plane(grid())
    assert np.abs(off_m).max() < 1e-8


def test_four_points_fit_exactly():
    corners = np.array([[0.0, 0.0], [1000.0, 0.0], [1000.0, 800.0], [0.0, 800.0]])
    found = PlaneView(fit_homography(corners, TILTED.to_plane(corners)))
    assert_allclose(found.to_plane(corners), TILTED.to_plane(corners), atol=1e-9)


def test_useless_points_are_named():
    line = np.stack([np.arange(6.0), 2.0 * np.arange(6.0)], axis=1)
    with pytest.raises(ValueError, match="one line"):
        fit_homography(line, line)
    with pytest.raises(ValueError, match="all points are the same"):
        fit_homography(np.ones((5, 2)), np.ones((5, 2)))
