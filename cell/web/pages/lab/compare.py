"""Panels that compare fitted models on the study: errors by time, place, frequency."""

from __future__ import annotations

from typing import Any

from nicegui import run, ui

from cell.cable.effects import library
from cell.web.lab_tasks import BASELINE
from cell.web.lab_views import PLACES, Data, failing_places, model_errors, read_result, trials_of
from cell.web.pages.lab.desk import (
    Desk,
    NeedsStudy,
    ShownFiles,
    first_lines,
    frame,
    output,
    set_names,
)
from cell.web.theme import card, chart, filled, several_of, show_option
from cell.web.workspace import is_name


class ModelsPanel:
    """Panel of the fitted models and their comparison."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._t = desk, desk.t
        self._needs_study = NeedsStudy(desk)
        t = self._t
        with ui.element("div").classes("w-full grid grid-cols-1 lg:grid-cols-2 gap-4"):
            with card(t("Fit a model")):
                self._name = ui.input(t("Name"), value=BASELINE).classes("w-full")
                self._name.props("maxlength=60 data-test=model-name")
                self._effects = several_of(t("Effects in it"), "model-effects")
                self._line = ui.checkbox(t("Start from the line's model"))
                button = filled(t("Fit"), "fit", self._fit, "tune")
                self._needs_study.of(button)
            with card(t("Compare models")):
                self._models = several_of(t("Models, in order"), "models")
                button = filled(t("Compare"), "compare", self._compare, "compare")
        self._shown = ComparePanel(self._desk, "compare")
        self._desk.listen(self._refresh)

    async def _refresh(self) -> None:
        self._needs_study.refresh()
        set_names(self._effects, [*self._desk.own_effects(), *library()])
        models = self._desk.models()
        selected = [m for m in self._models.value or [] if m in models]
        self._models.set_options(models, value=selected or models)
        await self._shown.refresh()

    def _fit(self) -> None:
        desk, name = self._desk, str(self._name.value or "").strip()
        if (subject := desk.subject_or_refusal()) is None:
            return
        if not is_name(name):
            desk.notify_refusal(self._t("A name has letters, digits, _, - and dots."))
        else:
            effects = [desk.effect_file(e) for e in self._effects.value or []]
            desk.ask(desk.tasks.fit(subject, name, effects, bool(self._line.value)))

    def _compare(self) -> None:
        desk, models = self._desk, list(self._models.value or [])
        if desk.subject is None or not models:
            desk.notify_refusal(self._t("Fit a model first."))
        else:
            desk.ask(desk.tasks.compare(desk.subject, models, ()))


class ComparePanel:
    """A comparison that a command wrote: errors as bars, and where they are in each trial."""

    def __init__(self, desk: Desk, name: str) -> None:
        self._desk, self._t, self._file = desk, desk.t, name
        self._shown = ShownFiles()
        self._place = ui.column().classes("w-full gap-4").props(f"data-test=shown-{name}")

    async def refresh(self) -> None:
        """Show its present state on the disk."""
        path = self._desk.result(f"{self._file}.json")
        if not self._shown.changed([] if path is None else [path]):
            return
        data = None if path is None else await run.io_bound(read_result, path)
        self._place.clear()
        if data is not None:
            with self._place:
                self._show(data)

    def _show(self, data: Data) -> None:
        desk, t = self._desk, self._t
        with ui.card().classes("w-full"):
            log = desk.result(f"{self._file}.txt")
            for line in first_lines(log):
                ui.label(line).classes("break-words text-lg").props("data-test=sentence")
            chart(model_errors(data, t), "h-72").props("data-test=errors")
            frame(desk, f"{self._file}.html", t("Every trial with a time slider"))
            output(t("As the command prints it"), log)
        with card(t("Where they fail")):
            trials = trials_of(data)
            trial = ui.select(trials, value=trials[0], label=t("Trial")).classes("w-64")
            with ui.element("div").classes("w-full grid grid-cols-1 lg:grid-cols-3 gap-4"):
                charts: dict[str, Any] = {}
                for place, (words, *_) in PLACES.items():
                    with ui.column().classes("w-full gap-0"):
                        ui.label(t(words)).classes("font-bold")
                        option = failing_places(data, place, trials[0], t)
                        charts[place] = chart(option)

            def choose() -> None:
                for place in PLACES:
                    show_option(charts[place], failing_places(data, place, trial.value, t))

            trial.on_value_change(choose)
