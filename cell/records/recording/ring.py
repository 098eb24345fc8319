"""A ring of bytes that one process writes and another reads, without ever waiting for each other.

Memory: three numbers of 8 bytes (written, read, pause until), then the ring, whose length is a
multiple of 8.  `written` and `read` count bytes since the ring was empty at its beginning.  A
record is

  4 bytes   its length with this head, a multiple of 8; 0xFFFFFFFF = go to the beginning
  4 bytes   length of the header
  header    pickled
  payload   bytes as they are
"""

from __future__ import annotations

import errno
import mmap
import os
import pickle
import struct
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEAD_BYTES = 64
_IN_MEMORY = Path("/dev/shm")
_NAME, _FORGOTTEN_S = "cable-cell-", 86_400.0
_RECORD = struct.Struct("<II")
_TO_BEGINNING = 0xFFFFFFFF

#: Kept free for records that are not frames: they must never be lost.
RESERVE_BYTES = 8 * 2**20


def shared_memory(size_bytes: int) -> tuple[int, Path | None]:
    """File descriptor of memory that a child can share; its path if it is a file in memory.

    The file outlives its processes: after they were killed at once, `cell recover` reads the
    pending messages from it.  Where the system has no such place, or no room there, the memory
    ends with the last process.
    raises  OSError: there is no room
    """
    needed_bytes = _HEAD_BYTES + -(-size_bytes // _RECORD.size) * _RECORD.size
    if _IN_MEMORY.is_dir() and os.access(_IN_MEMORY, os.W_OK):
        path = _IN_MEMORY / f"{_NAME}{os.getpid()}-{os.urandom(4).hex()}"
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
        try:
            _lengthen(descriptor, needed_bytes)
            return descriptor, path
        except OSError:
            os.close(descriptor)
            path.unlink()
    with tempfile.TemporaryFile() as file:
        _lengthen(file.fileno(), needed_bytes)
        return os.dup(file.fileno()), None


def _lengthen(descriptor: int, needed_bytes: int) -> None:
    """Extend a file to a size.  Raises OSError: there is no room.

    The system gives room only when it is written to, and ends the process if there is none then.
    """
    filesystem = os.fstatvfs(descriptor)
    if filesystem.f_bavail * filesystem.f_frsize < needed_bytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    os.ftruncate(descriptor, needed_bytes)


def remove_forgotten() -> None:
    """Remove the memory files of killed cells that nobody has recovered for a day."""
    if not _IN_MEMORY.is_dir():
        return
    for file in _IN_MEMORY.glob(f"{_NAME}*"):
        with suppress(OSError):
            if time.time() - file.stat().st_mtime > _FORGOTTEN_S and not open_somewhere(file):
                file.unlink()


def open_somewhere(file: Path) -> bool:
    """Whether a process has a file open or mapped; False where the system does not tell.

    raises  FileNotFoundError
    """
    known = file.stat()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with suppress(OSError):
            status = link.stat()
            if (status.st_dev, status.st_ino) == (known.st_dev, known.st_ino):
                return True
    return False


class _SharedBuffer:
    """The shared numbers, and the ring behind them."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, os.fstat(descriptor).st_size)
        head = np.frombuffer(self._map, np.uint64, 2)
        self.count = head.view(np.int64)
        self.pause_until_s = np.frombuffer(self._map, np.float64, 1, 16)
        self.ring = np.frombuffer(self._map, np.uint8, offset=_HEAD_BYTES)


class RingWriter:
    """The end that writes; from one thread at a time."""

    def __init__(self, descriptor: int) -> None:
        self._memory = _SharedBuffer(descriptor)

    @property
    def waiting_bytes(self) -> int:
        """Bytes that the reader has not read yet."""
        written, read = self._memory.count
        return int(written - read)

    def pause(self, until_s: float) -> None:
        """Ask the reader to leave the computer to others until a moment on `time.monotonic`."""
        self._memory.pause_until_s[0] = until_s

    def put(self, header: Any, payload: NDArray[Any] | None = None, spare: int = 0) -> bool:
        """Add a record; False if there is no room for it.

        payload  any array, whose bytes are copied
        spare    bytes that must stay free after it
        """
        head = pickle.dumps(header, protocol=pickle.HIGHEST_PROTOCOL)
        size = 0 if payload is None else payload.nbytes
        length = -(-(_RECORD.size + len(head) + size) // 8) * 8
        written, read = (int(n) for n in self._memory.count)
        if written == read and written:  # empty: begin anew, so that little memory is touched
            self._memory.count[0] = 0
            self._memory.count[1] = 0
            written = read = 0
        ring = self._memory.ring
        at = written % len(ring)
        skipped = len(ring) - at if at + length > len(ring) else 0
        if written - read + skipped + length + spare > len(ring):
            return False
        if skipped:
            _put(ring, at, np.frombuffer(struct.pack("<I", _TO_BEGINNING), np.uint8))
            at = 0
        _put(ring, at, np.frombuffer(_RECORD.pack(length, len(head)) + head, np.uint8))
        if payload is not None:
            _put(ring, at + _RECORD.size + len(head), payload.reshape(-1).view(np.uint8))
        self._memory.count[0] = written + skipped + length
        return True


class RingReader:
    """The end that reads."""

    def __init__(self, descriptor: int) -> None:
        self._memory = _SharedBuffer(descriptor)

    @property
    def pause_until_s(self) -> float:
        """Moment on `time.monotonic` until which the reader is asked to pause."""
        return float(self._memory.pause_until_s[0])

    @property
    def position(self) -> int:
        """Number of bytes read so far; may be reset to an earlier value."""
        return int(self._memory.count[1])

    @position.setter
    def position(self, position: int) -> None:
        self._memory.count[1] = position

    def take(self) -> tuple[Any, bytes] | None:
        """Header and payload of the next record; None if there is none."""
        memory, ring = self._memory, self._memory.ring
        written, read = self._counts()
        if written <= read:
            return None
        at = read % len(ring)
        length, head_length = _RECORD.unpack(ring[at : at + _RECORD.size].tobytes())
        if length == _TO_BEGINNING:
            read += len(ring) - at
            at = 0
            length, head_length = _RECORD.unpack(ring[at : at + _RECORD.size].tobytes())
        begin = at + _RECORD.size
        header = pickle.loads(ring[begin : begin + head_length].tobytes())
        # the caller removes the padding to a multiple of 8: it knows the payload's size
        payload = ring[begin + head_length : at + length].tobytes()
        memory.count[1] = read + length
        return header, payload

    def _counts(self) -> tuple[int, int]:
        """Consistent pair of `written` and `read`: the writer may reset an empty ring."""
        while True:
            read, written = int(self._memory.count[1]), int(self._memory.count[0])
            if read == int(self._memory.count[1]):
                return written, read


def _put(ring: NDArray[np.uint8], at: int, data: NDArray[np.uint8]) -> None:
    ring[at : at + len(data)] = data
