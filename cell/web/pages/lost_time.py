"""Lost time as a Pareto table: each cause with its share, its evidence and links to its cycles."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from datetime import time as time_of_day

from nicegui import run, ui

from cell.files.input_error import InputError
from cell.plant.users import Role
from cell.records.ledger.effectiveness import shift_start
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.ledger.losses import (
    CandidateForecasts,
    ShiftLosses,
    merged,
    minutes_in,
    read_forecasts,
    shift_losses,
)
from cell.settings.provenance import line_name
from cell.settings.records import LedgerSettings
from cell.web.theme import heading, table_head
from cell.web.visit import Visit
from cell.web.watching import WatchedState, read_ledger
from cell.web.wording import Translate
from cell.web.workspace import Workspace

#: Number of the newest candidates of the lab that are examined.
_CANDIDATES = 5
_HEADS = 7
#: Number of the newest linked cycles of a cause.
MOST_LINKS = 50


@dataclass(frozen=True)
class LossRow:
    """One cause, as texts.

    width   of its bar, as a share of the largest
    so_far  cumulative share of the lost time
    links   name of a cycle's folder, and its text; the newest first
    """

    cause: str
    minutes: str
    share: str
    so_far: str
    width: float
    evidence: str
    cycles: int
    links: tuple[tuple[str, str], ...]


def loss_rows(shifts: Sequence[ShiftLosses], t: Translate) -> list[LossRow]:
    """A row for each cause, the longest first, in a language."""
    losses = merged(shifts)
    lost_min = sum(minutes_in(loss.lasted) for loss in losses)
    rows: list[LossRow] = []
    so_far_min = 0.0
    for loss in losses:
        minutes = minutes_in(loss.lasted)
        so_far_min += minutes
        links = tuple(
            (c.folder.name, f"{c.started:%m-%d %H:%M:%S} · {c.cycle}")
            for c in reversed(loss.cycles[-MOST_LINKS:])
        )
        rows.append(
            LossRow(
                t(loss.text),
                t(f"{minutes:.1f}"),
                t(f"{100.0 * minutes / lost_min:.0f}"),
                t(f"{100.0 * so_far_min / lost_min:.0f}"),
                minutes / minutes_in(losses[0].lasted),
                "; ".join(t(text) for text in (loss.evidence, loss.physics) if text),
                len(loss.cycles),
                links,
            )
        )
    return rows


def time_text(shifts: Sequence[ShiftLosses], t: Translate) -> str:
    """Text of the use of the planned time, in a language."""
    if not shifts:
        return t("The cell has not run.")
    planned = sum(minutes_in(s.planned) for s in shifts)
    good = sum(minutes_in(s.productive) for s in shifts)
    cables = sum(s.inserted for s in shifts)
    return t(
        f"{planned:.1f} min planned = {good:.1f} min of inserted cables ({cables}) + "
        f"{planned - good:.1f} min lost"
    )


def waits_now(state: WatchedState, now_s: float) -> dict[str, float]:
    """Current waits of the cell by reason, s, which are not in the ledger yet.

    now_s  Unix time
    """
    status = state.status
    if status is None or not state.connected:
        return {}
    return dict.fromkeys(status.waiting_for[:1], now_s - status.since_s)


class LostTime:
    """Panel of the lost time: a table of causes with their share and evidence."""

    def __init__(self, visit: Visit) -> None:
        self._visit, self._t = visit, visit.t
        t = self._t
        with ui.card().classes("w-full overflow-x-auto"):
            with ui.row().classes("items-center w-full justify-between"):
                heading(t("Lost time"))
                days = {0: t("This shift"), 1: t("1 day"), 7: t("7 days")}
                self._days = ui.toggle(days, value=0).props("no-caps data-test=lost-days")
            self._summary = ui.label().props("data-test=lost-said")
            self._table = ui.element("table").classes("plain-table")
            self._table.props("data-test=lost-time")
        self._days.on_value_change(self._refresh)
        ui.timer(0.05, self._refresh, once=True)

    async def _refresh(self) -> None:
        if not self._visit.stays(Role.watch):
            return
        result = await run.io_bound(losses_since, self._visit, int(self._days.value or 0))
        if result is None:
            return
        shifts, error = result
        self._summary.text = self._t(error) if error else time_text(shifts, self._t)
        self._table.clear()
        rows, t = loss_rows(shifts, self._t), self._t
        heads = [t("Cause"), "", t("Minutes"), "%", t("Cumulative %"), t("Evidence"), t("Cycles")]
        self._table.set_visibility(bool(rows))
        with self._table:
            table_head(heads, (2, 3, 4))
            with ui.element("tbody"):
                for row in rows:
                    self._row(row)

    def _row(self, row: LossRow) -> None:
        with ui.element("tr").props("data-test=loss"):
            with ui.element("td"):
                ui.label(row.cause)
            with ui.element("td").style("min-width: 6rem"):
                bar = ui.element("div").classes("loss-bar")
                bar.style(f"width: {100.0 * row.width:.1f}%")
            for text in (row.minutes, row.share, row.so_far):
                with ui.element("td").classes("text-right"):
                    ui.label(text)
            with ui.element("td"):
                ui.label(row.evidence)
            with ui.element("td"):
                button = ui.button(str(row.cycles)).props("flat dense data-test=loss-cycles")
                button.set_visibility(row.cycles > 0)
        if row.cycles:
            links = ui.element("tr")
            with (
                links,
                ui.element("td").props(f"colspan={_HEADS}"),
                ui.row().classes("gap-x-4 gap-y-1"),
            ):
                for name, words in row.links:
                    ui.link(words, f"/cycle/{name}")
            links.set_visibility(False)
            button.on_click(lambda: links.set_visibility(not links.visible))


def losses_since(visit: Visit, days: int) -> tuple[list[ShiftLosses], str]:
    """Losses of the line, and an error if there are none.

    days  0 = the current shift
    """
    settings, now = visit.room.settings, datetime.now(UTC)
    options = settings.ledger or LedgerSettings()
    begins = [time_of_day.fromisoformat(t) for t in options.shifts]
    since = now - timedelta(days=days) if days else shift_start(begins, now.astimezone())
    wanted = LedgerQuery(since=since, line=line_name(settings))

    def read(ledger: Ledger) -> list[ShiftLosses]:
        return shift_losses(
            ledger,
            wanted,
            begins,
            now,
            options.ideal_cycle_s,
            candidate=_candidate(visit, ledger),
            waits_now=waits_now(visit.room.watch.state, time.time()),
        )

    shifts, error = read_ledger(settings, visit.room.runs, read)
    return shifts or [], error


def _candidate(visit: Visit, ledger: Ledger) -> CandidateForecasts | None:
    """The newest candidate of the lab that has forecasts of rejected or missed cables."""
    workspace = Workspace.of_runs(visit.room.runs)
    for name in workspace.names(workspace.candidates, ".yaml")[:_CANDIDATES]:
        with suppress(InputError):
            path = workspace.candidates / f"{name}.yaml"
            forecasts = read_forecasts(path, visit.room.settings, ledger)
            if forecasts.counts:
                return forecasts
    return None
