"""Curves against circles and lines, whose arc length, curvature and moment are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from cell.vision.curve import (
    Curve,
    basis_matrix,
    choose_penalty,
    chord_parameters,
    fit_curve,
    roughness,
)


def circle(curvature, angle, length, count):
    s = np.linspace(0.0, length, count)
    theta = angle + curvature * s
    x = (np.sin(theta) - np.sin(angle)) / curvature
    y = (np.cos(angle) - np.cos(theta)) / curvature
    return np.stack([x, y], axis=1)


@settings(max_examples=40, deadline=None)
@given(
    curvature=st.floats(1.0, 30.0),
    angle=st.floats(-3.0, 3.0),
    length=st.floats(0.05, 0.15),
    intervals=st.integers(3, 12),
)
def test_a_circle_keeps_its_length_and_curvature(curvature, angle, length, intervals):
    """Within the order of quintic splines: 6 in place, 5 in direction, 4 in curvature (de Boor).

    What counts is how far the circle turns in one interval.  Measured with 3 to 12 intervals that
    turn by 0.05 to 1.5 rad: at most 0.33 of the bound of length, 0.23 of direction, 0.63 of
    curvature.
    """
    points = circle(curvature, angle, length, 300)
    curve = fit_curve(chord_parameters(points), points, np.ones(300), intervals, 1e-15)
    line = curve.centreline(500)
    turn = curvature * length / intervals
    turned = line.angle_rad[-1] - line.angle_rad[0]
    assert line.length_m == pytest.approx(length, rel=1e-4 * turn**6 + 1e-6)
    assert turned == pytest.approx(curvature * length, rel=3e-3 * turn**5 + 1e-5)
    assert line.curvature_1_per_m == pytest.approx(curvature, rel=2e-2 * turn**4 + 1e-3)


def test_noise_across_the_curve_does_not_lengthen_it():
    points = circle(10.0, 0.0, 0.1, 400)
    u = np.linspace(0.0, 1.0, 400)
    normals = np.stack([-np.sin(u), np.cos(u)], axis=1)  # turned through 1 rad in all
    noisy = points + 5e-5 * np.random.default_rng(0).standard_normal(400)[:, None] * normals
    assert (
        np.sum(np.linalg.norm(np.diff(noisy, axis=0), axis=1)) > 0.101
    )  # what a polyline would say
    curve = fit_curve(u, noisy, np.ones(400), 7, 1e-10)
    assert curve.centreline(500).length_m == pytest.approx(0.1, abs=2e-5)


def test_a_held_direction_is_held_and_ignored_points_are_ignored():
    points = circle(5.0, 0.3, 0.1, 200)
    points[50:60] += 1.0
    weights = np.ones(200)
    weights[50:60] = 0.0
    u = np.linspace(0.0, 1.0, 200)
    curve = fit_curve(u, points, weights, 8, 1e-12, np.array([1.0, 0.0]))
    start = curve.at(np.zeros(1), 1)[0]
    assert start[1] == pytest.approx(0.0, abs=1e-9)
    assert start[0] > 0.05
    assert curve.at(np.array([0.27])) == pytest.approx(circle(5.0, 0.3, 0.027, 2)[1:], abs=1e-4)


def test_roughness_is_the_integral_of_the_third_derivative_squared():
    rng = np.random.default_rng(1)
    coefficients = rng.standard_normal(9)
    fine = np.linspace(0.0, 1.0, 200001)
    third = basis_matrix(4, fine, 3) @ coefficients
    assert coefficients @ roughness(4) @ coefficients == pytest.approx(
        np.trapezoid(third**2, fine), rel=1e-6
    )


@pytest.mark.parametrize("derivative", [0, 1, 2, 5])
@pytest.mark.parametrize("intervals", [1, 5, 7, 10])
def test_points_are_those_of_the_splines_and_go_on_beyond_the_ends(intervals, derivative):
    rng = np.random.default_rng(0)
    curve = Curve(rng.normal(size=(intervals + 5, 2)))
    u = np.concatenate([rng.uniform(-0.1, 1.1, 50), [0.0, 1.0 / 7.0, 1.0]])
    knots = np.pad(np.linspace(0.0, 1.0, intervals + 1), 5, mode="edge")
    spline = BSpline(knots, curve.coefficients, 5)
    expected = spline.derivative(derivative)(u) if derivative else spline(u)
    found = curve.at(u, derivative), basis_matrix(intervals, u, derivative) @ curve.coefficients
    for points in found:
        np.testing.assert_allclose(points, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_the_penalty_follows_the_noise():
    u = np.linspace(0.0, 1.0, 250)
    points = circle(15.0, 0.0, 0.25, 250)
    wave = np.convolve(np.random.default_rng(0).standard_normal(270), np.ones(21) / 4.6, "valid")
    normals = np.stack([-np.sin(15.0 * 0.25 * u), np.cos(15.0 * 0.25 * u)], axis=1)
    quiet = choose_penalty(u, points + 1e-6 * wave[:, None] * normals, 16, 20)
    loud = choose_penalty(u, points + 3e-4 * wave[:, None] * normals, 16, 20)
    assert loud > 10.0 * quiet


@given(length=st.floats(0.05, 0.5), load=st.floats(0.01, 20.0))
def test_the_moment_of_a_level_cantilever_is_half_of_load_times_length_squared(length, load):
    points = np.stack([np.linspace(0.0, length, 50), np.zeros(50)], axis=1)
    line = fit_curve(chord_parameters(points), points, np.ones(50), 3, 1e-12).centreline(400)
    moment = line.moment(load)
    assert moment[0] == pytest.approx(0.5 * load * length**2, rel=1e-3)
    assert moment[-1] == 0.0
    assert np.all(np.diff(moment) < 0.0)


def test_too_few_points_are_named():
    with pytest.raises(ValueError, match="3 usable points"):
        fit_curve(np.linspace(0, 1, 3), np.zeros((3, 2)), np.ones(3), 4, 1e-9)
