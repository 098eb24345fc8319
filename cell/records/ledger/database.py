"""Opens a ledger's database: SQLite in a file, or a PostgreSQL server; brings it up to date."""

from __future__ import annotations

import os
import re
import shlex
import sqlite3
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, inspect, select, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import NoSuchModuleError as NoDialectError

from cell.files.atomic import named_folder
from cell.records.ledger.entry import LedgerError
from cell.records.ledger.tables import HEAD, cycles, metadata, upgrade, version
from drivers.installing import install_extra

#: Suffix of a ledger's file.
_SUFFIX = ".sqlite"
#: How long another process may lock the database, s.
BUSY_S = 5.0
#: Pause before write-ahead logging is requested again for a file that another process opens, s.
_AGAIN_S = 0.01
#: How long a server may take to answer a connection, s.
CONNECT_S = 3
#: Lock on a server that a writer holds during its transaction; SQLite has its own.
_LOCK = 0x63656C6C


def url_of(place: str | Path) -> URL:
    """URL of a ledger: of a file, of the file next to a folder of records, or the URL itself.

    raises  LedgerError: no such kind of database
    """
    if isinstance(place, Path) or "://" not in place:
        path = Path(place)
        if path.suffix != _SUFFIX:  # next to the folder, like its log
            if path.is_file():
                raise LedgerError(
                    f"{path} is a file, and none named *{_SUFFIX}: give a folder of records, a "
                    "ledger's file, or a database's URL"
                )
            try:
                path = named_folder(path)
            except ValueError as error:
                raise LedgerError(str(error)) from error
            path = path.with_name(f"{path.name}{_SUFFIX}")
        return URL.create("sqlite", database=str(path))
    try:
        url = make_url(place)
    except ArgumentError as error:
        raise LedgerError(f"{place} is no database's URL: {error}") from error
    if url.drivername == "postgresql":
        url = url.set(drivername="postgresql+psycopg")
    return url


def need_file(place: str | Path | URL) -> None:
    """Raise LedgerError if the ledger is a file that does not exist, or no file."""
    url = place if isinstance(place, URL) else url_of(place)
    path = Path(url.database or "")
    if not url.drivername.startswith("sqlite") or not url.database or path.is_file():
        return
    try:
        kind = "a folder" if stat.S_ISDIR(path.stat().st_mode) else "a pipe or a device"
        raise LedgerError(f"{path} is {kind}, no ledger's file; give another name")
    except FileNotFoundError as error:
        raise LedgerError(
            f"{path} is missing: no cycle is listed there; `cell run` lists each, "
            "`cell history --import FOLDER` takes in those that were before"
        ) from error
    except OSError as error:
        raise LedgerError(
            f"{path} cannot be read: {error.strerror}; mend that, or give another name"
        ) from error


def check_file(place: str | Path) -> None:
    """Raise LedgerError if the ledger is a file that exists, but is none of this program."""
    url = url_of(place)
    path = Path(url.database or "")
    if url.drivername.startswith("sqlite") and (path.exists() or path.is_symlink()):
        engine = _engine(url, create=False)
        try:
            with database_errors(engine), engine.connect() as connection:
                _version(connection)
        finally:
            engine.dispose()


def open_engine(url: URL, *, create: bool) -> Engine:
    """An engine whose database has today's tables.

    create  make the database's tables, or bring them up to date
    raises  LedgerError: it cannot be reached, or is of a newer version, or, without `create`, of an
            older one
    """
    engine = _engine(url, create)
    try:
        with database_errors(engine):
            _bring_up_to_date(engine, create)
    except BaseException:
        engine.dispose()
        raise
    return engine


def _engine(url: URL, create: bool) -> Engine:
    """An engine, not yet connected.  Raises LedgerError, as `open_engine`."""
    path = None if url.database is None else Path(url.database)
    in_file = url.drivername.startswith("sqlite")
    if not create:
        need_file(url)
    read_only = in_file and not create and path is not None and not os.access(path.parent, os.W_OK)
    if path is not None and read_only:
        query = {"mode": "ro", "uri": "true"}
        if not path.with_name(f"{path.name}-wal").exists():  # nobody writes to it now
            query["immutable"] = "1"  # no auxiliary file is needed
        url = url.set(database=f"file:{path}", query=query)
    arguments: dict[str, Any] = {"connect_args": {"timeout": BUSY_S}}
    if not in_file:
        arguments = {"connect_args": {"connect_timeout": CONNECT_S}, "pool_pre_ping": True}
    try:
        engine = create_engine(url, **arguments)
    except (NoDialectError, ModuleNotFoundError) as error:
        raise LedgerError(
            f"{url.render_as_string()} needs a package that is not installed: {error}; "
            f"{install_extra('postgresql')}"
        ) from error
    if in_file:
        if path is not None and create:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise LedgerError(f"{path.parent} cannot be made: {error.strerror}") from error
        _keep_transactions(engine, read_only, create)
    return engine


@contextmanager
def opened(place: str | Path) -> Iterator[Engine]:
    """An engine of an existing ledger, disposed of at the end.  Raises LedgerError."""
    engine = open_engine(url_of(place), create=False)
    try:
        yield engine
    finally:
        engine.dispose()


@contextmanager
def database_errors(engine: Engine) -> Iterator[None]:
    """Turn errors of the database into LedgerError: one line that names the database."""
    try:
        yield
    except SQLAlchemyError as error:
        cause = str(getattr(error, "orig", None) or error).strip().splitlines()[0]
        line = f"{engine.url.render_as_string()}: {cause}"
        if _is_damaged(error):
            raise LedgerError(f"{line}; {_move_away(Path(engine.url.database or ''))}") from error
        if engine.dialect.name != "sqlite" and isinstance(error, OperationalError):
            raise LedgerError(f"{line}; check ledger.url, and that the database runs") from error
        raise LedgerError(line) from error


def _is_damaged(error: SQLAlchemyError) -> bool:
    """Whether SQLite reports that the file is no database, or a damaged one."""
    code = getattr(getattr(error, "orig", None), "sqlite_errorcode", 0)
    return code & 0xFF in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT)


def _move_away(file: Path) -> str:
    """Remedy for a damaged file: move it with its log, which would be used for a new file."""
    moved, here = (shlex.quote(str(p)) for p in (file.with_name(f"damaged-{file.name}"), file))
    return (
        "stop the programs that use it, then "
        f"`mkdir {moved} && mv {here}* {moved}`: the next run begins a new ledger, "
        "and `cell history --import FOLDER` takes in the cycles of a folder"
    )


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """A transaction that writes; concurrent ones wait.  Raises LedgerError."""
    with (
        database_errors(engine),
        engine.connect().execution_options(writing=True) as connection,
        connection.begin(),
    ):
        if engine.dialect.name == "postgresql":
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        yield connection


def _keep_transactions(engine: Engine, read_only: bool, create: bool) -> None:
    """Begin transactions explicitly: Python's module for SQLite begins them by itself."""

    @event.listens_for(engine, "connect")
    def connect(connection: Any, _record: object) -> None:
        connection.isolation_level = None
        if not read_only:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
            if {version.name, cycles.name} <= tables or (create and not tables):  # not foreign
                _write_ahead(connection)
            connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        writes = connection.get_execution_options().get("writing", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def _write_ahead(connection: Any) -> None:
    """Switch a file to write-ahead logging.

    While another process opens a new file, SQLite refuses this at once instead of waiting.
    raises  sqlite3.OperationalError: after `BUSY_S`, too
    """
    until_s = time.monotonic() + BUSY_S
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() >= until_s:
                raise
        time.sleep(_AGAIN_S)


def _bring_up_to_date(engine: Engine, create: bool) -> None:
    with engine.connect() as connection:
        held = _version(connection)
    if held == HEAD:
        return
    where = engine.url.render_as_string()
    if held is not None and held > HEAD:
        raise LedgerError(
            f"{where} is of a newer version ({held}) than this program knows ({HEAD}): use the "
            "newer program, or another ledger"
        )
    if not create:
        state = "has no tables of a ledger" if held is None else f"is of an older version ({held})"
        raise LedgerError(f"{where} {state}; the next `cell run` that uses it brings it up to date")
    with writing(engine) as connection:
        held = _version(connection)
        if held != HEAD:  # nobody else has done it meanwhile
            upgrade(connection, held)


def _version(connection: Connection) -> str | None:
    """Version of the ledger's tables; None = there is no ledger yet.

    raises  LedgerError: the tables are another program's; a server may hold others beside ours
    """
    tables = {*inspect(connection).get_table_names()}
    held = connection.scalar(select(version.c.version_num)) if version.name in tables else None
    own = (
        tables if connection.dialect.name == "sqlite" else tables & {version.name, *metadata.tables}
    )
    if own if held is None else not re.fullmatch(r"\d{4}", held):
        raise LedgerError(
            f"{connection.engine.url.render_as_string()} is no ledger of this program: it holds "
            f"tables of another ({', '.join(sorted(own))[:100]}); give another name"
        )
    return held
