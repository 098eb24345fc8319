"""Page of the calibrations: age and quality of each; repeats one, instruction by instruction."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial

from nicegui import ui

from calib.store import KINDS, CalibrationFileError, StoredCalibration, load
from cell.calibration import assistants
from cell.files.input_error import InputError
from cell.plant.users import Role
from cell.settings import load_settings
from cell.settings.calibrated import bounds_of, calibration_file, complaint_of
from cell.settings.loading import products_of
from cell.settings.model import Settings
from cell.web.guided import OpenQuestion, calibrate_command
from cell.web.heartbeat import on_press
from cell.web.theme import BLUE, GREEN, N_, RED, card, table
from cell.web.visit import Visit, do

#: Titles of the calibrations.
WORDS = {
    "camera": N_("Camera: lens"),
    "cell": N_("Cell: map from pixels to the plane"),
    "time": N_("Time: latency and lag"),
    "grip": N_("Grip: gripping point, clamp angle, free length"),
}
#: Suffix of an error's name → displayed unit, factor from the SI unit.
_UNITS = {"m": ("mm", 1e3), "s": ("ms", 1e3), "rad": ("°", 180.0 / math.pi), "px": ("px", 1.0)}
#: The error of a lens that is shown in addition to the bounded ones.
_ALSO = ("spread_95_px", "noise_px", "held_out_rms_m")


@dataclass(frozen=True)
class CalibrationPart:
    """One calibration.

    name   of its file, without the suffix
    made   local time; None = there is none
    valid  whether `cell run` may use it
    why    reason if not, or ""
    errors heading → value with its bound
    """

    kind: str
    name: str
    made: datetime | None
    age_h: float
    most_h: float
    valid: bool
    why: str
    errors: tuple[tuple[str, str], ...]


def parts(settings: Settings, now: datetime | None = None) -> tuple[CalibrationPart, ...]:
    """All calibrations of a cell, in the order in which they are made; a grip for each product."""
    now = now or datetime.now(UTC)
    each = [(kind, settings) for kind in KINDS if kind != "grip"]
    each += [("grip", of) for of in products_of(settings).values() or [settings]]
    return tuple(_part(kind, of, now) for kind, of in each)


def _part(kind: str, settings: Settings, now: datetime) -> CalibrationPart:
    wanted = settings.calibration
    assert wanted is not None
    most_h = wanted.time_max_age_h if kind == "time" else 24.0 * wanted.max_age_days
    path = calibration_file(settings, kind)
    missing = CalibrationPart(kind, path.stem, None, math.nan, most_h, False, "", ())
    if not path.exists():
        return missing
    try:
        stored = load(path, kind)
        why = complaint_of(stored, wanted, settings, now) or ""
        errors = _errors(stored, settings)
    except (CalibrationFileError, ValueError) as error:
        return replace(missing, why=str(error))
    made, age_h = stored.made.astimezone(), stored.age_h(now)
    return CalibrationPart(kind, path.stem, made, age_h, most_h, not why, why, errors)


def _errors(stored: StoredCalibration, settings: Settings) -> tuple[tuple[str, str], ...]:
    assert settings.calibration is not None
    bounds = bounds_of(settings.calibration)
    rows = []
    for name in (*bounds, *_ALSO):
        if name not in stored.error:
            continue
        unit, size = _UNITS[name.rpartition("_")[2]]
        text = f"{float(stored.error[name]) * size:.3g} {unit}"
        if name in bounds:
            text += f" ≤ {bounds[name] * size:.3g} {unit}"
        rows.append((name.rpartition("_")[0].replace("_95", " 95 %").replace("_", " "), text))
    return tuple(rows)


#: Interval of the page's updates, s.
_EVERY_S = 0.5
#: Commands that can be started: word of the command, heading.
_STARTS = (
    ("", N_("Everything")),
    ("camera", N_("Camera")),
    ("cell", N_("Cell")),
    ("time", N_("Time")),
    ("grip", N_("Grip")),
    ("check", N_("Check")),
)


def build(visit: Visit) -> None:
    """Fill the page."""
    t = visit.t
    ui.label(t("Calibration")).classes("text-2xl").props("role=heading aria-level=1")
    try:
        settings = load_settings(visit.room.config)
    except InputError as error:
        ui.label(str(error)).classes("wrong break-words")
        return
    if settings.calibration is None:
        words = t("The settings have no section `calibration`: camera.view is typed by hand.")
        ui.label(words).props("data-test=uncalibrated")
        return
    _CalibrationPage(visit, settings)


class _CalibrationPage:
    """The elements of one open page."""

    def __init__(self, visit: Visit, settings: Settings) -> None:
        self._visit, self._t, self._settings = visit, visit.t, settings
        self._updates: list[Callable[[], None]] = []
        self._ran = False
        self._question = OpenQuestion(visit.room.guided)
        self._guide()
        self._states()
        self._starts()
        ui.timer(_EVERY_S, self._update)
        self._update()

    def _update(self) -> None:
        if not self._visit.stays(Role.engineer, used=False):
            return
        for update in self._updates:
            update()
        runs = self._visit.room.guided.state.runs
        if self._ran and not runs:
            self._states.refresh()
        self._ran = runs

    @ui.refreshable_method
    def _states(self) -> None:
        """Table of the calibrations."""
        t = self._t
        listed = parts(self._settings)
        heads = [t("Calibration"), t("State"), t("Made"), t("Age"), t("Errors and bounds")]
        rows = [
            [
                t(WORDS[p.kind]) + p.name.removeprefix(p.kind).replace(".", " ", 1),
                self._state(p),
                "" if p.made is None else f"{p.made:%Y-%m-%d %H:%M}",
                "" if p.made is None else t(f"{_hours(p.age_h)} ≤ {_hours(p.most_h)}"),
                "\n".join(f"{t(name)}: {t(text)}" for name, text in p.errors),
            ]
            for p in listed
        ]
        table(t("What there is"), heads, rows, set())
        with ui.row().classes("gap-4"):
            for p in listed:
                if p.made is not None:
                    ui.link(f"{t('Report')}: {p.name}", f"/calibration/{p.name}", new_tab=True)

    def _state(self, part: CalibrationPart) -> str:
        missing = part.made is None and not part.why
        word = N_("valid") if part.valid else N_("missing") if missing else N_("not valid")
        return f"{self._t(word)} {self._t(part.why)}".strip()

    def _starts(self) -> None:
        t, room = self._t, self._visit.room
        with card(t("Calibrate anew")):
            words = t("Needs the devices: end the cell first. The gripper moves within the limits.")
            ui.label(words)
            runs = ui.label(t("A cell runs now: end it first.")).classes("wrong")
            runs.props("data-test=cell-runs")
            buttons = []
            with ui.row():
                for part, title in _STARTS:
                    products = [*self._settings.products] if part == "grip" else []
                    for product in products or [""]:
                        words, name = f"{t(title)} {product}".strip(), f"{part or 'all'}{product}"
                        button = ui.button(words, color=BLUE)
                        on_press(
                            self._visit.heartbeats, button, t(title), self._start(part, product)
                        )
                        button.props(f'text-color=white no-caps data-test="start-{name}"')
                        buttons.append(button)

        def update() -> None:
            there = room.watch.state.may_run
            runs.set_visibility(there)
            for button in buttons:
                button.set_enabled(not there and not room.guided.state.runs)

        self._updates.append(update)

    def _start(self, part: str, product: str = "") -> Callable[[float], Awaitable[None]]:
        async def start(asked_s: float) -> None:
            visit = self._visit
            command = calibrate_command(part, visit.room.config, product)
            title = " ".join(filter(None, ("calibrate", part, product)))

            def act() -> str:
                return visit.room.with_devices(lambda: visit.room.guided.start(title, command))

            await do(visit, title, Role.engineer, act, asked_s=asked_s)

        return start

    def _guide(self) -> None:
        t, guided = self._t, self._visit.room.guided
        with ui.card().classes("w-full") as card:
            title = ui.label().classes("text-xl font-bold").props("data-test=guided")
            ask = (
                ui.label().classes("text-2xl break-words guide").props("role=status data-test=ask")
            )
            with ui.row() as answers:
                for words, word, colour in (("", N_("Done, go on"), GREEN), ("n", N_("No"), BLUE)):
                    button = ui.button(t(word), color=colour)
                    on_press(self._visit.heartbeats, button, t(word), self._answer(words))
                    button.classes("big-button").props(
                        f'text-color=white data-test="answer{words}"'
                    )
            bar = ui.linear_progress(show_value=False).props(f'aria-label="{t("Progress")}"')
            output = ui.label().classes("whitespace-pre-line break-words font-mono")
            output.props("data-test=guided-said")
            picture = ui.element("img").classes("w-full max-w-3xl")
            picture.props(f'alt="{t("Corners of the board seen so far; the newest in orange")}"')
            cancel = ui.button(t("Cancel"), color=RED, on_click=self._cancel)
            cancel.props("text-color=white data-test=cancel")
        shown = [0.0]

        def update() -> None:
            state = guided.state
            card.set_visibility(bool(state.title))
            ended = "" if state.runs else self._ended(state.code)
            title.text = f"{t(state.title)}: {ended}" if ended else t(state.title)
            ask.text = t(state.ask)
            answers.set_visibility(self._question.refresh())
            bar.set_visibility(state.runs and state.total > 0)
            bar.value = state.done / state.total if state.total else 0.0
            output.text = "\n".join(map(t, state.output[-(4 if state.runs else 12) :]))
            cancel.set_visibility(state.runs)
            written_s = self._coverage_s()
            picture.set_visibility(written_s > state.started_s)
            if written_s > max(state.started_s, shown[0]):
                shown[0] = written_s
                picture.props(f'src="/calibration/coverage.jpg?{written_s}"')

        self._updates.append(update)

    def _ended(self, code: int | None) -> str:
        t = self._t
        words = {0: t("done"), 1: t("done, but not good enough")}
        return words.get(code or 0, t("nothing came of it"))

    def _coverage_s(self) -> float:
        """Unix time of the picture of the coverage; 0 = there is none."""
        assert self._settings.calibration is not None
        try:
            return (self._settings.calibration.folder / assistants.FILE).stat().st_mtime
        except OSError:
            return 0.0

    def _answer(self, words: str) -> Callable[[float], Awaitable[None]]:
        async def answer(asked_s: float) -> None:
            to = self._visit.room.guided.state.ask
            note, act = f"{to} {words or 'done'}", partial(self._question.answer, words)
            await do(self._visit, "answer calibration", Role.engineer, act, note, asked_s=asked_s)

        return answer

    async def _cancel(self) -> None:
        cancel = self._visit.room.guided.cancel
        await do(self._visit, "cancel calibration", Role.engineer, cancel)


def _hours(hours: float) -> str:
    return f"{hours / 24.0:.1f} d" if hours >= 48.0 else f"{hours:.1f} h"
