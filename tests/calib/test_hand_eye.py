"""The classic hand–eye calibration of a gripper that moves in one plane, against the true map."""

from __future__ import annotations

import numpy as np
import pytest

from calib.camera import picture_grid
from calib.hand_eye import classic_view
from calib.jaw_marks import JawObservation
from calib.lens import pose
from calib.plane import PlaneView
from drivers.sim.render import JAW_MARKS_M
from tests.calib.conftest import SIZE_PX, lens_of

MARKS_M = np.array(JAW_MARKS_M)[:, :2]
BESIDE = np.array([0.0, 0.0, 0.02, 0.003, -0.002, 0.0])


@pytest.mark.parametrize(("noise_px", "most_m"), [(0.0, 1e-7), (0.02, 6e-4)])
def test_the_plane_is_found_from_places_where_turns_about_one_axis_say_too_little(
    eye, noise_px, most_m
):
    rng, X_BP = np.random.default_rng(4), pose(np.array([0.0, 0.0, 0.1, 0.2, -0.1, 0.0]))
    shown = []
    for k in range(24):
        x, y, turn = rng.uniform([-0.06, -0.1, -0.35], [0.02, 0.02, 0.35])
        X_PT = pose(np.array([0.0, 0.0, turn, x, y, 0.0]))
        flat = np.column_stack([MARKS_M, np.zeros((len(MARKS_M), 1))])
        X_PM = X_PT @ pose(BESIDE)
        pixels = eye.to_pixels(flat @ X_PM[:3, :3].T + X_PM[:3, 3])
        pixels += rng.normal(0.0, noise_px, pixels.shape)
        shown.append(JawObservation(f"{k}", X_BP @ X_PT, pixels))
    lens, grid = lens_of(eye), picture_grid(SIZE_PX)
    found = classic_view(shown, MARKS_M, lens, X_BP)
    away = found.to_plane(grid) - PlaneView.from_pose(lens, eye.X_CP).to_plane(grid)
    assert np.max(np.linalg.norm(away, axis=-1)) < most_m
