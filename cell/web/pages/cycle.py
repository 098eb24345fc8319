"""One cycle: film with a slider, the tip's path, times, parameters; protection of the film."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from nicegui import run, ui

from cell.files.input_error import InputError
from cell.files.table import TableData
from cell.plant.users import Role
from cell.records.recording import form
from cell.records.recording.film import is_protected, keep_recording
from cell.records.recording.retention import recording_room, remove_recording
from cell.run.machine import CellState
from cell.settings import load_settings
from cell.settings.translate import picture_size
from cell.web.cycle_view import (
    CycleView,
    cycle_folder,
    cycle_view,
    decision_chart,
    error_chart,
    tip_chart,
)
from cell.web.jobs import OPEN, JobState
from cell.web.lab_tasks import LabTasks, Subject
from cell.web.theme import (
    LOOKS,
    N_,
    asset,
    card,
    chart,
    confirmed,
    filled,
    notify_refusal,
    outlined,
    table,
)
from cell.web.views import PICTURES, step_word
from cell.web.visit import Visit, do

#: Slow-motion factor of the film.
_SLOWER = 10
#: Labels of the charts.
_NAMES = {
    "seen": N_("seen"),
    "predicted": N_("predicted"),
    "destination": N_("destination"),
    "above": N_("seen above predicted"),
    "right": N_("seen to the right of predicted"),
    "limit": N_("three standard deviations"),
    "time": N_("time since the beginning of the motion, s"),
    "error": N_("seen − predicted, mm"),
    "inside": N_("in the destination"),
    "correction": N_("correction"),
    "offset": N_("offset, mm"),
    "probability": N_("probability of passing, %"),
    "margin": N_("margin, mm"),
    "chosen": N_("executed"),
}
#: Tabs of the lab that begin with this cycle's study, and their questions.
_TO_LAB = {
    "compare": N_("Compare with the model"),
    "diagnose": N_("What does the model lack?"),
}
#: Polling interval of a replay's state, s.
_EVERY_S = 0.5


def build(visit: Visit, name: str) -> None:
    """Fill the page; slow parts are loaded later."""
    script = asset("film.js", SLOWER=str(_SLOWER))
    ui.add_body_html(f"<script>{script}</script>")
    with ui.column().classes("w-full max-w-7xl mx-auto p-2 gap-4"):
        with ui.row().classes("items-center gap-6"):
            ui.link(visit.t("Back to the history"), "/history")
            ui.link(visit.t("Report for printing"), f"/cycles/{name}/report", new_tab=True)
            page = _CyclePage(visit, name)
            if visit.has_role(Role.engineer):
                for tab, words in _TO_LAB.items():
                    link = ui.link(visit.t(words), f"/lab?study={name}&tab={tab}")
                    link.props(f"data-test=to-{tab}")
                outlined(visit.t("Replay"), "replay", page.replay, "replay").props("dense")
        page.place()
        ui.timer(0.01, page.fill, once=True)


class _CyclePage:
    """The elements of one open page."""

    def __init__(self, visit: Visit, name: str) -> None:
        self._visit, self._t, self._name = visit, visit.t, name
        self._hours: float | None = None
        self._replaying = 0

    def place(self) -> None:
        """Make the placeholders that are filled later."""
        self._replayed = ui.label().classes("w-full whitespace-pre-line break-words")
        self._replayed.props("role=status data-test=replayed").set_visibility(False)
        self._place = ui.column().classes("w-full gap-4")
        ui.timer(_EVERY_S, self._show_replay)

    def replay(self) -> None:
        """Repeat the cycle from its recording, in a separate process."""
        jobs, room = self._visit.room.lab.jobs, self._visit.room
        folder = cycle_folder(room.runs, self._name)
        if folder is None:
            ui.navigate.to("/history")
            return
        task = LabTasks(room.lab.workspace, room.config).replay(Subject(self._name, folder, True))
        refused = self._visit.do(
            "replay", Role.engineer, lambda: jobs.submit(task, self._visit.name), task.typed
        )
        notify_refusal(refused, self._t)
        if not refused:
            self._replaying = jobs.listed()[0].number

    def _show_replay(self) -> None:
        jobs = self._visit.room.lab.jobs.listed() if self._replaying else ()
        job = next((j for j in jobs if j.number == self._replaying), None)
        if job is None:
            return
        lines = (*job.printed, *(job.output if job.state is JobState.FAILED else ()))
        under_way = f"{self._t('Replay')}: {self._t('at work')} …"
        self._replayed.text = under_way if job.state in OPEN else "\n".join(map(self._t, lines))
        self._replayed.set_visibility(True)
        self._replaying = self._replaying if job.state in OPEN else 0

    async def fill(self) -> None:
        """Show the cycle as it is now."""
        folder = cycle_folder(self._visit.room.runs, self._name)
        if folder is None or not self._visit.has_role(Role.watch):
            ui.navigate.to("/history")
            return
        try:
            loaded = await run.io_bound(_load_cycle, self._visit, folder)
        except InputError as error:
            with self._place:
                ui.label(str(error)).classes("wrong break-words")
            return
        if loaded is None:
            return
        view, times, self._hours = loaded
        self._place.clear()
        with self._place:
            self._heading(view)
            with ui.element("div").classes("w-full grid grid-cols-1 lg:grid-cols-2 gap-4"):
                self._film(view, times)
                self._charts(view)
                self._table(self._t("Result"), view.numbers)
                self._table(self._t("Parameters of the cable"), view.parameters)
                self._spent(view)
                self._pictures(view)

    def _heading(self, view: CycleView) -> None:
        t = self._t
        title = f"{t('Cable')} {view.cycle}"
        ui.label(title).classes("text-2xl").props("role=heading aria-level=1")
        label = ui.label(t(view.summary)).classes("text-lg break-words").props("data-test=says")
        label.classes(add="" if view.good else "wrong")
        begun = f"{view.started:%Y-%m-%d %H:%M:%S}" if view.started else ""
        part = f"{t('Part')} {view.part}" if view.part else ""
        ui.label(" · ".join(filter(None, (begun, part, self._name)))).classes("break-all")

    def _film(self, view: CycleView, times: tuple[float, ...]) -> None:
        t = self._t
        with card(t("Film")):
            if view.no_film or not times:
                reason = view.no_film or N_("the recording has no frames")
                ui.label(t(reason)).classes("break-words").props("data-test=no-film")
            else:
                self._player(times)
                for gap in view.gaps:
                    ui.label(f"{t('Frames that are missing')}: {t(gap)}").classes("break-words")
            if not view.no_film and self._visit.has_role(Role.engineer):
                self._show_retention()

    def _player(self, times: tuple[float, ...]) -> None:
        t, base = self._t, f"/cycles/{self._name}/frames"
        frame = ui.element("img").classes("w-full")
        frame.props(f'id=film-frame src="{base}/0.jpg" alt="{t("Frame with the cable as seen")}"')
        slider = ui.element("input").classes("w-full film-slider")
        slider.props(f"id=film-slider type=range min=0 max={len(times) - 1} value=0 step=1")
        slider.props(f'aria-label="{t("Time in the film")}" data-test=slider')
        slider.on("input", js_handler="(e) => { film.stop(); film.show(Number(e.target.value)); }")
        with ui.row().classes("items-center w-full"):
            play = filled(t("Play, stop"), "play", None, "play_arrow")
            play.on("click", js_handler="() => film.play()")
            ui.label(f"0.000 s · 1/{len(times)}").props("id=film-time data-test=time")
            ui.label(f"{t('slower than reality:')} {_SLOWER} ×").classes("quiet")
        stamps = json.dumps([round(s, 4) for s in times])
        ui.run_javascript(f"film.stop(); film.times = {stamps}; film.base = {base!r}; film.at = 0;")

    @ui.refreshable_method
    def _show_retention(self) -> None:
        t = self._t
        protected = is_protected(self._visit.room.runs / self._name)
        with ui.row().classes("items-center"):
            words = t("The film is kept for good.") if protected else t("The film may be removed.")
            ui.label(words).props("data-test=kept")
            if self._hours is not None:
                fits = t("Room for films of so many hours of work:")
                ui.label(f"{fits} {self._hours:.1f}").classes("quiet").props("data-test=room")

            async def keep() -> None:
                action = "release recording" if protected else "keep recording"
                await self._did(action, lambda folder: keep_recording(folder, not protected))
                self._show_retention.refresh()

            label = t("Keep no longer") if protected else t("Keep for good")
            outlined(label, "keep", keep)
            if protected:
                return

            async def remove() -> None:
                question = t("Remove the film of this cycle? Its tables and pictures stay.")
                if await confirmed(question, t("Remove"), t, "remove-sure"):
                    why = f"by {self._visit.name} at the pages, {datetime.now():%Y-%m-%d}"
                    await self._did(
                        "remove recording", lambda folder: remove_recording(folder / form.FILE, why)
                    )
                    await self.fill()

            outlined(t("Remove"), "remove", remove)

    async def _did(self, action: str, change: Callable[[Path], None]) -> None:
        def act() -> str:
            folder = cycle_folder(self._visit.room.runs, self._name)
            if folder is None:
                return "the cycle's folder is gone"
            try:
                change(folder)
            except OSError as error:
                return f"{error.filename}: {error.strerror}"
            return ""

        await do(self._visit, action, Role.engineer, act, self._name)

    def _charts(self, view: CycleView) -> None:
        t, names = self._t, {key: self._t(word) for key, word in _NAMES.items()}
        for title, option in (
            (N_("Path of the tip"), tip_chart(view.flight, names)),
            (N_("Error of the forecast"), error_chart(view.flight, view.corrections, names)),
            (N_("Decision"), decision_chart(*view.decision, names)),
        ):
            if option:
                with card(t(title)):
                    chart(option, "h-96").props(f'role=img aria-label="{t(title)}"')

    def _table(self, title: str, data: TableData | None) -> None:
        if data is None or not data.rows:
            return
        translated = {0, *data.numbers}
        rows = [
            [self._t(cell) if at in translated else cell for at, cell in enumerate(row)]
            for row in data.rows
        ]
        table(title, [self._t(h or "quantity") for h in data.heads], rows, set(data.numbers))

    def _spent(self, view: CycleView) -> None:
        t = self._t
        rows = [
            [
                t("State") if kind == "state" else t("Step"),
                _word(t, kind, name),
                t(f"{seconds:.3f}"),
            ]
            for kind, spent in view.spent.items()
            for name, seconds in spent.items()
            if seconds > 0.0
        ]
        if rows:
            table(t("States and steps"), [t("Kind"), t("Name"), t("Time, s")], rows, {2})

    def _pictures(self, view: CycleView) -> None:
        for picture in view.pictures:
            title = self._t(PICTURES.get(Path(picture).stem, Path(picture).stem))
            with card(title):
                image = ui.element("img").classes("w-full")
                image.props(f'src="/cycles/{self._name}/pictures/{picture}" loading=lazy')
                image.props(f'alt="{title}"')


def _word(t: Callable[[str], str], kind: str, name: str) -> str:
    if kind == "state" and name in set(CellState):
        return t(LOOKS[CellState(name)].word)
    return t(step_word(name))


def _load_cycle(visit: Visit, folder: Path) -> tuple[CycleView, tuple[float, ...], float | None]:
    """The cycle, the times of its frames, and the hours of films that fit.  Raises InputError."""
    view = cycle_view(folder)
    times: tuple[float, ...] = ()
    if not view.no_film:
        try:
            times = visit.room.films.film(folder).times_s
        except OSError:  # removed at this moment
            times = ()
    return view, times, _hours_of_films(visit)


def _hours_of_films(visit: Visit) -> float | None:
    """Hours of films that fit; None = the settings cannot be read, or record none."""
    try:
        settings = load_settings(visit.room.config)
    except InputError:
        return None
    if settings.recording is None:
        return None
    width_px, height_px = picture_size(settings)
    return recording_room(visit.room.runs, settings.recording, width_px * height_px).hours
