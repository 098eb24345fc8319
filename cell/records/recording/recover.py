"""Makes a readable recording of a torn one, and says what is missing."""

from __future__ import annotations

import errno
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import foxglove
from foxglove import Channel, Context
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.stream_reader import breakup_chunk
from zstandard import ZstdDecompressor, ZstdError

from cell.files.input_error import InputError
from cell.records.recording import form
from cell.records.recording.reading import (
    MAGIC,
    UNREADABLE,
    TornRecordingError,
    check_begins,
    lacks_end,
    verify,
)
from cell.records.recording.ring import RingReader, open_somewhere
from cell.records.recording.writer import RecordingSession, Sink, open_mcap

_HEAD_BYTES = 9  # opcode, length
#: Of a chunk: its head; where the name of the compression begins; the most that one may hold.
_CHUNK_HEAD_BYTES, _NAME_AT, _MOST_OF_CHUNK = 53, 37, 256 * 2**20


_READERS: dict[int, Callable[[ReadDataStream], records.McapRecord]] = {
    Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read,
    Opcode.CHUNK: records.Chunk.read,
    Opcode.METADATA: records.Metadata.read,
    Opcode.FOOTER: records.Footer.read,
}


@dataclass(frozen=True)
class Recovered:
    """What `recover` found.

    messages      number by topic, in the file that was written
    frames_s, poses_s   time of the last frame and of the last measured pose, s after the first
                        message; None = there is none
    read_bytes    of the torn file, up to where its records are whole; of what is behind that the
                  whole messages were taken too
    damaged_bytes   of records before that which could not be read
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
    """Torn recordings in a folder and below it, and a file that lacks anything or is damaged.

    Recordings that are being written now are left out.  In a folder damage in the middle of a
    recording is not looked for: that would read all of them.
    raises  InputError: there is no such place
    """
    if place.is_file():
        return [] if _is_complete_file(place) else [place]
    if not place.is_dir():
        raise InputError.at(place, "is missing; give a recording or a folder")
    parts = (p for p in place.rglob(form.PART) if not being_written(p))
    return sorted([*parts, *(p for p in place.rglob(form.FILE) if lacks_end(p))])


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
    beside = source.with_name(f"{source.stem}.recovered.mcap")
    if target is not None or source.name not in (form.PART, form.FILE):
        return recover(source, target or beside)
    file = source.with_name(form.FILE)
    recovered = recover(source, beside if source == file else file)
    if recovered.damaged_bytes:
        kept = source.with_name(form.TORN)
        os.link(source, kept)  # never over another file
        recovered = replace(recovered, source=kept)
    if source == file:
        recovered.file.replace(file)
        return replace(recovered, file=file)
    source.unlink()
    return recovered


def being_written(part: Path) -> bool:
    """Whether a process has this file open, or has ended it just now; False where the system does
    not tell.
    """
    try:
        return open_somewhere(part)
    except FileNotFoundError:
        return True


def recover(source: Path, target: Path) -> Recovered:
    """Write what can be read of `source` to `target`, and verify that.

    The source stays as it is.  Chunks whose checksum is wrong are left out.
    raises  InputError: there is nothing to recover; OSError: it cannot be written; FileExistsError
    """
    try:
        check_begins(source)
    except OSError as error:
        raise InputError.at(source, f"cannot be read: {error.strerror}") from error
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        copy = _Copy(part)
        try:
            reached = copy.take_all(source)
            if not copy.complete:
                copy.copy_partial_chunk(source, reached)
                if (rest := _remaining_in_ring(source)) is not None:
                    copy.take_all(rest)
            copy.close()
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


def _remaining_in_ring(source: Path) -> Path | None:
    """What the recorder of a torn recording was given and has not written, as a file beside it.

    It belongs to the recording that was begun last.  One that was begun in that memory and not on
    the disk becomes a file of its own.
    """
    rest = source.with_name(form.REST)
    begun = _begun(source)
    ring = Path(begun.get(form.RING) or "/nowhere")
    if not ring.exists() or being_written(ring) or _is_another_later(source, begun):
        return rest if rest.exists() else None
    descriptor = os.open(ring, os.O_RDWR)
    try:
        reader = RingReader(descriptor)
        begins_at = reader.position
        reports = _write_what_waits(reader, rest, begun)
        if refused := next((r for r in reports if not _is_complete(r)), None):
            reader.position = begins_at  # it stays in memory, for the next try
            for one in (Path(r["path"]) for r in reports):
                one.unlink(missing_ok=True)
                if one != rest:
                    one.with_name(form.PART).unlink(missing_ok=True)
            why = refused.get("error") or refused["cause"]
            raise OSError(errno.ENOSPC, f"the rest, still in memory, cannot be written: {why}")
    finally:
        os.close(descriptor)
    ring.unlink()
    return rest


def _is_another_later(source: Path, begun: Mapping[str, str]) -> bool:
    """Whether another torn recording of the same recorder was begun later."""
    others = (_begun(p) for p in source.parent.parent.glob(f"*/{form.PART}") if p != source)
    of_same = [other for other in others if other.get(form.RING) == begun.get(form.RING)]
    return any(_started_s(other) > _started_s(begun) for other in of_same)


def _started_s(begun: Mapping[str, str]) -> float:
    """When a recording was begun, s since 1970; 0 = it does not say that."""
    said = begun.get("started")
    return datetime.fromisoformat(said).timestamp() if said else 0.0


def _is_complete(report: Mapping[str, Any]) -> bool:
    return "error" not in report and not report["lost_frames"] and not report["lost_messages"]


def _write_what_waits(
    reader: RingReader, rest: Path, begun: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Write what is in a ring to files; what is reported of each.

    rest, begun  of the recording to which the first of it belongs
    """
    rest.unlink(missing_ok=True)  # of a try that failed
    recording: RecordingSession | None = RecordingSession(rest, begun, part=rest)
    ended: list[RecordingSession] = []
    while (taken := reader.take()) is not None:
        header, payload = taken
        match header:
            case ("begin", path, said):
                ended += [recording] if recording else []
                Path(path).with_name(form.PART).unlink(missing_ok=True)
                recording = RecordingSession(Path(path), said)
            case ("end", *_):
                ended += [recording] if recording else []
                recording = None
            case _ if recording is not None:
                recording.write(header, payload)
    return [one.end(True, False) for one in ended + ([recording] if recording else [])]


def _begun(source: Path) -> dict[str, str]:
    """What a recording says at its beginning."""
    for record, _ in _records(source):
        if isinstance(record, records.Metadata) and record.name == form.BEGUN:
            return dict(record.metadata)
    return {}


class _Copy:
    """The messages of one file, written to another as they are."""

    def __init__(self, path: Path) -> None:
        self.counts: Counter[str] = Counter()
        self.bad_bytes = 0
        self.complete = False
        self.sink = Sink(path)
        self._last_ns: dict[str, int] = {}
        self._first_ns: int | None = None
        self._closed: dict[str, str] = {}
        self._metadata: set[str] = set()
        self._context = Context()
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._topics: dict[int, str] = {}
        self._writer = open_mcap(self.sink, self._context)

    def take_all(self, source: Path) -> int:
        """Take every record that is whole; how far the file could be read, bytes."""
        reached = len(MAGIC)
        self._topics.clear()  # every file has its own numbers
        for record, end in _records(source):
            reached = end
            match record:
                case records.Chunk():
                    self._take_chunk(record)
                case records.Metadata(name=name, metadata=data):
                    if name == form.CLOSED:
                        self._closed = dict(data)
                    elif name not in self._metadata:
                        self._metadata.add(name)
                        self._writer.write_metadata(name, dict(data))
                case records.Schema() | records.Channel() | records.Message():
                    self._take(record)
                case records.Footer():
                    self.complete = True
        return reached

    def copy_partial_chunk(self, source: Path, at: int) -> None:
        """Take the whole messages of a chunk that was not ended."""
        with source.open("rb") as file:
            file.seek(at)
            rest = file.read(_MOST_OF_CHUNK)
        if len(rest) < _CHUNK_HEAD_BYTES or rest[0] != Opcode.CHUNK:
            return
        name = int.from_bytes(rest[_NAME_AT : _NAME_AT + 4], "little")
        packed = rest[_NAME_AT + 4 + name + 8 :]
        if rest[_NAME_AT + 4 : _NAME_AT + 4 + name] != b"zstd":
            return
        inside = b""
        with suppress(ZstdError), ZstdDecompressor().stream_reader(packed) as stream:
            while block := stream.read(65536):
                inside += block
        for record in _complete_records(inside):
            self._take(record)

    def close(self) -> None:
        """End the file with its index."""
        said = self._closed or {"complete": "false"}
        counts = json.dumps(dict(self.counts))
        lost = {form.DAMAGED_BYTES: str(self.bad_bytes)} if self.bad_bytes else {}
        said = said | {"recovered": "true", "counts": counts} | lost
        self._writer.write_metadata(form.CLOSED, said)
        self._writer.close()
        if self.sink.refused is not None:
            raise self.sink.refused
        self.sink.sync()

    def after_first_s(self, topic: str) -> float | None:
        """Time of a topic's last message, s after the first of all."""
        last_ns = self._last_ns.get(topic)
        return (
            None if last_ns is None or self._first_ns is None else (last_ns - self._first_ns) / 1e9
        )

    def _take_chunk(self, chunk: records.Chunk) -> None:
        try:
            inside = breakup_chunk(chunk, validate_crc=True)
        except UNREADABLE:
            self.bad_bytes += len(chunk.data)
            return
        for record in inside:
            self._take(record)

    def _take(self, record: records.McapRecord) -> None:
        match record:
            case records.Schema(id=number):
                self._schemas[number] = record
            case records.Channel(id=number):
                self._topics[number] = record.topic
                if record.topic in self._channels:
                    return
                schema = self._schemas.get(record.schema_id)
                self._channels[record.topic] = Channel(
                    record.topic,
                    schema=None
                    if schema is None
                    else foxglove.Schema(
                        name=schema.name, encoding=schema.encoding, data=schema.data
                    ),
                    message_encoding=record.message_encoding,
                    metadata=dict(record.metadata),
                    context=self._context,
                )
            case records.Message(channel_id=number, log_time=log_ns) if number in self._topics:
                topic = self._topics[number]
                self._channels[topic].log(record.data, log_time=log_ns)
                self.counts[topic] += 1
                self._last_ns[topic] = max(log_ns, self._last_ns.get(topic, 0))
                first = log_ns if self._first_ns is None else self._first_ns
                self._first_ns = min(first, log_ns)
            case records.Message(data=data):  # its channel stood in a chunk that is damaged
                self.bad_bytes += len(data)


def _records(source: Path) -> Iterator[tuple[records.McapRecord, int]]:
    """Whole records of a file with where they end, as far as they go; none is larger than it."""
    size = source.stat().st_size
    with source.open("rb") as file:
        file.seek(len(MAGIC))
        at = len(MAGIC)
        while at + _HEAD_BYTES <= size:
            head = file.read(_HEAD_BYTES)
            opcode, length = head[0], int.from_bytes(head[1:], "little")
            if not 1 <= opcode <= Opcode.DATA_END or length > size - at - _HEAD_BYTES:
                return
            body = file.read(length)
            at += _HEAD_BYTES + length
            read = _READERS.get(Opcode(opcode))
            if read is not None:
                try:
                    yield read(ReadDataStream(BytesIO(body))), at
                except UNREADABLE:
                    return


def _complete_records(inside: bytes) -> Iterator[records.McapRecord]:
    """Records at the beginning of a chunk's content, up to one that is not all there."""
    at = 0
    while at + _HEAD_BYTES <= len(inside):
        opcode, length = inside[at], int.from_bytes(inside[at + 1 : at + _HEAD_BYTES], "little")
        body = inside[at + _HEAD_BYTES : at + _HEAD_BYTES + length]
        if len(body) < length:
            return
        stream = ReadDataStream(BytesIO(body))
        try:
            if opcode == Opcode.MESSAGE:
                yield records.Message.read(stream, length)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield _READERS[Opcode(opcode)](stream)
        except UNREADABLE:
            return
        at += _HEAD_BYTES + length
