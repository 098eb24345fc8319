"""Store of recordings away from the cell: a folder, or any object store that fsspec supports."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from cell.files.atomic import write_atomic
from cell.files.input_error import InputError
from cell.files.rescue import NO_ROOM
from cell.files.text_file import read_json_object
from cell.files.words import error_text
from cell.records.recording import form
from drivers.installing import install_extra

#: Block size of a transfer: the least size of a part of an object.
BLOCK_BYTES = 5 * 2**20
#: Stores without folders of their own: there a bucket must exist, elsewhere the folder itself.
_OBJECT_STORES = frozenset(
    {"abfs", "abfss", "adl", "az", "gcs", "gs", "memory", "oci", "oss", "s3", "s3a"}
)

#: Context that is entered around every block that is sent or read.
Turn = Callable[[], AbstractContextManager[object]]


class RecordingStoreError(Exception):
    """A store is unreachable, or has lost data.  Scenario: the network is down."""


@dataclass(frozen=True)
class Stored:
    """Location of a stored recording, and its size and hash.

    stored  when it was verified there, UTC
    """

    url: str
    bytes: int
    sha256: str
    stored: str


class Store:
    """Connection to a store of recordings.

    url     as the settings allow it
    raises  RecordingStoreError, from every method
    """

    def __init__(self, url: str) -> None:
        import fsspec

        self.url = url if url.endswith("//") else url.rstrip("/")
        try:
            self._files, self._root = fsspec.core.url_to_fs(self.url)
        except ImportError as error:
            package = install_extra("s3") if url.startswith("s3") else str(error)
            raise RecordingStoreError(
                f"{url} needs a package that is not installed: {package}"
            ) from error
        except Exception as error:  # each store has errors of its own
            raise RecordingStoreError(f"{url}: {error}") from error

    def put(self, source: Path, name: str, turn: Turn = nullcontext) -> Stored:
        """Copy a file to the store, read it back there, and mark it as complete.

        name  where it goes, below the store's URL
        turn  entered around every block
        """
        target = f"{self._root}/{name}"
        try:
            with turn():
                self._need_root()
                self._files.makedirs(target.rpartition("/")[0], exist_ok=True)
            size, sent = self._send(source, target, turn)
            received = self._read(target, _nowhere, turn)
            if received != (size, sent):
                raise RecordingStoreError(
                    f"{self.url}/{name} is not what was sent: {received[0]} of {size} bytes, or "
                    "other ones; the recording is kept here"
                )
            now = datetime.now(UTC).isoformat(timespec="seconds")
            stored = Stored(f"{self.url}/{name}", size, sent, now)
            with turn():
                self._files.pipe_file(f"{target}.json", _json(stored).encode())
        except (RecordingStoreError, KeyboardInterrupt):
            raise
        except Exception as error:  # each store has errors of its own
            raise RecordingStoreError(f"{self.url}/{name}: {_cause(error)}") from error
        return stored

    def _need_root(self) -> None:
        protocols = self._files.protocol
        named = {protocols} if isinstance(protocols, str) else set(protocols)
        bucket = bool(named & _OBJECT_STORES)
        place = self._root.lstrip("/").split("/")[0] if bucket else self._root
        if not self._files.exists(place):
            kind = "bucket" if bucket else "folder"
            raise RecordingStoreError(
                f"{self.url}: there is no {kind} {place}; make it, or mount it"
            )

    def _send(self, source: Path, target: str, turn: Turn) -> tuple[int, str]:
        with source.open("rb") as file:
            with turn():
                sink = self._files.open(target, "wb", block_size=BLOCK_BYTES)
            try:
                sent = _pass_on(file.read, sink.write, turn)
                with turn():
                    sink.close()
            except BaseException:
                with suppress(Exception):  # the upload has no mark, and is replaced next time
                    sink.discard()
                raise
        return sent

    def _read(self, path: str, sink: Callable[[bytes], object], turn: Turn) -> tuple[int, str]:
        with self._files.open(path, "rb", block_size=BLOCK_BYTES) as file:
            return _pass_on(file.read, sink, turn)


def fetch(stored: Stored, target: Path, progress: Callable[[float], None]) -> None:
    """Download a recording atomically.

    progress  callback that receives the share that has arrived
    raises    RecordingStoreError: the store does not deliver it, or its content differs; OSError:
              it cannot be written here
    """
    store = Store(stored.url)
    part = target.with_name(f"{target.name}.{os.getpid()}.fetched")
    try:
        with part.open("wb") as sink:

            def take(block: bytes) -> None:
                sink.write(block)
                progress(sink.tell() / stored.bytes)

            try:
                received = store._read(store._root, take, nullcontext)
            except OSError as error:
                if error.errno in NO_ROOM:
                    raise
                raise RecordingStoreError(f"{stored.url}: {_cause(error)}") from error
            except Exception as error:  # each store has errors of its own
                raise RecordingStoreError(f"{stored.url}: {_cause(error)}") from error
        if received != (stored.bytes, stored.sha256):
            raise RecordingStoreError(f"{stored.url} is not what was stored on {stored.stored}")
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def mark(folder: Path, stored: Stored) -> None:
    """Write into a cycle's folder where its recording is stored.  Raises OSError."""
    write_atomic(folder / form.STORED, _json(stored))


def stored_of(folder: Path) -> Stored | None:
    """Where the recording of a cycle is stored; None = in no store.

    raises  InputError: the file with the place was changed
    """
    path = folder / form.STORED
    if not path.exists():
        return None
    data = read_json_object(path)
    try:
        return Stored(data["url"], int(data["bytes"]), data["sha256"], data["stored"])
    except (KeyError, TypeError, ValueError) as error:
        message = f"does not say where the recording is ({error_text(error)})"
        raise InputError.at(path, message) from error


def name_of(recording: Path, line: str) -> str:
    """Name of a cycle's recording in a store: line, then the cycle's folder."""
    return f"{line.replace('/', '_')}/{recording.parent.name}/{form.FILE}"


def _pass_on(
    read: Callable[[int], bytes], write: Callable[[bytes], object], turn: Turn
) -> tuple[int, str]:
    """Copy block by block, each within `turn`; size in bytes, and SHA-256."""
    digest, size = hashlib.sha256(), 0
    while True:
        with turn():
            block = read(BLOCK_BYTES)
            write(block)
        if not block:
            return size, digest.hexdigest()
        digest.update(block)
        size += len(block)


def _nowhere(block: bytes) -> None:
    """Discard a block: it is only hashed."""


def _json(stored: Stored) -> str:
    return json.dumps(asdict(stored), indent=2) + "\n"


def _cause(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip() or 'no answer'}".splitlines()[0]
