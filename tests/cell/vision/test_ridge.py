"""Lines painted with a known profile at a known place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cell.vision.ridge import End, Picture, crossings, find_start, follow, offsets_along


def painted(angle, offset, *, ends=(-1e9, 1e9), sign=1, slope=0.0, width=1.0, edge=0.0):
    """A line through the middle of 240 × 320 pixels, `offset` px beside it, and its direction."""
    v, u = np.mgrid[:240, :320].astype(float)
    d = np.array([np.cos(angle), np.sin(angle)])
    along = (u - 160.0) * d[0] + (v - 120.0) * d[1]
    across = (v - 120.0) * d[0] - (u - 160.0) * d[1] - offset
    line = np.exp(-0.5 * (across / width) ** 2) * ((along > ends[0]) & (along < ends[1]))
    level = 120.0 + sign * 60.0 * line + slope * across + edge * (across > 10.0)
    return np.clip(np.rint(level), 0, 255).astype(np.uint8), d


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
    normals = np.broadcast_to([-d[1], d[0]], points.shape)
    offsets, amplitudes, left = offsets_along(Picture(image, None, sign), points, normals, 1.0)
    assert np.mean(offsets) == pytest.approx(offset, abs=0.06)  # one step of Gauss–Newton
    assert np.mean(amplitudes) == pytest.approx(60.0, rel=0.25)
    assert np.mean(left) < 8.0


def test_where_there_is_no_line_there_is_no_offset():
    image, d = painted(0.3, 0.0, sign=-1)
    points = np.array([160.0, 120.0]) + np.linspace(-30, 30, 61)[:, None] * d
    normals = np.broadcast_to([-d[1], d[0]], points.shape)
    offsets, _, _ = offsets_along(Picture(image, None, +1), points, normals, 1.0)
    assert np.all(np.isnan(offsets))


@settings(max_examples=30, deadline=None)
@given(angle=st.floats(-3.1, 3.1), end=st.floats(40.0, 90.0))
def test_a_line_is_started_and_followed_to_its_end(angle, end):
    image, d = painted(angle, 0.0, ends=(-20.0, end))
    picture = Picture(image, None, 1)
    at = np.array([160.0, 120.0]) + 2.0 * np.array([-d[1], d[0]])
    start, heading, contrast = find_start(picture, at, d, reach_px=4.0)
    assert contrast > 20.0
    assert heading @ d > 0.99
    points, contrasts, why = follow(
        picture,
        start,
        heading,
        contrast=contrast,
        seen_share=0.4,
        step_px=2.0,
        gap_px=10.0,
        longest_px=400.0,
    )
    across = (points - np.array([160.0, 120.0])) @ np.array([-d[1], d[0]])
    assert why is End.FADED
    assert len(points) == len(contrasts)
    assert (points[-1] - np.array([160.0, 120.0])) @ d == pytest.approx(end, abs=3.0)
    assert np.abs(across[2:-1]).max() < 0.35


def test_a_line_that_goes_on_leaves_the_picture_or_is_too_long():
    image, d = painted(0.2, 0.0)
    how = {"contrast": 40.0, "seen_share": 0.4, "step_px": 2.0, "gap_px": 10.0}
    picture = Picture(image, None, 1)
    middle = np.array([160.0, 120.0])
    assert follow(picture, middle, d, **how, longest_px=900.0)[2] is End.LEFT_PICTURE
    assert follow(picture, middle, d, **how, longest_px=50.0)[2] is End.TOO_LONG


def test_an_edge_is_not_a_line():
    image, d = painted(0.5, 0.0, sign=0, edge=80.0)
    at = np.array([160.0, 120.0]) + 10.0 * np.array([-d[1], d[0]])
    for sign in (1, -1):
        _, _, contrast = find_start(Picture(image, None, sign), at, d, reach_px=6.0)
        assert contrast < 3.0


def test_what_the_background_shows_too_is_not_there():
    image, d = painted(0.5, 0.0)
    points, _ = crossings(Picture(image, None, 1), np.array([160.0, 120.0]), 60.0, 0.5, 1.5)
    assert len(points) == 1
    assert points[0] == pytest.approx(np.array([160.0, 120.0]) + 60.0 * d, abs=1.0)
    points, _ = crossings(Picture(image, image, 1), np.array([160.0, 120.0]), 60.0, 0.5, 1.5)
    assert len(points) == 0
