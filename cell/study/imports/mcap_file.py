"""MCAP recordings of any program: numbers in JSON, ROS 2 and protobuf messages, by topic."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.transforms import has_chains, transforms_tree
from cell.study.table import MAX_ROWS
from drivers.installing import install_extra

#: Maximum length of a list in a message, and maximum number of columns: images are skipped.
_MAX_ENTRIES, _MAX_COLUMNS = 200, 2000
_MAX_DEPTH = 8
#: Exceptions of the readers for a truncated file or another format.
_UNREADABLE = (
    McapError, ValueError, EOFError, LookupError, MemoryError, struct.error,
    OSError,  # it seeks before the beginning of a short file
)  # fmt: skip
#: Fields that hold the time of measurement.
_STAMPS = ("timestamp", "stamp", "time")
#: Fields without measurements.
_IGNORED_FIELDS = frozenset(("covariance", "header", "seq", "color", "scale", "lifetime", *_STAMPS))


def read_mcap(path: Path) -> Capture:
    """Read all numbers of all topics: one row per time, columns named topic and field.

    A file needs no index; a truncated one is read up to its last complete message.

    raises  InputError: it is no MCAP file, or no message can be decoded
    """
    rows: dict[float, dict[str, float]] = {}
    undecoded, notes, names = set[str](), list[str](), dict[str, None]()
    transforms: dict[str, list[Any]] = {}
    for topic, log_s, content in _messages(path, undecoded, notes):
        if sent := _transforms(content):
            transforms.setdefault(topic, []).extend(sent)
        for t_s, name, value in _numbers(content, 0, log_s):
            rows.setdefault(t_s, {})[f"{topic} {name}"] = value
            names[f"{topic} {name}"] = None
        if len(rows) > MAX_ROWS or len(names) > _MAX_COLUMNS:
            raise InputError.at(
                path,
                f"has more than {MAX_ROWS} times or {_MAX_COLUMNS} numbers; keep the topics with "
                "markers and gripper, and cut it to the motion",
            )
    if has_chains(list(transforms.values())):
        rows, names = _with_chains(path, rows, transforms)
    if not rows:
        reason = f": {', '.join(sorted(undecoded))} cannot be decoded" if undecoded else ""
        remedy = f"{install_extra('import')} decodes ROS 2 and protobuf"
        raise InputError.at(path, f"holds no messages with numbers{reason}; {remedy}")
    times = sorted(rows)
    values = [[t, *(rows[t].get(n, np.nan) for n in names)] for t in times]
    columns = (CapturedColumn("time", "s"), *(CapturedColumn(n) for n in names))
    notes += [f"{path}: {t} cannot be decoded; it is not read" for t in sorted(undecoded)]
    return Capture(
        path, columns, np.array(values), np.arange(1, len(times) + 1), notes=tuple(notes),
        counted="time",
    )  # fmt: skip


def _with_chains(
    path: Path, rows: dict[float, dict[str, float]], transforms: dict[str, list[Any]]
) -> tuple[dict[float, dict[str, float]], dict[str, None]]:
    """Rows and their names with paths of the outermost frames in place of the transforms."""
    tree, _ = transforms_tree(path, list(transforms.values()))
    of_topics = tuple(f"{topic} transforms " for topic in transforms)
    result = {
        t: {name: v for name, v in row.items() if not name.startswith(of_topics)}
        for t, row in rows.items()
    }
    for (source, name), series in tree.items():
        for t, value in zip(tree[source, "time"].tolist(), series.tolist(), strict=True):
            if name != "time":
                result.setdefault(t, {})[name] = value
    result = {t: row for t, row in result.items() if row}
    return result, dict.fromkeys(name for t in sorted(result) for name in result[t])


def _transforms(content: Any) -> list[Any]:
    """Transforms of a message of ROS, as plain data."""
    if content is None or isinstance(content, bool | int | float | str | bytes | list | tuple):
        return []
    sent = _fields(content).get("transforms")
    return [_plain(item) for item in sent] if isinstance(sent, list | tuple) else []


def _plain(content: Any) -> Any:
    if content is None or isinstance(content, int | float | str | bytes):
        return content
    return {name: _plain(item) for name, item in _fields(content).items()}


def metadata_names(path: Path) -> frozenset[str]:
    """Names of the records of metadata; none where the file cannot be read."""
    try:
        with path.open("rb") as file:
            return frozenset(m.name for m in make_reader(file).iter_metadata())
    except _UNREADABLE:
        return frozenset()


def _messages(
    path: Path, undecoded: set[str], notes: list[str]
) -> Iterator[tuple[str, float, Any]]:
    """Topic, time of recording, s, and content of every message that can be decoded."""
    try:
        with path.open("rb") as file:
            decoders: dict[int, Any] = {}
            for schema, channel, message in _in_sequence(path, file, notes):
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(channel, schema)
                decode = decoders[channel.id]
                if decode is None:
                    undecoded.add(f"topic {channel.topic} ({channel.message_encoding})")
                    continue
                yield channel.topic, message.log_time * 1e-9, decode(message.data)
    except FileNotFoundError as error:
        raise InputError.at(path, "cannot be read: no such file; check the name") from error
    except _UNREADABLE as error:
        if isinstance(error, InputError):
            raise
        message_text = f"is torn or is no MCAP file ({error}); record it again, or mend it"
        raise InputError.at(path, message_text) from error


def _in_sequence(path: Path, file: BinaryIO, notes: list[str]) -> Iterator[tuple[Any, Any, Any]]:
    """Schema, channel and message in the file's order: its index may be missing or incomplete."""
    count = 0
    try:
        for item in NonSeekingReader(file).iter_messages(log_time_order=False):
            count += 1
            yield item
    except _UNREADABLE:
        if not count:
            raise
        notes.append(f"{path}: ends in the middle; its first {count} messages are read")


def _factories() -> list[Any]:
    factories: list[Any] = []
    for library in ("mcap_ros2", "mcap_protobuf"):
        with suppress(ImportError):
            factories.append(import_module(f"{library}.decoder").DecoderFactory())
    return factories


def _decoder(channel: Any, schema: Any) -> Any:
    if channel.message_encoding == "json":
        return json.loads
    for factory in _factories():
        if (decode := factory.decoder_for(channel.message_encoding, schema)) is not None:
            return decode
    return None


def _fields(content: Any) -> dict[str, Any]:
    """Names and contents of a message's fields, however it was decoded."""
    if isinstance(content, dict):
        return content
    if hasattr(content, "DESCRIPTOR"):  # protobuf
        return {f.name: getattr(content, f.name) for f in content.DESCRIPTOR.fields}
    names = getattr(content, "__slots__", None) or vars(content)
    return {name: getattr(content, name) for name in names}


def _numbers(
    content: Any, depth: int, log_s: float, name: str = ""
) -> Iterator[tuple[float, str, float]]:
    """Every number of a message: time of measurement, s, names of its fields, value.

    log_s  time of recording, or of the enclosing message; used where there is no timestamp
    """
    match content:
        case bool() | str() | bytes() | None:
            return
        case int() | float():
            yield log_s, name.strip(), float(content)
            return
    if depth > _MAX_DEPTH:
        return
    if isinstance(content, list | tuple) or (
        hasattr(content, "__getitem__") and not isinstance(content, dict)
    ):
        if len(content) <= _MAX_ENTRIES:
            for i, item in enumerate(content):
                yield from _numbers(item, depth + 1, log_s, f"{name} {_label(item, i)}")
        return
    stamp_s = _stamp(content)
    for key, item in _fields(content).items():
        if key not in _IGNORED_FIELDS:
            at_s = log_s if stamp_s is None else stamp_s
            yield from _numbers(item, depth + 1, at_s, f"{name} {key}")


def _label(item: Any, index: int) -> str:
    """Name of a list entry by its own fields, else its index."""
    if isinstance(item, int | float | str | bytes):
        return str(index)
    fields = _fields(item)
    if isinstance(space := fields.get("ns"), str) and "id" in fields:  # a marker of ROS
        return f"{space} {fields['id']}".strip()
    for key in ("child_frame_id", "name", "label", "marker_name", "id"):
        text = fields.get(key)
        if isinstance(text, str) and text:
            return text
    return str(index)


def _stamp(content: Any) -> float | None:
    """Timestamp of a message, s; None if it has none."""
    fields = _fields(content)
    if "header" in fields:
        fields = _fields(fields["header"])
    for key in _STAMPS:
        if (stamp := fields.get(key)) is None:
            continue
        if isinstance(stamp, int | float) and not isinstance(stamp, bool):
            return float(stamp)
        parts = {} if isinstance(stamp, str) else _fields(stamp)
        seconds = parts.get("sec", parts.get("seconds"))
        nanoseconds = parts.get("nanosec", parts.get("nsec", parts.get("nanos", 0)))
        if isinstance(seconds, int | float) and (seconds or nanoseconds):
            return float(seconds) + 1e-9 * float(nanoseconds)
    return None
