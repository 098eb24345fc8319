"""Cycles as a table for other programs: CSV, Parquet."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

from cell.files.atomic import write_atomic
from cell.records.ledger.ledger import ListedCycle
from drivers.installing import install_extra


def rows_of(cycles: Sequence[ListedCycle]) -> tuple[list[str], list[dict[str, Any]]]:
    """Column names, those of parameters last, and one row per cycle; None = not known."""
    rows = [cycle.to_json() for cycle in cycles]
    return list(dict.fromkeys(name for row in rows for name in row)), rows


def csv_text(cycles: Sequence[ListedCycle]) -> str:
    """Comma-separated values, one line of names."""
    names, rows = rows_of(cycles)
    text = StringIO(newline="")
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_csv(cycles: Sequence[ListedCycle], path: Path) -> None:
    """Write `csv_text` to a file, UTF-8.  Raises OSError."""
    write_atomic(path, csv_text(cycles))


def write_parquet(cycles: Sequence[ListedCycle], path: Path) -> None:
    """Apache Parquet.  Raises OSError."""
    import pyarrow
    import pyarrow.parquet

    names, rows = rows_of(cycles)
    columns = {name: [row.get(name) for row in rows] for name in names}
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.table(columns), sink)
    write_atomic(path, sink.getvalue().to_pybytes())


def need_parquet() -> None:
    """Raise ValueError if the package that writes Parquet is not installed."""
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError as error:
        message = f"--parquet needs a package: {error}; {install_extra('parquet')}"
        raise ValueError(message) from error
