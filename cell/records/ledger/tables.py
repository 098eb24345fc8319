"""Tables of the ledger.  All times are UTC; all numbers are in SI units.

A change here needs a new `HEAD`, and an entry in `upgrade` for older ledgers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Connection,
    DateTime,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    insert,
    text,
    update,
)

#: Version of these tables.
HEAD = "0004"

metadata = MetaData()
#: Version of a ledger, in a table with one row.
version = Table("alembic_version", MetaData(), Column("version_num", String(32), primary_key=True))

#: Numbers of a `Result` that have a column of the same name.
NUMBERS = (
    "offset_m",
    "predicted_miss_m",
    "measured_miss_m",
    "margin_m",
    "predicted_margin_m",
    "predicted_std_m",
    "probability",
    "prediction_error_m",
    "residual_rms_m",
    "noise_m",
    "wait_s",
    "speed",
)

#: Parts held by the jaws: a part may be tried more than once.
parts = Table(
    "parts",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("code", String(200), nullable=False, unique=True),
)

#: One row per cycle.  `outcome` is null until the cycle has ended; `ordered` is `started`, but not
#: earlier than that of the line's cycle before, even if the clock was set back.
cycles = Table(
    "cycles",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("uid", String(300), nullable=False, unique=True),
    Column("line", String(100), nullable=False),
    Column("cycle", Integer, nullable=False),
    Column("part_id", ForeignKey("parts.id"), index=True),
    Column("product", String(64)),
    Column("folder", Text, nullable=False),
    Column("aim", String(20), nullable=False),
    Column("started", DateTime, nullable=False),
    Column("ordered", DateTime, nullable=False),
    Column("ended", DateTime),
    Column("outcome", String(20)),
    Column("reason", Text),
    Column("model_misses", Boolean, nullable=False),
    Column("model", String(64)),
    Column("calibration", String(64)),
    Column("software", String(50)),
    Column("running_s", Float),
    *(Column(name, Float) for name in NUMBERS),
    Index("by_line", "line", "ordered", "id"),
    Index("by_time", "ordered", "id"),
    Index("by_outcome", "outcome", "ordered"),
    Index("by_product", "line", "product", "ordered", "id"),
)

#: This cable's parameters, with 95 % intervals.
parameters = Table(
    "parameters",
    metadata,
    Column("cycle_id", ForeignKey("cycles.id", ondelete="CASCADE"), primary_key=True),
    Column("name", String(100), primary_key=True),
    Column("value", Float, nullable=False),
    Column("low", Float),
    Column("high", Float),
)

#: Faults that ended a cycle; `code` as `Fault.code`.
faults = Table(
    "faults",
    metadata,
    Column("cycle_id", ForeignKey("cycles.id", ondelete="CASCADE"), primary_key=True),
    Column("code", String(50), nullable=False, index=True),
    Column("step", String(50), nullable=False),
    Column("device", String(100)),
    Column("cause", Text, nullable=False),
    Column("remedy", Text, nullable=False),
    Column("cable", Text, nullable=False),
)

#: Acknowledgements of faults by a person.
acknowledgements = Table(
    "acknowledgements",
    metadata,
    Column("cycle_id", ForeignKey("cycles.id", ondelete="CASCADE"), primary_key=True),
    Column("at", DateTime, nullable=False),
    Column("by", String(100), nullable=False),
    Column("note", Text, nullable=False),
)

#: Longest name of a state, a step or a reason to wait, characters.
LONGEST_NAME = 50
#: Time spent in each state of the cell (PackML) and in each step; and waiting, by reason, since
#: the previous cycle.
times = Table(
    "times",
    metadata,
    Column("cycle_id", ForeignKey("cycles.id", ondelete="CASCADE"), primary_key=True),
    Column("kind", String(10), primary_key=True),  # state, step, waiting
    Column("name", String(LONGEST_NAME), primary_key=True),
    Column("seconds", Float, nullable=False),
)

#: Actions of people at the pages; `place`: offset of the line in the log `source`.
actions = Table(
    "actions",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("source", String(300), nullable=False),
    Column("place", BigInteger, nullable=False),
    Column("line", String(100), nullable=False),
    Column("at", DateTime, nullable=False),
    Column("by", String(100), nullable=False),
    Column("action", String(100), nullable=False),
    Column("done", Boolean, nullable=False),
    Column("note", Text, nullable=False),
    Index("once", "source", "place", unique=True),
    Index("actions_by_time", "at", "id"),
)


def _add_products(connection: Connection) -> None:
    connection.execute(text("ALTER TABLE cycles ADD COLUMN product VARCHAR(64)"))
    next(index for index in cycles.indexes if index.name == "by_product").create(connection)


#: Changes of each version relative to its predecessor.
_ADDED: Mapping[str, Callable[[Connection], None]] = {
    "0002": acknowledgements.create,
    "0003": _add_products,
    "0004": actions.create,
}


def upgrade(connection: Connection, current: str | None) -> None:
    """Make the tables of a new ledger, or add missing columns of an older version.

    current  its version; None = it is new
    """
    if current is None:
        metadata.create_all(connection)
        version.create(connection, checkfirst=True)
        connection.execute(insert(version).values(version_num=HEAD))
        return
    for number, add in _ADDED.items():
        if number > current:
            add(connection)
    connection.execute(update(version).values(version_num=HEAD))
