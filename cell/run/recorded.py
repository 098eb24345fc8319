"""What of a cycle goes into its recording, and whether the recording is kept."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cell.cable.arrays import FloatArray
from cell.records.recording import form
from cell.records.recording.retention import Retention
from cell.records.recording.uploads import Uploads
from cell.records.result import Fault, Outcome, Result
from cell.run.findings import FilmedMotion, Findings
from cell.run.station import Station
from cell.study.data import Study
from cell.study.plain import study_to_plain

#: Versions on which the last digit of a result may depend.
_COMPUTING = ("cable-cell", "numpy", "scipy", "numba", "opencv-python-headless")


class TakesEvents(Protocol):
    """What a cycle is handed over to: a `Recorder`, or whoever wants to hear of it.

    notes  what a person should know
    """

    notes: list[str]

    def begin(self, path: Path, begun: Mapping[str, str]) -> None:
        """A recording begins."""

    def event(self, topic: str, data: Mapping[str, Any]) -> None:
        """A message of a JSON topic."""

    def seen(self, t_s: Sequence[float], points_px: FloatArray) -> None:
        """The cable as it was seen in frames."""

    def end(self, keep: bool = True) -> None:
        """The recording ends."""

    def note(self, text: str) -> None:
        """Something that a person should know."""

    def close(self) -> None:
        """Nothing more is recorded."""


@dataclass(frozen=True)
class Keeping:
    """Which recordings are kept.

    outcomes  of these cycles all
    every     and every cycle whose number is a multiple of it; 0 = no others
    """

    outcomes: frozenset[Outcome] = frozenset(Outcome)
    every: int = 1

    def keeps(self, result: Result) -> bool:
        """Whether the recording of a cycle is kept."""
        counted = self.every > 0 and result.cycle % self.every == 0
        return counted or result.outcome in self.outcomes


@dataclass(frozen=True)
class RecordingSetup:
    """How cycles are recorded.

    settings   as resolved for what a cycle makes
    files      texts that they refer to, by path: the calibration, effects of one's own
    retention  what makes room for a recording; None = nothing has to
    uploads    what brings recordings to a store; None = they stay
    """

    recorder: TakesEvents
    settings: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    keeping: Keeping = Keeping()
    retention: Retention | None = None
    uploads: Uploads | None = None

    def notes(self) -> tuple[str, ...]:
        """What a person should know."""
        return (*self.recorder.notes, *(() if self.uploads is None else self.uploads.notes))

    def close(self) -> None:
        """Nothing more is recorded; what was is finished, and uploaded if there is time."""
        try:
            self.recorder.close()
        finally:
            if self.uploads is not None:
                self.uploads.close()


def begun(cycle: int, started: datetime) -> dict[str, str]:
    """What is said at the beginning of a recording."""
    return {
        "cycle": str(cycle),
        "started": started.isoformat(),
        "host": platform.node(),
        "process": str(os.getpid()),
        "python": platform.python_version(),
        **{package: version(package) for package in _COMPUTING},
    }


class CycleRecording:
    """Hands over what a cycle finds, each thing once; does nothing without a recorder."""

    def __init__(self, recording: RecordingSetup | None) -> None:
        self._recording = recording
        self._told = Findings()
        self._path = Path()

    def begin(self, folder: Path, cycle: int, started: datetime, plan: Mapping[str, Any]) -> None:
        """The cycle begins; `plan` says what is meant to be done."""
        if self._recording is None:
            return
        kept = self._recording.retention
        if kept is not None and (no_room := kept.make_room()):
            self._recording.recorder.note(f"cycle {cycle} is not recorded: {no_room}")
            self._recording = None
            return
        self._path = folder / form.FILE
        to = self._recording.recorder
        to.begin(self._path, begun(cycle, started))
        about = {"cycle": cycle, "started": started.isoformat(), "folder": str(folder)}
        to.event(form.CYCLE, {**about, **plan})
        settings, files = dict(self._recording.settings), dict(self._recording.files)
        to.event(form.SETTINGS, {"settings": settings, "files": files})

    def state(self, state: str, step: str | None) -> None:
        """A step begins, or the cell's state changes."""
        self._event(form.STATE, {"state": state, "step": step})

    def found(self, findings: Findings, station: Station) -> None:
        """What was found since the last time."""
        if self._recording is None:
            return
        before, self._told = self._told, findings
        if findings.filming is not None and findings.filming is not before.filming:
            filming = findings.filming
            self._event(form.TASK, {"model": station.task.model, **vars(station.timing)})
            names = ("begin_s", "rest_s", "end_s", "frame_count")
            self._event(form.FILMING, {name: getattr(filming, name) for name in names})
        if findings.choice is not None and findings.choice is not before.choice:
            self._event(form.DECISION, decision_of(findings))
        if findings.identified is not None and findings.identified is not before.identified:
            self._event(form.MODEL, findings.identified.to_dict())
        for filmed, known in ((findings.held, before.held), (findings.executed, before.executed)):
            if filmed is not None and filmed is not known:
                self._seen(filmed, station)

    def study(self, study: Study) -> None:
        """The trials so far."""
        self._event(form.STUDY, study_to_plain(study))

    def fault(self, fault: Fault) -> None:
        """Something has ended the cycle."""
        self._event(form.FAULT, vars(fault))

    def end(self, result: Result) -> None:
        """The cycle has ended, with this result."""
        if self._recording is None:
            return
        self._event(form.RESULT, result.to_json())
        kept = self._recording.keeping.keeps(result)
        self._recording.recorder.end(kept)
        if self._recording.retention is not None:
            self._recording.retention.add(self._path)
        if kept and self._recording.uploads is not None:
            self._recording.uploads.add(self._path)

    def _event(self, topic: str, data: Mapping[str, Any]) -> None:
        if self._recording is not None:
            self._recording.recorder.event(topic, data)

    def _seen(self, filmed: FilmedMotion, station: Station) -> None:
        assert self._recording is not None
        nodes_m = np.array([sighting.nodes_m for sighting in filmed.sightings])
        points_px = station.task.view.to_pixels(nodes_m)
        self._recording.recorder.seen([s.t_s for s in filmed.sightings], points_px)


def decision_of(findings: Findings) -> dict[str, Any]:
    """What was decided, and from what: plain data, every number as it was computed.

    raises  LookupError: nothing was decided
    """
    choice, candidates = findings.choice, findings.candidates
    identified = findings.identified
    if choice is None or candidates is None or identified is None:
        raise LookupError("nothing was decided")
    return {
        "offset_m": choice.best.offset_m if choice.chosen else None,
        "reason": choice.reason,
        "start_s": candidates.start_s,
        "simulated_s": list(findings.simulated_s),
        "parameters": {
            name: float(value)
            for name, value in zip(identified.space.names, identified.values, strict=True)
        },
        "table": [vars(row) for row in choice.table],
        "tip_m": choice.tip_m,
        "residual_rms_m": identified.residual_rms_m,
        "frames_used": identified.frames_used,
        "wait_s": findings.wait_s,
    }
