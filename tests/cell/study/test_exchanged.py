"""Markers that change places are found, with the row; motion is never taken for it."""

from __future__ import annotations

import numpy as np
import pytest

from cell.study.exchanged import Exchange, exchanges


def cable(frames_per_s: float, noise_m: float = 2e-4) -> np.ndarray:
    """(T, 6, 2) markers of a cable of 0.1 m that swings by ±1 rad at 2 Hz, m."""
    t_s = np.arange(0.0, 2.0, 1.0 / frames_per_s)
    angle = np.sin(2.0 * np.pi * 2.0 * t_s)[:, None] + 0.5 * np.pi
    arcs = np.linspace(0.1, 0.0, 6)
    xy_m = np.stack([arcs * np.cos(angle), -arcs * np.sin(angle)], axis=-1)
    return xy_m + np.random.default_rng(1).normal(0.0, noise_m, xy_m.shape)


@pytest.mark.parametrize("frames_per_s", [30.0, 100.0, 500.0])
@pytest.mark.parametrize("noise_m", [1e-5, 5e-4, 5e-3, 5e-2])
def test_a_swing_exchanges_nothing(frames_per_s, noise_m):
    assert exchanges(cable(frames_per_s, noise_m)) == []


@pytest.mark.parametrize(("one", "other"), [(0, 1), (0, 5), (2, 4)])
def test_an_exchange_is_found_in_its_row_to_its_end(one, other):
    xy_m = cable(100.0)
    xy_m[149:, [one, other]] = xy_m[149:, [other, one]]
    assert exchanges(xy_m) == [Exchange(one, other, 149, 200)]
    xy_m[180:, [one, other]] = xy_m[180:, [other, one]]
    assert exchanges(xy_m) == [Exchange(one, other, 149, 180)]


def test_where_both_are_lost_the_row_is_that_in_which_they_are_seen_again():
    xy_m = cable(200.0)
    xy_m[149:, [0, 3]] = xy_m[149:, [3, 0]]
    xy_m[149, [0, 3]] = np.nan
    assert exchanges(xy_m) == [Exchange(0, 3, 150, 400)]
