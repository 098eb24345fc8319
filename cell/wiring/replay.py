"""Runs the cell again on a recorded cycle, and compares its decisions with the recorded ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cell.files.input_error import InputError
from cell.files.plain import plain
from cell.records.recording import form
from cell.records.recording.reading import Recording
from cell.records.recording.recorder import Recorder
from cell.records.recording.unpack import restored_files
from cell.records.result import Outcome, Result
from cell.run.archive import Archive, RecordingSetup
from cell.run.findings import Filming
from cell.run.plans import FILM, INSERTING, LOOK, Plan, filmed
from cell.settings import Settings, load_settings
from cell.settings.calibrated import Calibrated, calibrated
from cell.settings.plugged import settings_class
from cell.settings.translate import pose_of
from cell.wiring.build import cell_with
from drivers.interfaces import Devices
from drivers.replay import RecordedPoses, ReplayArm, ReplayCamera, ReplayGripper
from drivers.sim.clock import SimClock

#: Time of a replayed cycle before its first film, s.
_BEFORE_S = 60.0


def replayed_devices(
    recording: Recording, settings: Settings
) -> tuple[Devices, Callable[[int, str], None]]:
    """Devices of a recorded cycle, and a function that sets their clock as a step begins.

    raises  InputError: the recording lacks data that a replay needs
    """
    task, filming = recording.last(form.TASK), recording.last(form.FILMING)
    if task is None or filming is None:
        raise InputError.at(recording.path, "ends before a cable was filmed: nothing to replay")
    tries = list(_tries(recording))
    simulated_s: list[float] = []
    clock = SimClock(tries[0][0] - _BEFORE_S)
    answers = [
        RecordedPoses(data["start_s"], data["end_s"], poses)
        for data, poses in recording.trajectories(form.ANSWER)
    ]
    filmed = [p for data, p in recording.trajectories(form.PATH) if data["start_s"] is not None]
    held = any(data["holding"] for data in recording.json(form.GRIPPER))
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

    return devices, on_step


def _tries(recording: Recording) -> Iterator[tuple[float, list[float]]]:
    """Start of each film of a hold, and starts of the simulations of its offsets."""
    decisions = [d["simulated_s"] for d in recording.json(form.DECISION)]
    begun_s = list(dict.fromkeys(data["begin_s"] for data in recording.json(form.FILMING)))
    for begin_s, end_s in zip(begun_s, [*begun_s[1:], math.inf], strict=True):
        matching = [s for s in decisions if s and begin_s <= s[0] < end_s]
        yield begin_s, list(max(matching, key=len, default=[]))


#: Fields of a result that are compared; the others depend on time and place.
_OF_RESULT = (
    *("outcome", "reason", "stops", "hold_saved_s", "offset_m", "delay_s", "pace", "corrections"),
    *("further_m", "predicted_miss_m", "measured_miss_m", "margin_m", "predicted_margin_m"),
    *("predicted_std_m", "probability", "prediction_error_m"),
    *("residual_rms_m", "noise_m", "model", "parameters"),
)
#: Fields that recordings of the first version lack: not compared then.
_RECORDED_LATER = frozenset(
    {"delay_s", "pace", "further_m", "hold_saved_s", "corrections", "stops"}
)
#: Fields of a decision that depend on the computer's speed, or are compared elsewhere.
_NOT_OF_DECISION = frozenset({"wait_s", "simulated_s"})


@dataclass(frozen=True)
class ReplayDifference:
    """A value that differs between recording and replay."""

    name: str
    then: Any
    now: Any


@dataclass(frozen=True)
class Replayed:
    """Result of a replay.

    result       of the replay
    complete     whether the recording contains the cycle to its end
    decided      whether it contains a decision
    differences  in decision, models and result; empty = bit for bit the same
    software     packages whose version differs: name → (then, now)
    losses       measured data that are missing in the recording
    """

    recording: Path
    result: Result
    complete: bool
    decided: bool
    differences: tuple[ReplayDifference, ...]
    software: Mapping[str, tuple[str, str]]
    losses: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "recording": str(self.recording),
            "identical": not self.differences,
            "complete": self.complete,
            "losses": list(self.losses),
            "decided": self.decided,
            "differences": [vars(d) for d in self.differences],
            "software": {name: list(pair) for name, pair in self.software.items()},
            "result": self.result.to_json(),
        }


def replay(
    recording: Recording,
    config: Path | None,
    runs: Path,
    on_step: Callable[[int, str], None] = lambda number, step: None,
) -> Replayed:
    """Carry out a recorded cycle again, on its frames and measured poses.

    config  other settings; None = those of the recording, with its calibration and effects
    runs    parent folder of the replayed cycle's folder
    raises  InputError: settings are wrong, or the recording is damaged or incomplete
    """
    recording.check()
    cycle = recording.last(form.CYCLE) or {}
    aim = cycle.get("aim")
    plan = None if aim is None else _plan(recording, cycle)
    if plan is None:
        subject = "of nothing" if aim is None else f"of a cycle to have a cable {aim}"
        message = f"is {subject}; only insertions and films of your own can be replayed"
        raise InputError.at(recording.path, message)
    with TemporaryDirectory() as folder:
        settings, known = _settings(recording, config, Path(folder), cycle)
        devices, set_clock = replayed_devices(recording, settings)
        events = _ReplayedEvents(devices)

        def step(number: int, name: str) -> None:
            set_clock(number, name)
            on_step(number, name)

        archive = Archive(RecordingSetup(events))
        cell = cell_with(settings, devices, runs, step, known, archive=archive)
        try:
            result = cell.run_cycle(cycle["cycle"], plan)
        finally:
            cell.close()
    return Replayed(
        recording.path,
        result,
        recording.complete,
        recording.count(form.DECISION) > 0,
        tuple(_differences(recording, events)),
        _software(recording, events.begun),
        recording.losses(),
    )


def _plan(recording: Recording, cycle: Mapping[str, Any]) -> Plan | None:
    """Plan of the recorded cycle; None = it cannot be replayed."""
    if cycle["aim"] == Outcome.INSERTED.value:
        return INSERTING
    filming = recording.last(form.FILMING)
    if FILM not in cycle["steps"] or filming is None:
        return None
    return filmed(Filming(**filming), decides=LOOK not in cycle["steps"])


def _settings(
    recording: Recording, config: Path | None, folder: Path, cycle: Mapping[str, Any]
) -> tuple[Settings, Calibrated]:
    if config is not None:
        settings = load_settings(config)
        return _at_once(settings), calibrated(settings, config)
    try:
        restored = restored_files(recording, folder)
        settings = settings_class(restored).model_validate(restored)
    except ValueError as error:  # pydantic's, too
        message = f"its settings are of another version: {error}; give some with --config"
        raise InputError.at(recording.path, message) from error
    started = datetime.fromisoformat(cycle["started"]).astimezone()
    return _at_once(settings), calibrated(settings, recording.path, started)


def _at_once(settings: Settings) -> Settings:
    """The same, in simulated time without waiting."""
    world = settings.world.model_copy(update={"real_time_factor": None})
    return settings.model_copy(update={"world": world})


class _ReplayedEvents(Recorder):
    """Collects the events of a replayed cycle, and writes no file; read as a `Recording` is."""

    def __init__(self, devices: Devices) -> None:
        super().__init__(devices.arm, devices.clock, memory_bytes=0)
        self.begun: Mapping[str, str] = {}
        self._events: dict[str, list[dict[str, Any]]] = {}

    def begin(self, path: Path, begun: Mapping[str, str], vision: Any = None) -> None:
        """Keep the metadata."""
        self.begun = dict(begun)

    def event(self, topic: str, data: Mapping[str, Any]) -> None:
        """Store it as it would be read from a file."""
        self._events.setdefault(topic, []).append(plain(data))

    def json(self, topic: str) -> Iterator[dict[str, Any]]:
        """Events of a topic, in their order."""
        return iter(self._events.get(topic, ()))

    def last(self, topic: str) -> dict[str, Any] | None:
        """The last event of a topic; None = there is none."""
        return next(reversed(self._events.get(topic, [])), None)


def _differences(then: Recording, now: _ReplayedEvents) -> list[ReplayDifference]:
    differences = _compared("decision", *(_part(of.last(form.DECISION)) for of in (then, now)))
    models, others = list(then.json(form.MODEL)), list(now.json(form.MODEL))
    for number, (a, b) in enumerate(zip(models, others, strict=False), start=1):
        differences += _compared(f"model {number}", a, b)
    result, other = then.last(form.RESULT), now.last(form.RESULT)
    if result is not None and other is not None:
        known = [k for k in _OF_RESULT if k in result or k not in _RECORDED_LATER]
        differences += _compared("result", *({k: r.get(k) for k in known} for r in (result, other)))
    if len(others) < len(models):  # more are no difference: the recording may be cut off
        differences.append(ReplayDifference("models", len(models), len(others)))
    return differences


def _part(decision: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    if decision is None:
        return None
    return {k: v for k, v in decision.items() if k not in _NOT_OF_DECISION}


def _compared(name: str, then: Any, now: Any) -> list[ReplayDifference]:
    """Every leaf that differs; numbers must be the same to the last bit."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        keys = dict.fromkeys([*then, *(k for k in now if k not in _RECORDED_LATER)])
        return [d for k in keys for d in _compared(f"{name}.{k}", then.get(k), now.get(k))]
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        pairs = enumerate(zip(then, now, strict=True))
        return [d for i, (a, b) in pairs for d in _compared(f"{name}[{i}]", a, b)]
    return [] if then == now else [ReplayDifference(name, then, now)]


def _software(recording: Recording, now: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    excluded = ("cycle", "started", "host", "process", "format", form.EPOCH, form.RING)
    return {
        name: (then, now[name])
        for name, then in recording.started.items()
        if name not in excluded and name in now and now[name] != then
    }
