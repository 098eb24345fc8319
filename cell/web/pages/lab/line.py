"""From the lab to the line: learn from many cables, compare candidates, promote and undo."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from nicegui import run, ui

from cell.files.input_error import InputError
from cell.settings.promotion import history_of, section_of
from cell.web.lab_views import candidate_table
from cell.web.pages.lab.desk import Desk, ShownFiles, first_lines, output, set_names
from cell.web.theme import card, confirmed, filled, outlined, several_of
from cell.web.workspace import is_name

#: Number of candidates that are shown side by side, the newest.
_SHOWN = 4


class LinePanel:
    """Panel that learns from many cables, compares candidates, promotes and undoes."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._t = desk, desk.t
        self._files = ShownFiles()
        t = self._t
        with card(t("Learn from recorded cables")):
            with ui.row().classes("items-center w-full gap-4"):
                self._name = ui.input(t("Name of the candidate")).classes("w-64")
                self._name.props("maxlength=60 data-test=candidate-name")
                self._name.value = f"candidate_{datetime.now():%Y%m%d_%H%M}"
                self._own = several_of(t("Own effects, tried too"), "learn-own", width="w-64")
                self._selected = ui.checkbox(t("Only the cycles selected under Study"))
            filled(t("Learn"), "learn", self._learn, "school")
        with card(t("Candidates")):
            self._place = ui.column().classes("w-full").props("data-test=candidates")
        with card(t("The line's model")):
            self._model = ui.label().classes("whitespace-pre-wrap font-mono text-sm break-words")
            self._model.props("data-test=line-model")
            self._undo_button = outlined(t("Undo the last promotion"), "undo", self._undo, "undo")
            ui.label(t("A cell that runs uses its model until it is started anew."))
        self._desk.listen(self._refresh)

    def _learn(self) -> None:
        desk, name = self._desk, str(self._name.value or "").strip()
        if not is_name(name):
            desk.notify_refusal(self._t("A name has letters, digits, _, - and dots."))
            return
        cycles = desk.cycles if self._selected.value else []
        if self._selected.value and not cycles:
            desk.notify_refusal(self._t("Select cycles under Study first."))
            return
        settings, own = desk.visit.room.settings, [str(e) for e in self._own.value or []]
        url = None if settings.ledger is None else settings.ledger.url
        ledger = str(url or desk.visit.room.runs)
        files = [desk.effect_file(e) for e in own]
        desk.ask(desk.tasks.learn(name, cycles, ledger, files))

    async def _refresh(self) -> None:
        desk = self._desk
        set_names(self._own, desk.own_effects())
        folder = desk.workspace.candidates
        names = [n for n in desk.workspace.names(folder, ".yaml") if not n.endswith("_motion")]
        paths = {name: folder / f"{name}.yaml" for name in names[:_SHOWN]}
        logs = [folder / f"{n}.txt" for n in desk.workspace.names(folder, ".txt")[:_SHOWN]]
        if not self._files.changed([*paths.values(), *logs, desk.visit.room.config]):
            return
        self._model.text = await run.io_bound(model_text, desk.visit.room.config) or ""
        self._undo_button.set_enabled(former_models(desk.visit.room.config) > 0)
        table = await run.io_bound(candidate_table, paths, self._t)
        self._place.clear()
        with self._place:
            if paths and table is not None:
                self._candidates(list(paths), *table)
            else:
                ui.label(self._t("There is no candidate yet."))
            for log in logs:
                ui.label("\n".join(first_lines(log))).classes("whitespace-pre-line break-words")
                output(f"{log.stem}: {self._t('As the command prints it')}", log)

    def _candidates(
        self, names: list[str], columns: list[dict[str, Any]], rows: list[dict[str, str]]
    ) -> None:
        """Candidates with their gates side by side, each with its button."""
        table = ui.table(columns=columns, rows=rows, row_key="gate").classes("w-full")
        table.props("dense flat wrap-cells hide-bottom data-test=gates")
        with ui.row():
            for name in names:
                button = ui.button(f"{self._t('Promote')} {name}", icon="publish")
                button.props("outline no-caps").on_click(lambda name=name: self._promote(name))
                button.props(f"data-test=promote-{name}")

    async def _promote(self, name: str) -> None:
        question = f"{self._t('Give the line this model?')} {name}"
        sure = await confirmed(question, self._t("Promote"), self._t, "promote-yes")
        if sure and await self._desk.run_promotion(self._desk.tasks.promote(name)):
            await self._desk.changed()

    async def _undo(self) -> None:
        question = self._t("Give the line its former model again?")
        sure = await confirmed(question, self._t("Undo"), self._t, "undo-yes")
        if sure and await self._desk.run_promotion(self._desk.tasks.undo()):
            await self._desk.changed()


def former_models(config: Path) -> int:
    """Number of promotions that can be undone."""
    files = history_of(config.resolve()).glob("*.yaml")
    return sum(".undone." not in path.name for path in files)


def model_text(config: Path) -> str:
    """Text of the section `model` in the settings' file, and the number of its changes."""
    try:
        section = section_of(config, config.read_text(encoding="utf-8"))
        count = former_models(config)
    except (OSError, ValueError, InputError) as error:
        return str(error)
    return f"{section or 'model: {effects: []}'}\n# {count} former models in {history_of(config)}"
