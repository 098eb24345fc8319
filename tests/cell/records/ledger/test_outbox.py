"""What the ledger is told waits until it can be told, and is told in order."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from cell.records.ledger import outbox
from cell.records.ledger.entry import LedgerEntry, LedgerError
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.ledger.outbox import LaterLedger, LedgerWriter, Outbox, outbox_of
from tests.waiting import wait_until

from .conftest import begun, ended, stopped


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trying again does not wait for a second."""
    monkeypatch.setattr(outbox, "_FIRST_S", 0.02)
    monkeypatch.setattr(outbox, "_LAST_S", 0.05)


def counts(place: Path) -> dict[str, int]:
    """Cycles in a ledger by outcome."""
    ledger = Ledger(place)
    try:
        return ledger.count(LedgerQuery())
    finally:
        ledger.close()


class Told:
    """A ledger that hands entries on."""

    def __init__(self, write: Callable[[Sequence[LedgerEntry]], None]) -> None:
        self.write = write

    def close(self) -> None:
        """Nothing is open."""


@pytest.fixture
def writer_to(tmp_path: Path) -> Iterator[Callable[..., LedgerWriter]]:
    begun: list[LedgerWriter] = []

    def made(to) -> LedgerWriter:
        ledger = to if isinstance(to, LaterLedger) else Told(to)
        writer = LedgerWriter(ledger, outbox_of(tmp_path / "runs"))
        writer.start()
        begun.append(writer)
        return writer

    yield made
    for writer in begun:
        writer.close()


def test_an_entry_is_read_back_as_it_was() -> None:
    for entry in (begun(1, part="Ä 1"), ended(2), stopped(3)):
        assert LedgerEntry.from_json(json.loads(json.dumps(entry.to_json()))) == entry


def test_entries_are_written_in_order_and_removed(writer_to, tmp_path: Path) -> None:
    writer = writer_to(LaterLedger(tmp_path / "runs"))
    for n in range(1, 250):
        writer.put(begun(n))
    writer.close()
    assert writer.notes == []
    assert not (outbox_of(tmp_path / "runs")).exists()
    ledger = Ledger(tmp_path / "runs")
    assert [c.cycle for c in ledger.listed(LedgerQuery())] == list(range(1, 250))
    ledger.close()


def test_what_an_earlier_run_has_left_comes_first(writer_to, tmp_path: Path) -> None:
    """It was killed before it could tell."""
    left = Outbox(outbox_of(tmp_path / "runs"))
    left.put(begun(1))
    left.put(stopped(1))
    told: list[LedgerEntry] = []
    writer = writer_to(told.extend)
    writer.put(begun(2))
    wait_until(lambda: len(told) == 3)  # a busy disk may be slower than `close` waits
    writer.close()
    assert told == [begun(1), stopped(1), begun(2)]


def test_a_cell_goes_on_while_the_ledger_is_away(writer_to, tmp_path: Path, caplog) -> None:
    told: list[LedgerEntry] = []
    away = threading.Event()
    away.set()

    def write(entries: list[LedgerEntry]) -> None:
        if away.is_set():
            raise LedgerError("the server is away")
        told.extend(entries)

    writer = writer_to(write)
    for n in range(3):
        writer.put(begun(n))
        writer.put(ended(n))
    wait_until(lambda: "the cell goes on" in caplog.text)
    away.clear()
    wait_until(lambda: len(told) == 6)
    assert told == [e for n in range(3) for e in (begun(n), ended(n))]
    assert caplog.text.count("the cell goes on") == 1


def test_what_cannot_be_told_waits_for_the_next_run(writer_to, tmp_path: Path) -> None:
    def refused(entries: list[LedgerEntry]) -> None:
        raise LedgerError("the server is away")

    writer = writer_to(refused)
    writer.put(ended(1))
    writer.close()
    (note,) = writer.notes
    assert "1 entry for the ledger" in note
    assert "the server is away" in note
    following = writer_to(LaterLedger(tmp_path / "runs"))
    following.close()
    assert counts(tmp_path / "runs") == {"inserted": 1}


def test_what_a_damaged_ledger_lacks_is_written_once_it_is_moved_away(
    writer_to, tmp_path: Path
) -> None:
    """As its note says, by the command that is in it."""
    file = tmp_path / "runs.sqlite"
    Ledger(file, create=True).close()
    file.write_bytes(b"damaged" + file.read_bytes()[7:])
    file.with_name("runs.sqlite-wal").write_bytes(b"of the damaged one")
    for _ in range(2):  # another run alone changes nothing
        writer = writer_to(LaterLedger(file))
        writer.put(ended(1))
        wait_until(lambda: outbox_of(tmp_path / "runs").exists())
        writer.close()
        (note,) = writer.notes
        assert "written by the next run that can" in note
    command = note.partition("`")[2].partition("`")[0]
    subprocess.run(command, shell=True, check=True)
    following = writer_to(LaterLedger(file))
    following.close()
    assert following.notes == []
    assert counts(file) == {"inserted": 1}


def test_what_is_no_entry_is_put_aside(writer_to, tmp_path: Path) -> None:
    folder = outbox_of(tmp_path / "runs")
    folder.mkdir()
    (folder / "00000001-7.json").write_text('{"half')
    (folder / "00000002-7.json").write_text('{"line": "other"}')
    told: list[LedgerEntry] = []
    writer = writer_to(told.extend)
    writer.put(begun(1))
    writer.close()
    assert told == [begun(1)]
    assert sorted(f.name for f in folder.iterdir()) == ["00000001-7.bad", "00000002-7.bad"]


def test_a_folder_that_cannot_be_written_is_told_of(writer_to, tmp_path: Path) -> None:
    (outbox_of(tmp_path / "runs")).write_text("a file")
    writer = writer_to(lambda entries: None)
    writer.put(ended(1))
    (note,) = writer.notes
    assert "the ledger lacks 00001" in note
    assert "cell history --import /records" in note
    writer.close()


def test_two_cells_use_one_folder(tmp_path: Path) -> None:
    """Either may write what the other has put there: nothing is missing, nothing twice."""
    writers = [
        LedgerWriter(LaterLedger(tmp_path / "runs"), outbox_of(tmp_path / "runs")) for _ in range(2)
    ]
    for writer in writers:
        writer.start()
    for n in range(1, 41):
        writers[n % 2].put(begun(n))
        writers[n % 2].put(ended(n))
    for writer in writers:
        writer.close()
    assert [writer.notes for writer in writers] == [[], []]
    assert counts(tmp_path / "runs") == {"inserted": 40}


def test_a_locked_file_is_written_later(writer_to, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("cell.records.ledger.database.BUSY_S", 0.05)
    Ledger(tmp_path / "runs", create=True).close()
    other = sqlite3.connect(tmp_path / "runs.sqlite", isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    writer = writer_to(LaterLedger(tmp_path / "runs"))
    writer.put(ended(1))
    time.sleep(0.3)
    assert list((outbox_of(tmp_path / "runs")).iterdir())
    other.execute("ROLLBACK")
    other.close()
    wait_until(lambda: not (outbox_of(tmp_path / "runs")).exists())
    assert counts(tmp_path / "runs") == {"inserted": 1}


def test_a_server_goes_away_and_comes_back(writer_to, server) -> None:
    place = server.new_database()
    writer = writer_to(LaterLedger(place))
    ledger = Ledger(place, create=True)
    writer.put(begun(1))
    wait_until(lambda: ledger.count(LedgerQuery()))
    server.stop()
    try:
        for n in (1, 2, 3):
            writer.put(ended(n))
        time.sleep(0.3)
        with pytest.raises(LedgerError):
            ledger.count(LedgerQuery())
    finally:
        server.start()
    wait_until(lambda: ledger.count(LedgerQuery()) == {"inserted": 3})
    assert [c.cycle for c in ledger.listed(LedgerQuery())] == [1, 2, 3]
    ledger.close()


def test_entries_that_cannot_be_removed_are_told_of(
    writer_to, tmp_path, monkeypatch, caplog
) -> None:
    """As on a disk that the system has made read-only: the writer goes on to try."""

    def refused(self: Outbox, file: Path) -> None:
        raise PermissionError(13, "Permission denied", str(file))

    monkeypatch.setattr(Outbox, "remove", refused)
    writer = writer_to(lambda entries: None)
    writer.put(ended(1))
    wait_until(lambda: "the cell goes on" in caplog.text)
    writer.close()
    (note,) = writer.notes
    assert "1 entry for the ledger" in note
    assert "Permission denied" in note
