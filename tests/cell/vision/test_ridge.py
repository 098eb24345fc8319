"""Lines painted with a known profile at a known place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from cell.vision.ridge import (
    End,
    GreyImage,
    RidgeStart,
    crossings,
    find_start,
    follow,
    new_scratch,
    offset_at,
    profile_fit,
)

from .entries import entry


def painted(angle, offset, *, ends=(-1e9, 1e9), sign=1, slope=0.0, width=1.0, edge=0.0):
    """A line through the middle of 240 × 320 pixels, `offset` px beside it, and its direction."""
    v, u = np.mgrid[:240, :320].astype(float)
    d = np.array([np.cos(angle), np.sin(angle)])
    along = (u - 160.0) * d[0] + (v - 120.0) * d[1]
    across = (v - 120.0) * d[0] - (u - 160.0) * d[1] - offset
    line = np.exp(-0.5 * (across / width) ** 2) * ((along > ends[0]) & (along < ends[1]))
    level = 120.0 + sign * 60.0 * line + slope * across + edge * (across > 10.0)
    return np.clip(np.rint(level), 0, 255).astype(np.uint8), d


@njit
def offsets_beside(picture, points, normal, fit, scratch):
    found = np.empty((len(points), 3))
    for n in range(len(points)):
        found[n] = offset_at(
            picture, points[n, 0], points[n, 1], normal[0], normal[1], fit, scratch
        )
    return found


def followed(picture, start, *, gap=10.0, longest=400.0):
    line = np.empty((int(longest / 2.0), 3))
    count, why = entry(follow)(picture, start, 0.4, 2.0, gap, line, new_scratch())
    return line[:count], End(why)


def crossed(picture):
    found = np.empty((64, 3))
    ring = (160.0, 120.0, 60.0, 0.5, 1.5)
    return found[: entry(crossings)(picture, ring, new_scratch(200), found)]


@settings(max_examples=60, deadline=None)
@given(
    angle=st.floats(-3.1, 3.1),
    offset=st.floats(-0.6, 0.6),
    sign=st.sampled_from([-1, 1]),
    slope=st.floats(-0.3, 0.3),
)
def test_the_offset_across_is_right_whatever_the_direction_and_the_base(angle, offset, sign, slope):
    image, d = painted(angle, offset, sign=sign, slope=slope)
    points = np.array([160.0, 120.0]) + np.linspace(-60, 60, 121)[:, None] * d
    picture, normal = GreyImage.of(image, sign), np.array([-d[1], d[0]])
    offsets, amplitudes, left = offsets_beside(
        picture, points, normal, profile_fit(1.0), new_scratch()
    ).T
    assert np.mean(offsets) == pytest.approx(offset, abs=0.06)  # one step of Gauss–Newton
    assert np.mean(amplitudes) == pytest.approx(60.0, rel=0.25)
    assert np.mean(left) < 8.0


def test_where_there_is_no_line_there_is_no_offset():
    image, d = painted(0.3, 0.0, sign=-1)
    points = np.array([160.0, 120.0]) + np.linspace(-30, 30, 61)[:, None] * d
    picture, normal = GreyImage.of(image, +1), np.array([-d[1], d[0]])
    offsets = offsets_beside(picture, points, normal, profile_fit(1.0), new_scratch())[:, 0]
    assert np.all(np.isnan(offsets))


@settings(max_examples=30, deadline=None)
@given(angle=st.floats(-3.1, 3.1), end=st.floats(40.0, 90.0))
def test_a_line_is_started_and_followed_to_its_end(angle, end):
    image, d = painted(angle, 0.0, ends=(-20.0, end))
    picture = GreyImage.of(image, 1)
    at = np.array([160.0, 120.0]) + 2.0 * np.array([-d[1], d[0]])
    start = entry(find_start)(picture, tuple(at), tuple(d), 4.0, 0.5, new_scratch())
    assert start.contrast > 20.0
    assert np.array([start.du, start.dv]) @ d > 0.99
    line, why = followed(picture, start)
    points = line[:, :2]
    across = (points - np.array([160.0, 120.0])) @ np.array([-d[1], d[0]])
    assert why is End.FADED
    assert np.all(line[:-1, 2] > 20.0)
    assert (points[-1] - np.array([160.0, 120.0])) @ d == pytest.approx(end, abs=3.0)
    assert np.abs(across[2:-1]).max() < 0.35


def test_a_line_that_goes_on_leaves_the_picture_or_is_too_long():
    image, d = painted(0.2, 0.0)
    picture, start = GreyImage.of(image, 1), RidgeStart(160.0, 120.0, *d.tolist(), 40.0)
    assert followed(picture, start, longest=900.0)[1] is End.LEFT_PICTURE
    assert followed(picture, start, longest=50.0)[1] is End.TOO_LONG


@pytest.mark.parametrize("row", [3.0, 5.0, 234.5, 236.0])
def test_every_point_of_a_line_along_the_edge_of_the_picture_is_a_number(row):
    image, d = painted(0.01, row - 120.0)
    line, why = followed(GreyImage.of(image, 1), RidgeStart(40.0, row, *d.tolist(), 40.0))
    assert np.all(np.isfinite(line))
    assert why is not End.TOO_LONG


def test_an_edge_is_not_a_line():
    image, d = painted(0.5, 0.0, sign=0, edge=80.0)
    at = np.array([160.0, 120.0]) + 10.0 * np.array([-d[1], d[0]])
    for sign in (1, -1):
        picture = GreyImage.of(image, sign)
        start = entry(find_start)(picture, tuple(at), tuple(d), 6.0, 0.5, new_scratch())
        assert start.contrast < 3.0


def test_a_line_is_crossed_once_where_it_is():
    image, d = painted(0.5, 0.0)
    points = crossed(GreyImage.of(image, 1))[:, :2]
    assert len(points) == 1
    assert points[0] == pytest.approx(np.array([160.0, 120.0]) + 60.0 * d, abs=1.0)


def test_what_lies_beyond_the_edge_is_no_line():
    image, d = painted(0.0, 0.0)
    picture = GreyImage.of(image, 1)
    start = entry(find_start)(picture, (319.0, 120.0), tuple(d), 3.0, 0.5, new_scratch())
    assert not start.contrast > 5.0
