from __future__ import annotations

import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from drivers.emulators.camera import (
    CameraEmulatorOptions,
    EmulatedCamera,
    StreamFaults,
    TestCard,
    _Parcel,
    _Server,
)
from drivers.emulators.launch import EmulatorError
from tests.waiting import wait_until

SIZE = CameraEmulatorOptions(width_px=160, height_px=120)


@pytest.fixture
def reader(emulated_camera):
    """OpenCV itself, without our driver."""
    capture = cv2.VideoCapture(
        emulated_camera.url, cv2.CAP_FFMPEG, [cv2.CAP_PROP_READ_TIMEOUT_MSEC, 300]
    )
    assert capture.isOpened()
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    for _ in range(10):
        capture.read()
    yield capture
    capture.release()


def pictures(reader, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Number on the test card, and the stamp, of each picture."""
    numbers, stamps_s = [], []
    for _ in range(count):
        came, image = reader.read()
        if not came:
            break
        numbers.append(int(image[0, 0]))
        stamps_s.append(1e-3 * reader.get(cv2.CAP_PROP_POS_MSEC))
    return np.array(numbers), np.array(stamps_s)


def port(camera: EmulatedCamera) -> int:
    number = urlsplit(camera.url).port
    assert number is not None
    return number


def test_opencv_sees_every_picture_as_it_is_at_its_time(reader) -> None:
    came, image = reader.read()
    assert came
    card = TestCard(160, 120, 200.0)
    assert np.array_equal(image, card.picture(int(image[0, 0]) / 200.0))
    numbers, stamps_s = pictures(reader, 100)
    assert set(np.diff(numbers) % 256) == {1}
    assert np.diff(stamps_s) == pytest.approx(0.005, abs=2e-6)


def test_pictures_come_in_real_time(reader) -> None:
    began_s = time.monotonic()
    _, stamps_s = pictures(reader, 100)
    assert time.monotonic() - began_s == pytest.approx(stamps_s[-1] - stamps_s[0], abs=0.05)


def test_missing_pictures_leave_a_gap(emulated_camera, reader) -> None:
    emulated_camera.faults = StreamFaults(missing=3)
    numbers, stamps_s = pictures(reader, 40)
    assert np.diff(stamps_s).max() == pytest.approx(0.020, abs=1e-5)
    assert sorted(np.diff(numbers) % 256)[-2:] == [1, 4]


def test_a_frozen_camera_repeats_its_picture_with_new_stamps(emulated_camera, reader) -> None:
    emulated_camera.faults = StreamFaults(frozen=True)
    numbers, stamps_s = pictures(reader, 40)
    assert len(set(numbers[-10:])) == 1
    assert np.all(np.diff(stamps_s) > 0.004)


def test_a_slow_camera_is_slow(emulated_camera, reader) -> None:
    emulated_camera.faults = StreamFaults(slow=2.0)
    _, stamps_s = pictures(reader, 20)
    assert np.diff(stamps_s)[-5:] == pytest.approx(0.010, abs=2e-6)


@pytest.mark.parametrize("faults", [StreamFaults(silent=True), StreamFaults(refuses=True)], ids=str)
def test_silence_and_cutting_off_end_the_reading(emulated_camera, reader, faults) -> None:
    emulated_camera.faults = faults
    numbers, _ = pictures(reader, 100)
    assert len(numbers) < 100


def test_whoever_is_refused_may_come_again_afterwards(emulated_camera) -> None:
    emulated_camera.faults = StreamFaults(refuses=True)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port(emulated_camera)), 1.0)
    emulated_camera.faults = StreamFaults()
    socket.create_connection(("127.0.0.1", port(emulated_camera)), 1.0).close()


def test_a_reader_that_does_not_read_loses_pictures_not_time(emulated_camera, reader) -> None:
    before = emulated_camera.counts()
    wait_until(lambda: emulated_camera.counts().dropped > before.dropped)
    waited = emulated_camera.counts().sent - before.sent  # in the queues between us
    _, stamps_s = pictures(reader, waited + 60)
    assert np.diff(stamps_s).max() > 0.009


def test_the_newest_reader_is_served(emulated_camera) -> None:
    forgotten = socket.create_connection(("127.0.0.1", port(emulated_camera)), 1.0)
    forgotten.recv(64)
    with socket.create_connection(("127.0.0.1", port(emulated_camera)), 1.0) as newest:
        newest.settimeout(2.0)
        assert newest.recv(64)
    forgotten.close()


def test_a_scene_that_fails_is_told_to_the_parent() -> None:
    with pytest.raises(EmulatorError, match=r"picture is \(120, 100\) uint8, not \(120, 160\)"):
        EmulatedCamera(TestCard(100, 120, 200.0), SIZE).__enter__()


def test_killed_it_is_gone_for_everybody() -> None:
    with EmulatedCamera(TestCard(160, 120, 200.0), SIZE) as camera:
        assert camera.pid is not None
        os.kill(camera.pid, signal.SIGKILL)
        with pytest.raises(EmulatorError, match="gone"):
            for _ in range(1000):
                camera.counts()


PARENT = """
import time
from drivers.emulators.camera import CameraEmulatorOptions, EmulatedCamera
from drivers.emulators.camera import TestCard
if __name__ == "__main__":
    options = CameraEmulatorOptions(width_px=160, height_px=120)
    with EmulatedCamera(TestCard(160, 120, 200.0), options) as camera:
        print(camera.pid, flush=True)
        time.sleep(60)
"""


def test_it_ends_with_its_parent(tmp_path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.communicate(timeout=30)
    wait_until(lambda: not _runs(pid))


def _runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_whoever_looks_after_the_reader_holds_no_picture_up() -> None:
    """Every 20 ms without a picture it did, for 20 ms: pictures at 50 Hz came in pairs."""
    parcels: queue.Queue[_Parcel | None] = queue.Queue()
    server = _Server(TestCard(160, 120, 200.0), SIZE, ("127.0.0.1", 0))
    assert server._listener is not None
    server._listener.close()
    ours, reader = socket.socketpair()
    ours.settimeout(30.0)
    with ours, reader:
        threading.Timer(0.1, parcels.put, [_Parcel(0.0, (b"picture",))]).start()
        began_s = time.monotonic()
        assert server._next(ours, parcels) is not None
        assert time.monotonic() - began_s < 15.0
        reader.close()
        with pytest.raises(ConnectionResetError):
            server._next(ours, parcels)
