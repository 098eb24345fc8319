"""A ledger is made, brought up to date or refused, and never damaged."""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Engine, create_engine, text

from cell.records.ledger.database import check_file, url_of
from cell.records.ledger.entry import Acknowledgement, LedgerError
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.ledger.tables import metadata

from .conftest import BEGUN, ended, stopped


@contextmanager
def engine_of(place: str) -> Iterator[Engine]:
    engine = create_engine(url_of(place))
    yield engine
    engine.dispose()


def test_a_new_ledger_has_the_tables_that_the_program_uses(place: str) -> None:
    Ledger(place, create=True).close()
    with engine_of(place) as engine, engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), metadata) == []


def test_a_ledger_of_a_newer_version_is_refused_and_left_alone(place: str) -> None:
    ledger = Ledger(place, create=True)
    ledger.write([ended(1)])
    ledger.close()
    with engine_of(place) as engine, engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    for create in (True, False):
        with pytest.raises(LedgerError, match="newer version"):
            Ledger(place, create=create)
    with engine_of(place) as engine, engine.connect() as connection:
        assert connection.scalar(text("SELECT count(*) FROM cycles")) == 1


def test_a_ledger_that_is_missing_is_not_made_by_asking(tmp_path: Path) -> None:
    with pytest.raises(LedgerError, match=r"runs\.sqlite is missing: .* --import"):
        Ledger(tmp_path / "runs")
    assert list(tmp_path.iterdir()) == []


def test_an_empty_database_is_not_changed_by_asking(server) -> None:
    place = server.new_database()
    with pytest.raises(LedgerError, match="has no tables of a ledger"):
        Ledger(place)


def test_what_is_no_ledger_is_refused(tmp_path: Path) -> None:
    (tmp_path / "runs.sqlite").write_text("these are no tables" * 100)
    with pytest.raises(LedgerError, match="not a database"):
        Ledger(tmp_path / "runs", create=True)


def test_a_server_that_does_not_answer_is_named_with_a_remedy() -> None:
    pytest.importorskip("psycopg")
    with pytest.raises(LedgerError, match=r"127\.0\.0\.1:1/x: .*; check ledger\.url, and that"):
        Ledger("postgresql://127.0.0.1:1/x")


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TABLE cycles (name TEXT)",
        "CREATE TABLE songs (name TEXT)",
        "CREATE TABLE alembic_version AS SELECT '1975ea83b712' AS version_num",
    ],
)
def test_a_file_of_another_program_is_refused_and_not_changed(
    tmp_path: Path, statement: str
) -> None:
    file = tmp_path / "foreign.sqlite"
    foreign = sqlite3.connect(file)
    foreign.execute(statement)
    foreign.commit()
    foreign.close()
    before = file.read_bytes()
    refusal = pytest.raises(LedgerError, match=r"foreign\.sqlite is no ledger .* another name")
    for create in (True, False):
        with refusal:
            Ledger(file, create=create)
    with refusal:
        check_file(file)
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == {file.name: before}


def test_an_empty_file_becomes_a_ledger(tmp_path: Path) -> None:
    file = tmp_path / "empty.sqlite"
    file.touch()
    check_file(file)
    assert not file.stat().st_size
    Ledger(file, create=True).close()
    check_file(file)


def test_what_is_no_file_is_said(tmp_path: Path) -> None:
    check_file(tmp_path / "missing.sqlite")
    (tmp_path / "folder.sqlite").mkdir()
    (tmp_path / "loop.sqlite").symlink_to("loop.sqlite")
    for check in (Ledger, check_file):
        with pytest.raises(LedgerError, match="is a folder, no ledger's file; give another name"):
            check(tmp_path / "folder.sqlite")
        with pytest.raises(LedgerError, match=r"loop\.sqlite cannot be read: .*; mend that"):
            check(tmp_path / "loop.sqlite")


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("postgresql://cell@127.0.0.1:1/plant", "127.0.0.1"),
        ("oracle://somewhere/else", "package that is not installed"),
        ("nothing://", "package that is not installed|no database"),
    ],
)
def test_a_server_that_cannot_be_used_is_named(place: str, said: str) -> None:
    with pytest.raises(LedgerError, match=said):
        Ledger(place, create=True)


def test_a_reader_keeps_no_writer_waiting(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "runs", create=True)
    ledger.write([ended(1)])
    reader = sqlite3.connect(tmp_path / "runs.sqlite")
    reader.execute("BEGIN")
    assert reader.execute("SELECT count(*) FROM cycles").fetchone() == (1,)
    ledger.write([ended(2)])
    assert reader.execute("SELECT count(*) FROM cycles").fetchone() == (1,)
    reader.close()
    assert len(ledger.listed(LedgerQuery())) == 2
    ledger.close()


def test_an_older_ledger_is_not_changed_by_asking(place: str) -> None:
    ledger = Ledger(place, create=True)
    ledger.close()
    with engine_of(place) as engine, engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '0000'"))
    with pytest.raises(LedgerError, match=r"older version \(0000\)"):
        Ledger(place)


#: What each version added.
_ADDED = {
    "0002": ["DROP TABLE acknowledgements"],
    "0003": ["DROP INDEX by_product", "ALTER TABLE cycles DROP COLUMN product"],
    "0004": ["DROP TABLE actions"],
}


@pytest.mark.parametrize("version", ["0001", "0002", "0003"])
def test_a_ledger_of_an_older_version_keeps_what_is_in_it(place: str, version: str) -> None:
    """As it was before acknowledgements, products or actions were listed."""
    ledger = Ledger(place, create=True)
    ledger.write([ended(1), stopped(2)])
    ledger.close()
    with engine_of(place) as engine, engine.begin() as connection:
        for change in (c for v, added in _ADDED.items() if v > version for c in added):
            connection.execute(text(change))
        connection.execute(text(f"UPDATE alembic_version SET version_num = '{version}'"))
    with pytest.raises(LedgerError, match=rf"older version \({version}\)"):
        Ledger(place)
    ledger = Ledger(place, create=True)
    found = ledger.listed(LedgerQuery(), estimates=True)
    assert [c.outcome for c in found] == ["inserted", "failed"]
    assert [e.name for e in found[0].estimates] == ["rigidity_0", "viscosity"]
    ledger.acknowledge(found[1:], Acknowledgement(BEGUN, "Ada"))
    assert not ledger.listed(LedgerQuery(acknowledged=False))
    ledger.write([ended(3, product="soft")])
    assert [c.product for c in ledger.listed(LedgerQuery())] == [None, None, "soft"]
    ledger.close()
    with engine_of(place) as engine, engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), metadata) == []


def test_who_may_not_write_sees_what_is_written_at_the_moment(tmp_path: Path, monkeypatch) -> None:
    """A person asks the ledger of the cell, which is another user's and runs."""
    ledger = Ledger(tmp_path / "runs", create=True)
    ledger.write([ended(1)])
    may = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK and may(path, mode))
    reader = Ledger(tmp_path / "runs")
    assert reader.count(LedgerQuery()) == {"inserted": 1}
    reader.close()
    ledger.close()
    reader = Ledger(tmp_path / "runs")  # the cell has ended
    assert reader.count(LedgerQuery()) == {"inserted": 1}
    reader.close()


def test_a_folder_that_cannot_be_made_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(LedgerError, match="file"):
        Ledger(tmp_path / "file" / "ledgers" / "line.sqlite", create=True)


def test_a_new_file_that_another_cell_begins_with_is_waited_for(tmp_path: Path) -> None:
    """SQLite does not wait by itself there: the second of two new cells was refused."""
    other = sqlite3.connect(tmp_path / "runs.sqlite", isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    ends = threading.Timer(0.3, other.execute, ["COMMIT"])
    ends.start()
    Ledger(tmp_path / "runs", create=True).close()
    ends.join()
    other.close()


def test_a_file_that_another_process_keeps_is_said(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("cell.records.ledger.database.BUSY_S", 0.05)
    other = sqlite3.connect(tmp_path / "runs.sqlite", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(LedgerError, match=r"runs\.sqlite: database is locked"):
        Ledger(tmp_path / "runs", create=True)
    other.close()
