"""The line's page: state, step, buttons, fault, newest cable, figures of the shift."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Mapping
from datetime import datetime

from nicegui import run, ui

from cell.plant.users import Role
from cell.run.machine import MachineEvent
from cell.web.cycle_view import cycle_folder, newest_picture
from cell.web.heartbeat import on_press
from cell.web.theme import AMBER, AWAY, BLUE, GREEN, N_, RED
from cell.web.views import (
    WORDS,
    LiveView,
    adapters_text,
    fault_texts,
    live_view,
    reasons_text,
)
from cell.web.visit import Visit

#: The page is brought up to date so often, s.
_EVERY_S = 0.4

_BUTTONS = (
    (MachineEvent.START, N_("Start"), "play_arrow", GREEN),
    (MachineEvent.HOLD, N_("Hold"), "pause", AMBER),
    (MachineEvent.UNHOLD, N_("Continue"), "play_arrow", GREEN),
    (MachineEvent.STOP, N_("Stop"), "stop", RED),
)


def build(visit: Visit) -> None:
    """Fill the page."""
    _Live(visit).build()


class _Live:
    """The elements of one open page, which are changed in place."""

    def __init__(self, visit: Visit) -> None:
        self._visit, self._t = visit, visit.t
        self._updates: list[Callable[[LiveView], None]] = []

    def build(self) -> None:
        """Make the elements, and keep them up to date."""
        heading = ui.label(self._t("Live")).classes("unseen")
        heading.props("role=heading aria-level=1")
        with ui.element("div").classes("w-full grid grid-cols-1 lg:grid-cols-3 gap-4"):
            with ui.column().classes("lg:col-span-2 w-full gap-4"):
                self._state()
                self._fault()
                self._adapters()
                if self._visit.has_role(Role.operate):
                    self._commands()
                self._camera()
                self._newest()
            with ui.column().classes("w-full gap-4"):
                self._shift()
        page, control = self._visit.page, self._visit.room.control
        ui.context.client.on_delete(lambda: control.release(page))
        ui.timer(_EVERY_S, self._update)
        self._update()

    def _update(self) -> None:
        if not self._visit.has_role(Role.watch, used=False):
            ui.navigate.to("/login")
            return
        view = live_view(self._visit.room.watch.state, time.time())
        for update in self._updates:
            update(view)

    def _state(self) -> None:
        with ui.card().classes("w-full gap-1").props("id=state-card") as card:
            word = ui.label().classes("state-plate").props("role=status data-test=state")
            step = ui.label().classes("text-xl").props("data-test=step")
            cycle = ui.label().classes("text-xl").props("data-test=cycle")
            unrecorded = ui.label(self._t("This cycle is not recorded."))
            unrecorded.classes("text-xl").props("data-test=unrecorded")

        def update(view: LiveView) -> None:
            card.style(f"background-color: {view.style.ground}; color: {view.style.letters}")
            word.text = self._t(view.style.word)
            seconds = "" if view.step_s is None else f" · {view.step_s:.0f} s"
            waits = ", ".join(self._t(WORDS.get(w, w)) for w in view.waiting)
            step.text = f"{self._t(view.step)}{seconds}" if view.step else self._t(view.note)
            if waits and not view.step:
                step.text = f"{self._t('Waits for')} {waits}"
            if view.style is AWAY:
                step.text = self._t(view.note) or self._t(
                    "Start it with cell run --cycles forever."
                )
            if view.unknown_s is not None:
                at = datetime.fromtimestamp(view.unknown_s).astimezone()
                step.text = f"{self._t('State unknown since')} {at:%H:%M:%S}"
            named = [f"{self._t('Cable')} {view.cycle}"] if view.cycle else []
            named += [f"{self._t('Part')} {view.part}"] if view.part else []
            cycle.text = " · ".join([*named, *([view.product] if view.product else [])])
            unrecorded.set_visibility(bool(view.step) and self._visit.room.camera.unrecorded)

        self._updates.append(update)

    def _commands(self) -> None:
        visit, t = self._visit, self._t
        page = visit.page
        with ui.card().classes("w-full"):
            with ui.row().classes("items-center w-full"):
                who = ui.label().classes("text-lg").props("data-test=control")
                take = ui.button(t("Take control"), color=BLUE, on_click=self._take)
                take.props("text-color=white data-test=take")
                release = ui.button(
                    t("Release control"), on_click=lambda: visit.room.control.release(page)
                ).props("outline")
            part = (
                ui.input(t("Part id, if it has one"))
                .props("maxlength=200 data-test=part")
                .classes("w-full")
            )
            buttons: dict[MachineEvent, ui.button] = {}
            with ui.row().classes("gap-3 w-full"):
                for event, word, icon, colour in _BUTTONS:
                    button = ui.button(t(word), icon=icon, color=colour)
                    button.classes("big-button").props(f"data-test={event.value}")
                    button.props(f"text-color={'black' if event is MachineEvent.HOLD else 'white'}")
                    on_press(visit.heartbeats, button, t(word), self._command_handler(event, part))
                    buttons[event] = button
            ui.label(t("Stop is not an emergency stop: that is the red button at the robot."))

        def update(view: LiveView) -> None:
            holder = visit.room.control.keep_alive(page)
            mine = holder is not None and holder.page == page
            who.text = (
                t("You have control.")
                if mine
                else t("Nobody has control.")
                if holder is None
                else f"{holder.name} {t('has control.')}"
            )
            take.set_visibility(not mine and (holder is None or holder.name == visit.name))
            release.set_visibility(mine)
            part.set_enabled(mine)
            for event, button in buttons.items():
                stop = event is MachineEvent.STOP
                button.set_enabled(event in view.buttons and (mine or stop))

        self._updates.append(update)

    def _take(self) -> None:
        visit = self._visit

        def act() -> str:
            holder = visit.room.control.take(visit.page, visit.name)
            return "" if holder.page == visit.page else f"{holder.name} has control"

        self._notify_refusal(visit.do("take control", Role.operate, act))
        self._update()

    def _command_handler(
        self, event: MachineEvent, part: ui.input
    ) -> Callable[[float], Awaitable[None]]:
        async def give(asked_s: float) -> None:
            code = (part.value or "").strip() if event is MachineEvent.START else ""
            self._notify_refusal(await run.io_bound(self._visit.command, event, asked_s, code))
            if event is MachineEvent.START:
                part.value = ""
            self._update()

        return give

    def _notify_refusal(self, refused: str | None) -> None:
        if refused:
            words = self._t(refused)
            ui.notify(words, type="negative", multi_line=True, close_button=self._t("Close"))

    def _fault(self) -> None:
        t = self._t
        with ui.card().classes("w-full border-4 border-red-700").props("role=alert") as card:
            heading = ui.label().classes("text-xl font-bold")
            cause = ui.label().classes("text-lg break-words").props("data-test=cause")
            remedy = ui.label().classes("whitespace-pre-line break-words")
            operates = self._visit.has_role(Role.operate)
            if operates:
                by = ui.input(
                    t("Your name"),
                    value="" if self._visit.room.sessions is None else self._visit.name,
                ).classes("w-full")
                note = ui.input(t("What you found and did")).classes("w-full")
                by.props("maxlength=60 data-test=by")
                note.props("maxlength=500 data-test=note")

                async def acknowledge(asked_s: float) -> None:
                    if not (by.value.strip() and note.value.strip()):
                        self._notify_refusal(t("Give your name, and what you found and did."))
                        return
                    words = (by.value.strip(), note.value.strip())
                    refused = await run.io_bound(self._visit.acknowledge, asked_s, *words)
                    self._notify_refusal(refused)
                    if not refused:
                        note.value = ""
                    self._update()

                async def reset(asked_s: float) -> None:
                    self._notify_refusal(
                        await run.io_bound(self._visit.command, MachineEvent.RESET, asked_s)
                    )
                    self._update()

                word = N_("Acknowledge: nothing moves")
                saying = ui.button(t(word), color=BLUE)
                on_press(self._visit.heartbeats, saying, t(word), acknowledge)
                saying.classes("big-button").props("text-color=white data-test=acknowledge")
                word = N_("Reset: the jaws open, the gripper goes home")
                moving = ui.button(t(word), color=AMBER)
                on_press(self._visit.heartbeats, moving, t(word), reset)
                moving.classes("big-button").props("text-color=black data-test=reset")

        def update(view: LiveView) -> None:
            asked = MachineEvent.CLEAR in view.buttons or "acknowledgement" in view.waiting
            may_reset = MachineEvent.RESET in view.buttons and view.style.word == "Stopped"
            card.set_visibility(view.fault is not None or asked or may_reset)
            if operates:
                for element in (by, note, saying):
                    element.set_visibility(asked)
                moving.set_visibility(may_reset and not asked)
            heading.text = t("A person must look first.") if asked else t("Acknowledged.")
            cause.text = remedy.text = ""
            if view.fault is not None:
                heading.text, cause.text, remedy.text = fault_texts(view.fault, t)

        self._updates.append(update)

    def _camera(self) -> None:
        t, camera = self._t, self._visit.room.camera
        with ui.card().classes("w-full") as card:
            ui.label(t("Camera")).classes("text-xl font-bold")
            age = ui.label().classes("quiet").props("data-test=age")
            picture = ui.element("img").classes("w-full max-w-xl")
            picture.props(f'alt="{t("Camera picture of the cycle under way")}" data-test=camera')
        shown = [0]

        def update(view: LiveView) -> None:
            newest = camera.ask() if view.step else None
            card.set_visibility(newest is not None)
            if newest is None:
                return
            seconds = max(0.0, time.time() - newest.taken_s)
            age.text = f"{t('Picture as recorded, two a second; its age:')} {seconds:.0f} s"
            if newest.number != shown[0]:
                shown[0] = newest.number
                picture.props(f'src="/live/{newest.number}.jpg"')

        self._updates.append(update)

    def _adapters(self) -> None:
        """Troubles with programs between the cell and the plant: quiet, nobody need acknowledge."""
        with ui.card().classes("w-full py-2").props("role=status") as card:
            said = ui.label().classes("quiet whitespace-pre-line break-words")
            said.props("data-test=adapters")

        def update(view: LiveView) -> None:
            card.set_visibility(bool(view.adapters))
            said.text = adapters_text(view.adapters, self._t)

        self._updates.append(update)

    def _newest(self) -> None:
        t = self._t
        with ui.card().classes("w-full") as card:
            outcome = ui.label().classes("text-xl font-bold").props("data-test=outcome")
            why = ui.label().classes("break-words").props("data-test=why")
            figures = _Figures(t)
            picture = (
                ui.image("")
                .classes("w-full max-w-3xl")
                .props(f'alt="{t("Newest picture")}" no-spinner')
            )
            link = ui.link(t("All of this cycle"), "/history")
        shown = [""]

        def update(view: LiveView) -> None:
            outcome.text = f"{t('Newest cable')}: {t(WORDS.get(view.outcome, view.outcome))}"
            why.text = t(view.reason)
            why.set_visibility(bool(view.reason))
            figures.show(view.result)
            if view.folder != shown[0]:
                shown[0] = view.folder
                folder = cycle_folder(self._visit.room.runs, view.folder)
                there = folder is not None and newest_picture(folder) is not None
                picture.set_visibility(there)
                picture.set_source(f"/cycles/{view.folder}/newest" if there else "")
                link.props(f'href="/cycle/{view.folder}"')
            card.set_visibility(bool(view.folder))

        self._updates.append(update)

    def _shift(self) -> None:
        t = self._t
        with ui.card().classes("w-full"):
            ui.label(t("This shift")).classes("text-xl font-bold")
            counts, shares = _Figures(t), _Figures(t)
            unplanned = ui.label(
                t("No OEE: set `ledger.shifts`, the times at which shifts begin, to plan the time.")
            )
            unplanned.classes("quiet").props("data-test=unplanned")
        with ui.card().classes("w-full") as card:
            ui.label(t("Reasons")).classes("text-xl font-bold")
            reasons = ui.label().classes("whitespace-pre-line break-words")
            reasons.props("data-test=reasons")

        def update(view: LiveView) -> None:
            counts.show({WORDS.get(k, k): str(n) for k, n in view.counts.items()})
            shares.show(view.shift)
            unplanned.set_visibility(not view.has_planned_time)
            card.set_visibility(bool(view.reasons))
            reasons.text = reasons_text(view.reasons, t)

        self._updates.append(update)


class _Figures:
    """Figures with their headings in a row; elements are made once for each heading."""

    def __init__(self, t: Callable[[str], str]) -> None:
        self._t = t
        self._shown: dict[str, tuple[ui.element, ui.label]] = {}
        self._row = ui.row().classes("gap-x-6 gap-y-2 w-full")

    def show(self, figures: Mapping[str, str]) -> None:
        """Show these in their order, in place of those before."""
        is_new = False
        for heading, text in figures.items():
            if heading not in self._shown:
                with self._row, ui.element("div").classes("flex flex-col") as place:
                    ui.label(self._t(heading)).classes("text-sm")
                    self._shown[heading] = (place, ui.label().classes("figure"))
                    is_new = True
            self._shown[heading][1].text = self._t(text)
        if is_new:
            for at, heading in enumerate(figures):
                self._shown[heading][0].move(target_index=at)
        for heading, (place, _) in self._shown.items():
            place.set_visibility(heading in figures)
