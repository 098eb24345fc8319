"""Runs the cell again on a recorded cycle, and compares what it decides with what was decided."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cell.files.input_error import InputError
from cell.files.plain import plain
from cell.records.recording import form
from cell.records.recording.reading import Recording
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

#: Before its first film a replayed cycle has this time for what comes before, s.
_BEFORE_S = 60.0


def replayed_devices(
    recording: Recording, settings: Settings
) -> tuple[Devices, Callable[[int, str], None]]:
    """Devices of a recorded cycle, and a function that sets their clock as a step begins.

    raises  InputError: the recording lacks what a replay needs
    """
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

    return devices, on_step


def _tries(recording: Recording) -> Iterator[tuple[float, list[float]]]:
    """When each film of a hold began, and when simulations of its offsets did."""
    decisions = [d["simulated_s"] for d in recording.json(form.DECISION)]
    begun_s = list(dict.fromkeys(said["begin_s"] for said in recording.json(form.FILMING)))
    for begin_s, end_s in zip(begun_s, [*begun_s[1:], math.inf], strict=True):
        made = [s for s in decisions if s and begin_s <= s[0] < end_s]
        yield begin_s, list(max(made, key=len, default=[]))


#: Of a result these tell what was found; the rest is time and place.
_OF_RESULT = (
    *("outcome", "reason", "stops", "hold_saved_s", "offset_m", "delay_s", "pace", "corrections"),
    *("further_m", "predicted_miss_m", "measured_miss_m", "margin_m", "predicted_margin_m"),
    *("predicted_std_m", "probability", "prediction_error_m"),
    *("residual_rms_m", "noise_m", "model", "parameters"),
)
#: What recordings of the first version do not say: nothing to compare with.
_RECORDED_LATER = frozenset(
    {"delay_s", "pace", "further_m", "hold_saved_s", "corrections", "stops"}
)
#: Of a decision these depend on the computer's speed, or are said elsewhere.
_NOT_OF_DECISION = frozenset({"wait_s", "simulated_s"})


@dataclass(frozen=True)
class ReplayDifference:
    """A number or a word that came out otherwise."""

    name: str
    then: Any
    now: Any


@dataclass(frozen=True)
class Replayed:
    """A cycle that was replayed.

    result       of the replay
    complete     whether the recording holds the cycle to its end
    decided      whether there was a decision then
    differences  from then, in decision, final model and result; empty = bit for bit the same
    software     packages whose version differs: name → (then, now)
    losses       what was measured and is not in the recording
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
    runs    folder in which the replayed cycle gets its own
    raises  InputError: settings are wrong, or the recording is damaged or lacks what is needed
    """
    recording.check()
    about = recording.last(form.CYCLE) or {}
    aim = about.get("aim")
    plan = None if aim is None else _plan(recording, about)
    if plan is None:
        what = "of nothing" if aim is None else f"of a cycle to have a cable {aim}"
        message = f"is {what}; only insertions and films of your own can be replayed"
        raise InputError.at(recording.path, message)
    with TemporaryDirectory() as folder:
        settings, known = _settings(recording, config, Path(folder), about)
        devices, set_clock = replayed_devices(recording, settings)
        heard = _ReplayedEvents()

        def step(number: int, name: str) -> None:
            set_clock(number, name)
            on_step(number, name)

        archive = Archive(RecordingSetup(heard))
        cell = cell_with(settings, devices, runs, step, known, archive=archive)
        try:
            result = cell.run_cycle(about["cycle"], plan)
        finally:
            cell.close()
    then, now = _found(recording), heard.found()
    return Replayed(
        recording.path,
        result,
        recording.complete,
        then.decision is not None,
        tuple(_differences(then, now)),
        _software(recording, heard.begun),
        recording.losses(),
    )


def _plan(recording: Recording, about: Mapping[str, Any]) -> Plan | None:
    """What was done in the recorded cycle; None = what cannot be done again."""
    if about["aim"] == Outcome.INSERTED.value:
        return INSERTING
    said = recording.last(form.FILMING)
    if FILM not in about["steps"] or said is None:
        return None
    return filmed(Filming(**said), decides=LOOK not in about["steps"])


def _settings(
    recording: Recording, config: Path | None, folder: Path, about: Mapping[str, Any]
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
    started = datetime.fromisoformat(about["started"]).astimezone()
    return _at_once(settings), calibrated(settings, recording.path, started)


def _at_once(settings: Settings) -> Settings:
    """The same, in simulated time that nobody waits for."""
    world = settings.world.model_copy(update={"real_time_factor": None})
    return settings.model_copy(update={"world": world})


@dataclass(frozen=True)
class _ReplayedValues:
    decision: Mapping[str, Any] | None
    models: Sequence[Mapping[str, Any]]
    result: Mapping[str, Any] | None


class _ReplayedEvents:
    """Takes what a replayed cycle hands over, in place of a recorder."""

    def __init__(self) -> None:
        self.begun: Mapping[str, str] = {}
        self.notes: list[str] = []
        self._events: dict[str, list[dict[str, Any]]] = {}

    def begin(self, path: Path, begun: Mapping[str, str], vision: Any = None) -> None:
        self.begun = dict(begun)

    def event(self, topic: str, data: Mapping[str, Any]) -> None:
        """Kept as it would be read from a file."""
        self._events.setdefault(topic, []).append(plain(data))

    def add_detections(self, t_s: Sequence[float], points_px: Any) -> None:
        """Follows from the rest."""

    def end(self, keep: bool = True, whole: bool = False) -> None:
        """Nothing is written."""

    def note(self, text: str) -> None:
        """Nothing is recorded."""

    def close(self) -> None:
        """Nothing is open."""

    def found(self) -> _ReplayedValues:
        decisions, results = self._events.get(form.DECISION), self._events.get(form.RESULT)
        return _ReplayedValues(
            decisions[-1] if decisions else None,
            self._events.get(form.MODEL, []),
            results[-1] if results else None,
        )


def _found(recording: Recording) -> _ReplayedValues:
    return _ReplayedValues(
        recording.last(form.DECISION), list(recording.json(form.MODEL)), recording.last(form.RESULT)
    )


def _differences(then: _ReplayedValues, now: _ReplayedValues) -> list[ReplayDifference]:
    found = []
    pairs: list[tuple[str, Any, Any]] = [
        ("decision", _part(then.decision), _part(now.decision)),
        *(
            (f"model {i + 1}", a, b)
            for i, (a, b) in enumerate(zip(then.models, now.models, strict=False))
        ),
    ]
    if then.result is not None and now.result is not None:
        known = [k for k in _OF_RESULT if k in then.result or k not in _RECORDED_LATER]
        a, b = ({k: r.get(k) for k in known} for r in (then.result, now.result))
        pairs.append(("result", a, b))
    for name, a, b in pairs:
        found += _compared(name, a, b)
    if len(now.models) < len(then.models):  # more of them: the recording ends before the cycle does
        found.append(ReplayDifference("models", len(then.models), len(now.models)))
    return found


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
    apart = ("cycle", "started", "host", "process", "format", form.EPOCH, form.RING)
    return {
        name: (said, now[name])
        for name, said in recording.started.items()
        if name not in apart and name in now and now[name] != said
    }
