"""The line's page, on one screen: state, picture, newest cables, commands; a fault if there is one.

After ISA-101 (human machine interfaces for process automation systems) colours mark only items that
need a person; after IEC 60204-1 Start is white and Stop black, and no screen button is red.
A button calls `Visit.command`, which sends the command to the service (`cell.plant.client`).
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from nicegui import run, ui

from cell.plant.users import Role
from cell.records.ledger.ledger import ListedCycle
from cell.run.machine import MachineEvent
from cell.settings.loading import products_of
from cell.web.cycle_view import cycle_folder, newest_picture
from cell.web.heartbeat import on_press
from cell.web.theme import AMBER, AWAY, BLUE, N_, NORMAL, asset, chart, notify_refusal, show_option
from cell.web.views import (
    OUTCOME_MARKS,
    SHIFT_DEFINITIONS,
    WORDS,
    LiveView,
    adapters_text,
    compact,
    error_chart,
    fault_texts,
    live_view,
    miss_chart,
    why_disabled,
)
from cell.web.visit import Visit
from cell.web.wording import Translate

#: Interval of the page's updates, s.
_EVERY_S = 0.4

_BUTTONS = (
    (MachineEvent.START, N_("Start"), "play_arrow"),
    (MachineEvent.HOLD, N_("Hold"), "pause"),
    (MachineEvent.UNHOLD, N_("Continue"), "play_arrow"),
    (MachineEvent.STOP, N_("Stop"), "stop"),
)


def build(visit: Visit) -> None:
    """Fill the page."""
    _Live(visit)


class _Live:
    """The elements of one open page, which are changed in place."""

    def __init__(self, visit: Visit) -> None:
        self._visit, self._t = visit, visit.t
        self._updates: list[Callable[[LiveView], None]] = []
        ui.add_css(asset("live.css"))
        heading = ui.label(self._t("Live")).classes("unseen")
        heading.props("role=heading aria-level=1")
        with ui.element("div").classes("live"):
            with ui.element("div").classes("live-column"):
                self._state()
                self._person()
                self._picture()
            with ui.element("div").classes("live-column"):
                self._cables()
                if self._visit.has_role(Role.operate):
                    self._commands()
                else:
                    ui.label(self._t(N_("You may only watch (role watch).")))
        page, control = self._visit.page, self._visit.room.control
        ui.context.client.on_delete(lambda: control.release(page))
        ui.timer(_EVERY_S, self._update)
        self._update()

    def _update(self) -> None:
        if not self._visit.stays(Role.watch, used=False):
            return
        view = live_view(self._visit.room.watch.state, time.time())
        for update in self._updates:
            update(view)

    def _state(self) -> None:
        with ui.element("div") as plate:
            with ui.element("div").classes("flex items-baseline gap-x-6"):
                word = ui.label().classes("state-plate").props("role=status data-test=state")
                step = ui.label().classes("text-xl").props("data-test=step")
                cycle = ui.label().classes("text-xl live-cut ml-auto").props("data-test=cycle")
            bar = ui.linear_progress(0.0, show_value=False, size="6px", color=None)
            bar.props(f'aria-label="{self._t("Progress")}"')

        def update(view: LiveView) -> None:
            plate.classes(replace=f"live-state {view.style.level}")
            word.text = self._t(view.style.word)
            step.text = self._step_text(view)
            bar.value = round(view.step_share, 2)
            named = [f"{self._t('Cable')} {view.cycle}"] if view.cycle else []
            named += [f"{self._t('Part')} {view.part}"] if view.part else []
            cycle.text = " · ".join([*named, *([view.product] if view.product else [])])

        self._updates.append(update)

    def _step_text(self, view: LiveView) -> str:
        """The current step with its time, else why there is none."""
        t = self._t
        if view.unknown_s is not None:
            at = datetime.fromtimestamp(view.unknown_s).astimezone()
            return f"{t('State unknown since')} {at:%H:%M:%S}"
        if view.style is AWAY:
            return t(view.note) or t("Start it with cell run --cycles forever.")
        if view.step:
            seconds = "" if view.step_s is None else f" · {view.step_s:.0f} s"
            return f"{t(view.step)}{seconds}"
        waits = ", ".join(t(WORDS.get(w, w)) for w in view.waiting)
        return f"{t('Waits for')} {waits}" if waits else t(view.note)

    def _picture(self) -> None:
        """The camera's newest picture while it records, else that of the newest cable with one."""
        t, room = self._t, self._visit.room
        with ui.element("div").classes("live-picture"):
            picture = ui.element("img").props("data-test=camera")
            caption = ui.label().classes("quiet").props("data-test=age")
            unrecorded = ui.label(t("This cycle is not recorded.")).classes("quiet")
            unrecorded.props("data-test=unrecorded")
        shown = [""]

        def update(view: LiveView) -> None:
            source, caption.text = _newest_picture(room.runs, view, t)
            words, newest = N_("Newest picture"), room.camera.ask() if view.step else None
            unrecorded.set_visibility(bool(view.step) and room.camera.unrecorded)
            if newest is not None:
                seconds = max(0.0, time.time() - newest.taken_s)
                words = N_("Camera picture of the cycle under way")
                source = f"/live/{newest.number}.jpg"
                caption.text = f"{t('Picture as recorded, two a second; its age:')} {seconds:.0f} s"
            picture.set_visibility(bool(source))
            if source != shown[0]:
                shown[0] = source
                picture.props(f'src="{source}" alt="{t(words)}"')

        self._updates.append(update)

    def _person(self) -> None:
        """Items that need a person: a fault or a stop, and failures of the cell's adapters."""
        t = self._t
        with ui.element("div").classes("live-person") as card:
            with ui.element("div").props("role=alert"):
                heading = ui.label().classes("text-xl font-bold")
                cause = ui.label().classes("text-lg break-words").props("data-test=cause")
                remedy = ui.label().classes("whitespace-pre-line break-words")
                adapters = ui.label().classes("quiet whitespace-pre-line break-words")
                adapters.props("data-test=adapters")
            answer = self._acknowledgement() if self._visit.has_role(Role.operate) else None

        def update(view: LiveView) -> None:
            stops = MachineEvent.CLEAR in view.buttons or "acknowledgement" in view.waiting
            may_reset = MachineEvent.RESET in view.buttons and view.style.word == "Stopped"
            is_stopped = view.fault is not None or stops or may_reset
            card.set_visibility(is_stopped or bool(view.adapters))
            if answer is not None:
                answer(stops, may_reset and not stops)
            heading.text = cause.text = remedy.text = ""
            if view.fault is not None:
                heading.text, cause.text, remedy.text = fault_texts(view.fault, t)
            elif is_stopped:
                heading.text = t("A person must look first.") if stops else t("Acknowledged.")
            adapters.text = adapters_text(view.adapters, t)

        self._updates.append(update)

    def _acknowledgement(self) -> Callable[[bool, bool], None]:
        """Fields and buttons after a fault; a function that shows the required ones."""
        t, visit = self._t, self._visit
        with ui.element("div").classes("flex flex-col gap-1"):
            with ui.element("div").classes("flex gap-4") as fields:
                name = "" if visit.room.sessions is None else visit.name
                by = ui.input(t("Your name"), value=name).classes("w-40")
                by.props("dense maxlength=60 data-test=by")
                note = ui.input(t("What you found and did")).classes("grow")
                note.props("dense maxlength=500 data-test=note")

            async def acknowledge(asked_s: float) -> None:
                if not (by.value.strip() and note.value.strip()):
                    notify_refusal("Give your name, and what you found and did.", t)
                    return
                words = (by.value.strip(), note.value.strip())
                refused = await run.io_bound(visit.acknowledge, asked_s, *words)
                notify_refusal(refused, t)
                if not refused:
                    note.value = ""
                self._update()

            word = N_("Acknowledge: nothing moves")
            clear = ui.button(t(word), color=BLUE)
            on_press(visit.heartbeats, clear, t(word), acknowledge)
            clear.classes("big-button").props("text-color=white data-test=acknowledge")
            word = N_("Reset: the jaws open, the gripper goes home")
            reset = ui.button(t(word), color=AMBER)
            on_press(visit.heartbeats, reset, t(word), self._command(MachineEvent.RESET))
            reset.classes("big-button").props("text-color=black data-test=reset")

        def show(is_asked: bool, may_reset: bool) -> None:
            fields.set_visibility(is_asked)
            clear.set_visibility(is_asked)
            reset.set_visibility(may_reset)

        return show

    def _cables(self) -> None:
        """The newest cable, the outcomes of the newest ones, trends, figures of the shift."""
        t, settings = self._t, self._visit.room.settings
        products = products_of(settings)
        errors_of = (t("Error of the forecast"), t("± 3 σ expected"), "", t("Cable"))
        misses_of = (t("Measured miss"), "", "", t("Cable"))
        with ui.element("div").classes("live-side"):
            with ui.element("div").classes("flex justify-between w-full"):
                ui.label(t("Newest cable")).classes("quiet")
                link = ui.link(t("All of this cycle"), "/history")
            outcome = ui.label().props("data-test=outcome")
            why = ui.label().classes("break-words").props("data-test=why")
            figures = ui.label().classes("text-sm").props("data-test=figures")
            with ui.element("div").classes("contents") as trends:
                strip = ui.element("div").classes("live-strip").props("data-test=strip")
                ui.label(t("Miss; limits dashed"))
                misses = chart({}).props(f'role=img aria-label="{misses_of[0]}"')
                ui.label(", ".join(errors_of[:2]))
                errors = chart({}).props(f'role=img aria-label="{errors_of[0]}"')
            shift = ui.label().props(f'data-test=shift title="{t(SHIFT_DEFINITIONS)}"')
            unplanned = ui.label(t("No OEE without `ledger.shifts`."))
            unplanned.classes("quiet").props("data-test=unplanned")
        shown: list[tuple[ListedCycle, ...]] = [()]

        def update(view: LiveView) -> None:
            _, level = OUTCOME_MARKS.get(view.outcome, ("", NORMAL))
            outcome.text = t(WORDS.get(view.outcome, view.outcome))
            outcome.classes(replace=f"live-outcome {level}")
            why.text = t(view.reason)
            figures.text = _figures_text(t, view.result)
            link.props(f'href="/cycle/{view.folder}"').set_visibility(bool(view.folder))
            counts = {WORDS.get(k, k): str(n) for k, n in view.counts.items()}
            shift.text = f"{t('This shift')}: {_figures_text(t, {**counts, **view.shift})}"
            unplanned.set_visibility(bool(view.shift) and "OEE" not in view.shift)
            trends.set_visibility(bool(view.newest))
            if view.newest != shown[0]:
                shown[0] = view.newest
                _fill_strip(strip, view.newest, t)
                show_option(misses, compact(miss_chart(view.newest, misses_of, products, settings)))
                show_option(errors, compact(error_chart(view.newest, errors_of)))

        self._updates.append(update)

    def _commands(self) -> None:
        visit, t = self._visit, self._t
        page = visit.page
        with ui.element("div").classes("live-bar"):
            with ui.element("div").classes("flex items-center gap-x-4"):
                who = ui.label().props("data-test=control")
                take = ui.button(t("Take control"), color=BLUE, on_click=self._take)
                take.props("text-color=white data-test=take padding='xs md'")
                release = ui.button(
                    t("Release control"), on_click=lambda: visit.room.control.release(page)
                ).props("outline padding='xs md'")
            part = ui.input(t("Part id, if it has one")).classes("w-full")
            part.props("dense maxlength=200 data-test=part")
            ui.label(t("Stop is not an emergency stop: that is the red button at the robot."))
            buttons: dict[MachineEvent, ui.button] = {}
            with ui.element("div").classes("live-buttons"):
                for event, word, icon in _BUTTONS:
                    button = ui.button(t(word), icon=icon, color=None).classes("big-button")
                    button.props(f"data-test={event.value}")
                    of_start = part if event is MachineEvent.START else None
                    on_press(visit.heartbeats, button, t(word), self._command(event, of_start))
                    buttons[event] = button

        def update(view: LiveView) -> None:
            holder = visit.room.control.keep_alive(page)
            mine = holder is not None and holder.page == page
            text = f"{holder.name} {t('has control.')}" if holder else t("Nobody has control.")
            who.text = t("You have control.") if mine else text
            take.set_visibility(not mine and (holder is None or holder.name == visit.name))
            release.set_visibility(mine)
            part.set_enabled(mine)
            for event, button in buttons.items():
                why = t(why_disabled(event, view, in_control=mine))
                button.set_enabled(not why)
                if button.props.get("title", "") != why:
                    button.props["title"] = why  # the tooltip, which screen readers say, too
                    button.update()

        self._updates.append(update)

    def _take(self) -> None:
        visit = self._visit

        def act() -> str:
            holder = visit.room.control.take(visit.page, visit.name)
            return "" if holder.page == visit.page else f"{holder.name} has control"

        notify_refusal(visit.do("take control", Role.operate, act), self._t)
        self._update()

    def _command(
        self, event: MachineEvent, part: ui.input | None = None
    ) -> Callable[[float], Awaitable[None]]:
        """Handler of a button that gives a command; `part` names the cable of a start."""

        async def give(asked_s: float) -> None:
            code = "" if part is None else (part.value or "").strip()
            refused = await run.io_bound(self._visit.command, event, asked_s, code)
            notify_refusal(refused, self._t)
            if part is not None:
                part.value = ""
            self._update()

        return give


def _newest_picture(runs: Path, view: LiveView, t: Translate) -> tuple[str, str]:
    """Address and caption of the picture of the newest cable that has one; empty = none has."""
    older = {cycle.folder.name: cycle.cycle for cycle in reversed(view.newest)}
    for name in (view.folder, *older):
        folder = cycle_folder(runs, name)
        if folder is not None and newest_picture(folder) is not None:
            of_which = "" if name == view.folder else f" · {t('Cable')} {older[name]}"
            return f"/cycles/{name}/newest", t("Newest picture") + of_which
    return "", ""


def _figures_text(t: Callable[[str], str], figures: Any) -> str:
    """Figures with their headings, in a line."""
    each = (f"{t(heading)} {t(text)}" for heading, text in figures.items())
    return " · ".join(words.replace(" ", "\u00a0") for words in each)


def _fill_strip(
    strip: ui.element, cycles: tuple[ListedCycle, ...], t: Callable[[str], str]
) -> None:
    """A mark for each cable, which leads to its cycle."""
    strip.clear()
    with strip:
        for cycle in cycles:
            mark, level = OUTCOME_MARKS.get(cycle.outcome, ("", NORMAL))
            words = f"{t('Cable')} {cycle.cycle}: {t(WORDS.get(cycle.outcome, cycle.outcome))}"
            link = ui.link(mark, f"/cycle/{cycle.folder.name}").classes(f"no-underline {level}")
            link.props(f'title="{words}" aria-label="{words}"')
