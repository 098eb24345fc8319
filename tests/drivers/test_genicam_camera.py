"""Against the part of the harvesters API that is used, and against a real GenTL producer."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from drivers.clock import RealClock
from drivers.genicam_camera import GenicamCamera, GenicamOptions
from drivers.interfaces import Camera, CameraError, ConnectError, DeviceLostError
from drivers.recording import CaptureOptions

CLOCK = RealClock()
CAPTURE = CaptureOptions(connect_s=1.5, settle_frames=10, rate_tolerance=0.3)


def record(camera, count: int) -> list:
    camera.start(count)
    return list(iter(camera.read, None))


# --- a stand-in for harvesters ----------------------------------------------------------------


class Node:
    """A feature that may be fixed."""

    def __init__(self, value, fixed: bool = False) -> None:
        self._value = value
        self._fixed = fixed
        self.writes = 0

    @property
    def value(self):
        return self._value

    @value.setter
    def value(self, value) -> None:
        if self._fixed:
            raise RuntimeError("AccessException: not writable")
        self.writes += 1
        self._value = value


@dataclass
class FakeCamera:
    """An industrial camera of 8 × 6 pixels and what is wrong with it."""

    serial_number: str = "A1"
    nodes: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(
            PixelFormat=Node("RGB8"),
            Width=Node(1280),
            Height=Node(1024),
            TriggerMode=Node("On"),
            ExposureAuto=Node("Continuous"),
            ExposureTime=Node(10_000.0),
            AcquisitionFrameRateEnable=Node(False),
            AcquisitionFrameRate=Node(30.0),
        )
    )
    stamped: bool = True
    first_id: int = 1
    skip_at: int | None = None  # this picture and the next get lost
    vanish_at: int | None = None
    calls: list[str] = field(default_factory=list)


class FakeBuffer:
    def __init__(self, camera: FakeCamera, number: int) -> None:
        shape = camera.nodes.Height.value, camera.nodes.Width.value
        self._data = np.full(shape, number % 256, dtype=np.uint8)
        self._data[0, 0] += 1  # not blank
        component = SimpleNamespace(
            width=shape[1], height=shape[0], data_format="Mono8", data=self._data.reshape(-1)
        )
        self.payload = SimpleNamespace(components=[component])
        self.module = SimpleNamespace(frame_id=(camera.first_id + number - 1) % 65_535 + 1)
        self.timestamp = number * 5_000_000 + 10**12 if camera.stamped else 0
        self.timestamp_frequency = 1_000_000_000

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self._data[:] = 0  # the camera fills it anew


class FakeAcquirer:
    min_num_buffers = 3

    def __init__(self, camera: FakeCamera) -> None:
        self.num_buffers = 1
        self.remote_device = SimpleNamespace(node_map=camera.nodes)
        self._camera = camera
        self._number = 0

    def start(self) -> None:
        assert self.num_buffers >= 3
        self._camera.calls.append("start")
        self._due_s = time.monotonic()

    def try_fetch(self, timeout: float):
        camera = self._camera
        self._number += 1
        self._due_s += 0.005
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        if camera.vanish_at is not None and self._number >= camera.vanish_at:
            raise RuntimeError("device lost")
        if camera.skip_at is not None and 0 <= self._number - camera.skip_at < 2:
            return None
        return FakeBuffer(camera, self._number)

    def stop(self) -> None:
        self._camera.calls.append("stop")

    def destroy(self) -> None:
        self._camera.calls.append("destroy")


@pytest.fixture
def plugged(monkeypatch, tmp_path):
    """Makes a GenicamCamera that finds these cameras."""
    producer = tmp_path / "maker.cti"
    producer.touch()

    def build(*cameras: FakeCamera, **options) -> GenicamCamera:
        class Harvester:
            def add_file(self, path: str, check_validity: bool) -> None:
                assert path == str(producer) and check_validity

            def update(self) -> None:
                self.device_info_list = [
                    SimpleNamespace(serial_number=c.serial_number) for c in cameras
                ]

            def create(self, number: int) -> FakeAcquirer:
                return FakeAcquirer(cameras[number])

            def reset(self) -> None:
                for camera in cameras:
                    camera.calls.append("reset")

        module = ModuleType("harvesters.core")
        module.Harvester = Harvester
        monkeypatch.setitem(sys.modules, "harvesters.core", module)
        options = {"width_px": 8, "height_px": 6, "capture": CAPTURE, **options}
        return GenicamCamera(GenicamOptions(producer, **options), CLOCK)

    return build


def test_everything_is_set_by_its_standard_name(plugged) -> None:
    fake = FakeCamera()
    camera = plugged(fake)
    assert isinstance(camera, Camera)
    camera.connect()
    assert camera.frame_rate_hz == 200.0
    found = {name: node.value for name, node in vars(fake.nodes).items()}
    assert found == {
        "PixelFormat": "Mono8",
        "Width": 8,
        "Height": 6,
        "TriggerMode": "Off",
        "ExposureAuto": "Off",
        "ExposureTime": pytest.approx(500.0),
        "AcquisitionFrameRateEnable": True,
        "AcquisitionFrameRate": 200.0,
    }
    camera.close()
    assert fake.calls == ["start", "stop", "destroy", "reset"]


def test_hardware_stamps_are_used_and_pictures_are_copies(plugged) -> None:
    camera = plugged(FakeCamera())
    camera.connect()
    frames = record(camera, 20)
    camera.close()
    assert np.diff([f.t_s for f in frames]) == pytest.approx(0.005, abs=1e-9)
    assert all(f.image.shape == (6, 8) and f.image[0, 0] == f.image[5, 7] + 1 for f in frames)


def test_a_gap_in_the_count_is_named(plugged) -> None:
    camera = plugged(FakeCamera(skip_at=30))
    camera.connect()
    with pytest.raises(CameraError, match="2 pictures missing before picture"):
        record(camera, 50)
    camera.close()


def test_the_count_goes_on_after_16_bits(plugged) -> None:
    camera = plugged(FakeCamera(first_id=65_535 - 30))
    camera.connect()
    assert len(record(camera, 50)) == 50
    camera.close()


def test_without_stamps_the_arrival_counts(plugged) -> None:
    camera = plugged(FakeCamera(stamped=False))
    camera.connect()
    began_s = CLOCK.now_s()
    (frame,) = record(camera, 1)
    camera.close()
    assert began_s <= frame.t_s <= CLOCK.now_s()


def test_a_camera_that_vanishes_is_lost(plugged) -> None:
    fake = FakeCamera(vanish_at=40)
    camera = plugged(fake)
    camera.connect()
    with pytest.raises(DeviceLostError, match="device lost; check the camera's cable"):
        record(camera, 100)
    camera.close()
    assert fake.calls[-3:] == ["stop", "destroy", "reset"]


@pytest.mark.parametrize(
    ("name", "node", "message"),
    [
        ("AcquisitionFrameRate", Node(170.0, fixed=True), "AcquisitionFrameRate = 200.0 .* 170.0"),
        ("ExposureTime", Node(900.0, fixed=True), r"ExposureTime = 500\.0 refused.* 900\.0: Runt"),
        ("Width", Node(1280, fixed=True), "Width = 8 refused, the camera has 1280"),
        ("PixelFormat", Node("Mono12", fixed=True), "PixelFormat = Mono8 .* has Mono12"),
    ],
)
def test_what_a_camera_refuses_is_named(plugged, name, node, message) -> None:
    fake = FakeCamera()
    setattr(fake.nodes, name, node)
    with pytest.raises(ConnectError, match=message):
        plugged(fake).connect()
    assert fake.calls == ["destroy", "reset"]


def test_a_feature_that_is_missing_is_named(plugged) -> None:
    fake = FakeCamera()
    del fake.nodes.ExposureTime
    with pytest.raises(ConnectError, match=r"ExposureTime = 500\.0 refused, the camera has no"):
        plugged(fake).connect()


@pytest.mark.parametrize(
    ("serials", "wanted", "message"),
    [
        ([], None, "finds the cameras none, wanted is the only one"),
        (["A1", "B2"], None, "finds the cameras A1, B2, wanted is the only one"),
        (["A1"], "B2", "finds the cameras A1, wanted is B2"),
    ],
)
def test_the_wrong_number_of_cameras_is_named(plugged, serials, wanted, message) -> None:
    camera = plugged(*(FakeCamera(s) for s in serials), serial_number=wanted)
    with pytest.raises(ConnectError, match=message):
        camera.connect()


def test_one_of_several_is_found_by_its_serial_number(plugged) -> None:
    first, second = FakeCamera("A1"), FakeCamera("B2")
    camera = plugged(first, second, serial_number="B2")
    camera.connect()
    camera.close()
    assert "start" in second.calls and "start" not in first.calls


def test_without_the_producer_it_says_which_file(plugged, tmp_path) -> None:
    camera = plugged(FakeCamera())
    (tmp_path / "maker.cti").unlink()
    with pytest.raises(ConnectError, match=r"maker\.cti does not exist"):
        camera.connect()


def test_without_harvesters_it_says_what_to_install(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "harvesters.core", None)  # as Python marks what is not there
    camera = GenicamCamera(GenicamOptions(tmp_path / "maker.cti", capture=CAPTURE), CLOCK)
    with pytest.raises(ConnectError, match=r"not installed .*pip install -e .*\[genicam\]"):
        camera.connect()


# --- the producer that comes with the GenICam wheel: a game that is a camera -------------------


@pytest.fixture
def game() -> Path:
    pytest.importorskip("harvesters", reason="the extra cable-cell[genicam] is not installed")
    producer = Path(pytest.importorskip("genicam").__file__).with_name("viky.cti")
    if not producer.exists():
        pytest.skip("this version of the genicam wheel comes without a producer")
    return producer


def on_game(producer: Path, **changes) -> GenicamCamera:
    options = {
        "serial_number": "1",
        "width_px": 320,
        "height_px": 240,
        "frame_rate_hz": 100.0,
        "exposure_s": None,
        "capture": CaptureOptions(rate_tolerance=0.1, settle_frames=20),
        **changes,
    }
    return GenicamCamera(GenicamOptions(producer, **options), CLOCK)


def test_harvesters_records_from_a_real_producer_and_again(game) -> None:
    camera = on_game(game)
    for _ in range(2):
        camera.connect()
        assert camera.frame_rate_hz == 100.0
        frames = []
        camera.start(20)
        while (frame := camera.read()) is not None:
            frames.append(frame)
        camera.close()
        assert [f.index for f in frames] == list(range(20))
        assert {f.image.shape for f in frames} == {(240, 320)}
        assert frames[-1].t_s - frames[0].t_s == pytest.approx(0.19, abs=0.06)


def test_harvesters_refuses_what_a_real_producer_refuses(game) -> None:
    with pytest.raises(ConnectError, match=r"AcquisitionFrameRate = 500\.0 refused"):
        on_game(game, frame_rate_hz=500.0).connect()
    with pytest.raises(ConnectError, match=r"ExposureTime = 500\.0 refused, the camera has no"):
        on_game(game, exposure_s=0.0005).connect()
    with pytest.raises(ConnectError, match="finds the cameras 0, 1, 2, wanted is 7"):
        on_game(game, serial_number="7").connect()
