"""Commands about the ledger of cycles: history, acknowledge, actions."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import taking
from cell.cli.output import Delivery, deliver, print_json, show
from cell.cli.shared import STDOUT, AsJson, Force, MaybeConfig, group, refusing, user_name
from cell.cli.streams import emit
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.cli.cycle_tables import Part
    from cell.records.ledger.ledger import Ledger, LedgerQuery, ListedCycle
    from cell.settings.model import Settings

app = group()

#: Number of cycles that are shown by default.
_SHOWN = 20

Since = Annotated[
    str | None,
    typer.Option(
        help="Cycles that began at this time or later: 2026-11-01, 2026-11-01T06:00, 12h or 7d ago."
    ),
]
LedgerPlace = Annotated[
    str | None,
    typer.Option(
        "--runs",
        help="Folder of the cycles, or their ledger: a file or a database's URL.  Default: that of "
        "--config, else that of the folder `runs`, `runs.sqlite`.",
        show_default=False,
    ),
]


@dataclass(frozen=True)
class HistoryOptions:
    """Options of `cell history`."""

    config: MaybeConfig = None
    ledger: LedgerPlace = None
    since: Since = None
    until: Annotated[str | None, typer.Option(help="Cycles that began before this time.")] = None
    outcome: Annotated[
        list[str] | None,
        typer.Option(
            help="Cycles with this outcome: inserted, missed, rejected, failed, … or unfinished.  "
            "May be repeated."
        ),
    ] = None
    line: Annotated[str | None, typer.Option(help="Cycles of this line.")] = None
    part_id: Annotated[str | None, typer.Option("--part-id", help="Cycles of this part.")] = None
    product: Annotated[str | None, typer.Option(help="Cycles of this product.")] = None
    model: Annotated[str | None, typer.Option(help="Cycles with the model of this hash.")] = None
    fault: Annotated[
        str | None,
        typer.Option(help="Cycles that ended by this fault, such as `stop`, `arm` or `arm.limit`."),
    ] = None
    open_faults: Annotated[
        bool, typer.Option("--open", help="Faults that nobody has acknowledged.")
    ] = False
    most: Annotated[
        int | None,
        typer.Option("-n", "--most", min=1, help=f"The newest N cycles; tables show {_SHOWN}."),
    ] = None
    faults: Annotated[bool, typer.Option("--faults", help="Count faults by their code.")] = False
    oee: Annotated[
        bool, typer.Option("--oee", help="Availability, performance and quality of every shift.")
    ] = False
    losses: Annotated[
        bool,
        typer.Option("--losses", help="Causes of all time that did not end in an inserted cable."),
    ] = False
    candidate: Annotated[
        Path | None,
        typer.Option(
            help="For --losses: candidate of `cell learn`.  Tells which share of the rejected and "
            "missed cables its model would have inserted."
        ),
    ] = None
    as_json: AsJson = False
    csv: Annotated[
        Path | None, typer.Option(help="Write the cycles with their cables' parameters as CSV.")
    ] = None
    parquet: Annotated[Path | None, typer.Option(help="The same as Parquet.")] = None
    force: Force = False
    take_in: Annotated[
        list[Path] | None,
        typer.Option(
            "--import", help="Add cycles of this folder that are not listed.  May be repeated."
        ),
    ] = None

    def check(self) -> None:
        """Raises ValueError: options do not go together."""
        tables = {"--faults": self.faults, "--oee": self.oee, "--losses": self.losses}
        if len(listed := [name for name, wanted in tables.items() if wanted]) > 1:
            raise ValueError(f"{' and '.join(listed)} are different tables; give one of them")
        for option, path in (("--csv", self.csv), ("--parquet", self.parquet)):
            if path == STDOUT:
                raise ValueError(f"{option} -: give the name of a file; --json alone prints data")
        if self.candidate is not None and not (self.losses and self.config):
            raise ValueError(
                f"--candidate {self.candidate}: is for --losses, with the line's --config; add both"
            )
        chosen = {
            "--outcome": self.outcome, "--part-id": self.part_id, "--product": self.product,
            "--model": self.model, "--fault": self.fault, "--open": self.open_faults,
        }  # fmt: skip
        if self.losses and (filters := [name for name, value in chosen.items() if value]):
            raise ValueError(
                f"--losses is about all the time of a line: leave out {', '.join(filters)}"
            )

    def query(self, now: datetime) -> LedgerQuery:
        """Query for the requested cycles.  Raises ValueError: an option is wrong."""
        from cell.records.folder import UNFINISHED
        from cell.records.ledger.ledger import LedgerQuery

        since = parse_time(self.since, now, "--since")
        until = parse_time(self.until, now, "--until")
        if since is not None and until is not None and since >= until:
            raise ValueError(
                f"--since {self.since} is not before --until {self.until}: no time is between; "
                "exchange them"
            )
        outcomes = [
            UNFINISHED if o == "unfinished" else _checked_outcome(o) for o in self.outcome or ()
        ]
        return LedgerQuery(
            since=since,
            until=until,
            outcomes=tuple(outcomes),
            line=self.line,
            part=self.part_id,
            product=self.product,
            model=self.model,
            fault=self.fault,
            acknowledged=False if self.open_faults else None,
        )


@app.command()
@taking(HistoryOptions)
def history(options: HistoryOptions) -> None:
    """List past cycles of a line or a plant, count their faults, compute OEE, export.

    Every cycle of `cell run` is in the ledger: outcome, forecast and measured miss, the cable's
    parameters with 95 % intervals, times, fault with its code, model and calibration.

    Exit codes: 0; 2 if the ledger cannot be read or an option is wrong.
    """
    from cell.settings import load_settings

    with refusing(options.csv, options.parquet, force=options.force), ledger_errors():
        settings = None if options.config is None else load_settings(options.config)
        options.check()
        now = datetime.now(UTC)
        wanted = options.query(now)
        with open_ledger(settings, options.ledger, create=bool(options.take_in)) as ledger:
            added = [_import_cycles(ledger, folder, settings) for folder in options.take_in or ()]
            data, parts = _answer(ledger, wanted, options, settings, now)
            exported = _exports(ledger, wanted, options)

    def printed() -> None:
        if options.as_json:
            print_json(data)
        else:
            show(*added, *parts)

    deliver(printed, *exported)


def _answer(
    ledger: Ledger,
    wanted: LedgerQuery,
    options: HistoryOptions,
    settings: Settings | None,
    now: datetime,
) -> tuple[Any, Sequence[Part]]:
    """Requested data, as plain data and as tables."""
    from cell.cli.cycle_tables import cycles_parts, faults_parts, losses_parts, shifts_parts

    if options.faults:
        counts = ledger.faults(wanted)
        return faults_json(counts), faults_parts(counts)
    if options.oee or options.losses:
        from cell.records.ledger.effectiveness import shifts
        from cell.records.ledger.losses import read_forecasts, shift_losses
        from cell.settings.records import LedgerSettings as Section

        section = (None if settings is None else settings.ledger) or Section()
        begins = [time.fromisoformat(t) for t in section.shifts]
        if options.losses:
            learned = None
            if options.candidate is not None and settings is not None:
                learned = read_forecasts(options.candidate, settings, ledger)
            ideal_s = section.ideal_cycle_s
            losses = shift_losses(ledger, wanted, begins, now, ideal_s, candidate=learned)
            chosen = "shifts" in section.model_fields_set
            parts = losses_parts(losses, section.shifts, chosen=chosen)
            return [s.to_json() for s in losses], parts
        listed_shifts = shifts(ledger, wanted, begins, now, section.ideal_cycle_s)
        return [s.to_json() for s in listed_shifts], shifts_parts(listed_shifts)
    most = options.most if options.as_json else options.most or _SHOWN
    listed = ledger.listed(wanted, most, estimates=options.as_json)
    return [c.to_json() for c in listed], cycles_parts(listed, ledger.count(wanted))


def faults_json(counts: Sequence[tuple[str, int, str]]) -> list[dict[str, Any]]:
    """Faults as counted by `Ledger.faults`, as plain data."""
    return [{"code": code, "cycles": n, "newest_cause": cause} for code, n, cause in counts]


@contextmanager
def open_ledger(
    settings: Settings | None,
    place: str | None,
    *,
    create: bool = False,
    must_exist: bool = False,
) -> Iterator[Ledger]:
    """The ledger of an option, of the settings, or of the folder `runs`.

    create      make its tables, or bring them up to date …
    must_exist  … but make no new file
    raises      LedgerError: it cannot be used
    """
    from cell.records.ledger.database import need_file
    from cell.records.ledger.ledger import Ledger

    if place is None and settings is not None and settings.ledger is not None:
        place = settings.ledger.url
    if must_exist:
        need_file(place or Path("runs"))
    ledger = Ledger(place or Path("runs"), create=create)
    try:
        yield ledger
    finally:
        ledger.close()


def listed_cycles(settings: Settings, place: str | None, since: str | None) -> list[Path]:
    """Folders of the line's cycles in the ledger that have measured a cable, oldest first.

    raises  ValueError: the ledger cannot be read, or there are none
    """
    from cell.records.ledger.ledger import TELLING, LedgerQuery
    from cell.records.result import Outcome
    from cell.settings.provenance import line_name

    outcomes = (*TELLING, Outcome.MEASURED)
    wanted = LedgerQuery(
        since=parse_time(since, datetime.now(UTC), "--since"),
        outcomes=tuple(o.value for o in outcomes),
        line=line_name(settings),
        product=settings.product or "",
    )
    with ledger_errors(), open_ledger(settings, place) as ledger:
        folders = [c.folder for c in ledger.listed(wanted)]
    there = [f for f in folders if f.is_dir()]
    for gone in (f for f in folders if f not in there):
        print(f"left out: {gone}: is gone", file=sys.stderr)
    if not there:
        lately = "" if since is None else f" since {since}"
        raise ValueError(
            f"no cycle of {wanted.line}{lately} is listed whose folder is there; give folders of "
            "recorded cycles, or see `cell history`"
        )
    return there


@contextmanager
def ledger_errors() -> Iterator[None]:
    """Turn a LedgerError into a ValueError: for a command that only reads the ledger."""
    from cell.records.ledger.entry import LedgerError

    try:
        yield
    except LedgerError as error:
        raise ValueError(str(error)) from error


def parse_time(text: str | None, now: datetime, option: str) -> datetime | None:
    """Parse a typed time; None stays None.

    raises  ValueError: it is no time, or `--since` lies in the future
    """
    if text is None:
        return None
    parsed = _time(text, now, option)
    if option == "--since" and parsed > now:
        raise ValueError(
            f"{option} {text}: is to come, it is {now.astimezone():%Y-%m-%dT%H:%M} now; give a "
            "time that has been"
        )
    return parsed


def _time(text: str, now: datetime, option: str) -> datetime:
    try:
        if ago := re.fullmatch(r"(\d+)([hd])", text):
            number = int(ago[1])
            return now - (timedelta(hours=number) if ago[2] == "h" else timedelta(days=number))
        return datetime.fromisoformat(text).astimezone()
    except (ValueError, OverflowError) as error:  # before the year 1, or after 9999
        message = f"{option} {text}: no time; give 2026-11-01, 2026-11-01T06:00, 12h or 7d"
        raise ValueError(message) from error


def _checked_outcome(outcome: str) -> str:
    from cell.records.result import Outcome

    if outcome not in set(Outcome):
        known = ", ".join(Outcome)
        raise ValueError(f"--outcome {outcome}: no outcome; give one of {known} or unfinished")
    return outcome


def _import_cycles(ledger: Ledger, folder: Path, settings: Settings | None) -> str:
    """Import the cycles of a folder into the ledger; a sentence that counts them."""
    from cell.records.ledger.entry import entry_of_folder
    from cell.records.ledger.ledger import LedgerQuery
    from cell.settings.provenance import line_name

    if not folder.is_dir():
        raise ValueError(
            f"--import {folder}: is no folder of cycles; give the one that `cell run --runs` "
            "wrote to"
        )
    line = line_name(settings)
    known = {f"{c.line}/{c.folder.name}" for c in ledger.listed(LedgerQuery(line=line))}
    entries = [e for f in sorted(folder.iterdir()) if (e := entry_of_folder(f, line)) is not None]
    new = [e for e in entries if e.uid not in known]
    ledger.write(new, of_now=False)
    return (
        f"{folder}: {len(new)} of {counted(len(entries), 'cycle')} "
        f"{'is' if len(new) == 1 else 'are'} new to the ledger"
    )


def _exports(ledger: Ledger, wanted: LedgerQuery, options: HistoryOptions) -> list[Delivery]:
    """Requested output files, and what writes them."""
    from cell.records.ledger.ledger import need_parquet, write_csv, write_parquet

    if options.csv is None and options.parquet is None:
        return []
    if options.parquet is not None:
        need_parquet()
    listed = ledger.listed(wanted, options.most, estimates=True)
    csv, parquet = partial(write_csv, listed), partial(write_parquet, listed)
    return [(options.csv, csv), (options.parquet, parquet)]


def _ended_by_fault(faults: Sequence[ListedCycle], folder: Path) -> ListedCycle:
    """The cycle of a folder, or that of its name: records may be on other computers.

    raises  ValueError: there is none; or several lines have a cycle of this name
    """
    named = [c for c in faults if c.folder.name == folder.name]
    matches = [c for c in named if c.folder.resolve() == folder] or named
    if not matches:
        raise ValueError(f"{folder.name}: no cycle of this name was ended by a fault")
    if len(matches) > 1:
        lines = " and of ".join(c.line for c in matches)
        raise ValueError(f"{folder.name}: is a cycle of {lines}; say which line with --config")
    return matches[0]


@app.command()
def acknowledge(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders of failed cycles; default: the newest failed cycle."),
    ] = None,
    *,
    by: Annotated[str | None, typer.Option(help="Your name; default: the logged-in user.")] = None,
    note: Annotated[str, typer.Option(help="The cause that was found, and what was done.")] = "",
    everything: Annotated[
        bool, typer.Option("--all", help="All faults that nobody has acknowledged.")
    ] = False,
    config: MaybeConfig = None,
    ledger: LedgerPlace = None,
    as_json: AsJson = False,
) -> None:
    """Acknowledge that a fault was looked at: who, when, and what was done about it.

    The acknowledgement is stored in the ledger with the fault, and in the cycle's folder;
    `cell history --open` lists faults that nobody has acknowledged.  An acknowledgement moves
    nothing: after a fault the next `cell run` begins anew.

    Exit codes: 0; 2 if there is no such fault, or the ledger cannot be used.
    """
    from cell.records.folder import acknowledge_record
    from cell.records.ledger.entry import Acknowledgement
    from cell.records.ledger.ledger import LedgerQuery
    from cell.settings import load_settings
    from cell.settings.provenance import line_name

    with refusing(), ledger_errors():
        if everything and folders:
            raise ValueError("give folders or --all, not both")
        settings = None if config is None else load_settings(config)
        line = None if settings is None else line_name(settings)
        ack = Acknowledgement(datetime.now(UTC), by or user_name(), note)
        with open_ledger(settings, ledger, create=True, must_exist=True) as listed:
            wanted = LedgerQuery(line=line, fault="", acknowledged=None if folders else False)
            faults = listed.listed(wanted)
            chosen = faults if everything else faults[-1:]
            if folders:
                each = [_ended_by_fault(faults, folder.resolve()) for folder in folders]
                chosen = list({c.uid: c for c in each}.values())
            if not chosen:
                raise ValueError("no fault is open: every one was acknowledged, or there was none")
            for cycle in chosen:
                if cycle.folder.is_dir():  # not those of other computers, and removed ones
                    acknowledge_record(cycle.folder, ack.by, note)
            listed.acknowledge(chosen, ack)
    said = {**vars(ack), "at": ack.at.isoformat()}
    data = [
        {"folder": str(c.folder), "fault": c.fault.code, "cause": c.fault.cause, **said}
        for c in chosen
        if c.fault is not None
    ]
    if as_json:
        print_json(data)
        return
    for row in data:
        print(f"acknowledged by {ack.by}: {row['fault']}: {row['cause']}: {row['folder']}")


@app.command()
def actions(
    *,
    config: MaybeConfig = None,
    ledger: LedgerPlace = None,
    since: Since = None,
    most: Annotated[int, typer.Option("-n", "--most", min=1, help="The newest N.")] = 50,
    as_json: AsJson = False,
) -> None:
    """List what people have done at the pages: when, who, what, done or refused.

    `cell serve` takes them into the ledger from its log beside the records.

    Exit codes: 0; 2 if the ledger cannot be read.
    """
    from cell.records.ledger.actions import listed_actions
    from cell.settings import load_settings

    with refusing(), ledger_errors():
        place: str | Path = ledger or "runs"
        if ledger is None and config is not None:
            section = load_settings(config).ledger
            place = (section.url if section is not None else None) or place
        listed = listed_actions(place, parse_time(since, datetime.now(UTC), "--since"), most)
    if as_json:
        print_json([a.to_json() for a in listed])
        return
    for a in listed:
        done = "" if a.done else "  refused"
        emit(f"{a.at:%Y-%m-%d %H:%M:%S}  {a.by}  {a.action}{done}  {a.note}".rstrip())
