"""Panel of the study: choose, upload, import, gather from cycles, look at."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from nicegui import run, ui

from cell.plant.users import Role
from cell.records.ledger.ledger import LedgerQuery
from cell.settings.provenance import line_name
from cell.web.cycle_view import cycle_folder
from cell.web.guard import MOST_BYTES
from cell.web.lab_tasks import MAPPING, PREVIEW, Subject
from cell.web.pages.lab.desk import Desk, frame, notes_after_tables, output
from cell.web.theme import N_, asset, card, columns, filled, heading, outlined, several_of
from cell.web.views import history_row
from cell.web.visit import do
from cell.web.watching import read_ledger
from cell.web.workspace import plain


def drop_zone(desk: Desk, uploaded: Callable[[dict[str, Any]], Awaitable[None]]) -> None:
    """Build the drop zone; `uploaded` gets the server's answer to an accepted upload."""
    t = desk.t
    ui.add_css(asset("upload.css"))
    with ui.element("div").classes("drop-zone w-full").props("data-test=drop"):
        ui.label(t("Drop a study's folder, a .zip of it, or tables (CSV, Excel, MAT, C3D …) here."))
        with ui.row().classes("gap-2"):
            for name, words, options in (
                ("files", N_("Choose files"), "multiple"),
                ("folder", N_("Choose a folder"), "webkitdirectory"),
            ):
                with ui.element("label"):
                    ui.label(t(words)).classes("inline")
                    ui.element("input").props(f"type=file {options} data-test=upload-{name}")
        ui.label(f"{t('At most')} {MOST_BYTES >> 20} MiB").classes("text-sm opacity-70")
        ui.label().classes("drop-said font-bold")

    async def heard(event: Any) -> None:
        answer = event.args if isinstance(event.args, dict) else {}
        if "error" in answer:
            desk.notify_refusal(str(answer["error"]))
        elif isinstance(answer.get("name"), str):
            await uploaded(answer)

    ui.on("lab_uploaded", heard)
    script = asset(
        "upload.js",
        MOST=str(MOST_BYTES - 65536),
        TOO_LARGE=json.dumps(t("Too large: upload less at once.")),
        BROKEN=json.dumps(t("The connection broke: try again.")),
    )
    ui.timer(0.1, lambda: ui.run_javascript(script), once=True)


#: Name of the example's study.
_EXAMPLE = "example"
#: Ways to begin without a study: name, title, description, label and icon of the button.
_WAYS = (
    (
        "cycles",
        N_("Recorded cycles"),
        N_("A recorded cycle is a study. Several cycles of one cable can be gathered."),
        N_("Show cycles"),
        "history",
    ),
    (
        "files",
        N_("My measurements"),
        N_("Upload tables, check what each column was taken for: a few minutes."),
        N_("Choose files"),
        "upload_file",
    ),
    (
        "example",
        N_("The example"),
        N_("Tables of a simulated cable whose model lacks an effect: ten seconds."),
        N_("Make the example"),
        "science",
    ),
)
#: Number of the newest cycles that are offered.
_MOST_CYCLES = 200
#: End of the line with the page of pictures, which is shown instead.
_PICTURES = "pictures of every trial"
#: Data that files lack: option of `cell import`, description, unit, its size in SI units.
_ENTRIES = (
    ("--free-length", N_("Free length"), "mm", 1e-3),
    ("--line-density", N_("Mass per length"), "g/m", 1e-3),
    ("--width", N_("Width"), "mm", 1e-3),
    ("--thickness", N_("Thickness"), "mm", 1e-3),
    ("--diameter", N_("Diameter, if round"), "mm", 1e-3),
    ("--rate", N_("Rows a second, without times"), "1/s", 1.0),
)


def chooser(desk: Desk) -> None:
    """The choice of the study, above all parts of the page."""
    chosen = ui.select({}, label=desk.t("Study")).classes("min-w-64 grow max-w-lg")
    chosen.props("data-test=subject options-dense")

    async def refresh() -> None:
        studies = desk.workspace.names(desk.workspace.studies)
        names = [name for name in studies if desk.find(name) is not None]
        subject = desk.subject
        if subject is not None and subject.name not in names:
            names.insert(0, subject.name)
        chosen.set_options(names, value=None if subject is None else subject.name)

    async def choose(event: Any) -> None:
        if event.value and (desk.subject is None or event.value != desk.subject.name):
            await desk.choose(str(event.value))

    chosen.on_value_change(choose)
    desk.listen(refresh)


class StudyPanel:
    """Panel that chooses, uploads, imports and shows the study."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._t = desk, desk.t
        with ui.card().classes("w-full") as self._card:
            self._shown = ui.column().classes("w-full")
        with ui.card().classes("w-full") as self._begin:
            self._ways()
        with card(self._t("Upload")):
            drop_zone(self._desk, self._uploaded)
            self._form = _ImportForm(self._desk)
        with ui.card().classes("w-full"):
            self._cycles = _Cycles(desk)
        self._desk.listen(self._refresh)

    def _ways(self) -> None:
        """Ways to begin while there is no study, with descriptions."""
        t = self._t
        heading(t("Begin with"))
        with ui.element("div").classes("w-full grid grid-cols-1 md:grid-cols-3 gap-4"):
            for name, title, takes, word, icon in _WAYS:
                with ui.column().classes("gap-2"):
                    ui.label(t(title)).classes("font-bold")
                    ui.label(t(takes)).classes("grow")
                    button = ui.button(t(word), icon=icon).props(f"outline data-test=way-{name}")
                if name == "cycles":
                    button.on_click(lambda: self._cycles.open())
                elif name == "files":
                    choose = "() => document.querySelector('[data-test=upload-files]').click()"
                    button.on("click", js_handler=choose)
                else:
                    button.on_click(self._make_example)

    def _make_example(self) -> None:
        if self._desk.ask(self._desk.tasks.make_example(_EXAMPLE)):
            self._desk.choose_when_made(_EXAMPLE)

    async def _uploaded(self, answer: dict[str, Any]) -> None:
        name = str(answer["name"])  # sent by a browser: only an existing name counts
        if answer.get("is_study"):
            await self._desk.choose(name)
        elif files := self._desk.workspace.uploaded(name):
            self._form.show(name, files)

    async def _refresh(self) -> None:
        desk, subject = self._desk, self._desk.subject
        self._card.set_visibility(subject is not None)
        self._begin.set_visibility(subject is None)
        self._shown.clear()
        if subject is None:
            return
        self._form.hide_if_made(subject.name)
        with self._shown:
            heading(subject.name)
            if subject.to_import:
                self._mapping(subject)
                return
            log = desk.result("look.txt")
            lines = notes_after_tables(log, ("Odd:", "To be mended:", "Nothing is odd."))
            label = ui.label("\n".join(line for line in lines if not line.endswith(_PICTURES)))
            label.classes("break-words whitespace-pre-wrap").props("data-test=look-said")
            output(self._t("As the command prints it"), log)
            frame(desk, "look.html", self._t("Pictures of every trial"), opened=True)

            def look() -> None:
                desk.ask(desk.tasks.show_study(subject))

            outlined(self._t("Look at it"), "look", look, "visibility")

    def _mapping(self, subject: Subject) -> None:
        """The proposed mapping, to be checked and edited."""
        desk, t = self._desk, self._t
        path = subject.folder / MAPPING
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            ui.label(str(error))
            return
        output(t("What was understood"), subject.folder / "import.txt")
        frame(desk, PREVIEW, t("Preview"))
        ui.label(t("Check the mapping; what is missing is marked null."))
        editor = ui.codemirror(text, language="YAML", theme=desk.editor_theme).classes("w-full")
        editor.style("height: 26rem").props("data-test=mapping")

        async def write() -> None:
            save = partial(desk.lab.save_mapping, path, editor.value)
            if await do(desk.visit, "lab mapping", Role.engineer, save, subject.name):
                desk.ask(desk.tasks.write_study(subject))

        filled(t("Make the study"), "write-study", write, "done")


class _ImportForm:
    """Form for data of uploaded tables, before a mapping is proposed."""

    def __init__(self, desk: Desk) -> None:
        self._desk, t = desk, desk.t
        self._upload, self._files = "", list[str]()
        with ui.column().classes("w-full") as self._place:
            self._what = ui.label().classes("font-bold break-words")
            ui.label(t("State what you know; the rest is read from the files."))
            self._entries: dict[str, tuple[ui.number, float]] = {}
            with ui.row().classes("gap-4"):
                for key, words, unit, size in _ENTRIES:
                    entry = ui.number(f"{t(words)}, {unit}", min=0).classes("w-48")
                    entry.props(f"data-test=entry{key}")
                    self._entries[key] = (entry, size)
            self._logs = several_of(t("Files of the gripper, if apart"), "gripper-logs")
            filled(t("Propose a mapping"), "propose", self._propose, "table_view")
        self._place.set_visibility(False)

    def show(self, upload: str, files: list[str]) -> None:
        """Show the form for the files of an upload."""
        self._upload, self._files = upload, files
        self._what.text = f"{upload}: {', '.join(files[:10])}{' …' if len(files) > 10 else ''}"
        self._logs.set_options(files, value=[])
        self._place.set_visibility(True)

    def hide_if_made(self, study: str) -> None:
        """Hide the form once the study of its files exists."""
        if study == self._upload:
            self._place.set_visibility(False)

    async def _propose(self) -> None:
        desk, logs = self._desk, list(self._logs.value or [])
        files = [f for f in self._files if f not in logs]
        stated = {
            option: float(entry.value) * size
            for option, (entry, size) in self._entries.items()
            if entry.value
        }
        task = desk.tasks.propose(self._upload, files, logs, stated)
        if desk.ask(task):  # the form stays until there is a study: its data may be wrong
            desk.choose_when_made(self._upload)


class _Cycles:
    """Recorded cycles: one is a study, and several of one cable can be gathered."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._t = desk, desk.t
        t = self._t
        self._place = ui.expansion(t("Recorded cycles"), icon="history").classes("w-full")
        with self._place.props("data-test=cycles-open"):
            self._message = ui.label()
            heads = columns(
                ("started", t("Begun")),
                ("part", t("Part")),
                ("outcome", t("Outcome")),
                ("name", t("Folder")),
            )
            self._table = ui.table(
                columns=heads, rows=[], row_key="name", selection="multiple", pagination=8
            ).classes("w-full")
            self._table.props(f'data-test=cycles rows-per-page-label="{t("Rows")}"')
            self._table.on_select(self._selected)
            with ui.row():
                outlined(t("Work on this cycle"), "use-cycle", self._use, "check")
                outlined(t("Gather into one study"), "gather", self._gather, "merge")
            ui.label(t("Gather cycles of one cable: the first is fitted to, the others held out."))
        self._place.on_value_change(self._opened)

    def open(self) -> None:
        """Show the cycles."""
        self._place.open()
        self._place.run_method("$el.scrollIntoView")

    async def _opened(self, event: Any) -> None:
        if not event.value:
            return
        result = await run.io_bound(self._query)
        if result is not None:
            self._table.rows, self._message.text = result
            self._message.set_visibility(bool(self._message.text))

    def _query(self) -> tuple[list[dict[str, str]], str]:
        room = self._desk.visit.room
        query = LedgerQuery(line=line_name(room.settings))
        cycles, error = read_ledger(
            room.settings, room.runs, lambda ledger: ledger.listed(query, _MOST_CYCLES)
        )
        return [history_row(cycle, self._t) for cycle in reversed(cycles or [])], self._t(error)

    def _selected(self) -> None:
        runs = self._desk.visit.room.runs
        names = sorted(str(row["name"]) for row in self._table.selected)
        folders = (cycle_folder(runs, name) for name in names)
        self._desk.cycles = [f for f in folders if f is not None]

    async def _use(self) -> None:
        if len(self._desk.cycles) != 1:
            self._desk.notify_refusal(self._t("Select one cycle."))
            return
        await self._desk.choose(self._desk.cycles[0].name)

    async def _gather(self) -> None:
        desk = self._desk
        if len(desk.cycles) < 2:
            desk.notify_refusal(self._t("Select two cycles or more, of one cable."))
            return
        first = desk.cycles[0].name.replace(".", "_")
        name = plain(f"cycles_{first}_{len(desk.cycles)}")
        if desk.ask(desk.tasks.gather(desk.cycles, name)):
            desk.choose_when_made(name)
