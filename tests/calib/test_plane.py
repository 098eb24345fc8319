"""The plane's homography: exact on exact points, honest on noisy ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from calib.plane import PlaneView, fit_plane

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
    fit = fit_plane(grid(), view.to_plane(grid()))
    assert_allclose(fit.view.homography, view.homography, rtol=1e-4, atol=1e-7)
    assert fit.residuals_m.max() < 1e-8
    assert fit.held_out_rms_m < 1e-7


def test_four_points_fit_exactly_and_say_nothing_about_the_error():
    corners = np.array([[0.0, 0.0], [1000.0, 0.0], [1000.0, 800.0], [0.0, 800.0]])
    fit = fit_plane(corners, TILTED.to_plane(corners))
    assert fit.residuals_m.max() < 1e-9
    assert np.isnan(fit.held_out_rms_m)


def test_the_held_out_error_predicts_the_error_elsewhere():
    rng = np.random.default_rng(0)
    elsewhere = rng.uniform([50, 40], [1230, 980], (200, 2))
    said, true = [], []
    for _ in range(40):
        seen = grid() + rng.normal(0.0, 0.5, (20, 2))
        fit = fit_plane(seen, TILTED.to_plane(grid()))
        assert fit.held_out_rms_m > np.sqrt(np.mean(fit.residuals_m**2))
        said.append(fit.held_out_rms_m)
        noisy = elsewhere + rng.normal(0.0, 0.5, (200, 2))
        off = fit.view.to_plane(noisy) - TILTED.to_plane(elsewhere)
        true.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    assert np.mean(said) == pytest.approx(np.mean(true), rel=0.15)


def test_useless_points_are_named():
    line = np.stack([np.arange(6.0), 2.0 * np.arange(6.0)], axis=1)
    with pytest.raises(ValueError, match="one line"):
        fit_plane(line, line)
    with pytest.raises(ValueError, match="3 correspondences"):
        fit_plane(line[:3], line[:3])
    with pytest.raises(ValueError, match="all points are the same"):
        fit_plane(np.ones((5, 2)), np.ones((5, 2)))
    with pytest.raises(ValueError, match=r"\(6, 2\) and points_m \(5, 2\)"):
        fit_plane(line, line[:5])
    with pytest.raises(ValueError, match="not finite"):
        fit_plane(np.full((5, 2), np.nan), np.ones((5, 2)))
