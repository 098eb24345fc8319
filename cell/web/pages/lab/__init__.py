"""The lab's page: a study, where models fail on it, what is missing, own effects, the line."""

from __future__ import annotations

from nicegui import ui

from cell.web.lab_tasks import Subject
from cell.web.pages.lab import compare, diagnose, line, own, study
from cell.web.pages.lab.desk import Desk
from cell.web.pages.lab.strip import Strip
from cell.web.theme import N_
from cell.web.visit import Visit

_TABS = (
    ("study", N_("Study"), "folder_open", study.StudyPanel),
    ("compare", N_("Compare"), "compare", compare.ModelsPanel),
    ("diagnose", N_("Diagnose"), "troubleshoot", diagnose.DiagnosePanel),
    ("own", N_("Own effect"), "edit_note", own.OwnEffectPanel),
    ("line", N_("Line"), "conveyor_belt", line.LinePanel),
)


def build(visit: Visit) -> None:
    """Fill the page."""
    t, desk = visit.t, Desk(visit)
    request = ui.context.client.request
    parameters = request.query_params if request is not None else {}
    tab = parameters.get("tab", "")
    opened = tab if tab in {name for name, *_ in _TABS} else "study"
    desk.subject = desk.find(parameters.get("study", "")) or _newest(desk)
    with ui.row().classes("items-center w-full gap-4"):
        ui.label(t("Lab")).classes("text-2xl").props("role=heading aria-level=1")
        study.chooser(desk)
        again = ui.button(icon="refresh", on_click=desk.changed).props("flat round")
        again.props(f'data-test=reload aria-label="{t("Read again")}"').tooltip(t("Read again"))
    Strip(desk)
    with ui.tabs().classes("w-full").props("align=left inline-label no-caps") as tabs:
        for name, title, icon, _ in _TABS:
            ui.tab(name, t(title), icon).props(f"data-test=tab-{name}")
    with (
        ui.tab_panels(tabs, value=opened, animated=False)
        .classes("w-full bg-transparent")
        .props("keep-alive")
    ):
        for name, _, _, part in _TABS:
            with ui.tab_panel(name).classes("p-0 gap-4"):
                part(desk)
    ui.timer(0.05, desk.begin, once=True)


def _newest(desk: Desk) -> Subject | None:
    """The study of the newest job, else the newest study."""
    jobs = [j.task.subject for j in desk.lab.jobs.listed()]
    names = (*jobs, *desk.workspace.names(desk.workspace.studies))
    return next((s for name in names if (s := desk.find(name)) is not None), None)
