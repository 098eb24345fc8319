"""Recovers a readable recording from a torn one, and reports what is missing."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from mcap import records

from cell.files.input_error import InputError
from cell.records.recording import form
from cell.records.recording.copying import RecordingCopy, records_of
from cell.records.recording.reading import (
    TornRecordingError,
    check_begins,
    damaged,
    lacks_end,
    verify,
)
from cell.records.recording.ring import RingReader, open_somewhere
from cell.records.recording.writer import RecordingSession


@dataclass(frozen=True)
class Recovered:
    """Result of the recovery of a recording.

    messages      number by topic, in the file that was written
    frames_s, poses_s   time of the last frame and of the last measured pose, s after the first
                        message; None = there is none
    read_bytes    of the torn file, up to the end of its complete records; complete messages behind
                  that are copied too
    damaged_bytes   of earlier records that could not be read
    """

    source: Path
    file: Path
    messages: dict[str, int]
    frames_s: float | None
    poses_s: float | None
    read_bytes: int
    damaged_bytes: int

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self) | {"source": str(self.source), "file": str(self.file)}


def torn_recordings(place: Path) -> list[Path]:
    """Torn recordings in a folder and below it; of a file itself, if incomplete or damaged.

    Recordings that are being written are skipped.  In a folder, damage in the middle of a
    recording is not detected: `damaged_recordings` reads all of them.
    raises  InputError: there is no such place, or no recording in it
    """
    if place.is_file():
        return [] if _is_complete_file(place) else [place]
    if not place.is_dir():
        raise InputError.at(place, "is missing; give a recording or a folder")
    there = [*place.rglob(form.PART), *place.rglob(form.FILE)]
    if not there:
        raise InputError.at(place, "holds no recording; give a recording, or a folder with some")
    parts = [p for p in there if p.name == form.PART and not being_written(p)]
    for part in parts:  # its recorder was killed while it reduced the frames
        part.with_name(form.BAND).unlink(missing_ok=True)
        if part.with_name(form.FILE).exists():
            part.replace(part.with_name(form.WHOLE))
    parts = [p for p in parts if p.exists()]
    return sorted([*parts, *(p for p in place.rglob(form.FILE) if lacks_end(p))])


def damaged_recordings(place: Path) -> Iterator[InputError]:
    """One error for each recording in a folder and below it that has an index, but is damaged."""
    for path in sorted(place.rglob(form.FILE)):
        try:
            if not lacks_end(path):
                verify(path)
        except TornRecordingError as error:
            yield damaged(path, error)
        except OSError as error:
            yield InputError.at(path, f"cannot be read: {error.strerror}; check who may read it")


def _is_complete_file(path: Path) -> bool:
    try:
        verify(path)
    except (TornRecordingError, OSError):
        return False
    return True


def recover_in_place(source: Path, target: Path | None = None) -> Recovered:
    """Recover to another file; one of a cycle becomes its `recording.mcap`.

    The torn file of a cycle is then removed, or kept as `recording.mcap.torn` if it is damaged.
    Files of other names stay as they are.

    target  None = `recording.mcap` in a cycle's folder, else the name with `.recovered.mcap`
    raises  as `recover`
    """
    sibling = source.with_name(f"{source.stem}.recovered.mcap")
    if target is not None or source.name not in (form.PART, form.FILE):
        return recover(source, target or sibling)
    file = source.with_name(form.FILE)
    recovered = recover(source, sibling if source == file else file)
    if recovered.damaged_bytes:
        torn = source.with_name(form.TORN)
        os.link(source, torn)  # never over another file
        recovered = replace(recovered, source=torn)
    if source == file:
        recovered.file.replace(file)
        return replace(recovered, file=file)
    source.unlink()
    return recovered


def being_written(part: Path) -> bool:
    """Whether a process has this file open or has just renamed it; False if unknown."""
    try:
        return open_somewhere(part)
    except FileNotFoundError:
        return True


def recover(source: Path, target: Path) -> Recovered:
    """Write the readable part of `source` to `target`, and verify it.

    The source is not changed.  Chunks with a wrong checksum are skipped.
    raises  InputError: there is nothing to recover; OSError: it cannot be written; FileExistsError
    """
    try:
        check_begins(source)
    except OSError as error:
        raise InputError.at(source, f"cannot be read: {error.strerror}") from error
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        copy = RecordingCopy(part)
        try:
            reached = copy.take_all(source)
            if not copy.complete:
                copy.copy_partial_chunk(source, reached)
                if (rest := _remaining_in_ring(source)) is not None:
                    copy.take_all(rest)
            copy.close(_closing_metadata(copy))
        except RuntimeError as error:  # of the writing library, which drops the cause
            if (why := copy.sink.refused) is None:
                raise
            raise OSError(why.errno, why.strerror, str(target)) from error
        finally:
            copy.sink.close()
        if not sum(copy.counts.values()):
            raise InputError.at(source, "holds no whole message: nothing can be recovered")
        try:
            verify(part, copy.counts)
        except TornRecordingError as error:
            raise OSError(f"what was recovered cannot be read back: {error}") from error
        os.link(part, target)  # never over another file
        source.with_name(form.REST).unlink(missing_ok=True)
    finally:
        part.unlink(missing_ok=True)
    return Recovered(
        source,
        target,
        dict(copy.counts),
        copy.after_first_s(form.IMAGE),
        copy.after_first_s(form.MEASURED),
        reached,
        copy.bad_bytes,
    )


def _closing_metadata(copy: RecordingCopy) -> dict[str, str]:
    metadata = copy.closed or {"complete": "false"}
    lost = {form.DAMAGED_BYTES: str(copy.bad_bytes)} if copy.bad_bytes else {}
    return metadata | {"recovered": "true", "counts": json.dumps(dict(copy.counts))} | lost


def _remaining_in_ring(source: Path) -> Path | None:
    """Messages of a torn recording that are in its recorder's ring only, as a file next to it.

    They belong to the recording that was begun last.  A recording that was begun in that memory
    and not on the disk becomes a file of its own.
    """
    rest = source.with_name(form.REST)
    begun = _begun(source)
    ring = Path(begun.get(form.RING) or "/nowhere")
    if not ring.exists() or being_written(ring) or _has_later(source, begun):
        return rest if rest.exists() else None
    descriptor = os.open(ring, os.O_RDWR)
    try:
        reader = RingReader(descriptor)
        begins_at = reader.position
        reports = _write_ring(reader, rest, begun)
        if refused := next((r for r in reports if not _is_complete(r)), None):
            reader.position = begins_at  # it stays in memory, for the next try
            for recording in (Path(r["path"]) for r in reports):
                recording.unlink(missing_ok=True)
                if recording != rest:
                    recording.with_name(form.PART).unlink(missing_ok=True)
            why = refused.get("error") or refused["cause"]
            raise OSError(errno.ENOSPC, f"the rest, still in memory, cannot be written: {why}")
    finally:
        os.close(descriptor)
    ring.unlink()
    return rest


def _has_later(source: Path, begun: Mapping[str, str]) -> bool:
    """Whether a torn recording of the same recorder was begun later."""
    others = (_begun(p) for p in source.parent.parent.glob(f"*/{form.PART}") if p != source)
    of_same = [torn for torn in others if torn.get(form.RING) == begun.get(form.RING)]
    return any(_started_s(torn) > _started_s(begun) for torn in of_same)


def _started_s(begun: Mapping[str, str]) -> float:
    """When a recording was begun, s since 1970; 0 = not known."""
    text = begun.get("started")
    return datetime.fromisoformat(text).timestamp() if text else 0.0


def _is_complete(report: Mapping[str, Any]) -> bool:
    return "error" not in report and not report["lost_frames"] and not report["lost_messages"]


def _write_ring(reader: RingReader, rest: Path, begun: Mapping[str, str]) -> list[dict[str, Any]]:
    """Write the content of a ring to files; the report of each.

    rest, begun  of the recording to which its first messages belong
    """
    rest.unlink(missing_ok=True)  # of a try that failed
    recording: RecordingSession | None = RecordingSession(rest, begun, part=rest)
    ended: list[RecordingSession] = []
    while (message := reader.take()) is not None:
        header, payload = message
        match header:
            case ("begin", path, metadata, *_):
                ended += [recording] if recording else []
                Path(path).with_name(form.PART).unlink(missing_ok=True)
                recording = RecordingSession(Path(path), metadata)
            case ("end", *_):
                ended += [recording] if recording else []
                recording = None
            case _ if recording is not None:
                recording.write(header, payload)
    return [session.end(True, False) for session in ended + ([recording] if recording else [])]


def _begun(source: Path) -> dict[str, str]:
    """Metadata from the beginning of a recording."""
    for record, _ in records_of(source):
        if isinstance(record, records.Metadata) and record.name == form.BEGUN:
            return dict(record.metadata)
    return {}
