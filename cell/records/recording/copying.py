"""Copies a recording message by message, as far as it can be read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import IO

import foxglove
from foxglove import Channel, Context
from mcap import records
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader, breakup_chunk
from zstandard import ZstdDecompressor, ZstdError

from cell.records.recording import form
from cell.records.recording.reading import MAGIC, UNREADABLE
from cell.records.recording.writer import LEVEL, Sink, open_mcap

#: Of a chunk: size of its head; offset of the compression's name; largest content, bytes.
_CHUNK_HEAD_BYTES, _NAME_AT, _MOST_OF_CHUNK = 53, 37, 256 * 2**20


class RecordingCopy:
    """A copy of a recording's messages, unchanged.

    counts     messages by topic that were written
    bad_bytes  of records that could not be read
    complete   whether a file was read to its end
    closed     metadata from its end
    """

    def __init__(self, path: Path, level: int = LEVEL) -> None:
        self.counts: Counter[str] = Counter()
        self.bad_bytes = 0
        self.complete = False
        self.sink = Sink(path)
        self._last_ns: dict[str, int] = {}
        self._first_ns: int | None = None
        self.closed: dict[str, str] = {}
        self._metadata: set[str] = set()
        self._context = Context()
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._topics: dict[int, str] = {}
        self._writer = open_mcap(self.sink, self._context, level)

    def take_all(self, source: Path) -> int:
        """Copy every complete record; returns how far the file could be read, bytes."""
        reached = len(MAGIC)
        self._topics.clear()  # every file has its own numbers
        for record, end in records_of(source):
            reached = end
            match record:
                case records.Chunk():
                    self._take_chunk(record)
                case records.Metadata(name=name, metadata=data):
                    if name == form.CLOSED:
                        self.closed = dict(data)
                    elif name not in self._metadata:
                        self._metadata.add(name)
                        self._writer.write_metadata(name, dict(data))
                case records.Schema() | records.Channel() | records.Message():
                    self._take(record)
                case records.Footer():
                    self.complete = True
        return reached

    def copy_partial_chunk(self, source: Path, at: int) -> None:
        """Copy the complete messages of an unfinished chunk."""
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
        for record in _complete_records(BytesIO(inside)):
            self._take(record)

    def close(self, metadata: Mapping[str, str]) -> None:
        """End the file with its index and final metadata.  Raises OSError."""
        self._writer.write_metadata(form.CLOSED, dict(metadata))
        self._writer.close()
        if self.sink.refused is not None:
            raise self.sink.refused
        self.sink.sync()

    def log(self, topic: str, data: bytes, log_ns: int) -> None:
        """Write a message."""
        self._channels[topic].log(data, log_time=log_ns)
        self.counts[topic] += 1
        self._last_ns[topic] = max(log_ns, self._last_ns.get(topic, 0))
        first = log_ns if self._first_ns is None else self._first_ns
        self._first_ns = min(first, log_ns)

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
                self.log(self._topics[number], record.data, log_ns)
            case records.Message(data=data):  # its channel stood in a chunk that is damaged
                self.bad_bytes += len(data)


def records_of(source: Path) -> Iterator[tuple[records.McapRecord, int]]:
    """Records of a file up to the first incomplete one, and where each ends."""
    with source.open("rb") as file:
        file.seek(len(MAGIC))
        for record in _complete_records(file):
            yield record, file.tell()


def _complete_records(file: IO[bytes]) -> Iterator[records.McapRecord]:
    """Records from here on, up to the first incomplete one."""
    with suppress(*UNREADABLE):
        yield from StreamReader(file, skip_magic=True, emit_chunks=True).records
