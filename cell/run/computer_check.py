"""Checks whether this computer can run a cell: its properties, stalls, and pictures per second."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.computer.abilities import Abilities, StallProbe, Stalls, abilities
from cell.records.recording.retention import RecordingRoom
from cell.run.warm_up import made_up_picture
from cell.vision.detect import VisionOptions, detect

#: Pictures that vision must process in the time of one of the camera: it has to catch up after a
#: stall, and the other core computes.
HEAD_ROOM = 2.0
#: Tolerated stalls, s: the arm's commands are 2 ms apart, a watch is excused after 20 ms.
USUAL_STALL_S, LONGEST_STALL_S = 2e-3, 20e-3

_GIB = 2**30
_FREE_BYTES = 1 * _GIB
_SAMPLES = 40
_DIMMEST, _NOISE = 0.7, 1.5  # share of the light on the dark side; grey levels


@dataclass(frozen=True)
class Condition:
    """A requirement of a cell on its computer.

    name      of the property
    measured  value on this computer, with its unit
    needed    required value
    met       whether it is met
    remedy    for a person; empty if it is met
    """

    name: str
    measured: str
    needed: str
    met: bool
    remedy: str = ""


@dataclass(frozen=True)
class CameraLoad:
    """The camera's load on vision: size, rate and content of the pictures."""

    width_px: int
    height_px: int
    frame_rate_hz: float
    vision: VisionOptions


def check_computer(
    camera: CameraLoad, seconds: float, on_step: Callable[[str], None] = lambda _: None
) -> list[Condition]:
    """All conditions; measures stalls for `seconds`, and vision for about a second.

    on_step  called with the name of each measurement as it begins
    """
    on_step(f"stalls, for {seconds:g} s")
    with StallProbe() as probe:
        time.sleep(seconds)
        stalls = probe.take()
    on_step("vision")
    tracked_hz, cold_hz = vision_rates_hz(camera)
    return [
        *_of_computer(abilities()),
        *_of_stalls(stalls),
        _of_vision(camera, tracked_hz, cold_hz),
    ]


def vision_rates_hz(camera: CameraLoad) -> tuple[float, float]:
    """Pictures per second of one core: with the result of the previous picture, and without."""
    image, view = _full_picture(camera)
    previous = detect(image, 0.0, view, camera.vision)  # loads the code
    begun_s = time.thread_time()
    for number in range(1, _SAMPLES + 1):
        previous = detect(image, number / camera.frame_rate_hz, view, camera.vision, previous)
    tracked_s = time.thread_time() - begun_s
    begun_s = time.thread_time()
    for _ in range(_SAMPLES):
        detect(image, 0.0, view, camera.vision)
    return _SAMPLES / tracked_s, _SAMPLES / (time.thread_time() - begun_s)


def _full_picture(camera: CameraLoad) -> tuple[NDArray[np.uint8], PlaneView]:
    """A made-up jaw and cable in a corner of a picture of the camera's size, lit from one side."""
    part, view = made_up_picture(camera.vision)
    rows, columns = max(camera.height_px, part.shape[0]), max(camera.width_px, part.shape[1])
    light = np.full((rows, columns), part[0, 0], dtype=np.float64)
    light[: part.shape[0], : part.shape[1]] = part
    light *= np.linspace(1.0, _DIMMEST, columns)
    light += np.random.default_rng(0).normal(scale=_NOISE, size=light.shape)
    return np.clip(np.rint(light), 0, 255).astype(np.uint8), view


def check_room(room: RecordingRoom | None) -> Condition:
    """Whether the disk has the room that the settings give to recordings; None = none are made."""
    if room is None:
        return _condition("room for recordings", "nothing is recorded", "any", True, "")
    limit = room.limit_bytes
    return _condition(
        "room for recordings",
        str(room),
        "any" if limit is None else f"{limit / 1e9:g} GB (recording.max_size_gb)",
        limit is None or room.bytes >= limit,
        f"lower recording.max_size_gb to {room.bytes / 1e9:.0f}, or make room on the disk",
    )


def _of_computer(computer: Abilities) -> list[Condition]:
    limits = "add to /etc/security/limits.d/cell.conf: `@cell - rtprio 40` and `@cell - nice -20`"
    free = computer.free_memory_bytes
    return [
        _condition(
            "cores",
            f"{computer.cores}",
            "2 or more",
            computer.cores >= 2,
            "use a computer with two cores: one looks at pictures, one computes",
        ),
        _condition(
            "real-time scheduling",
            "permitted" if computer.real_time else "not permitted",
            "permitted to the user of the cell",
            computer.real_time,
            f"{limits}; put the user into the group `cell`; log in again",
        ),
        _condition("kernel", computer.kernel, "any; PREEMPT_RT for an arm at 500 Hz", True, ""),
        _condition(
            "clock",
            computer.clock or "not said",
            "tsc, or the computer's own",
            computer.clock not in ("hpet", "acpi_pm", "jiffies"),
            "look in the kernel's log why tsc was given up; try the kernel option `tsc=reliable`",
        ),
        _condition(
            "frequency of the cores",
            computer.governor or "not said",
            "performance",
            computer.governor in (None, "performance"),
            "`cpupower frequency-set -g performance`",
        ),
        _condition(
            "free memory",
            "not said" if free is None else f"{free / _GIB:.1f} GiB",
            f"{_FREE_BYTES / _GIB:g} GiB",
            free is None or free >= _FREE_BYTES,
            "end other programs",
        ),
    ]


def _of_stalls(stalls: Stalls) -> list[Condition]:
    remedy = (
        "end other programs; leave the cell a core (`isolcpus`, or pin a virtual machine's cores); "
        "use a PREEMPT_RT kernel"
    )
    conditions = []
    for name, values_s in (("asleep", stalls.slept_s), ("awake", stalls.spun_s)):
        usual_s, longest_s = np.quantile(values_s, [0.99, 1.0])
        met = bool(usual_s <= USUAL_STALL_S and longest_s <= LONGEST_STALL_S)
        conditions.append(
            _condition(
                f"stalls while {name}",
                f"p99 {1e3 * usual_s:.2f} ms, longest {1e3 * longest_s:.1f} ms",
                f"p99 {1e3 * USUAL_STALL_S:g} ms, longest {1e3 * LONGEST_STALL_S:g} ms",
                met,
                remedy,
            )
        )
    return conditions


def _of_vision(camera: CameraLoad, tracked_hz: float, cold_hz: float) -> Condition:
    needed_hz = HEAD_ROOM * camera.frame_rate_hz
    return _condition(
        "vision",
        f"{tracked_hz:.0f} pictures/s of one core ({cold_hz:.0f} when the jaw is first found)",
        f"{needed_hz:.0f} pictures/s of {camera.width_px} × {camera.height_px}",
        tracked_hz >= needed_hz,
        f"lower camera.frame_rate_hz to {tracked_hz / HEAD_ROOM:.0f} Hz, or use a faster computer",
    )


def _condition(name: str, measured: str, needed: str, met: bool, remedy: str) -> Condition:
    return Condition(name, measured, needed, met, "" if met else remedy)
