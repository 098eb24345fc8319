"""Recordings come to a store whole and verified, or stay where they are; never beside a cable."""

from __future__ import annotations

import fcntl
import logging
import threading
import time
import uuid
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFile, MemoryFileSystem

from cell.files.input_error import InputError
from cell.records.recording import form, uploads
from cell.records.recording.reading import read_recording, verify
from cell.records.recording.retention import KEPT, Retention
from cell.records.recording.store import (
    BLOCK_BYTES,
    RecordingStoreError,
    Store,
    fetch,
    mark,
    name_of,
    stored_of,
)
from cell.records.recording.uploads import Uploads, bring, waiting
from cell.settings.records import RecordingSettings
from tests.waiting import wait_until

SIZE = 2 * BLOCK_BYTES + 12_345


@pytest.fixture(scope="module")
def s3_server():
    """An S3 server on loopback: boto's own protocol over HTTP."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    logging.getLogger("werkzeug").setLevel("ERROR")
    server.start()
    yield "http://{}:{}".format(*server.get_host_and_port())
    server.stop()


@pytest.fixture(params=["folder", "memory", "s3"])
def url(request, tmp_path, monkeypatch):
    """An empty store of each kind."""
    name = uuid.uuid4().hex
    match request.param:
        case "folder":
            (tmp_path / "nas").mkdir()
            return str(tmp_path / "nas")
        case "memory":
            fsspec.filesystem("memory").mkdir(f"/{name}")
            return f"memory://{name}/cables"
    monkeypatch.setenv("AWS_ENDPOINT_URL", request.getfixturevalue("s3_server"))
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "line3")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    fsspec.filesystem("s3", skip_instance_cache=True).mkdir(name)
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    return f"s3://{name}/cables"


def recording_of(runs: Path, cycle: int) -> Path:
    """Something of the size of a recording: more than two blocks."""
    path = runs / f"20261124T10150{cycle}.000-{cycle}" / form.FILE
    path.parent.mkdir(parents=True)
    path.write_bytes(bytes(f"cycle {cycle} ", "ascii") * (SIZE // 8))
    return path


def test_a_recording_comes_to_the_store_and_back(url, tmp_path, make_recording):
    recording = make_recording("runs-1.mcap")
    folder = tmp_path / "runs" / "20261124T101500.000-1"
    folder.mkdir(parents=True)
    recording.rename(folder / form.FILE)
    content = (folder / form.FILE).read_bytes()
    stored = bring(Store(url), folder / form.FILE, "line/3", nullcontext)
    assert stored.bytes == len(content)
    assert not (folder / form.FILE).exists()
    assert stored_of(folder) == stored
    with pytest.raises(InputError, match="cell fetch"):
        read_recording(folder)
    shares = []
    fetch(stored, folder / form.FILE, shares.append)
    assert (folder / form.FILE).read_bytes() == content
    assert shares[-1] == 1.0
    assert verify(folder / form.FILE)[form.IMAGE] == 12
    assert waiting(tmp_path / "runs") == []  # it is in the store already


def test_many_blocks(url, tmp_path):
    recording = recording_of(tmp_path / "runs", 1)
    content, turns = recording.read_bytes(), []

    @contextmanager
    def turn():
        turns.append(threading.current_thread())
        yield

    stored = bring(Store(url), recording, "line3", turn)
    fetch(stored, recording, lambda share: None)
    assert recording.read_bytes() == content
    assert len(turns) >= 9  # three blocks each way, and what is around them


def test_what_the_store_has_spoilt_stays_here(tmp_path, monkeypatch):
    opened = MemoryFileSystem._open

    def spoilt(files, path, mode="rb", **options):
        file = opened(files, path, mode, **options)
        if mode == "rb":
            file.getbuffer()[7] ^= 1
        return file

    monkeypatch.setattr(MemoryFileSystem, "_open", spoilt)
    fsspec.filesystem("memory").mkdir("/spoilt")
    recording = recording_of(tmp_path, 1)
    before = recording.read_bytes()
    with pytest.raises(RecordingStoreError, match="is not what was sent"):
        bring(Store("memory://spoilt/x"), recording, "line3", nullcontext)
    assert recording.read_bytes() == before
    assert stored_of(recording.parent) is None


def test_what_was_changed_in_the_store_is_not_taken_back(tmp_path):
    recording = recording_of(tmp_path / "runs", 1)
    (tmp_path / "nas").mkdir()
    stored = bring(Store(str(tmp_path / "nas")), recording, "line3", nullcontext)
    (tmp_path / "nas" / name_of(recording, "line3")).write_bytes(b"something else")
    with pytest.raises(RecordingStoreError, match="is not what was stored"):
        fetch(stored, recording, lambda share: None)
    assert list(recording.parent.iterdir()) == [recording.with_name(form.STORED)]


def test_a_folder_that_is_not_mounted_gets_nothing(tmp_path):
    recording = recording_of(tmp_path / "runs", 1)
    with pytest.raises(RecordingStoreError, match=r"no folder .*; make it, or mount it"):
        bring(Store(str(tmp_path / "nas")), recording, "line3", nullcontext)
    assert recording.exists() and not (tmp_path / "nas").exists()


def test_a_marked_recording_stays_here_too(tmp_path):
    recording = recording_of(tmp_path / "runs", 1)
    recording.with_name(KEPT).touch()
    (tmp_path / "nas").mkdir()
    stored = bring(Store(str(tmp_path / "nas")), recording, "line3", nullcontext)
    assert recording.exists() and stored_of(recording.parent) == stored
    assert waiting(tmp_path / "runs") == []


def test_old_recordings_go_only_once_they_are_stored(tmp_path):
    first, second = (recording_of(tmp_path / "runs", n) for n in (1, 2))
    (tmp_path / "nas").mkdir()
    limits = RecordingSettings(max_size_gb=1e-6, min_free_gb=0.0, store=str(tmp_path / "nas"))
    Retention(tmp_path / "runs", limits).make_room()
    assert first.exists() and second.exists()
    mark(first.parent, Store(str(tmp_path / "nas")).put(first, "first"))
    Retention(tmp_path / "runs", limits).make_room()
    assert not first.exists() and second.exists()


@dataclass
class SlowStore:
    """A store that needs 20 ms for every block, and when it was at one."""

    store: Store
    busy_s: list[tuple[float, float]] = field(default_factory=list)


@pytest.fixture
def slow(monkeypatch):
    fsspec.filesystem("memory").makedirs("/slow", exist_ok=True)
    found, write = SlowStore(Store("memory://slow")), MemoryFile.write

    def written(file, data):
        start_s = time.monotonic()
        time.sleep(0.02)
        found.busy_s.append((start_s, time.monotonic()))
        return write(file, data)

    monkeypatch.setattr(MemoryFile, "write", written)
    monkeypatch.setattr("cell.records.recording.store.BLOCK_BYTES", 100_000)
    return found


def test_nothing_is_sent_while_a_cable_is_in_the_jaws(tmp_path, slow):
    sent = Uploads(lambda: slow.store, tmp_path, "line3")
    recording = recording_of(tmp_path, 1)
    sent.start()
    time.sleep(0.1)
    assert not slow.busy_s  # nobody has said that the jaws are empty
    held_s = []
    for _ in range(4):
        sent.jaws(holding=False)
        enough = len(slow.busy_s) + 4
        wait_until(lambda enough=enough: len(slow.busy_s) >= enough)
        sent.jaws(holding=True)
        begin_s = time.monotonic()
        time.sleep(0.1)
        held_s.append((begin_s, time.monotonic()))
    assert recording.exists()
    sent.jaws(holding=False)
    sent.close()
    assert not recording.exists() and not sent.notes
    assert not any(a < end and b > begin for a, b in slow.busy_s for begin, end in held_s)


def test_jaws_emptied_at_the_last_moment_do_not_keep_a_recording_here(tmp_path, monkeypatch):
    fsspec.filesystem("memory").makedirs("/late", exist_ok=True)
    sent = Uploads(lambda: Store("memory://late"), tmp_path, "line3")
    recording = recording_of(tmp_path, 1)
    wait, waits = sent._empty.wait, []

    def emptied_late(timeout_s=None):
        waits.append(timeout_s)
        if len(waits) > 1:
            return wait(timeout_s)
        sent.jaws(holding=False)  # after the wait had ended, before its result was read
        sent._over.set()
        return False

    monkeypatch.setattr(sent._empty, "wait", emptied_late)
    sent.start()
    sent.close()
    assert not recording.exists() and not sent.notes


def test_a_run_that_ends_with_a_cable_in_the_jaws_does_not_blame_the_store(tmp_path, slow, caplog):
    sent = Uploads(lambda: slow.store, tmp_path, "line3")
    recording_of(tmp_path, 1)
    sent.start()
    sent.jaws(holding=False)
    wait_until(lambda: slow.busy_s)
    sent.jaws(holding=True)
    sent.close()
    assert "no answer" not in caplog.text and sent.notes


def test_a_run_that_ends_with_a_cable_in_the_jaws_leaves_them_here(tmp_path, slow):
    sent = Uploads(lambda: slow.store, tmp_path, "line3")
    recording = recording_of(tmp_path, 1)
    sent.start()
    sent.jaws(holding=True)
    sent.close()
    assert recording.exists()
    (note,) = sent.notes
    assert "not uploaded yet: 1: a cable is in the jaws" in note and "cell upload" in note


def test_a_store_that_comes_back_gets_what_waited(tmp_path, monkeypatch):
    monkeypatch.setattr(uploads, "_FIRST_S", 0.05)
    sent = Uploads(lambda: Store(str(tmp_path / "nas")), tmp_path / "runs", "line3")
    recording = recording_of(tmp_path / "runs", 1)
    sent.start()
    sent.jaws(holding=False)
    wait_until(lambda: sent._failed)
    (tmp_path / "nas").mkdir()
    wait_until(lambda: not recording.exists())
    other = recording_of(tmp_path / "runs", 2)
    sent.add(other)
    sent.close()
    assert not other.exists() and not sent.notes


def test_a_store_that_is_away_at_the_end_is_told_of(tmp_path):
    sent = Uploads(lambda: Store(str(tmp_path / "nas")), tmp_path / "runs", "line3")
    recording = recording_of(tmp_path / "runs", 1)
    sent.start()
    sent.jaws(holding=False)
    wait_until(lambda: sent._failed)
    sent.close()
    assert recording.exists()
    assert "there is no folder" in sent.notes[0]


def test_two_processes_do_not_upload_one_recording(tmp_path, slow):
    recording = recording_of(tmp_path, 1)
    with recording.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert bring(slow.store, recording, "line3", nullcontext) is None
    assert recording.exists()


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("nas/line3", "give a whole path"),
        ("nowhere://x", "no store that fsspec knows"),
        ("s3://key:secret@bucket/x", "password"),
        ("s3://bucket/x?secret=1", "password or options"),
    ],
)
def test_stores_that_the_settings_refuse(url, why):
    with pytest.raises(ValueError, match=why):
        RecordingSettings(store=url)


def test_a_mark_that_was_changed_is_told_of(tmp_path):
    (tmp_path / form.STORED).write_text('{"url": "s3://bucket"}')
    with pytest.raises(InputError, match="does not say where"):
        stored_of(tmp_path)


def test_a_torn_recording_blocks_no_other(tmp_path, slow):
    """The thread waited for its file for ever."""
    sent = Uploads(lambda: slow.store, tmp_path, "line3")
    torn = tmp_path / "torn" / form.FILE
    torn.parent.mkdir()
    torn.with_name(form.PART).touch()
    sent.start()
    sent.jaws(holding=False)
    sent.add(torn)
    other = recording_of(tmp_path, 1)
    sent.add(other)
    wait_until(lambda: not other.exists())
    sent.close()
    assert not sent._thread.is_alive() and not sent.notes


def test_a_recording_that_is_finished_late_is_uploaded(tmp_path, slow):
    """The recorder may have begun nothing yet when the cycle ends."""
    sent = Uploads(lambda: slow.store, tmp_path, "line3")
    sent.start()
    sent.jaws(holding=False)
    sent.add(tmp_path / "20261124T101501.000-1" / form.FILE)
    time.sleep(0.3)
    late = recording_of(tmp_path, 1)
    wait_until(lambda: not late.exists())
    sent.close()


def test_one_that_cannot_be_sent_stops_no_other(tmp_path, slow, monkeypatch):
    monkeypatch.setattr(uploads, "_FIRST_S", 0.05)
    first, second = recording_of(tmp_path, 1), recording_of(tmp_path, 2)
    put = slow.store.put

    def refusing(source, *rest):
        if source == first:
            raise RecordingStoreError("not this one")
        return put(source, *rest)

    monkeypatch.setattr(slow.store, "put", refusing)
    sent = Uploads(lambda: slow.store, tmp_path, "line3")
    sent.start()
    sent.jaws(holding=False)
    wait_until(lambda: not second.exists())
    sent.close()
    assert first.exists() and "not this one" in sent.notes[0]


def test_a_store_that_fails_in_its_own_way_is_told_of(monkeypatch):
    """As one whose profile is missing; fsspec knows no errors that all stores have."""

    def refused(url):
        raise LookupError("no such profile")

    monkeypatch.setattr("fsspec.core.url_to_fs", refused)
    with pytest.raises(RecordingStoreError, match="no such profile"):
        Store("s3://recordings")


def test_one_that_another_process_has_brought_meanwhile_is_left_alone(tmp_path, monkeypatch):
    """It was opened here before the other process removed it, and gave it free."""
    (tmp_path / "nas").mkdir()
    recording = tmp_path / "runs" / "1" / form.FILE
    recording.parent.mkdir(parents=True)
    recording.write_bytes(b"frames")

    def brought(file, how):
        recording.unlink(missing_ok=True)

    monkeypatch.setattr(fcntl, "flock", brought)
    assert bring(Store(str(tmp_path / "nas")), recording, "line3", nullcontext) is None
    assert list((tmp_path / "nas").iterdir()) == []
