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
#: Outcomes of cycles with forecasts and fits.
TELLING = (Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED)
#: `Fault.code` of a cycle that a commanded stop has ended.
STOPPED = "stop"


@dataclass(frozen=True)
class LedgerQuery:
    """Filter of cycles; None or empty = all.

    since, until   of their beginning; with a time zone
    outcomes       "running or killed" selects cycles without a result
    fault          a reason code, or a prefix: `arm` selects all of the arm, "" any fault
    product        "" = of none, as without products in the settings
    acknowledged   whether the fault is acknowledged
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
        """Identifier, as of its `LedgerEntry`."""
        return f"{self.line}/{self.folder.name}"

    def to_json(self) -> dict[str, Any]:
        """Plain data: one level, as a row of a table."""
        fault, ack = self.fault or Fault("", ""), self.acknowledged
        data: dict[str, Any] = {
            "started": self.started.isoformat(),
            "ended": None if self.ended is None else self.ended.isoformat(),
            **{k: getattr(self, k) for k in ("line", "cycle", "product", "part")},
            **{k: getattr(self, k) for k in ("outcome", "reason")},
            **{f"fault_{k}": getattr(fault, k) or None for k in ("code", "step", "device")},
            "fault_cause": fault.cause or None,
            "acknowledged": None if ack is None else ack.at.isoformat(),
            "acknowledged_by": None if ack is None else ack.by,
            "acknowledged_note": (None if ack is None else ack.note) or None,
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
        """Write entries, all or none.  An existing entry is updated; a cycle that has ended stays
        so.

        of_now  the cycles follow those that are listed, even if the clock was set back; False =
                their own times are used
        """
        with writing(self._engine) as connection:
            for entry in entries:
                write_entry(connection, entry, of_now)

    def acknowledge(self, of: Iterable[ListedCycle], acknowledgement: Acknowledgement) -> None:
        """Write the acknowledgement of these cycles' faults; it replaces an earlier one."""
        with writing(self._engine) as connection:
            for cycle in of:
                at = connection.scalar(select(cycles.c.id).where(cycles.c.uid == cycle.uid))
                if at is not None:
                    acknowledge_cycle(connection, at, acknowledgement)

    # --- queries ----------------------------------------------------------------------------------

    def results(self, line: str, product: str | None = None, *, most: int = MOST) -> list[Result]:
        """Newest cycles of a line with forecasts and fits, oldest first, as charts need them:
        outcome, model, errors, parameters.

        product  only its cycles; None = only those without a product
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
        with self._reading() as connection:
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
        """Cycles of a query, oldest first, at most the newest `most`.

        estimates  with the cables' parameters
        """
        query = (
            _of_cycles(
                select(cycles, parts.c.code.label("part"), *_FAULT_COLUMNS, *_SEEN_COLUMNS), wanted
            )
            .order_by(cycles.c.ordered.desc(), cycles.c.id.desc())
            .limit(most)
        )
        with self._reading() as connection:
            rows = connection.execute(query).all()[::-1]
            known = _estimates(connection, query) if estimates else {}
        return [self._cycle(row, known.get(row.id, ())) for row in rows]

    def count(self, wanted: LedgerQuery) -> dict[str, int]:
        """Number of cycles of a query, by outcome."""
        query = _of_cycles(select(cycles.c.outcome, func.count()), wanted)
        rows = self._rows(query.group_by(cycles.c.outcome))
        return {outcome or UNFINISHED: n for outcome, n in rows}

    def faults(self, wanted: LedgerQuery) -> list[tuple[str, int, str]]:
        """Faults: reason code, number of cycles and newest cause; the most frequent first."""
        columns = faults.c.code.label("kind"), faults.c.cycle_id, faults.c.cause.label("why")
        ended = faults.c.code.is_not(None)
        return self._counts(_of_cycles(select(*columns).where(ended), wanted))

    def not_inserted(self, wanted: LedgerQuery) -> list[tuple[str, int, str]]:
        """Rejected and missed cycles: outcome, number and newest reason; most frequent first."""
        columns = (
            cycles.c.outcome.label("kind"),
            cycles.c.id.label("cycle_id"),
            cycles.c.reason.label("why"),
        )
        ended = cycles.c.outcome.in_((Outcome.REJECTED.value, Outcome.MISSED.value))
        return self._counts(_of_cycles(select(*columns).where(ended), wanted))

    def _counts(self, cycles_of: Select[Any]) -> list[tuple[str, int, str]]:
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
        with self._reading() as connection:
            return connection.execute(query).all()

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        with database_errors(self._engine), self._engine.connect() as connection:
            yield connection

    def times(self, wanted: LedgerQuery) -> dict[str, dict[str, dict[str, float]]]:
        """Seconds of the cycles of a query: `uid` → kind → name; kinds as in the table `times`."""
        columns = cycles.c.uid, times.c.kind, times.c.name, times.c.seconds
        query = _of_cycles(select(*columns), wanted)
        by_cycle: dict[str, dict[str, dict[str, float]]] = {}
        for uid, kind, name, seconds in self._rows(query.where(times.c.cycle_id == cycles.c.id)):
            by_cycle.setdefault(uid, {}).setdefault(kind, {})[name] = seconds
        return by_cycle

    def span(self, wanted: LedgerQuery) -> tuple[datetime, datetime] | None:
        """When the first and the last cycle of a query began; None = there are none."""
        query = _of_cycles(select(func.min(cycles.c.ordered), func.max(cycles.c.ordered)), wanted)
        ((first, last),) = self._rows(query)
        return None if first is None else (_aware(first), _aware(last))

    def work(self, wanted: LedgerQuery) -> tuple[dict[str, int], float]:
        """Cycles that were to insert a cable: number by outcome, and total time at work, s.

        A cycle that was ended by a commanded stop counts in the time only: the stop is no result
        of its cable.
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
        """Quantile of the insertions' time at work, s; None = no insertion."""
        at_work = _of_cycles(select(cycles.c.running_s), wanted).where(
            cycles.c.outcome == Outcome.INSERTED.value, cycles.c.running_s.is_not(None)
        )
        with self._reading() as connection:
            number = connection.scalar(select(func.count()).select_from(at_work.subquery())) or 0
            if not number:
                return None
            at = int(share * (number - 1))
            quantile_s = connection.scalar(at_work.order_by(cycles.c.running_s).offset(at).limit(1))
        return None if quantile_s is None else float(quantile_s)

    def _cycle(self, row: Any, estimates: Sequence[LedgerEstimate]) -> ListedCycle:
        ack = None
        if row.seen_at is not None:
            ack = Acknowledgement(_aware(row.seen_at), row.seen_by, row.seen_note)
        return ListedCycle(
            **{name: getattr(row, name) for name in _AS_STORED},
            folder=self._folder(row.folder),
            started=_aware(row.started),
            ended=None if row.ended is None else _aware(row.ended),
            outcome=row.outcome or UNFINISHED,
            numbers={name: getattr(row, name) for name in NUMBERS},
            fault=None if row.code is None else Fault(*(getattr(row, k) for k in _OF_FAULT)),
            estimates=tuple(estimates),
            acknowledged=ack,
        )

    def _folder(self, stored: str) -> Path:
        """A cycle's folder; next to the ledger if it was moved with it."""
        folder = Path(stored)
        if folder.is_dir() or not self.url.drivername.startswith("sqlite"):
            return folder
        moved = Path(self.url.database or "").with_suffix("") / folder.name
        return moved if moved.is_dir() else folder


#: Columns that charts need.
_CHARTED_NAMES = (
    *("cycle", "outcome", "folder", "predicted_miss_m", "measured_miss_m", "predicted_std_m"),
    *("residual_rms_m", "noise_m", "model", "model_misses", "product"),
)
_CHARTED = [cycles.c[name] for name in _CHARTED_NAMES]
_OF_FAULT = ("step", "cause", "device", "remedy", "cable", "code")
_FAULT_COLUMNS = [faults.c[k] for k in _OF_FAULT]
#: Entries of a `ListedCycle` that are columns of the tables.
_AS_STORED = (
    *("line", "cycle", "part", "product", "reason"),
    *("model", "calibration", "software", "running_s"),
)
_SEEN_COLUMNS = [acknowledgements.c[k].label(f"seen_{k}") for k in ("at", "by", "note")]


#: Each cycle with its part, its fault and the acknowledgement.
_CYCLES = (
    cycles.outerjoin(parts, parts.c.id == cycles.c.part_id)
    .outerjoin(faults, faults.c.cycle_id == cycles.c.id)
    .outerjoin(acknowledgements, acknowledgements.c.cycle_id == cycles.c.id)
)


def _of_cycles(query: Select[Any], wanted: LedgerQuery) -> Select[Any]:
    """A query on the selected cycles; a database skips joins that it does not need."""
    return query.select_from(_CYCLES).where(*_conditions(wanted))


def _conditions(wanted: LedgerQuery) -> list[ColumnElement[bool]]:
    conditions: list[ColumnElement[bool]] = []
    if wanted.since is not None:
        conditions.append(cycles.c.ordered >= utc(wanted.since))
    if wanted.until is not None:
        conditions.append(cycles.c.ordered < utc(wanted.until))
    if wanted.outcomes:
        named = [o for o in wanted.outcomes if o != UNFINISHED]
        of = [cycles.c.outcome.in_(named)] if named else []
        if UNFINISHED in wanted.outcomes:
            of.append(cycles.c.outcome.is_(None))
        conditions.append(or_(*of))
    if wanted.acknowledged is not None:
        ack = acknowledgements.c.cycle_id
        condition = ack.is_not(None) if wanted.acknowledged else ack.is_(None)
        conditions += [faults.c.code.is_not(None), condition]
    if wanted.fault == "":
        conditions.append(faults.c.code.is_not(None))
    elif wanted.fault is not None:
        below = faults.c.code.startswith(f"{wanted.fault}.", autoescape=True)
        conditions.append(or_(faults.c.code == wanted.fault, below))
    if wanted.product == "":
        conditions.append(cycles.c.product.is_(None))
    elif wanted.product is not None:
        conditions.append(cycles.c.product == wanted.product)
    for column, value in (
        (cycles.c.line, wanted.line),
        (parts.c.code, wanted.part),
        (cycles.c.model, wanted.model),
    ):
        if value is not None:
            conditions.append(column == value)
    return conditions


def _estimates(connection: Connection, of: Select[Any]) -> dict[int, list[LedgerEstimate]]:
    """Parameters of the cycles of a query, by the number of their cycle."""
    chosen = of.with_only_columns(cycles.c.id, maintain_column_froms=True).subquery()
    columns = (parameters.c[k] for k in ("cycle_id", "name", "value", "low", "high"))
    query = select(*columns).join(chosen, chosen.c.id == parameters.c.cycle_id)
    by_cycle: dict[int, list[LedgerEstimate]] = {}
    for at, *values in connection.execute(query).all():
        by_cycle.setdefault(at, []).append(LedgerEstimate(*values))
    return by_cycle


def _aware(moment: datetime) -> datetime:
    """Local time, with its zone."""
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
