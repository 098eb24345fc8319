"""Panel of the diagnosis, with its checks, and of the motion that would be most informative."""

from __future__ import annotations

from pathlib import Path

from nicegui import run, ui

from cell.cable.effects import library, unscreened
from cell.web.heartbeat import on_press
from cell.web.jobs import JobTask
from cell.web.lab_views import (
    VERDICTS,
    Data,
    check_rows,
    error_steps,
    parameter_lines,
    ranking_rows,
    read_result,
)
from cell.web.pages.lab.desk import (
    Desk,
    NeedsStudy,
    ShownFiles,
    first_lines,
    frame,
    output,
    printed,
    set_names,
)
from cell.web.theme import (
    card,
    chart,
    columns,
    filled,
    heading,
    manual_page,
    outlined,
    several_of,
)

_PASSED = """
<q-td :props="props">
  <span :style="{color: props.row.passed === 'False' ? '#d64545' : 'inherit',
                 fontWeight: props.row.passed === 'False' ? 700 : 400}">
    {{ props.row.passed === 'True' ? '✓' : props.row.passed === 'False' ? '✗' : '' }}
    {{ props.value }}</span>
</q-td>
"""


#: A check's question as a link to its entry in the manual.
_LINKED = """
<q-td :props="props">
  <a :href="'ENTRY#' + props.row.name" target="_blank" class="underline">{{ props.value }}</a>
</q-td>
"""


class DiagnosePanel:
    """Panel of the diagnosis: checks, effects, and the next motion."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._t = desk, desk.t
        self._files = ShownFiles()
        self._needs_study = NeedsStudy(desk)
        t = self._t
        with card(t("What does the model lack?")):
            with ui.element("div").classes("w-full grid grid-cols-1 md:grid-cols-2 gap-4"):
                self._tried = several_of(t("Own effects, tried too"), "tried", width="")
                self._known = several_of(t("Known: part of the model"), "known", width="")
            self._line = ui.checkbox(t("Start from the line's model"))
            with ui.row():
                diagnose = filled(t("Diagnose"), "diagnose", self._diagnose, "troubleshoot")
                suggest = outlined(t("Suggest the next motion"), "suggest", self._suggest, "route")
                self._needs_study.of(diagnose, suggest)
        self._place = ui.column().classes("w-full gap-4").props("data-test=diagnosis")
        self._desk.listen(self._refresh)

    def _names(self) -> tuple[list[str], list[str]]:
        known = [str(k) for k in self._known.value or []]
        tried = [str(e) for e in self._tried.value or [] if e not in known]
        return [self._desk.effect_file(e) for e in tried], [
            self._desk.effect_file(e) for e in known
        ]

    def _diagnose(self) -> None:
        desk = self._desk
        if (subject := desk.subject_or_refusal()) is not None:
            desk.ask(desk.tasks.diagnose(subject, *self._names(), bool(self._line.value)))

    def _suggest(self) -> None:
        desk = self._desk
        if (subject := desk.subject_or_refusal()) is not None:
            desk.ask(desk.tasks.suggest(subject, *self._names()))

    async def _refresh(self) -> None:
        self._needs_study.refresh()
        own = self._desk.own_effects()
        set_names(self._tried, own)
        set_names(self._known, [*own, *library()])
        names = ("diagnosis.json", "motion.yaml", "suggest.txt")
        files = [p for name in names if (p := self._desk.result(name)) is not None]
        if not self._files.changed(files):
            return
        data = await run.io_bound(read_result, files[0]) if files else None
        self._place.clear()
        with self._place:
            if data is not None:
                self._show(data)
            if files and (files[1].exists() or files[2].exists()):
                self._motion(files[1])

    def _show(self, data: Data) -> None:
        desk, t = self._desk, self._t
        with ui.card().classes("w-full"):
            verdict = VERDICTS.get(str(data["verdict"]), str(data["verdict"]))
            ui.label(t(verdict)).classes("text-xl font-bold").props("data-test=verdict")
            log = desk.result("diagnosis.txt")
            ui.label("\n".join(first_lines(log))).classes("whitespace-pre-line break-words")
            parameters = ui.label("\n".join(parameter_lines(data)))
            parameters.classes("font-mono whitespace-pre-line break-words")
            parameters.props("data-test=parameters")
            entry = manual_page("reference/effects.html")
            for effect in (m["effect"] for m in data["missing"]):
                if entry and effect in library() | unscreened():
                    words = f"{effect}: {t('law, limits and remedy')}"
                    ui.link(words, f"{entry}#{effect}", new_tab=True)
            chart(error_steps(data, t), "h-72").props("data-test=falling")
            frame(desk, "diagnosis.html", t("Report with the evidence"))
            output(t("As the command prints it"), log)
        with ui.element("div").classes("w-full grid grid-cols-1 xl:grid-cols-3 gap-4"):
            with ui.card().classes("w-full xl:col-span-2"):
                heading(t("Checks"))
                self._checks(data)
            with card(t("Effects, each alone")):
                heads = columns(
                    ("effect", t("Effect")),
                    ("score", t("χ² explained")),
                    ("p", "p"),
                    ("status", t("Status")),
                )
                table = ui.table(columns=heads, rows=ranking_rows(data), row_key="effect")
                table.classes("w-full").props("dense flat data-test=ranking")

    def _checks(self, data: Data) -> None:
        t = self._t
        heads = columns(
            ("question", t("Question")),
            ("statistic", t("Statistic")),
            ("limit", t("Limit")),
            ("result", t("Result")),
            ("said", t("What it says")),
        )
        table = ui.table(columns=heads, rows=check_rows(data, t), row_key="name")
        table.classes("w-full").props("dense flat wrap-cells data-test=checks")
        table.add_slot("body-cell-result", _PASSED)
        if entry := manual_page("reference/checks.html"):
            table.add_slot("body-cell-question", _LINKED.replace("ENTRY", entry))

    def _motion(self, motion: Path) -> None:
        """The suggested motion, and the command that measures a cable with it."""
        desk, t = self._desk, self._t
        with ui.card().classes("w-full").props("data-test=motion"):
            heading(t("The next motion"))
            log = desk.result("suggest.txt")
            printed(log)
            if motion.exists() and desk.subject is not None:
                ui.label(t("Measure a cable with it, where the cell is:"))
                task = desk.tasks.measure(desk.subject, desk.visit.room.runs)
                ui.code(task.typed, language="bash").classes("w-full")
                self._measuring(task)
                ui.label(t("Then gather both cycles into a study, and diagnose it."))

    def _measuring(self, task: JobTask) -> None:
        """A button that starts a measurement after a person's confirmation."""
        desk, t = self._desk, self._t
        with ui.dialog() as dialog, ui.card():
            ui.label(t("The gripper grips a cable and moves. Stay beside it, clear of its way."))

            async def measure(asked_s: float) -> None:
                dialog.close()
                desk.ask(task, asked_s)

            with ui.row():
                button = filled(t("Measure now"), "measure-now")
                on_press(desk.visit.heartbeats, button, t("Measure now"), measure)
                ui.button(t("Close"), on_click=dialog.close).props("outline")
        outlined(t("Measure"), "measure", dialog.open, "straighten")
