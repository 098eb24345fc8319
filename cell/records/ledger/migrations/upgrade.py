"""Brings the tables of a ledger up to date."""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection


def upgrade(connection: Connection, to: str = "head") -> None:
    """Apply all pending migrations, within the transaction of `connection`."""
    command.upgrade(config(connection), to)


def config(connection: Connection | None = None) -> Config:
    """Configuration of Alembic: the folder of the migrations, and a connection."""
    found = Config()
    found.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    found.attributes["connection"] = connection
    return found
