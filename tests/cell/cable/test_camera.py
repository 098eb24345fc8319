"""What a camera shows of points that could not be simulated."""

import numpy as np

from cell.cable import camera
from cell.cable.effects import library
from cell.cable.geometry import Cable
from cell.cable.model import CableModel


def test_points_that_are_nowhere_are_seen_nowhere_without_a_word():
    """A cable that a trial step of a fit throws apart has nan nodes; warnings are errors here."""
    shutter = library()["rolling_shutter"].active(s_per_m=0.05)
    model = CableModel(Cable(0.1, 0.0074, 0.016, 0.0001), np.array([2e-5]), effects=(shutter,))
    times_s = np.linspace(0.1, 0.3, 5)
    scene_s = camera.scene_times(model, times_s, 0.0, 0.4, 1e-3)
    points = np.zeros((len(scene_s), 2, 2))
    points[len(scene_s) // 2 :, 1] = np.nan
    seen = camera.image_positions(model, times_s, scene_s, points)
    assert np.isfinite(seen[:, 0]).all()
    assert np.isfinite(seen[0, 1]).all()
    assert np.isnan(seen[-1, 1]).all()


def test_of_a_cable_that_has_run_away_nothing_is_seen_before_its_scene() -> None:
    """The parabola into the past overflowed, which a user was told in numpy's words."""
    late = library()["camera_latency"].active(delay_s=0.05)
    model = CableModel.uniform(Cable(0.1, 0.0074, 0.016, 1e-4), 3e-5, effects=(late,))
    scene_s = np.linspace(0.0, 0.1, 51)
    away = np.full((51, 1, 2), 1e308) * np.sign(np.sin(np.arange(51.0) * 2.0))[:, None, None]
    seen = camera.image_positions(model, np.array([0.01, 0.09]), scene_s, away, in_motion=True)
    assert np.isnan(seen[0]).all()
