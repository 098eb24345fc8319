"""Films a motion of the gripper, and detects the cable in every frame as it arrives."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

from cell.cable.solver import threads
from cell.run.findings import FilmedMotion, Filming
from cell.run.station import Station
from cell.run.waiting import await_rest, check_grip, wait_until
from cell.vision.detect import detect
from cell.vision.sighting import Sighting
from drivers.interfaces import CameraError, Frame, Trajectory


def film(
    station: Station, path: Trajectory, still_s: float, hold_s: float, keep_every: int
) -> Filming:
    """Start filming the cable at rest, then follow `path`; returns when the gripper rests again.

    The cable is detected in the frames meanwhile, so that none wait when the last one comes.
    keep_every  one frame in so many is stored as a picture
    """
    arm, camera, clock = station.devices.arm, station.devices.camera, station.devices.clock
    moving_s = float(path.t_s[-1]) + arm.lag_s
    frame_count = int(np.ceil((still_s + moving_s + hold_s) * camera.frame_rate_hz))
    begin_s = clock.now_s()
    camera.start(frame_count)
    start_s = begin_s + still_s
    arm.follow(path, start_s)  # at once: no long computation can then delay the motion
    reader = _FrameReader(station, keep_every)
    rest_s = start_s + moving_s
    reader.read_until(rest_s)
    wait_until(station, rest_s)
    return Filming(
        begin_s,
        rest_s,
        rest_s + hold_s,
        frame_count,
        tuple(reader.sightings),
        tuple(reader.pictures),
        reader.delay_s,
    )


def capture(
    station: Station,
    filming: Filming,
    keep_every: int,
    enough: Callable[[list[Sighting]], bool] = lambda sightings: False,
) -> FilmedMotion:
    """Complete a filming, and check that the arm rests and the cable is still held.

    The next step moves the arm or opens the jaws, but the film may end before the arm rests.
    enough  called with all sightings so far after each new one; returns whether it is the last
    raises  CameraError, StoppedError, DeviceTimeoutError, GripError
    """
    reader = _FrameReader(station, keep_every, filming)
    last_frame_at_s = reader.read_until(np.inf, enough)
    if reader.ended:
        station.devices.camera.stop()
    elif len(reader.sightings) < filming.frame_count:
        raise CameraError(
            station.devices.camera.name,
            f"only {len(reader.sightings)} of {filming.frame_count} frames came",
            "check cable, load and frame rate of the camera",
        )
    await_rest(station)
    check_grip(station)
    hand = station.devices.arm.log(filming.begin_s, station.devices.clock.now_s())
    return FilmedMotion(
        filming.begin_s, tuple(reader.sightings), hand, tuple(reader.pictures), last_frame_at_s
    )


def filmed_so_far(station: Station, filming: Filming, sightings: list[Sighting]) -> FilmedMotion:
    """The first frames of a filming, without pictures, while more frames arrive."""
    hand = station.devices.arm.log(filming.begin_s, sightings[-1].t_s)
    return FilmedMotion(filming.begin_s, tuple(sightings), hand, (), time.perf_counter())


#: A frame read so many periods later than possible has further frames waiting behind it.
BEHIND_PERIODS = 2.0


class _FrameReader:
    """Reads the frames of a recording and detects the cable in each; stores all sightings.

    Waiting frames are processed in parallel, one on each core, until none waits: a stall of the
    computer then costs neither frames nor time after the last of them.
    """

    def __init__(self, station: Station, keep_every: int, filming: Filming | None = None) -> None:
        self._station = station
        self._keep_every = keep_every
        self.sightings: list[Sighting] = [] if filming is None else list(filming.sightings)
        self.pictures: list[Frame] = [] if filming is None else list(filming.pictures)
        self.delay_s = np.inf if filming is None else filming.delay_s
        self.ended = False

    def read_until(
        self,
        until_s: float,
        enough: Callable[[list[Sighting]], bool] = lambda sightings: False,
    ) -> float:
        """Detect the cable in the frames that come until `until_s` on the cell's clock.

        Sets `ended` if `enough` declares a frame the last.
        returns  time of the last frame, by the computer's own clock
        """
        camera, clock = self._station.devices.camera, self._station.devices.clock
        last_frame_at_s = float("nan")
        while clock.now_s() + 1.0 / camera.frame_rate_hz <= until_s:
            frames = self._waiting_frames()
            if not frames:
                break
            own_s = time.perf_counter() - clock.now_s()
            self._station.commands.check()
            for frame, sighting in zip(frames, self._detect_in(frames), strict=True):
                self.sightings.append(sighting)
                if frame.index % self._keep_every == 0:
                    self.pictures.append(frame)
                last_frame_at_s = own_s + frame.t_s
                self.ended = enough(self.sightings)
                if self.ended:
                    return last_frame_at_s
        return last_frame_at_s

    def _waiting_frames(self) -> list[Frame]:
        """The next frame, waiting for it, and those that wait already, up to the number of
        cores; empty = the recording has ended.
        """
        camera = self._station.devices.camera
        frames: list[Frame] = []
        for _ in range(threads()):
            frame = camera.read()
            if frame is None:
                break
            frames.append(frame)
            late_s = self._station.devices.clock.now_s() - frame.t_s
            self.delay_s = min(self.delay_s, late_s)
            if late_s - self.delay_s < BEHIND_PERIODS / camera.frame_rate_hz:
                break
        return frames

    def _detect_in(self, frames: list[Frame]) -> list[Sighting]:
        """Sightings of frames, in their order; the previous one only saves time."""
        task, previous = self._station.task, self.sightings[-1] if self.sightings else None

        def look(frame: Frame) -> Sighting:
            return detect(frame.image, frame.t_s, task.view, task.vision, previous)

        others = [_helpers(os.getpid()).submit(look, frame) for frame in frames[1:]]
        return [look(frames[0]), *(job.result() for job in others)]


@lru_cache(maxsize=1)
def _helpers(process: int) -> ThreadPoolExecutor:
    """Threads of this process that process frames in addition to the one that reads them."""
    return ThreadPoolExecutor(max(1, threads() - 1), thread_name_prefix="looking")
