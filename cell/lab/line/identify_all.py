"""All recordings of a folder identified again, by many workers, with bounded memory."""

from __future__ import annotations

import csv
import io
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TextIO

from cell.files.input_error import InputError
from cell.files.rescue import naming
from cell.lab.data.work import Progress, no_progress
from cell.lab.line.recordings import IdentifiedAgain, Packed, identified_again
from cell.workers.executor import Executor

COLUMNS = tuple(f.name for f in fields(IdentifiedAgain))
_INTEGERS = ("frames_used", "frames_total")
_FLOATS = ("moved_std", "residual_rms_m", "noise_std_m")


class IdentifiedTable:
    """A table file of results; each row is written before the next one is computed."""

    def __init__(self, file: TextIO, known: dict[str, IdentifiedAgain]) -> None:
        self._file = file
        self.known = known

    def add(self, row: IdentifiedAgain) -> None:
        """Write a row.  Raises OSError."""
        with naming(Path(self._file.name)):
            self._file.write(_line(row))
            self._file.flush()


@contextmanager
def identified_table(path: Path, *, afresh: bool = False) -> Iterator[IdentifiedTable]:
    """Open the table in a file, with the last row of each recording, without parameters.

    An incomplete last line, from a killed run, is removed.
    afresh  any existing file is overwritten, and no row is known
    raises  InputError: the file is another table; OSError
    """
    content = path.read_bytes() if path.exists() and not afresh else b""
    rows = rows_of(path) if content else ()
    known = {row.recording: replace(row, parameters=None) for row in rows}
    complete = content.rfind(b"\n") + 1  # bytes in complete lines
    file = path.open("r+" if complete else "w", encoding="utf-8", newline="")
    try:
        if complete:
            file.truncate(complete)
            file.seek(0, os.SEEK_END)
        else:
            file.write(",".join(COLUMNS) + "\n")
        yield IdentifiedTable(file, known)
    finally:
        with naming(path):  # on a full disk the last write is repeated
            file.close()


def rows_of(path: Path) -> Iterator[IdentifiedAgain]:
    """Yield the rows of a table.

    raises  InputError: a line is wrong
    """
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if number == 1:
                if line.rstrip(b"\r\n") != ",".join(COLUMNS).encode():
                    raise _wrong(path, 1, "is no table of `cell identify --all`")
            elif line.endswith(b"\n"):  # an incomplete one may end within a character
                yield _row(path, number, line)


def _line(row: IdentifiedAgain) -> str:
    cells = {name: getattr(row, name) for name in COLUMNS}
    numbers = cells["parameters"]
    cells["parameters"] = None if numbers is None else json.dumps(numbers, ensure_ascii=False)
    cells["why"] = " ".join(str(row.why).split())  # a row is a line
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(
        ["" if v is None else repr(v) if isinstance(v, float) else v for v in cells.values()]
    )
    return line.getvalue()


def _row(path: Path, number: int, line: bytes) -> IdentifiedAgain:
    try:
        cells = next(csv.reader([line.decode()]), [])
    except ValueError as error:
        raise _wrong(path, number, f"is no text: {error}") from error
    if len(cells) != len(COLUMNS):
        raise _wrong(path, number, f"has {len(cells)} cells, must have {len(COLUMNS)}")
    values: dict[str, Any] = dict(zip(COLUMNS, cells, strict=True))
    try:
        for name in (*_FLOATS, *_INTEGERS):
            kind = int if name in _INTEGERS else float
            values[name] = kind(values[name]) if values[name] else None
        numbers = json.loads(values["parameters"] or "null")
        values["parameters"] = numbers and {name: tuple(v) for name, v in numbers.items()}
    except (ValueError, AttributeError, TypeError) as error:
        raise _wrong(path, number, f"is wrong: {error}") from error
    return IdentifiedAgain(**values)


def _wrong(path: Path, line: int, problem: str) -> InputError:
    return InputError.at(path, f"{problem}; give another file, or --force to begin anew", line=line)


FORMAT = "cable-identified/1"
#: Number of recordings listed per kind in the summary; the table has all.
_NAMED = 10


@dataclass
class IdentifiedAll:
    """Summary of the results of all recordings.

    recordings    number in the folder
    known         number of them that the table had already
    outcomes, compared   counts of each, see `IdentifiedAgain`
    moved         recordings with the largest changes, largest first
    unidentified  the first recordings that were not identified
    """

    recordings: int
    known: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    compared: Counter[str] = field(default_factory=Counter)
    unidentified: list[IdentifiedAgain] = field(default_factory=list)
    moved: list[IdentifiedAgain] = field(default_factory=list)

    @property
    def done(self) -> int:
        """Number of recordings with a result."""
        return self.outcomes.total()

    def add(self, row: IdentifiedAgain) -> None:
        """Count one further result."""
        row = replace(row, parameters=None)
        self.outcomes[row.outcome] += 1
        self.compared[row.compared] += 1
        if row.outcome != "identified" and len(self.unidentified) < _NAMED:
            self.unidentified.append(row)
        if row.moved_std is not None:
            most_first = sorted(
                [*self.moved, row], key=lambda r: (-(r.moved_std or 0), r.recording)
            )
            self.moved = most_first[:_NAMED]

    def to_json(self) -> dict[str, Any]:
        """Plain data, format cable-identified/1."""
        return {
            "format": FORMAT,
            "recordings": self.recordings,
            "done": self.done,
            "known": self.known,
            "outcomes": dict(sorted(self.outcomes.items())),
            "compared": dict(sorted(self.compared.items())),
            "moved": [
                {"recording": r.recording, "parameter": r.moved, "std": r.moved_std}
                for r in self.moved
            ],
            "unidentified": [
                {"recording": r.recording, "outcome": r.outcome, "why": r.why}
                for r in self.unidentified
            ],
        }


def identify_all(
    recordings: Sequence[Path],
    pack: Callable[[Path], Packed],
    table: IdentifiedTable,
    executor: Executor,
    progress: Progress = no_progress,
    check: Callable[[], None] = lambda: None,
) -> Iterator[IdentifiedAll]:
    """Yield the results so far after every recording; its row is in the table by then.

    A row of the table is reused if all that it depends on is unchanged.
    pack   of `recordings.packer`
    check  called while waiting for a result; may raise
    """
    summary = IdentifiedAll(len(recordings))
    sent: list[str] = []

    def jobs() -> Iterator[Packed]:
        """Yield recordings without a valid row in the table."""
        for recording in recordings:
            packed = pack(recording)
            row = table.known.get(packed.name)
            if row is not None and not packed.error and row.key == packed.key:
                summary.known += 1
                summary.add(row)
                continue
            sent.append(packed.name)
            yield packed

    progress("identifying", 0, len(recordings))
    with closing(executor.map(identified_again, jobs(), check)) as results:
        for result in results:
            if result.error is None:
                row = result.value
            else:
                row = IdentifiedAgain(sent[result.number], "", "failed", why=str(result.error))
            table.add(row)
            summary.add(row)
            progress("identifying", summary.done, len(recordings))
            yield summary
    progress("identifying", summary.done, len(recordings))
    yield summary
