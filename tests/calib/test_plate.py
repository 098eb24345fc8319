"""The jaw's plate in a picture of which nothing is known: found, or not; never something else."""

from __future__ import annotations

import numpy as np
import pytest

from calib.plate import find_plate
from drivers.sim.render import JAW_MARKS_M, RenderOptions, render
from tests.calib.conftest import standing

MARKS_M = np.array(JAW_MARKS_M)[:, :2]


@pytest.mark.parametrize("tilt", [-0.5, 0.0, 0.4])
@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (-0.05, -0.09, 0.1), (-0.02, -0.04, -0.6)])
def test_marks_are_found_where_they_are(tilt, pose):
    eye = standing(tilt_rad=tilt, roll_rad=0.1)
    image = render(None, pose, eye, RenderOptions(), np.random.default_rng(1))
    found = find_plate(image, MARKS_M, 0.0025)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    true = eye.to_pixels(MARKS_M @ np.array([[c, s], [-s, c]]) + pose[:2])
    assert found is not None
    assert np.max(np.linalg.norm(found.pixels - true, axis=1)) < 0.08


def test_a_hidden_mark_a_mirrored_plate_and_no_plate_are_none():
    eye = standing()
    rng = np.random.default_rng(1)
    hidden = RenderOptions(marks_m=JAW_MARKS_M[:3])
    assert find_plate(render(None, (0.0, 0.0, 0.0), eye, hidden, rng), MARKS_M, 0.0025) is None
    image = render(None, (0.0, 0.0, 0.0), eye, RenderOptions(), rng)
    assert find_plate(image[:, ::-1].copy(), MARKS_M, 0.0025) is None
    assert find_plate(render(None, None, eye, RenderOptions(), rng), MARKS_M, 0.0025) is None
