"""Sandboxes: confined processes that run unreviewed code and serve requests.

A process of this program's own code alone, the nursery, loads trusted code; each sandbox is a
fork of it that confines itself.  A sandbox and this process exchange plain values only.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cell.computer.confinement import UnconfinedError, confine
from cell.computer.watched import POLL_S, GrantedTime, RunningCall

#: Longest message, bytes.
MOST_BYTES = 1 << 28
_HEAD = 8
_DTYPES = ("float64", "int64", "bool")


def encode(value: object) -> bytes:
    """Bytes of None, bool, int, float, str, list, tuple, dict with str keys, and arrays of these.

    raises  TypeError: it contains another type
    """
    arrays: list[bytes] = []

    def plain(v: Any) -> Any:
        if isinstance(v, np.ndarray) and v.dtype.name in _DTYPES:
            arrays.append(np.ascontiguousarray(v).tobytes())
            return {"array": [v.dtype.name, list(v.shape)]}
        if isinstance(v, np.bool_ | np.integer | np.floating):
            return v.item()
        if isinstance(v, tuple):
            return {"tuple": [plain(x) for x in v]}
        if isinstance(v, list):
            return [plain(x) for x in v]
        if isinstance(v, dict):
            return {"dict": {k: plain(x) for k, x in v.items()}}
        if v is None or isinstance(v, bool | int | float | str):
            return v
        raise TypeError(f"{type(v).__name__} is no plain value")

    head = json.dumps(plain(value)).encode()
    return b"".join([len(head).to_bytes(_HEAD, "little"), head, *arrays])


def decode(content: bytes) -> Any:
    """The value that `encode` has written.  Raises ValueError: the bytes are not such a value."""
    begin = _HEAD + int.from_bytes(content[:_HEAD], "little")
    if begin > len(content):
        raise ValueError("is cut")
    position = begin

    def value(v: Any) -> Any:
        nonlocal position
        if isinstance(v, list):
            return [value(x) for x in v]
        if not isinstance(v, dict):
            return v
        ((kind, inner),) = v.items()
        if kind == "tuple":
            return tuple(value(x) for x in inner)
        if kind == "dict":
            return {str(k): value(x) for k, x in inner.items()}
        name, shape = inner
        if kind != "array" or name not in _DTYPES or any(n < 0 for n in map(int, shape)):
            raise ValueError("is no array")
        dtype = np.dtype(name)
        size = dtype.itemsize * int(np.prod([int(n) for n in shape], dtype=object))
        part = content[position : position + size]
        if len(part) != size:
            raise ValueError("is cut")
        position += size
        if name == "bool":  # any byte but 0 is true
            return (np.frombuffer(part, np.uint8) != 0).reshape(shape)
        return np.frombuffer(part, dtype).reshape(shape).copy()

    try:
        return value(json.loads(content[_HEAD:begin]))
    except (TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"is no value: {error}") from error


#: Longest time for the nursery to load, s: a part of it may have to be compiled.
START_S = 180.0
_SIZE = 8
_CHUNK = 1 << 20


class SandboxEndedError(RuntimeError):
    """A sandbox's process has ended.  Scenario: a law divides by zero in compiled code."""


class SandboxStuckError(RuntimeError):
    """A request does not come to an end.  Scenario: a law with a loop without end."""


class Channel:
    """One end of the connection between a sandbox and the process that sends it requests."""

    def __init__(self, line: socket.socket) -> None:
        self._line = line
        self._buffer = bytearray()

    def send(self, value: object, wait: Callable[[bool], None] = lambda write: None) -> None:
        """Send a value.  Raises OSError: the other end is closed."""
        content = encode(value)
        remaining = memoryview(len(content).to_bytes(_SIZE, "little") + content)
        while remaining:
            wait(True)
            remaining = remaining[os.write(self._line.fileno(), remaining[:_CHUNK]) :]

    def receive(self, wait: Callable[[bool], None] = lambda write: None) -> Any:
        """The next value.  Raises EOFError: the other end is closed; ValueError: no value."""
        size = int.from_bytes(self._read(_SIZE, wait), "little")
        if size > MOST_BYTES:
            raise ValueError(f"a message of {size} bytes")
        return decode(self._read(size, wait))

    def close(self) -> None:
        """Close this end."""
        self._line.close()

    def fileno(self) -> int:
        """Its file's number."""
        return self._line.fileno()

    def _read(self, size: int, wait: Callable[[bool], None]) -> bytes:
        while len(self._buffer) < size:
            wait(False)
            if not (more := os.read(self._line.fileno(), _CHUNK)):
                raise EOFError
            self._buffer += more
        content = bytes(self._buffer[:size])
        del self._buffer[:size]
        return content


class Nursery:
    """Process that forks sandboxes; it ends with the last process that has a connection to it.

    main  `module:function` of this program, which calls `tend`
    """

    def __init__(self, main: str) -> None:
        module, function = main.split(":")
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        code = f"from {module} import {function}; {function}({theirs.fileno()})"
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
                | {"OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
            )
        self._process.returncode = 0  # it ends after its last client, and is not waited for

    def sandbox(self) -> Sandbox:
        """A new sandbox.  Raises UnconfinedError: this computer cannot confine one."""
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                socket.send_fds(self._control, [b"s"], [theirs.fileno()])
        except OSError as error:
            raise UnconfinedError(f"the sandbox does not start: {error}") from error
        return Sandbox(Channel(ours))


class Sandbox:
    """A confined process that serves requests of this one, one thread at a time."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._lock = threading.RLock()
        self._granted, self._under_way, self._patience_s = GrantedTime(0), RunningCall(), START_S
        try:
            begun = channel.receive(self._wait)
        except (OSError, EOFError, ValueError, SandboxStuckError) as error:
            channel.close()
            raise UnconfinedError(f"the sandbox does not start: {error!r}") from error
        if "unconfined" in begun:
            channel.close()
            raise UnconfinedError(begun["unconfined"])
        self._pid = int(begun["pid"])
        self._process = os.pidfd_open(self._pid)
        self._granted = GrantedTime(self._pid)

    def request(
        self,
        request: object,
        patience_s: float,
        more: Callable[[Any], tuple[bool, Any]] = lambda answer: (True, None),
    ) -> Any:
        """The answer to a request.

        patience_s  longest time of the sandbox's process for each message, s
        more        called with each message: whether it is the last, and a reply if it is not
        raises      SandboxStuckError, SandboxEndedError: it has ended
        """
        with self._lock:
            try:
                self._patience_s = patience_s
                self._send(request)
                while True:
                    answer = self._receive()
                    last, reply = more(answer)
                    if last:
                        return answer
                    if reply is not None:
                        self._send(reply)
            except BaseException:
                self.end()
                raise

    def be_patient(self, patience_s: float) -> None:
        """Set the longest time of the current request."""
        self._patience_s = patience_s

    def end(self) -> None:
        """Kill it."""
        if self._process >= 0:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._process, signal.SIGKILL)
            os.close(self._process)
            self._process = -1
            self._channel.close()

    @property
    def is_there(self) -> bool:
        """Whether it was not ended."""
        return self._process >= 0

    def _send(self, value: object) -> None:
        self._under_way = RunningCall()
        try:
            self._channel.send(value, self._wait)
        except OSError as error:
            raise SandboxEndedError from error

    def _receive(self) -> Any:
        self._under_way = RunningCall()
        try:
            return self._channel.receive(self._wait)
        except (OSError, EOFError, ValueError) as error:
            raise SandboxEndedError from error

    def _wait(self, write: bool) -> None:
        """Wait until the channel can be read or written.  Raises SandboxStuckError."""
        line = [self._channel]
        while True:
            ready = select.select([] if write else line, line if write else [], [], POLL_S)
            if ready[0] or ready[1]:
                return
            self._under_way.sample(self._granted.since_last_sample_s())
            if self._under_way.is_stuck(self._patience_s):
                raise SandboxStuckError


def tend(control: int, serve: Callable[[Channel], None], readable: Iterable[Path]) -> NoReturn:
    """Main loop of the nursery: fork a sandbox per request until the last client has gone.

    serve     serves requests until EOFError; only in a confined process
    readable  folders of programs, which a sandbox may read
    """
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    folders = list(readable)
    line = socket.socket(fileno=control)
    while True:
        request, descriptors, _, _ = socket.recv_fds(line, 1, 1)
        if not request:
            os._exit(0)
        parent = os.getpid()
        if os.fork() == 0:
            _begin(descriptors[0], parent, serve, folders)
        os.close(descriptors[0])


def _begin(
    descriptor: int, parent: int, serve: Callable[[Channel], None], folders: Iterable[Path]
) -> NoReturn:
    """In a fork of the nursery: close all other files, confine it, and serve."""
    try:
        channel = Channel(socket.socket(fileno=descriptor))
        os.closerange(3, descriptor)
        os.closerange(descriptor + 1, os.sysconf("SC_OPEN_MAX"))
        pid = os.getpid()
        try:
            confine(folders, parent)
        except OSError as error:
            channel.send({"unconfined": error.strerror or str(error)})
            os._exit(1)
        channel.send({"pid": pid})
        serve(channel)
    except BaseException:
        os._exit(1)
    os._exit(0)


def libraries() -> list[Path]:
    """Folders from which Python and this program load code."""
    shared = [Path("/lib"), Path("/lib64"), Path("/usr/lib"), Path("/usr/lib64")]
    here = Path(__file__).resolve().parents[1]
    python = [Path(p) for p in (sys.prefix, sys.base_prefix) if p != "/usr"]
    installed = [Path(p) for p in sys.path if p.endswith(("site-packages", "dist-packages"))]
    return [here, *python, *installed, *shared]
