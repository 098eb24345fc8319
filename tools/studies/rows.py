"""Rows of results: dataclasses in a CSV file, to which a stopped study can be continued."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter

RowT = TypeVar("RowT")


def read_rows(file: Path, kind: type[RowT]) -> list[RowT]:
    """Rows of a file, empty without one; a field that it lacks came later, and has a default."""
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as lines:
        return TypeAdapter(list[kind]).validate_python(list(csv.DictReader(lines)))


def added_rows(file: Path, kind: type[RowT], rows: Iterable[RowT]) -> Iterator[RowT]:
    """Yield the rows, each appended to a file at once."""
    with file.open("a", newline="", encoding="utf-8") as out:
        writer = csv.DictWriter(out, [f.name for f in fields(kind)], lineterminator="\n")
        if out.tell() == 0:
            writer.writeheader()
        for row in rows:
            writer.writerow(asdict(row))
            out.flush()
            yield row


def write_measured(file: Path, rows: Sequence[Mapping[str, object]], command: str) -> None:
    """Write a file of measured results: rows with their origin, as in docs/measured."""
    origin = {
        "measured_on": time.strftime("%Y-%m-%d"), "machine": f"{os.cpu_count()} cores",
        "load": f"{os.getloadavg()[2]:.0f}", "command": command,
    }  # fmt: skip
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.DictWriter(out, [*rows[0], *origin], lineterminator="\n")
        writer.writeheader()
        writer.writerows({**row, **origin} for row in rows)
