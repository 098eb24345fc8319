"""Past cycles: filters, the chart of the forecasts' errors, one click to a cycle's page."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from nicegui import run, ui

from cell.plant.users import Role
from cell.records.chart import signals
from cell.records.folder import UNFINISHED
from cell.records.ledger.ledger import Ledger, LedgerQuery, ListedCycle
from cell.records.result import Outcome
from cell.settings.model import Settings
from cell.settings.provenance import line_name
from cell.web.pages.lost_time import LostTime
from cell.web.theme import chart, columns, show_option
from cell.web.views import WORDS, error_chart, history_row, reasons_text
from cell.web.visit import Visit
from cell.web.watching import read_ledger
from cell.web.wording import Translate

#: Number of the newest cycles that are shown.
MOST = 300
_DAYS = (1, 7, 30, 0)

#: The first cell of a row links to the cycle's page.
_LINK = """
<q-td :props="props">
  <a :href="`/cycle/${props.row.name}`" class="underline whitespace-nowrap">{{ props.value }}</a>
</q-td>
"""


def build(visit: Visit) -> None:
    """Fill the page."""
    t = visit.t
    ui.label(t("History")).classes("text-2xl").props("role=heading aria-level=1")
    with ui.row().classes("items-end w-full"):
        names: dict[str | None, str] = {
            None: t("all"),
            **{o: t(WORDS[o]) for o in (*(o.value for o in Outcome), UNFINISHED)},
        }
        outcome = ui.select(names, label=t("Outcome"), value=None).classes("w-48")
        days = ui.select({d: f"{d} d" if d else t("all") for d in _DAYS}, label=t("Since"), value=7)
        days.classes("w-32")
        part = ui.input(t("Part")).props("clearable maxlength=100")
        made = visit.room.settings.products
        product = ui.select(
            {None: t("all"), **{n: n for n in made}}, label=t("Product"), value=None
        )
        product.classes("w-40").set_visibility(bool(made))
    message = ui.label().classes("whitespace-pre-line")
    reasons = ui.label().classes("whitespace-pre-line break-words").props("data-test=reasons")
    LostTime(visit)
    errors = chart({})
    heads = columns(
        ("started", t("Begun")),
        ("cycle", t("Cable")),
        ("part", t("Part")),
        *([("product", t("Product"))] if made else []),
        ("outcome", t("Outcome")),
        ("predicted", t("Predicted miss") + ", mm"),
        ("measured", t("Measured miss") + ", mm"),
        ("why", t("Reason")),
    )
    table = ui.table(
        columns=[{**head, "sortable": True} for head in heads],
        rows=[],
        row_key="name",
        pagination=20,
    ).classes("w-full")
    no_data = t("No such cycles")
    table.props(
        f'wrap-cells data-test=cycles no-data-label="{no_data}" rows-per-page-label="{t("Rows")}"'
    )

    table.add_slot("body-cell-started", _LINK)

    async def refresh() -> None:
        if not visit.stays(Role.watch):
            return
        since = datetime.now(UTC) - timedelta(days=days.value) if days.value else None
        outcomes = (outcome.value,) if outcome.value else ()
        wanted = LedgerQuery(
            since=since,
            outcomes=outcomes,
            line=line_name(visit.room.settings),
            part=(part.value or "").strip() or None,
            product=product.value,
        )
        result = await run.io_bound(_query, visit, wanted)
        if result is None:
            return
        cycles, changes, error = result
        table.rows = [history_row(c, t) for c in reversed(cycles)]
        names = (t("Error of the forecast"), t("± 3 σ expected"), t("Rejected or failed"))
        options = error_chart(cycles, (*names, t("Cable")))
        errors.set_visibility(bool(options["xAxis"]["data"]))
        show_option(errors, options)
        nothing = t("Nothing has changed in the newest cycles.")
        message.text = t(error) or "\n".join(changes) or nothing
        figures = visit.room.watch.state.figures
        lines = reasons_text(figures.reasons, t) if figures else ""
        reasons.text = f"{t('This shift')}:\n{lines}" if lines else ""

    for filtered in (outcome, days, part, product):
        filtered.on_value_change(refresh)
    ui.timer(0.05, refresh, once=True)


def _query(visit: Visit, wanted: LedgerQuery) -> tuple[list[ListedCycle], list[str], str]:
    """Cycles of a query, signals of the line's charts, and an error if there are none."""
    settings = visit.room.settings

    def read(ledger: Ledger) -> tuple[list[ListedCycle], list[str]]:
        changes = changes_of(ledger, settings, wanted.product, visit.t)
        return ledger.listed(wanted, MOST), changes

    result, error = read_ledger(settings, visit.room.runs, read)
    return *(result or ([], [])), error


def changes_of(ledger: Ledger, settings: Settings, product: str | None, t: Translate) -> list[str]:
    """Control-chart signals of the newest model, of one product or of each.  Raises LedgerError."""
    names: list[str | None] = [*settings.products] if product is None else [product]
    texts = []
    for name in names or [None]:
        results = ledger.results(line_name(settings), name)
        newest = [r for r in results if r.model == results[-1].model]
        texts += [f"{name}: {t(str(s))}" if name else t(str(s)) for s in signals(newest)]
    return texts
