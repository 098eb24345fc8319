"""What every camera keeps, simulated, replayed, emulated or real."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import Camera, CameraError, ConnectError, DeviceLostError, LimitError


@pytest.fixture
def bench(camera_bench):
    camera_bench.camera.connect()
    return camera_bench


def record(bench, count: int) -> list:
    bench.camera.start(count)
    return list(iter(bench.camera.read, None))


def test_is_a_camera(bench) -> None:
    assert isinstance(bench.camera, Camera)
    assert bench.camera.name
    assert bench.camera.frame_rate_hz > 0.0


def test_gives_exactly_the_frames_asked_for_in_order(bench) -> None:
    began_s = bench.clock.now_s()
    frames = record(bench, 12)
    assert [f.index for f in frames] == list(range(12))
    times = np.array([f.t_s for f in frames])
    assert np.all(np.diff(times) > 0.0)
    assert np.median(np.diff(times)) == pytest.approx(1.0 / bench.camera.frame_rate_hz, rel=0.2)
    assert began_s <= times[0] and times[-1] <= bench.clock.now_s()


def test_frames_are_grey_pictures_of_one_size(bench) -> None:
    frames = record(bench, 3)
    assert {f.image.shape for f in frames} == {frames[0].image.shape}
    assert all(f.image.dtype == np.uint8 and f.image.ndim == 2 for f in frames)


def test_records_again(bench) -> None:
    first, second = record(bench, 5), record(bench, 5)
    assert [f.index for f in second] == list(range(5))
    assert second[0].t_s >= first[-1].t_s


def test_nothing_is_read_before_start_and_after_the_last(bench) -> None:
    assert bench.camera.read() is None
    record(bench, 2)
    assert bench.camera.read() is None


def test_stop_drops_what_was_not_read(bench) -> None:
    bench.camera.start(10)
    bench.camera.read()
    bench.camera.stop()
    bench.camera.stop()
    assert bench.camera.read() is None
    assert len(record(bench, 3)) == 3


@pytest.mark.parametrize("count", [0, -1])
def test_refuses_to_record_nothing(bench, count) -> None:
    with pytest.raises((CameraError, LimitError)):
        bench.camera.start(count)


def test_can_be_checked_while_it_is_connected_recording_or_not(bench) -> None:
    bench.camera.check()
    bench.camera.start(5)
    bench.camera.check()
    bench.camera.stop()


def test_a_camera_that_is_lost_fails_its_check(bench) -> None:
    if bench.lose is None:
        pytest.skip("this bench cannot make its camera fall silent")
    bench.lose()
    bench.clock.sleep_s(0.6)
    with pytest.raises(DeviceLostError):
        bench.camera.check()


def test_closing_may_be_repeated_and_undone(bench) -> None:
    bench.camera.start(5)
    bench.camera.close()
    bench.camera.close()
    bench.camera.connect()
    assert len(record(bench, 2)) == 2


def test_a_camera_that_refuses_says_which_and_what_to_do(camera_bench) -> None:
    if camera_bench.refuse is None:
        pytest.skip("this bench cannot make its camera refuse")
    camera_bench.refuse()
    with pytest.raises(ConnectError) as error:
        camera_bench.camera.connect()
    assert error.value.device == camera_bench.camera.name
    assert error.value.remedy


def test_a_lost_camera_is_an_error(bench) -> None:
    if bench.lose is None:
        pytest.skip("this bench cannot lose its camera")
    bench.camera.start(50)
    bench.camera.read()
    bench.lose()
    with pytest.raises(DeviceLostError) as error:
        for _ in range(50):
            bench.camera.read()
    assert error.value.device == bench.camera.name
    bench.camera.stop()
    bench.camera.close()
