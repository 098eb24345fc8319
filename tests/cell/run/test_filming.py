"""Frames that wait are looked at side by side, in order, and none is left out."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from calib.plane import PlaneView
from cell.run import filming
from cell.run.commands import Commands
from cell.run.filming import _FrameReader
from cell.run.findings import Filming
from cell.run.warm_up import made_up_picture
from cell.vision.detect import VisionOptions, detect
from drivers.interfaces import Frame

RATE_HZ, COUNT = 200.0, 40
#: From a frame's exposure until it can be read, s.
USUAL_S = 0.004


class Clock:
    """Time passes only when a frame is awaited, or as the test says."""

    def __init__(self) -> None:
        self.t_s = 0.0

    def now_s(self) -> float:
        return self.t_s


class Camera:
    """Frames at their times; `stalls` maps an index to how long the computer then stands still."""

    frame_rate_hz = RATE_HZ

    def __init__(self, clock: Clock, images, stalls: dict[int, float]) -> None:
        self._clock, self._images, self._stalls = clock, images, stalls
        self._next = 0
        self.waited = 0

    def read(self) -> Frame | None:
        if self._next == COUNT:
            return None
        index, self._next = self._next, self._next + 1
        ready_s = index / RATE_HZ + USUAL_S
        self.waited += ready_s > self._clock.t_s
        self._clock.t_s = max(self._clock.t_s, ready_s) + self._stalls.get(index, 0.0)
        return Frame(index, index / RATE_HZ, self._images[index])


@pytest.fixture(scope="module")
def options() -> VisionOptions:
    return VisionOptions(0.1)


@pytest.fixture(scope="module")
def scene(options: VisionOptions):
    """Pictures in which jaw and cable go down by a pixel a frame, and the view of them."""
    image, view = made_up_picture(options)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 3, (COUNT, *image.shape), dtype=np.uint8)
    return [np.roll(image, k, axis=0) + noise[k] for k in range(COUNT)], view


def station(scene, options: VisionOptions, stalls: dict[int, float]) -> SimpleNamespace:
    images, view = scene
    assert isinstance(view, PlaneView)
    clock = Clock()
    devices = SimpleNamespace(camera=Camera(clock, images, stalls), clock=clock)
    task = SimpleNamespace(view=view, vision=options)
    return SimpleNamespace(devices=devices, task=task, commands=Commands())


def looked_at(it, monkeypatch: pytest.MonkeyPatch, started: Filming | None = None):
    """The reader when all frames were read, and how many were looked at by each thread."""
    by: dict[bool, int] = {True: 0, False: 0}
    mine = threading.current_thread()

    def counted(*arguments):
        by[threading.current_thread() is mine] += 1
        return detect(*arguments)

    monkeypatch.setattr(filming, "detect", counted)
    monkeypatch.setattr(filming, "threads", lambda: 2)
    told: list[float] = []
    reader = _FrameReader(it, 10, started)
    reader.read_until(np.inf, lambda sightings: told.append(sightings[-1].t_s))
    assert told == [s.t_s for s in reader.sightings]
    return reader, by[True], by[False]


def test_frames_that_come_in_time_are_looked_at_one_by_one(scene, options, monkeypatch) -> None:
    reader, mine, others = looked_at(station(scene, options, {}), monkeypatch)
    assert (mine, others) == (COUNT, 0)
    assert all(s.seen for s in reader.sightings)
    assert reader.delay_s == pytest.approx(USUAL_S)


def test_after_a_stall_frames_are_looked_at_on_both_cores_and_none_is_lost(
    scene, options, monkeypatch
) -> None:
    quiet, _, _ = looked_at(station(scene, options, {}), monkeypatch)
    it = station(scene, options, {12: 0.06})
    reader, mine, others = looked_at(it, monkeypatch)
    assert 4 <= others <= 6 and mine == COUNT - others  # 12 frames came in 0.06 s
    assert [s.t_s for s in reader.sightings] == [k / RATE_HZ for k in range(COUNT)]
    assert [p.index for p in reader.pictures] == [0, 10, 20, 30]
    for found, expected in zip(reader.sightings, quiet.sightings, strict=True):
        np.testing.assert_allclose(found.nodes_m, expected.nodes_m, atol=2e-6)


def test_whoever_takes_over_knows_how_quick_frames_can_be(scene, options, monkeypatch) -> None:
    """A reader that began behind took the delay of its first frame for the usual one."""
    it = station(scene, options, {0: 0.05})
    started = Filming(0.0, 0.0, 1.0, COUNT, delay_s=USUAL_S)
    _, _, others = looked_at(it, monkeypatch, started)
    assert others >= 3
    it = station(scene, options, {0: 0.05})
    _, _, unaware = looked_at(it, monkeypatch)
    assert unaware == 0
