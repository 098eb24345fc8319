from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from drivers.capture import StreamingCamera
from drivers.interfaces import CameraError, ConnectError, DeviceLostError
from drivers.recording import CaptureOptions, Shot

RATE_HZ = 200.0
PERIOD_S = 1.0 / RATE_HZ
BOOT_S = 640.0  # the camera's clock at the cell's zero


class ManualClock:
    def __init__(self) -> None:
        self.t_s = 0.0

    def now_s(self) -> float:
        return self.t_s

    def sleep_s(self, duration_s: float) -> None:
        self.t_s += duration_s


class StreamRig:
    """A camera whose pictures come when the test says so."""

    def __init__(self, **options) -> None:
        self.clock = ManualClock()
        self.rate_hz = RATE_HZ
        self.closed = threading.Event()
        self.opened = 0
        self._script: queue.Queue = queue.Queue()
        self._taken = threading.Semaphore(0)
        self._rng = np.random.default_rng(1)
        self._waits = False
        self.options = CaptureOptions(**{"settle_frames": 10, "connect_s": 1.0, **options})
        self.camera = StreamingCamera(self._open, self.options, self.clock, "cam")

    def _open(self):
        self.opened += 1
        return self

    def grab(self, wanted):
        if self._waits:
            self._taken.release()
            self._script.task_done()
        self._waits = False
        try:
            item = self._script.get(timeout=0.01)
        except queue.Empty:
            return None
        self._waits = True
        if isinstance(item, Exception):
            raise item
        image, stamp_s, number, arrived_s = item
        self.clock.t_s = max(self.clock.t_s, arrived_s)
        return Shot(image if wanted() else None, stamp_s, number)

    def close(self) -> None:
        self.closed.set()

    def put(
        self, exposed_s, delay_s=0.010, image=None, number=None, stamped=True, wait=True
    ) -> None:
        if image is None:
            image = self._rng.integers(0, 255, (8, 6), dtype=np.uint8)
        stamp_s = exposed_s + BOOT_S if stamped else None
        self._script.put((image, stamp_s, number, exposed_s + delay_s))
        if wait:
            assert self._taken.acquire(timeout=2.0)

    def fail(self, error: Exception) -> None:
        self._script.put(error)

    def connect(self, numbered=False, stamped=True, period_s=PERIOD_S) -> None:
        for k in range(12):
            self.put(k * period_s, number=k if numbered else None, stamped=stamped, wait=False)
        self.camera.connect()
        for _ in range(12):
            assert self._taken.acquire(timeout=2.0)

    def close_camera(self) -> None:
        self.camera.close()

    @contextmanager
    def in_vain(self) -> Iterator[None]:
        """Whoever waits for more pictures than are there waits too long, whenever it began."""
        over = threading.Event()

        def pass_time() -> None:
            while not over.wait(0.02):
                if not self._script.unfinished_tasks:
                    self.clock.sleep_s(1.0)

        passing = threading.Thread(target=pass_time, daemon=True)
        passing.start()
        try:
            yield
        finally:
            over.set()
            passing.join(30)
            assert not passing.is_alive()


@pytest.fixture
def make():
    benches = []

    def build(**options) -> StreamRig:
        benches.append(StreamRig(**options))
        return benches[-1]

    yield build
    for bench in benches:
        bench.close_camera()


def first_s(bench: StreamRig) -> float:
    """Exposure of the first picture after now."""
    return bench.clock.t_s + 0.25 * PERIOD_S


def test_stamps_are_mapped_onto_the_cells_clock_less_the_latency(make) -> None:
    bench = make(latency_s=0.010)
    bench.connect()
    bench.camera.start(5)
    exposed_s = first_s(bench) + PERIOD_S * np.arange(5)
    for k, t_s in enumerate(exposed_s):
        bench.put(t_s, delay_s=0.010 + 0.004 * (k % 2))  # jitter of the arrival is not seen
    assert [f.t_s for f in iter(bench.camera.read, None)] == pytest.approx(exposed_s)
    assert bench.camera.frame_rate_hz == RATE_HZ


def test_only_pictures_exposed_after_the_start_are_recorded(make) -> None:
    bench = make(latency_s=0.010)
    bench.connect()
    now_s = bench.clock.t_s
    bench.camera.start(1)
    bench.put(now_s - 0.001)
    bench.put(now_s + 0.004)
    assert bench.camera.read().t_s == pytest.approx(now_s + 0.004)


BLACK, SAME = np.zeros((8, 6), dtype=np.uint8), np.arange(48, dtype=np.uint8).reshape(8, 6)
#: Options, pictures at their periods after the start, how many of them are right, and what is said.
FAULTS: dict[str, tuple[dict[str, Any], list[dict[str, Any]], int | None, str]] = {
    "a gap": ({}, [{"at": k} for k in (0, 1, 4)], 2, "2 pictures missing before picture 3 of 30"),
    "none at first": ({}, [{"at": 3}], 0, r"pictures? missing before the first"),
    "a gap in its own count, without stamps": (
        {},
        [{"at": k, "number": n, "stamped": False} for k, n in enumerate((20, 21, 23))],
        2,
        "goes from 21 to 23",
    ),
    "frozen, which blank ones are not": (
        {},
        [{"at": k, "image": m} for k, m in enumerate((BLACK, BLACK, SAME, SAME.copy()))],
        3,
        r"picture 4 of 30 repeats .* frozen",
    ),
    "nobody reads": (
        {"buffer_frames": 4},
        [{"at": k} for k in range(6)],
        4,
        "overflow: 4 pictures wait to be read at picture 5",
    ),
    "slow": (
        {"rate_tolerance": 0.05},
        [{"at": 1.2 * k} for k in range(12)],
        None,
        r"slow: 166\.7 Hz measured, 200\.0 Hz expected",
    ),
    "piled up on their way": (
        {"late_s": 0.05},
        [{"at": 0}, {"at": 1, "delay_s": 0.070}],
        1,
        r"picture 2 of 30 came 0\.060 s late, allowed 0\.050",
    ),
    "another size": (
        {},
        [{"at": 0}, {"at": 1, "image": BLACK[:4, :4]}],
        1,
        "4 × 4 pixels, the one before 6 × 8",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_wrong_with_a_recording_is_named(make, fault) -> None:
    options, pictures, right, said = FAULTS[fault]
    counted, recorded = "number" in pictures[0], []
    bench = make(**({} if counted else {"latency_s": 0.010}), **options)
    bench.connect(numbered=counted, stamped=not counted)
    bench.camera.start(30)
    begin_s = first_s(bench)
    for picture in pictures:
        how = {name: value for name, value in picture.items() if name != "at"}
        bench.put(begin_s + picture["at"] * PERIOD_S, **how)
    with pytest.raises(CameraError, match=said):
        for frame in iter(bench.camera.read, None):
            recorded.append(frame.index)
    assert right is None or recorded == list(range(right))
    assert bench.camera.read() is None


def test_a_check_sees_what_the_reader_has_not_come_to_yet(make) -> None:
    bench = make(latency_s=0.010)
    bench.connect()
    bench.camera.start(5)
    exposed_s = first_s(bench)
    bench.put(exposed_s)
    bench.camera.check()
    bench.put(exposed_s + 3.0 * PERIOD_S)
    until_s = time.monotonic() + 2.0
    with pytest.raises(CameraError, match="2 pictures missing"):
        while time.monotonic() < until_s:
            bench.camera.check()


def test_silence_is_a_lost_camera_until_it_is_connected_again(make) -> None:
    bench = make(latency_s=0.010, lost_after_s=4.0 * PERIOD_S)
    bench.connect()
    bench.camera.start(5)
    bench.put(first_s(bench))
    bench.camera.read()
    bench.clock.sleep_s(4.1 * PERIOD_S)
    with pytest.raises(DeviceLostError, match=r"no picture came for 0\.0\d+ s, allowed 0\.020"):
        bench.camera.read()
    with pytest.raises(DeviceLostError):
        bench.camera.start(1)


def test_the_end_of_the_stream_is_told_to_the_next_too(make) -> None:
    bench = make()
    bench.connect()
    bench.camera.start(5)
    bench.fail(DeviceLostError("cam", "the stream of pictures ended", "connect again"))
    with pytest.raises(DeviceLostError, match="the stream of pictures ended; connect again"):
        bench.camera.read()
    assert bench.closed.wait(1.0)
    with pytest.raises(DeviceLostError):
        bench.camera.start(1)


def test_a_camera_slower_than_it_says_does_not_connect(make) -> None:
    bench = make(connect_s=0.3)
    uneven = r"slow or uneven: 100\.0 Hz measured, 200\.0 Hz exp"
    for k in range(12):
        bench.put(k * 2 * PERIOD_S, wait=False)
    with bench.in_vain(), pytest.raises(ConnectError, match=uneven):
        bench.camera.connect()


def test_a_camera_that_sends_nothing_does_not_connect(make) -> None:
    bench = make(connect_s=0.05)
    with bench.in_vain(), pytest.raises(ConnectError, match="only 0 pictures came within"):
        bench.camera.connect()


def test_opening_that_hangs_is_given_up_and_released_when_it_returns() -> None:
    let_go = threading.Event()
    bench = StreamRig()

    def hang():
        let_go.wait(5.0)
        return bench

    camera = StreamingCamera(hang, CaptureOptions(connect_s=0.05), bench.clock, "cam")
    with bench.in_vain(), pytest.raises(ConnectError, match="did not open within"):
        camera.connect()
    assert not bench.closed.is_set()
    let_go.set()
    assert bench.closed.wait(2.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("latency_s", -1e-3), ("connect_s", 0.0), ("buffer_frames", 0), ("settle_frames", 1)],
)
def test_impossible_options_are_named(name, value) -> None:
    with pytest.raises(ValueError, match=f"capture.{name} = {value}"):
        CaptureOptions(**{name: value})


@pytest.mark.parametrize("opened", [False, True])
def test_what_a_library_raises_is_named_at_once(opened) -> None:
    """Not a silence that is put down to the cable, after the longest wait."""
    rig = StreamRig(connect_s=60.0)
    if opened:
        rig.fail(ArithmeticError("bad tone"))
    else:
        rig._open = rig.camera._open_source = lambda: 1 // 0
    with pytest.raises(ConnectError, match=r"ArithmeticError: bad|ZeroDivisionError: integer"):
        rig.camera.connect()
