from __future__ import annotations

import os
import signal
import socket
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers import opencv_camera
from drivers.clock import RealClock
from drivers.emulators.camera import CameraEmulatorOptions, EmulatedCamera, StreamFaults, TestCard
from drivers.guard import GuardedCamera
from drivers.interfaces import CameraError, ConnectError, DeviceLostError
from drivers.opencv_camera import OpenCvCamera, OpenCvOptions
from drivers.recording import CaptureOptions

CLOCK = RealClock()


def of(stream: EmulatedCamera, **changes) -> OpenCvCamera:
    options = {"width_px": 160, "height_px": 120, "exposure_s": None, **changes}
    return OpenCvCamera(OpenCvOptions(stream.url, **options), CLOCK)


@pytest.fixture
def camera(emulated_camera):
    it = of(emulated_camera)
    it.connect()
    yield it
    it.close()


def record(camera, count: int) -> list:
    camera.start(count)
    return list(iter(camera.read, None))


# --- against the emulated camera --------------------------------------------------------------


def test_pictures_arrive_bit_by_bit_and_none_is_missing(camera) -> None:
    frames = record(camera, 60)
    card = TestCard(160, 120, 200.0)
    numbers = [int(f.image[0, 0]) for f in frames]
    assert set(np.diff(numbers) % 256) == {1}
    for frame, number in zip(frames, numbers, strict=True):
        assert np.array_equal(frame.image, card.picture(number / 200.0))
    assert np.diff([f.t_s for f in frames]) == pytest.approx(0.005, abs=2e-6)


def test_times_are_those_of_the_exposure_once_the_latency_is_known(emulated_camera) -> None:
    readout_s = CameraEmulatorOptions().readout_s
    camera = of(emulated_camera, capture=CaptureOptions(latency_s=readout_s))
    camera.connect()
    frames = record(camera, 5)
    camera.close()
    # the card shows round(200 t): its number changes 2.5 ms before and after the full period
    for frame in frames:
        shown = int(frame.image[0, 0])
        off = (frame.t_s * 200.0 - shown + 128.0) % 256.0 - 128.0
        assert -0.5 <= off <= 0.5 + 1.0  # transport takes up to 5 ms on a busy computer


def test_a_guard_finds_nothing_to_complain_of(camera) -> None:
    assert len(record(GuardedCamera(camera, CLOCK), 100)) == 100


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        (StreamFaults(missing=3), "3 pictures missing before picture"),
        (StreamFaults(frozen=True), "the camera is frozen"),
        (StreamFaults(slow=1.3), "slow: 1.*Hz measured, 200.0 Hz expected"),
    ],
    ids=["missing", "frozen", "slow"],
)
def test_a_fault_amid_a_recording_is_named(emulated_camera, camera, faults, message) -> None:
    camera.start(250)
    camera.read()
    emulated_camera.faults = faults
    with pytest.raises(CameraError, match=message):
        while camera.read() is not None:
            pass


@pytest.mark.parametrize(
    "faults",
    [StreamFaults(silent=True), StreamFaults(refuses=True), StreamFaults(garbage=True)],
    ids=["silent", "cut off", "garbage"],
)
def test_a_camera_without_pictures_is_lost_and_found_again(emulated_camera, camera, faults) -> None:
    camera.start(2000)
    camera.read()
    emulated_camera.faults = faults
    began_s = time.monotonic()
    with pytest.raises(DeviceLostError) as error:
        while camera.read() is not None:
            pass
    assert time.monotonic() - began_s < 1.0
    assert error.value.remedy
    emulated_camera.faults = StreamFaults()
    camera.connect()
    assert len(record(camera, 3)) == 3


def test_a_camera_that_is_slow_from_the_start_does_not_connect(emulated_camera) -> None:
    emulated_camera.faults = StreamFaults(slow=1.5)
    camera = of(emulated_camera, capture=CaptureOptions(connect_s=0.8))
    with pytest.raises(ConnectError, match=r"slow or uneven: 1\d\d\.\d Hz measured, 200\.0 Hz"):
        camera.connect()


def test_a_camera_process_that_is_killed_is_a_lost_camera() -> None:
    size = CameraEmulatorOptions(width_px=160, height_px=120)
    with EmulatedCamera(TestCard(160, 120, 200.0), size) as stream:
        camera = of(stream)
        camera.connect()
        camera.start(2000)
        camera.read()
        assert stream.pid is not None
        os.kill(stream.pid, signal.SIGKILL)
        with pytest.raises(DeviceLostError, match="the stream of pictures ended"):
            while camera.read() is not None:
                pass
        with pytest.raises(ConnectError, match=r"tcp://.* does not open"):
            camera.connect()


def test_a_camera_that_answers_nothing_is_given_up_in_time() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        options = OpenCvOptions(
            f"tcp://127.0.0.1:{mute.getsockname()[1]}",
            exposure_s=None,
            capture=CaptureOptions(connect_s=0.3),
        )
        began_s = time.monotonic()
        with pytest.raises(ConnectError, match="open"):
            OpenCvCamera(options, CLOCK).connect()
        assert time.monotonic() - began_s < 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width_px": 640}, "width_px = 640 refused, the camera has 160"),
        ({"frame_rate_hz": 100.0}, "frame_rate_hz = 100 refused, the camera has 200"),
        ({"exposure_s": 0.0005}, r"auto_exposure .* refused"),
    ],
)
def test_a_refused_setting_is_named(emulated_camera, changes, message) -> None:
    with pytest.raises(ConnectError, match=message):
        of(emulated_camera, **changes).connect()


def test_a_slow_reader_is_told_of_the_overflow(emulated_camera) -> None:
    camera = of(emulated_camera, capture=CaptureOptions(buffer_frames=5))
    camera.connect()
    camera.start(100)
    time.sleep(0.1)
    with pytest.raises(CameraError, match="overflow: 5 pictures wait"):
        while camera.read() is not None:
            pass
    camera.close()


def test_nothing_is_left_behind_by_connecting_often(emulated_camera) -> None:
    camera = of(emulated_camera)
    camera.connect()
    threads, files = threading.active_count(), open_files()
    for _ in range(3):
        camera.connect()
    assert threading.active_count() == threads
    assert open_files() == files
    camera.close()
    assert threading.active_count() == threads - 1


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


# --- settings, against a stand-in for a Video4Linux device ------------------------------------


class FakeDevice:
    """What OpenCV's Video4Linux capture does with settings, and a clock of its own."""

    def __init__(self, picture: np.ndarray | None = None, **refuses: float) -> None:
        self.properties = {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_EXPOSURE: 157.0,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")),
            cv2.CAP_PROP_CONVERT_RGB: 1.0,
        }
        self.fixed = {getattr(cv2, f"CAP_PROP_{k.upper()}"): v for k, v in refuses.items()}
        self.properties.update(self.fixed)
        self.order: list[int] = []
        self.released = False
        self.stamps = True
        self._picture = picture
        self._count = 0

    def isOpened(self) -> bool:
        return True

    def set(self, key: int, value: float) -> bool:
        self.order.append(key)
        if key in self.fixed:
            return False
        self.properties[key] = value
        return True

    def get(self, key: int) -> float:
        if key == cv2.CAP_PROP_POS_MSEC:
            return 5.0 * self._count if self.stamps else 0.0
        return self.properties.get(key, 0.0)

    def grab(self) -> bool:
        time.sleep(0.005)
        self._count += 1
        return True

    def read(self) -> tuple[bool, np.ndarray]:
        self.grab()
        return self.retrieve()

    def retrieve(self) -> tuple[bool, np.ndarray]:
        shape = (int(self.properties[cv2.CAP_PROP_FRAME_HEIGHT]), 64)
        if self._picture is not None:
            return True, self._picture
        if self.properties[cv2.CAP_PROP_CONVERT_RGB]:
            grey = np.full((*shape, 3), self._count % 200, dtype=np.uint8)
            return True, grey
        pair = np.full((*shape, 2), 128, dtype=np.uint8)
        pair[:, :, 0] = np.arange(64) + self._count % 100
        return True, pair

    def release(self) -> None:
        self.released = True


@pytest.fixture
def with_device(monkeypatch):
    def build(device: FakeDevice, **changes) -> OpenCvCamera:
        def opened(which, backend, *_):
            assert (which, backend) == (2, cv2.CAP_V4L2)
            return device

        monkeypatch.setattr(opencv_camera.cv2, "VideoCapture", opened)
        options = {"width_px": 64, "height_px": 48, "exposure_s": 0.0005, **changes}
        capture = CaptureOptions(connect_s=1.0, rate_tolerance=0.5, settle_frames=5)
        options.setdefault("capture", capture)
        return OpenCvCamera(OpenCvOptions(2, **options), CLOCK)

    return build


def test_size_exposure_and_rate_are_set_and_the_rate_last(with_device) -> None:
    device = FakeDevice()
    camera = with_device(device)
    camera.connect()
    assert camera.frame_rate_hz == 200.0
    found = device.properties
    assert (found[cv2.CAP_PROP_FRAME_WIDTH], found[cv2.CAP_PROP_FRAME_HEIGHT]) == (64.0, 48.0)
    assert (found[cv2.CAP_PROP_AUTO_EXPOSURE], found[cv2.CAP_PROP_EXPOSURE]) == (1.0, 5.0)
    assert device.order.index(cv2.CAP_PROP_FPS) > device.order.index(cv2.CAP_PROP_EXPOSURE)
    camera.close()
    assert device.released


@pytest.mark.parametrize(
    ("refuses", "message"),
    [
        ({"exposure": 157.0}, r"exposure_s = 0\.0005 refused, the camera has 0\.0157"),
        ({"auto_exposure": 3.0}, "auto_exposure .* = 1 refused, the camera has 3"),
        ({"fps": 30.0}, "frame_rate_hz = 200 refused, the camera has 30"),
        ({"frame_height": 480.0}, "height_px = 48 refused, the camera has 480"),
    ],
)
def test_what_a_device_refuses_is_named_and_the_device_released(
    with_device, refuses, message
) -> None:
    device = FakeDevice(**refuses)
    with pytest.raises(ConnectError, match=message):
        with_device(device).connect()
    assert device.released


def test_another_pixel_format_is_refused(with_device) -> None:
    device = FakeDevice(fourcc=float(cv2.VideoWriter.fourcc(*"MJPG")))
    with pytest.raises(ConnectError, match="fourcc = GREY refused, the camera has 'MJPG'"):
        with_device(device, fourcc="GREY").connect()


def test_the_luminance_of_yuyv_is_taken_as_it_is(with_device) -> None:
    camera = with_device(FakeDevice())
    camera.connect()
    (frame,) = record(camera, 1)
    assert np.array_equal(np.diff(frame.image[0].astype(int)), np.ones(63))
    camera.close()


def test_colour_is_turned_to_grey(with_device) -> None:
    colour = np.zeros((48, 64, 3), dtype=np.uint8)
    colour[:, :, 1] = 100
    camera = with_device(FakeDevice(colour))
    camera.connect()
    (frame,) = record(camera, 1)
    assert frame.image.shape == (48, 64)
    assert frame.image[0, 0] == 59  # 0.587 × 100
    camera.close()


def test_a_device_without_stamps_says_what_to_set(with_device) -> None:
    device = FakeDevice()
    device.stamps = False
    with pytest.raises(ConnectError, match=r"time stamps do not advance.*`stamps: arrival`"):
        with_device(device).connect()
    camera = with_device(device, stamps="arrival")
    camera.connect()
    began_s = CLOCK.now_s()
    assert began_s < record(camera, 1)[0].t_s <= CLOCK.now_s()
    camera.close()


@pytest.mark.parametrize(
    "bad", [{"width_px": 0}, {"frame_rate_hz": -1.0}, {"exposure_s": 0.0}, {"fourcc": "GREYS"}]
)
def test_impossible_options_are_named(bad) -> None:
    (name,) = bad
    with pytest.raises(ValueError, match=f"camera.{name} = "):
        OpenCvOptions(**bad)
