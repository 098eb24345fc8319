"""Encoding of messages as lines of JSON, and the place of the socket.

A line is an object with one key, the kind of the message:

    from the cell      greeting (protocol, run), status, notice, answer, refused (a reason),
                       alive (null): sign of life to a program that follows
    from a program     greeting (protocol), status (null), follow (run, sequence, or null), request
"""

from __future__ import annotations

import hashlib
import json
import math
import socket
import tempfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

from cell.plant.messages import COMMANDS, CommandReply, Notice, Request, Status
from cell.run.machine import MachineEvent

Message = TypeVar("Message")
_ADAPTERS: Mapping[type, TypeAdapter[Any]] = {
    kind: TypeAdapter(kind) for kind in (Notice, Status, CommandReply)
}

#: Longest time without a message to a program that follows, s.
HEARTBEAT_S = 0.4
#: A cell that sends nothing to a following program for this time is lost, s.
SILENCE_S = 1.5
#: A longer line is no message, bytes.
LONGEST_LINE = 1 << 20
#: A longer text in a request is refused, characters.
LONGEST_TEXT = 1000
#: A longer path is refused by the system (108 on Linux, 104 elsewhere, one of them at the end).
_LONGEST_PATH = 100


class LinkError(OSError):
    """A cell cannot be reached, or was lost.  Scenario: it ends between a request and its answer.

    The fate of a request is not known then.
    """


class NoCellError(LinkError):
    """No cell runs with this folder of records.  Scenario: the service has not been started."""


class ProtocolError(LinkError):
    """Cell and program use different versions.  Scenario: only one of them was updated."""


def socket_of(runs: Path) -> Path:
    """Path of the Unix socket of the cell whose records are in the folder `runs`.

    It is next to the folder, or in the temporary folder if its path would be too long.
    """
    folder = runs.resolve()
    path = folder.with_name(f"{folder.name}.socket")
    if len(bytes(path)) <= _LONGEST_PATH:
        return path
    name = hashlib.sha256(bytes(folder)).hexdigest()[:16]
    return Path(tempfile.gettempdir(), f"cable-cell-{name}.socket")


def has_unix_sockets() -> bool:
    """Whether this system has Unix sockets, which a link needs."""
    return hasattr(socket, "AF_UNIX")


def line_of(kind: str, data: Any) -> bytes:
    """A message as a line."""
    text = json.dumps({kind: data}, ensure_ascii=False, separators=(",", ":"))
    return text.encode() + b"\n"


def read_line(line: bytes) -> tuple[str, Any]:
    """Kind and data of the message in a line.  Raises ValueError: it is not a message."""
    try:
        message = json.loads(line)
    except RecursionError as error:
        raise ValueError("a message is not nested so deeply") from error
    if not isinstance(message, dict) or len(message) != 1:
        raise ValueError("a message is an object with one key")
    [(kind, data)] = message.items()
    return kind, data


def message_of(kind: type[Message], data: Any) -> Message:
    """Message of a type from plain data; unknown fields of newer versions are ignored.

    raises  ValueError: it is none
    """
    message: Message = _ADAPTERS[kind].validate_python(data)
    return message


def request_of(data: Any) -> Request:
    """The request in plain data.

    raises  ValueError: not a request; the message names the fault
    """
    if not isinstance(data, dict):
        raise ValueError("a request is an object")
    known = {f.name: data[f.name] for f in fields(Request) if f.name in data}
    asked_s = known.pop("asked_s", None)
    if type(asked_s) not in (int, float) or not math.isfinite(asked_s):
        raise ValueError("asked_s is missing: when it was asked, on the monotonic clock, s")
    for name, value in known.items():
        wanted = str if name in ("by", "note") else str | None
        if not isinstance(value, wanted) or len(value or "") > LONGEST_TEXT:
            raise ValueError(f"{name} is no text of at most {LONGEST_TEXT} characters")
        if not _is_valid_unicode(value or ""):
            raise ValueError(f"{name} is no text: it has half a character, {value!a}")
    if not known.get("by"):
        raise ValueError("by is missing: who asks")
    command = known.pop("command", None)
    if command is not None and command not in COMMANDS:
        raise ValueError(f"{command!r} is no command; those are {', '.join(sorted(COMMANDS))}")
    return Request(
        command=None if command is None else MachineEvent(command), asked_s=asked_s, **known
    )


def _is_valid_unicode(text: str) -> bool:
    """Whether a text can be encoded; JSON may contain a lone surrogate."""
    return not any("\ud800" <= character <= "\udfff" for character in text)
