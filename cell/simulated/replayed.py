"""A recording → devices that do it again, and the clock that they share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from cell.files.input_error import InputError
from cell.records.recording import form
from cell.records.recording.reading import Recording
from cell.settings.model import Settings
from cell.settings.translate import pose_of
from drivers.interfaces import Devices
from drivers.replay import RecordedPoses, ReplayArm, ReplayCamera, ReplayGripper
from drivers.sim.clock import SimClock

#: Before its first film a replayed cycle has this time for what comes before, s.
_BEFORE_S = 60.0


@dataclass(frozen=True)
class ReplayedDevices:
    """Devices, and what brings their clock to where the recorded one was as a step begins."""

    devices: Devices
    on_step: Callable[[int, str], None]


def replayed_devices(recording: Recording, settings: Settings) -> ReplayedDevices:
    """The devices of a recorded cycle.  Raises InputError: it lacks what a replay needs."""
    task, filming = recording.last(form.TASK), recording.last(form.FILMING)
    if task is None or filming is None:
        raise InputError.at(recording.path, "ends before a cable was filmed: nothing to replay")
    tries = list(_tries(recording))
    simulated_s: list[float] = []
    clock = SimClock(tries[0][0] - _BEFORE_S)
    answers = [
        RecordedPoses(said["start_s"], said["end_s"], poses)
        for said, poses in recording.trajectories(form.ANSWER)
    ]
    filmed = [p for said, p in recording.trajectories(form.PATH) if said["start_s"] is not None]
    held = any(said["holding"] for said in recording.json(form.GRIPPER))
    devices = Devices(
        ReplayArm(
            clock,
            pose_of(settings.motion.home),
            task["arm_rate_hz"],
            task["arm_lag_s"],
            answers,
            filmed,
            [p for _, p in recording.trajectories(form.REVISION)],
        ),
        ReplayCamera(clock, task["frame_rate_hz"], recording.frames()),
        ReplayGripper(clock, held),
        clock,
    )

    def on_step(number: int, step: str) -> None:
        if step in ("lower", "measure", "film") and tries:
            begin_s, simulated_s[:] = tries.pop(0)
            clock.forward_to_s(begin_s)
        elif step == "simulate" and simulated_s:
            clock.forward_to_s(simulated_s.pop(0))
        elif step == "choose" and simulated_s:  # the recorded choice came too late
            clock.forward_to_s(simulated_s[0])

    return ReplayedDevices(devices, on_step)


def _tries(recording: Recording) -> Iterator[tuple[float, list[float]]]:
    """When each film of a hold began, and when simulations of its offsets did."""
    decisions = [d["simulated_s"] for d in recording.json(form.DECISION)]
    begun_s = list(dict.fromkeys(said["begin_s"] for said in recording.json(form.FILMING)))
    for begin_s, end_s in zip(begun_s, [*begun_s[1:], math.inf], strict=True):
        made = [s for s in decisions if s and begin_s <= s[0] < end_s]
        yield begin_s, list(max(made, key=len, default=[]))
