"""Stores the evidence of cycles: recordings of all frames, and a ledger that lists cycles."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cell.identify.identified import Identified
from cell.plan.passage import path_at
from cell.records.ledger.entry import Acknowledgement, LedgerEntry, entry_of_folder, estimates_of
from cell.records.ledger.outbox import LedgerWriter
from cell.records.recording import form
from cell.records.recording.band import VisionSetup
from cell.records.recording.recorder import Recorder
from cell.records.recording.retention import Retention
from cell.records.recording.unpack import study_to_plain
from cell.records.recording.uploads import Uploads
from cell.records.result import Fault, Outcome, Result
from cell.run.findings import FilmedMotion, Findings, required
from cell.run.station import ProductTask, Station
from cell.settings.records import RecordingSettings
from cell.study.data import Study

#: Packages on whose versions the last digit of a result may depend.
_COMPUTING = ("cable-cell", "numpy", "scipy", "numba", "opencv-python-headless")


@dataclass(frozen=True)
class RecordingSetup:
    """How cycles are recorded.

    wanted       which recordings are stored, and whether with full frames
    retention    deletes old recordings to make room; None = nothing is deleted
    uploads      sends recordings to a store; None = they stay
    """

    recorder: Recorder
    wanted: RecordingSettings = field(default_factory=RecordingSettings)
    retention: Retention | None = None
    uploads: Uploads | None = None

    def notes(self) -> tuple[str, ...]:
        """Messages for a person."""
        return (*self.recorder.notes, *(() if self.uploads is None else self.uploads.notes))

    def close(self) -> None:
        """End recording: finish what was begun, and upload it if there is time."""
        try:
            self.recorder.close()
        finally:
            if self.uploads is not None:
                self.uploads.close()


def recording_metadata(cycle: int, started: datetime) -> dict[str, str]:
    """Metadata at the beginning of a recording."""
    return {
        "cycle": str(cycle),
        "started": started.isoformat(),
        "host": platform.node(),
        "process": str(os.getpid()),
        "python": platform.python_version(),
        **{package: version(package) for package in _COMPUTING},
    }


class CycleRecording:
    """Records what a cycle produces, each item once; does nothing without a recorder."""

    def __init__(self, recording: RecordingSetup | None) -> None:
        self._recording = recording
        self._recorded = Findings()
        self._path = Path()

    def begin(
        self,
        folder: Path,
        cycle: int,
        started: datetime,
        plan: Mapping[str, Any],
        made: ProductTask,
    ) -> None:
        """The cycle begins; `plan` describes its steps."""
        if self._recording is None:
            return
        retention = self._recording.retention
        if retention is not None and (no_room := retention.make_room()):
            self._recording.recorder.note(f"cycle {cycle} is not recorded: {no_room}")
            self._recording = None
            return
        self._path = folder / form.FILE
        recorder, task = self._recording.recorder, made.task
        whole = self._recording.wanted.whole_frames
        vision = None if whole else VisionSetup(task.view, task.vision)
        recorder.begin(self._path, recording_metadata(cycle, started), vision)
        identity = {"cycle": cycle, "started": started.isoformat(), "folder": str(folder)}
        corners_px = task.view.to_pixels(task.destination.corners_m)
        recorder.event(form.CYCLE, {**identity, **plan, "destination_px": corners_px.tolist()})
        recorder.event(form.SETTINGS, {"settings": made.settings, "files": made.files})

    def state(self, state: str, step: str | None) -> None:
        """A step begins, or the cell's state changes."""
        self._event(form.STATE, {"state": state, "step": step})

    def record_findings(self, findings: Findings, station: Station) -> None:
        """Record the findings that are new since the last call."""
        if self._recording is None:
            return
        before, self._recorded = self._recorded, findings
        if findings.filming is not None and findings.filming is not before.filming:
            filming = findings.filming
            self._event(form.TASK, {"model": station.task.model, **vars(station.timing)})
            names = ("begin_s", "rest_s", "end_s", "frame_count")
            self._event(form.FILMING, {name: getattr(filming, name) for name in names})
        if findings.choice is not None and findings.choice is not before.choice:
            self._event(form.DECISION, decision_of(findings))
        if findings.passage is not None and findings.passage is not before.passage:
            self._event(form.PASSAGE, passage_of(findings))
        if findings.identified is not None and findings.identified is not before.identified:
            self._event(form.MODEL, findings.identified.to_dict())
        for filmed, known in ((findings.held, before.held), (findings.executed, before.executed)):
            if filmed is not None and filmed is not known:
                self._record_sightings(filmed, station)

    def study(self, study: Study) -> None:
        """The trials so far."""
        self._event(form.STUDY, study_to_plain(study))

    def fault(self, fault: Fault) -> None:
        """A fault has ended the cycle."""
        self._event(form.FAULT, vars(fault))

    def end(self, result: Result) -> None:
        """The cycle has ended, with this result."""
        if self._recording is None:
            return
        self._event(form.RESULT, result.to_json())
        wanted = self._recording.wanted
        counted = wanted.keep_every > 0 and result.cycle % wanted.keep_every == 0
        keep = counted or result.outcome.value in wanted.keep
        self._recording.recorder.end(keep, result.outcome is not Outcome.INSERTED)
        if self._recording.retention is not None:
            self._recording.retention.add(self._path)
        if keep and self._recording.uploads is not None:
            self._recording.uploads.add(self._path)

    def _event(self, topic: str, data: Mapping[str, Any]) -> None:
        if self._recording is not None:
            self._recording.recorder.event(topic, data)

    def _record_sightings(self, filmed: FilmedMotion, station: Station) -> None:
        assert self._recording is not None
        nodes_m = np.array([sighting.nodes_m for sighting in filmed.sightings])
        points_px = station.task.view.to_pixels(nodes_m)
        self._recording.recorder.add_detections([s.t_s for s in filmed.sightings], points_px)


def parameters_of(identified: Identified) -> dict[str, float]:
    """Most probable values by name, SI units."""
    return dict(zip(identified.space.names, identified.values.tolist(), strict=True))


def decision_of(findings: Findings) -> dict[str, Any]:
    """The decision and its basis: plain data, every number as it was computed.

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
        "parameters": parameters_of(identified),
        "table": [vars(row) for row in choice.table],
        "tip_m": choice.tip_m,
        "residual_rms_m": identified.residual_rms_m,
        "frames_used": identified.frames_used,
        "wait_s": findings.wait_s,
    }


def passage_of(findings: Findings) -> dict[str, Any]:
    """The tip in the frames of the execution that show it, and where it was predicted, m.

    Plain data; times in s from the beginning of the motion.
    """
    executed, predicted = required(findings.executed), findings.predicted_choice
    sightings = [s for s in executed.sightings if s.seen]
    t_s = np.array([s.t_s for s in sightings]) - required(findings.candidates).start_s
    return {
        "t_s": t_s,
        "tip_m": np.array([s.nodes_m[0] for s in sightings]).reshape(-1, 2),
        "predicted_m": path_at(t_s, predicted.t_s, predicted.tip_m),
    }


@dataclass(frozen=True)
class LedgerSetup:
    """The ledger of a cell's cycles, and the columns that are the same for all of them.

    line         that the cell belongs to
    software     version of this program
    """

    ledger: LedgerWriter
    line: str
    software: str | None = None


class CycleListing:
    """Writes to the ledger that a cycle has begun, and how it ended; nothing without a ledger."""

    def __init__(self, setup: LedgerSetup | None) -> None:
        self._setup = setup
        self._entry: LedgerEntry | None = None

    def begin(
        self,
        folder: Path,
        cycle: int,
        started: datetime,
        aim: str,
        part: str | None,
        made: ProductTask,
    ) -> None:
        """The cycle begins."""
        if self._setup is None:
            return
        self._entry = LedgerEntry(
            line=self._setup.line,
            cycle=cycle,
            folder=folder.absolute(),
            started=started.astimezone(UTC),
            aim=aim,
            part=part,
            product=made.name,
            calibration=made.calibration,
            software=self._setup.software,
        )
        self._setup.ledger.put(self._entry)

    def take_up(self, folder: Path) -> None:
        """Resume the entry of an unfinished cycle of an earlier run, from its folder."""
        if self._setup is not None:
            self._entry = entry_of_folder(folder, self._setup.line)

    def acknowledge(self, by: str, note: str) -> None:
        """A person acknowledges the cycle's fault."""
        self._put(Acknowledgement(datetime.now(UTC), by, note))

    def reset(self, by: str, note: str) -> None:
        """A person resets the cell after that: added to the acknowledgement's note."""
        former = None if self._entry is None else self._entry.acknowledged
        if former is not None:
            words = ": ".join(filter(None, (f"reset by {by}", note)))
            self._put(replace(former, note="; ".join(filter(None, (former.note, words)))))

    def _put(self, acknowledgement: Acknowledgement) -> None:
        if self._setup is not None and self._entry is not None:
            self._entry = replace(self._entry, acknowledged=acknowledgement)
            self._setup.ledger.put(self._entry)

    def end(
        self,
        result: Result,
        identified: Identified | None,
        waited: Mapping[str, float] | None = None,
    ) -> None:
        """The cycle has ended.

        identified  None = its cable was not identified
        waited      waiting times by reason, as in the entry, s
        """
        if self._setup is None or self._entry is None:
            return
        self._entry = replace(
            self._entry,
            ended=datetime.now(UTC),
            result=result,
            estimates=estimates_of(None if identified is None else identified.to_dict()),
            waited=waited or {},
        )
        self._setup.ledger.put(self._entry)


@dataclass(frozen=True)
class Archive:
    """How cycles are recorded and listed; None = they are not."""

    recording: RecordingSetup | None = None
    ledger: LedgerSetup | None = None

    def notes(self) -> tuple[str, ...]:
        """Messages for a person."""
        recorded = () if self.recording is None else self.recording.notes()
        return (*recorded, *([] if self.ledger is None else self.ledger.ledger.notes))

    def close(self) -> None:
        """End recording and listing."""
        with ExitStack() as stack:
            if self.ledger is not None:
                stack.callback(self.ledger.ledger.close)
            if self.recording is not None:
                stack.callback(self.recording.close)
