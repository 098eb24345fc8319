from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.interfaces import ConnectError, DeviceLostError
from drivers.sim.camera import CameraFaults, SimCamera


def record(camera: SimCamera, count: int) -> list:
    camera.start(count)
    return list(iter(camera.read, None))


def test_frames_are_stamped_in_the_middle_of_their_exposure(cell) -> None:
    cell.clock.sleep_s(1.0)
    frames = record(cell.camera, 5)
    exposure_s = 0.0005
    assert [f.t_s for f in frames] == pytest.approx(1.0 + exposure_s / 2 + np.arange(5) / 200.0)
    assert cell.clock.now_s() == pytest.approx(frames[-1].t_s + exposure_s / 2 + 0.004)


def test_the_cable_is_in_the_picture_only_while_it_is_held(cell) -> None:
    def dark(image: np.ndarray) -> int:
        return int(np.sum(image[99:102, 45:135] < 100))

    assert dark(record(cell.camera, 1)[0].image) == 0
    cell.gripper.grip(20.0)
    assert dark(record(cell.camera, 1)[0].image) > 80
    cell.gripper.release()
    assert dark(record(cell.camera, 1)[0].image) == 0


def test_same_seed_same_picture(cell) -> None:
    a = record(cell.camera, 3)
    b = record(cell.camera, 3)
    assert not np.array_equal(a[1].image, a[2].image)
    assert not np.array_equal(a[1].image, b[1].image)
    twin = SimCamera(cell.world, cell.camera._options, seed=2)
    twin.connect()
    assert np.array_equal(record(twin, 3)[1].image, a[1].image)


def test_missing_frames_leave_a_gap(cell) -> None:
    cell.camera.faults = CameraFaults(missing_frames=frozenset({0, 2, 5}))
    assert [f.index for f in record(cell.camera, 6)] == [1, 3, 4]


def test_frozen_frames_repeat_the_last_good_one(cell) -> None:
    cell.camera.faults = CameraFaults(frozen_from=2)
    frames = record(cell.camera, 5)
    assert not np.array_equal(frames[0].image, frames[1].image)
    assert all(np.array_equal(f.image, frames[1].image) for f in frames[2:])
    assert len({f.t_s for f in frames}) == 5


def test_black_saturated_noisy_and_wrongly_stamped_frames(cell) -> None:
    good = record(cell.camera, 3)
    cell.camera.faults = CameraFaults(
        black_frames=frozenset({0}), saturated_frames=frozenset({1}), stamp_error_s=0.1
    )
    bad = record(cell.camera, 3)
    assert bad[0].image.mean() < 3
    assert np.mean(bad[1].image == 255) > 0.9
    assert bad[2].t_s - good[2].t_s > 0.1
    cell.camera.faults = replace(cell.camera.faults, noise_level=15.0)
    flat = (slice(0, 40), slice(80, 200))
    noisy = record(cell.camera, 3)[2].image[flat]
    assert noisy.std() > 10 > 2 * good[2].image[flat].std() / 3


def test_a_late_frame_is_handed_over_late_with_its_own_time(cell) -> None:
    cell.camera.faults = CameraFaults(late_from=1, late_s=2.0)
    cell.camera.start(2)
    cell.camera.read()
    frame = cell.camera.read()
    assert frame.t_s < 0.01 and cell.clock.now_s() > 2.0


def test_a_lost_camera_gives_no_frame_exposed_later(cell) -> None:
    cell.camera.faults = CameraFaults(lost_at_s=0.0101)
    cell.camera.start(10)
    assert [cell.camera.read().index for _ in range(2)] == [0, 1]
    with pytest.raises(DeviceLostError, match="no longer arrive"):
        for _ in range(5):
            cell.camera.read()
    with pytest.raises(ConnectError):
        cell.camera.connect()
