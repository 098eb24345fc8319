"""The lens' fit: right, honest about it, and not without enough to see."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib.camera import different_views, fit_camera, lens_difference, lens_spread
from calib.errors import BlurredError, MisfitError, OneSidedError, TooFewError
from cell.wiring.simulated_assistant import board_poses
from tests.calib.conftest import BOARD, SIZE_PX, lens_of, middle_m, standing, views_of


def test_the_lens_is_found_and_its_uncertainty_is_true():
    """Over random lenses, (found − true)² / variance is 1 on average."""
    rng = np.random.default_rng(5)
    scores = []
    for _ in range(4):
        k1 = rng.uniform(-0.3, 0.1)
        eye = standing(focal_px=rng.uniform(2300, 2900), distortion=(k1, 0.05, 3e-4, -2e-4, 0.0))
        fit = fit_camera(views_of(eye, rng, count=12), BOARD)
        off = fit.lens.numbers - lens_of(eye).numbers
        scores.append(off @ np.linalg.solve(fit.covariance, off) / 9.0)
        away = lens_difference(fit.lens, lens_of(eye), SIZE_PX)
        assert 2e-4 * np.sqrt(np.mean(away**2)) < 2e-5
        assert fit.noise_px == pytest.approx(0.03, rel=0.1)
    assert 0.5 < np.mean(scores) < 1.6


def test_the_spread_over_the_picture_is_that_of_repeated_fits(eye):
    rng = np.random.default_rng(2)
    poses = board_poses(BOARD, 10, rng, middle_m(), 0.08)
    fits = [fit_camera(views_of(eye, rng, poses=poses), BOARD) for _ in range(5)]
    offs = [lens_difference(fit.lens, lens_of(eye), SIZE_PX) for fit in fits]
    said = lens_spread(fits[0].lens, fits[0].covariance, SIZE_PX)
    ratio = np.sqrt(np.mean(np.square(offs)) / np.mean(said**2))
    assert 0.6 < ratio < 1.5
    assert np.all(fits[0].spread_px >= 0.0)


def test_a_bowed_board_is_recognised(eye):
    rng = np.random.default_rng(3)
    width = BOARD.size_m[0]
    views = []
    for k, X in enumerate(board_poses(BOARD, 14, rng, middle_m(), 0.08)):
        bent = BOARD.corners_m.copy()
        bent[:, 2] += 4e-4 * (1.0 - (2.0 * bent[:, 0] / width - 1.0) ** 2)
        pixels = eye.to_pixels(bent @ X[:3, :3].T + X[:3, 3])
        seen = np.all((pixels > 5) & (pixels < np.array(SIZE_PX) - 6), axis=1)
        noisy = pixels[seen] + rng.normal(0.0, 0.03, (seen.sum(), 2))
        views.append(replace(views_of(eye, rng, poses=[X])[0], name=f"{k}", pixels=noisy,
                             ids=np.flatnonzero(seen)))  # fmt: skip
    fit = fit_camera(views, BOARD)
    assert fit.warp_m[0] == pytest.approx(4e-4, abs=4 * fit.warp_std_m[0])
    assert fit.warp_m[1] == pytest.approx(0.0, abs=4 * fit.warp_std_m[1])


def test_wrong_corners_are_set_aside(eye):
    rng = np.random.default_rng(4)
    views = views_of(eye, rng)
    views[3].pixels[::9] += 3.0
    fit = fit_camera(views, BOARD)
    assert fit.views[3].outliers == len(views[3].pixels[::9])
    away = lens_difference(fit.lens, lens_of(eye), SIZE_PX)
    assert 2e-4 * np.sqrt(np.mean(away**2)) < 2e-5


def test_what_cannot_give_a_lens_is_named(eye):
    rng = np.random.default_rng(1)
    good = views_of(eye, rng)
    with pytest.raises(TooFewError, match="found in 3 of at least 8 pictures that differ"):
        fit_camera(good[:3], BOARD)
    with pytest.raises(BlurredError, match="are blurred"):
        fit_camera([replace(v, blur_px=4.0) for v in good], BOARD)
    with pytest.raises(MisfitError, match="different sizes"):
        fit_camera([*good[:-1], replace(good[-1], size_px=(640, 480))], BOARD)
    flat = []
    for X in board_poses(BOARD, 12, rng, middle_m(), 0.08):
        level = X.copy()
        level[:3, :3] = cv2.Rodrigues(rng.normal(0.0, 0.02, 3))[0] @ np.diag([1.0, -1.0, -1.0])
        centre = 0.5 * np.array([*BOARD.size_m, 0.0])
        level[:3, 3] += (X[:3, :3] - level[:3, :3]) @ centre
        flat.append(level)
    with pytest.raises(OneSidedError, match="tilted by"):
        fit_camera(views_of(eye, rng, poses=flat), BOARD)
    with pytest.raises(MisfitError, match="px rms"):
        fit_camera(views_of(eye, rng, noise_px=0.9), BOARD)


def test_a_wide_lens_seen_in_the_middle_only_stays_unknown_at_the_edges():
    eye = standing(focal_px=900.0, distortion=(-0.32, 0.12, 0.0, 0.0, -0.02))
    views = []
    for view in views_of(eye, np.random.default_rng(2), count=12):
        near = np.linalg.norm(view.pixels - np.array(SIZE_PX) / 2, axis=1) < 330.0
        views.append(replace(view, ids=view.ids[near], pixels=view.pixels[near]))
    with pytest.raises(OneSidedError, match=r"in \d+% of the picture the lens stays unknown"):
        fit_camera(views, BOARD)


def test_copies_and_bursts_of_a_still_board_are_one_picture(eye):
    """Three times the same pictures made the stated error smaller, and halves that agree."""
    rng = np.random.default_rng(5)
    views = views_of(eye, rng, count=12)
    copies = [replace(v, name=f"{v.name} copy") for v in views]
    burst = [
        replace(v, name=f"{v.name} burst", pixels=rng.normal(v.pixels, 0.05)) for v in views[::2]
    ]
    once, many = fit_camera(views, BOARD), fit_camera([*views, *copies, *burst], BOARD)
    assert [v.name for v in many.views] == [v.name for v in once.views]
    np.testing.assert_allclose(many.spread_px, once.spread_px, rtol=1e-3)
    np.testing.assert_allclose(many.halves_px, once.halves_px, atol=1e-3)
    left_out = different_views([*views, *burst]).left_out
    assert len(left_out) == 6
    assert "burst shows the same as" in left_out[0]
    with pytest.raises(TooFewError, match="found in 3 of at least 8 pictures that differ"):
        fit_camera([*views[:3], *copies[:3], *copies[:3]], BOARD)
