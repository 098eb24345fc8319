"""Series of clocks of their own in one table, and series with lost frames."""

import numpy as np
import pytest

from cell.identify.innovations import frames_since
from cell.identify.noise import Noise
from cell.identify.whitener import Whitener


def test_a_lost_frame_counts_and_another_cameras_frame_does_not():
    every, second = np.ones(12, dtype=bool), np.arange(12) % 2 == 1
    lost, second_lost = every.copy(), second.copy()
    lost[4:6] = False
    second_lost[5] = False
    since = frames_since(np.stack([every, second, lost, second_lost], axis=1))
    assert since[:, 0].tolist() == [0, *[1] * 11]
    assert since[second, 1].tolist() == [0, *[1] * 5]
    assert since[lost, 2].tolist() == [0, 1, 1, 1, 3, 1, 1, 1, 1, 1]
    assert since[second_lost, 3].tolist() == [0, 1, 2, 1, 1]


@pytest.mark.parametrize("white", [0.0, 0.3])
def test_two_cameras_in_one_table_are_whitened_as_each_by_itself(white):
    """Their rows alternate: each counted the other's as frames that it had lost."""
    rng, noise = np.random.default_rng(0), Noise(1e-4, 0.6, white=white)
    each = [1e-4 * rng.normal(size=(40, 1, 2)) for _ in range(2)]
    together = np.full((80, 2, 2), np.nan)
    for camera, xy_m in enumerate(each):
        together[camera::2, camera] = xy_m[:, 0]
    found = Whitener(together, noise)(np.zeros((1, 80, 2, 2)))[0].reshape(2, 2, 80)
    for camera, xy_m in enumerate(each):
        alone = Whitener(xy_m, noise)(np.zeros((1, 40, 1, 2)))[0].reshape(2, 40)
        assert found[camera, :, camera::2] == pytest.approx(alone, rel=1e-12)
