"""The ledger: a database of cycles, written once per cycle, queried for results and faults.

Its cycles become tables for other programs: CSV, Parquet.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Engine,
    Select,
    case,
    func,
    or_,
    select,
)

from cell.files.atomic import write_atomic
from cell.records.folder import UNFINISHED
from cell.records.ledger.database import database_errors, open_engine, url_of, writing
from cell.records.ledger.entry import Acknowledgement, LedgerEntry, LedgerEstimate
from cell.records.ledger.entry_rows import acknowledge_cycle, utc, write_entry
from cell.records.ledger.tables import (
    NUMBERS,
    acknowledgements,
    cycles,
    faults,
    parameters,
    parts,
    times,
)
from cell.records.result import Fault, Outcome, Result
from drivers.installing import install_extra

#: Newest cycles that charts and the promotion check look at.
MOST = 500
#: Cycles that tell of forecasts and fits.
TELLING = (Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED)
#: `Fault.code` of a cycle that a commanded stop has ended.
STOPPED = "stop"


@dataclass(frozen=True)
class LedgerQuery:
    """Filter of cycles; None or empty = all.

    since, until   of their beginning; with a time zone
    outcomes       "running or killed" are those that have none
    fault          a reason code, or the beginning of some: `arm` is all of the arm, "" is any
    product        "" = of none, as without products in the settings
    acknowledged   whether somebody has acknowledged the fault
    """

    since: datetime | None = None
    until: datetime | None = None
    outcomes: tuple[str, ...] = ()
    line: str | None = None
    part: str | None = None
    product: str | None = None
    model: str | None = None
    fault: str | None = None
    acknowledged: bool | None = None


@dataclass(frozen=True)
class ListedCycle:
    """A cycle as stored in the ledger; see `LedgerEntry` and `Result`."""

    line: str
    cycle: int
    part: str | None
    product: str | None
    folder: Path
    started: datetime
    ended: datetime | None
    outcome: str
    reason: str | None
    model: str | None
    calibration: str | None
    software: str | None
    running_s: float | None
    numbers: Mapping[str, float | None]
    fault: Fault | None
    estimates: tuple[LedgerEstimate, ...] = ()
    acknowledged: Acknowledgement | None = None

    @property
    def uid(self) -> str:
        """As of its `Entry`."""
        return f"{self.line}/{self.folder.name}"

    def to_json(self) -> dict[str, Any]:
        """Plain data: one level, as a row of a table."""
        fault, seen = self.fault or Fault("", ""), self.acknowledged
        data: dict[str, Any] = {
            "started": self.started.isoformat(),
            "ended": None if self.ended is None else self.ended.isoformat(),
            **{k: getattr(self, k) for k in ("line", "cycle", "product", "part")},
            **{k: getattr(self, k) for k in ("outcome", "reason")},
            **{f"fault_{k}": getattr(fault, k) or None for k in ("code", "step", "device")},
            "fault_cause": fault.cause or None,
            "acknowledged": None if seen is None else seen.at.isoformat(),
            "acknowledged_by": None if seen is None else seen.by,
            "acknowledged_note": (None if seen is None else seen.note) or None,
            **self.numbers,
            "running_s": self.running_s,
            **{k: getattr(self, k) for k in ("model", "calibration", "software")},
            "folder": str(self.folder),
        }
        for e in self.estimates:
            data |= {e.name: e.value, f"{e.name}_low": e.low, f"{e.name}_high": e.high}
        return data


class Ledger:
    """A ledger's database; safe to be used from several threads and processes.

    place  a URL, a file, or a folder of records
    raises  LedgerError, from every method
    """

    def __init__(self, place: str | Path, *, create: bool = False) -> None:
        self.url = url_of(place)
        self._engine: Engine = open_engine(self.url, create=create)

    def close(self) -> None:
        """Close its connections."""
        self._engine.dispose()

    # --- writing ----------------------------------------------------------------------------------

    def write(self, entries: Iterable[LedgerEntry], *, of_now: bool = True) -> None:
        """Write entries, all or none.  One that is there already becomes what it says now; a cycle
        that has ended stays so.

        of_now  the cycles come after those that are listed, even if the clock was set back; False =
                they were when they say
        """
        with writing(self._engine) as connection:
            for entry in entries:
                write_entry(connection, entry, of_now)

    def acknowledge(self, of: Iterable[ListedCycle], said: Acknowledgement) -> None:
        """Write a person's word on the faults of these cycles; it takes the place of another."""
        with writing(self._engine) as connection:
            for cycle in of:
                at = connection.scalar(select(cycles.c.id).where(cycles.c.uid == cycle.uid))
                if at is not None:
                    acknowledge_cycle(connection, at, said)

    # --- asking -----------------------------------------------------------------------------------

    def results(self, line: str, product: str | None = None, *, most: int = MOST) -> list[Result]:
        """What charts need of a line's newest cycles that tell of forecasts and fits, oldest first:
        outcome, model, misses, parameters.

        product  only its cycles; None = only those of no product
        """
        newest = (
            select(cycles.c.id, *_CHARTED)
            .where(
                cycles.c.line == line,
                cycles.c.product.is_(None) if product is None else cycles.c.product == product,
                cycles.c.outcome.in_([o.value for o in TELLING]),
            )
            .order_by(cycles.c.ordered.desc(), cycles.c.id.desc())
            .limit(most)
        )
        with self._asking() as connection:
            rows = connection.execute(newest).all()[::-1]
            estimates = _estimates(connection, newest)
        results = []
        for at, *values in rows:
            known = dict(zip(_CHARTED_NAMES, values, strict=True))
            known["outcome"] = Outcome(known["outcome"])
            parameters = {e.name: e.value for e in estimates.get(at, ())}
            results.append(Result(**known, parameters=parameters))
        return results

    def listed(
        self, wanted: LedgerQuery, most: int | None = None, *, estimates: bool = False
    ) -> list[ListedCycle]:
        """Cycles that are asked for, oldest first; of too many the newest.

        estimates  with the cables' parameters
        """
        query = (
            _of_cycles(
                select(cycles, parts.c.code.label("part"), *_FAULT_COLUMNS, *_SEEN_COLUMNS), wanted
            )
            .order_by(cycles.c.ordered.desc(), cycles.c.id.desc())
            .limit(most)
        )
        with self._asking() as connection:
            rows = connection.execute(query).all()[::-1]
            known = _estimates(connection, query) if estimates else {}
        return [self._cycle(row, known.get(row.id, ())) for row in rows]

    def count(self, wanted: LedgerQuery) -> dict[str, int]:
        """Number of cycles that are asked for, by outcome."""
        query = _of_cycles(select(cycles.c.outcome, func.count()), wanted)
        rows = self._rows(query.group_by(cycles.c.outcome))
        return {outcome or UNFINISHED: n for outcome, n in rows}

    def faults(self, wanted: LedgerQuery) -> list[tuple[str, int, str]]:
        """Reason code, number of cycles and newest cause of what has ended them; most first."""
        columns = faults.c.code.label("kind"), faults.c.cycle_id, faults.c.cause.label("why")
        ended = faults.c.code.is_not(None)
        return self._counted(_of_cycles(select(*columns).where(ended), wanted))

    def not_inserted(self, wanted: LedgerQuery) -> list[tuple[str, int, str]]:
        """Outcome, number of cycles and newest reason of those rejected and missed; most first."""
        columns = (
            cycles.c.outcome.label("kind"),
            cycles.c.id.label("cycle_id"),
            cycles.c.reason.label("why"),
        )
        ended = cycles.c.outcome.in_((Outcome.REJECTED.value, Outcome.MISSED.value))
        return self._counted(_of_cycles(select(*columns).where(ended), wanted))

    def _counted(self, cycles_of: Select[Any]) -> list[tuple[str, int, str]]:
        """Number and newest `why` of cycles by their `kind`; the most frequent first."""
        each = cycles_of.subquery()
        newest = func.max(each.c.cycle_id).label("newest")
        groups = (
            select(each.c.kind, func.count().label("number"), newest)
            .group_by(each.c.kind)
            .subquery()
        )
        rows = self._rows(
            select(groups.c.kind, groups.c.number, each.c.why)
            .join(each, each.c.cycle_id == groups.c.newest)
            .order_by(groups.c.number.desc(), groups.c.kind)
        )
        return [(kind, n, why or "") for kind, n, why in rows]

    def _rows(self, query: Select[Any]) -> Sequence[Any]:
        with self._asking() as connection:
            return connection.execute(query).all()

    @contextmanager
    def _asking(self) -> Iterator[Connection]:
        with database_errors(self._engine), self._engine.connect() as connection:
            yield connection

    def times(self, wanted: LedgerQuery) -> dict[str, dict[str, dict[str, float]]]:
        """Seconds of the cycles that are asked for: `uid` → kind → name; kinds as in `times`."""
        columns = cycles.c.uid, times.c.kind, times.c.name, times.c.seconds
        query = _of_cycles(select(*columns), wanted)
        found: dict[str, dict[str, dict[str, float]]] = {}
        for uid, kind, name, seconds in self._rows(query.where(times.c.cycle_id == cycles.c.id)):
            found.setdefault(uid, {}).setdefault(kind, {})[name] = seconds
        return found

    def span(self, wanted: LedgerQuery) -> tuple[datetime, datetime] | None:
        """When the first and the last cycle that are asked for began; None = there are none."""
        query = _of_cycles(select(func.min(cycles.c.ordered), func.max(cycles.c.ordered)), wanted)
        ((first, last),) = self._rows(query)
        return None if first is None else (_aware(first), _aware(last))

    def work(self, wanted: LedgerQuery) -> tuple[dict[str, int], float]:
        """Of cycles that were to insert a cable: number by outcome, and time at work in all, s.

        A cycle that a commanded stop has ended is in the time, and not in the number: the stop says
        nothing about its cable.
        """
        stopped = select(faults.c.cycle_id).where(faults.c.code == STOPPED)
        counted = case((cycles.c.id.in_(stopped), 0), else_=1)
        query = _of_cycles(
            select(
                cycles.c.outcome,
                func.sum(counted),
                func.coalesce(func.sum(cycles.c.running_s), 0.0),
            ),
            wanted,
        ).where(cycles.c.aim == Outcome.INSERTED.value, cycles.c.outcome.is_not(None))
        rows = self._rows(query.group_by(cycles.c.outcome))
        return {o: int(n) for o, n, _ in rows}, float(sum(s for *_, s in rows))

    def quick_cycle_s(self, wanted: LedgerQuery, share: float) -> float | None:
        """Time at work that this share of the insertions needed at most, s; None = no insertion."""
        at_work = _of_cycles(select(cycles.c.running_s), wanted).where(
            cycles.c.outcome == Outcome.INSERTED.value, cycles.c.running_s.is_not(None)
        )
        with self._asking() as connection:
            number = connection.scalar(select(func.count()).select_from(at_work.subquery())) or 0
            if not number:
                return None
            at = int(share * (number - 1))
            found = connection.scalar(at_work.order_by(cycles.c.running_s).offset(at).limit(1))
        return None if found is None else float(found)

    def _cycle(self, row: Any, estimates: Sequence[LedgerEstimate]) -> ListedCycle:
        seen = None
        if row.seen_at is not None:
            seen = Acknowledgement(_aware(row.seen_at), row.seen_by, row.seen_note)
        return ListedCycle(
            **{name: getattr(row, name) for name in _AS_STORED},
            folder=self._folder(row.folder),
            started=_aware(row.started),
            ended=None if row.ended is None else _aware(row.ended),
            outcome=row.outcome or UNFINISHED,
            numbers={name: getattr(row, name) for name in NUMBERS},
            fault=None if row.code is None else Fault(*(getattr(row, k) for k in _OF_FAULT)),
            estimates=tuple(estimates),
            acknowledged=seen,
        )

    def _folder(self, said: str) -> Path:
        """Where a cycle's folder is; beside the ledger if it was moved with it."""
        folder = Path(said)
        if folder.is_dir() or not self.url.drivername.startswith("sqlite"):
            return folder
        moved = Path(self.url.database or "").with_suffix("") / folder.name
        return moved if moved.is_dir() else folder


#: What charts need.
_CHARTED_NAMES = (
    *("cycle", "outcome", "folder", "predicted_miss_m", "measured_miss_m", "predicted_std_m"),
    *("residual_rms_m", "noise_m", "model", "model_misses", "product"),
)
_CHARTED = [cycles.c[name] for name in _CHARTED_NAMES]
_OF_FAULT = ("step", "cause", "device", "remedy", "cable", "code")
_FAULT_COLUMNS = [faults.c[k] for k in _OF_FAULT]
#: Entries of a `ListedCycle` that stand so in the tables.
_AS_STORED = (
    *("line", "cycle", "part", "product", "reason"),
    *("model", "calibration", "software", "running_s"),
)
_SEEN_COLUMNS = [acknowledgements.c[k].label(f"seen_{k}") for k in ("at", "by", "note")]


#: Each cycle with its part, its fault and what was said of that.
_CYCLES = (
    cycles.outerjoin(parts, parts.c.id == cycles.c.part_id)
    .outerjoin(faults, faults.c.cycle_id == cycles.c.id)
    .outerjoin(acknowledgements, acknowledgements.c.cycle_id == cycles.c.id)
)


def _of_cycles(query: Select[Any], wanted: LedgerQuery) -> Select[Any]:
    """A question to the cycles that are asked for; a database skips joins that it does not need."""
    return query.select_from(_CYCLES).where(*_conditions(wanted))


def _conditions(wanted: LedgerQuery) -> list[ColumnElement[bool]]:
    found: list[ColumnElement[bool]] = []
    if wanted.since is not None:
        found.append(cycles.c.ordered >= utc(wanted.since))
    if wanted.until is not None:
        found.append(cycles.c.ordered < utc(wanted.until))
    if wanted.outcomes:
        named = [o for o in wanted.outcomes if o != UNFINISHED]
        of = [cycles.c.outcome.in_(named)] if named else []
        if UNFINISHED in wanted.outcomes:
            of.append(cycles.c.outcome.is_(None))
        found.append(or_(*of))
    if wanted.acknowledged is not None:
        seen = acknowledgements.c.cycle_id
        said = seen.is_not(None) if wanted.acknowledged else seen.is_(None)
        found += [faults.c.code.is_not(None), said]
    if wanted.fault == "":
        found.append(faults.c.code.is_not(None))
    elif wanted.fault is not None:
        below = faults.c.code.startswith(f"{wanted.fault}.", autoescape=True)
        found.append(or_(faults.c.code == wanted.fault, below))
    if wanted.product == "":
        found.append(cycles.c.product.is_(None))
    elif wanted.product is not None:
        found.append(cycles.c.product == wanted.product)
    for column, value in (
        (cycles.c.line, wanted.line),
        (parts.c.code, wanted.part),
        (cycles.c.model, wanted.model),
    ):
        if value is not None:
            found.append(column == value)
    return found


def _estimates(connection: Connection, of: Select[Any]) -> dict[int, list[LedgerEstimate]]:
    """Parameters by the number of their cycle, of the cycles that are asked for."""
    chosen = of.with_only_columns(cycles.c.id, maintain_column_froms=True).subquery()
    columns = (parameters.c[k] for k in ("cycle_id", "name", "value", "low", "high"))
    query = select(*columns).join(chosen, chosen.c.id == parameters.c.cycle_id)
    found: dict[int, list[LedgerEstimate]] = {}
    for at, *values in connection.execute(query).all():
        found.setdefault(at, []).append(LedgerEstimate(*values))
    return found


def _aware(moment: datetime) -> datetime:
    """As people read it: local time, with its zone."""
    return moment.replace(tzinfo=UTC).astimezone()


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
