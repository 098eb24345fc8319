"""A user's own effect: typed, checked while it is typed, fitted with one click."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Sequence
from functools import partial
from typing import Any

from nicegui import run, ui

from cell.cable.effects import library
from cell.plant.users import Role
from cell.web.lab import CheckedFile
from cell.web.lab_views import fitted_lines, read_result
from cell.web.pages.lab.compare import ComparePanel
from cell.web.pages.lab.desk import Desk, NeedsStudy, output, set_names
from cell.web.theme import Unsaved, card, filled, outlined, several_of
from cell.web.visit import do

#: Pause in typing after which a text is checked, s.
_PAUSE_S = 0.5
_NAMED = re.compile(r"^\s+name\s*=\s*[\"'](\w+)[\"']", re.MULTILINE)
_LINE = re.compile(r"\.py:(\d+)\b")
_CSS = ".wrong-line { background: #d6454533 !important; }"

TEMPLATE = '''"""What it is, in a sentence."""

from cell.cable.effects import Effect, Parameter


class MyDrag(Effect):
    """F = -c v: drag in proportion to the velocity.  Write the law and its source here."""

    name = "my_drag"
    parameters = (
        # name, unit, low, high; off at its default; values from which a fit starts
        Parameter("c_n_s_per_m2", "N·s/m²", 0.0, 1.0, default=0.0, starts=(0.002,)),
    )

    def force(cable, at, p):
        """N/m at a place with x, y, vx, vy, tx, ty, angle, spin, arc_length, time."""
        return -p.c_n_s_per_m2 * at.vx, -p.c_n_s_per_m2 * at.vy

    # Other hooks: moment(cable, at, m, p), inertia(cable, p), tip_mass(cable, p),
    # rest_curvature(cable, arc_length, p), grip_compliance(cable, p) ...: `cell help own_effect`
'''


class OwnEffectPanel:
    """Panel in which a person types an effect, has it checked, and fits it."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._t = desk, desk.t
        self._typed = 0
        self._saved_text = TEMPLATE
        self._unsaved = Unsaved("effect")
        self._needs_study = NeedsStudy(desk)
        t = self._t
        ui.add_css(_CSS)
        with card(t("Write an effect")):
            with ui.row().classes("items-center w-full gap-4"):
                self._saved = ui.select([], label=t("Open")).classes("w-64")
                self._saved.props("data-test=open-effect").on_value_change(self._open)
                ui.button(t("Template"), icon="note_add", on_click=self._template).props("outline")
                self._what = ui.label().classes("grow break-words")
            self._editor = ui.codemirror(
                TEMPLATE, language="Python", theme=self._desk.editor_theme, on_change=self._changed
            )
            self._editor.classes("w-full border").style("height: 26rem")
            self._editor.props("data-test=editor")
            with ui.row().classes("items-start no-wrap w-full gap-2"):
                self._icon = ui.icon("edit").classes("text-2xl")
                self._check_output = ui.label().classes("whitespace-pre-line break-words")
                self._check_output.props("role=status data-test=checked")
            ui.label(t("A law may only compute: math, numpy, and what an effect is made of."))
            with ui.row().classes("items-center w-full gap-4"):
                self._shared = several_of(t("Also in both models"), "shared", width="w-64")
                button = filled(t("Save and fit"), "fit-own", self._fit, "auto_graph")
                infer = outlined(
                    t("Infer a law from the error"), "infer", self._infer, "psychology"
                )
                self._needs_study.of(button, infer)
            self._inferred = ui.column().classes("w-full")
        self._fitted = ui.label().classes("font-mono whitespace-pre-line break-words")
        self._fitted.props("data-test=fitted-own")
        self._shown = ComparePanel(self._desk, "own")
        self._desk.listen(self._refresh)

    async def _refresh(self) -> None:
        own = self._desk.own_effects()
        self._saved.set_options(own, value=self._saved.value if self._saved.value in own else None)
        set_names(self._shared, [*own, *library()])
        self._needs_study.refresh()
        self._inferred.clear()
        with self._inferred:
            output(self._t("The law that was inferred"), self._desk.result("discover.txt"))
        self._editor.theme = self._desk.editor_theme
        self._fitted.text = "\n".join(await run.io_bound(self._fitted_lines) or ())
        await self._shown.refresh()

    def _fitted_lines(self) -> list[str]:
        """Parameters of the last fitted effect."""
        desk = self._desk
        path = desk.result("own.json")
        compared = None if path is None else read_result(path)
        if compared is None or desk.subject is None:
            return []
        effect = str(compared["models"][-1]["name"])
        model = read_result(desk.tasks.model(desk.subject, effect))
        return [] if model is None else fitted_lines(model, effect)

    def _template(self) -> None:
        self._saved.value = None
        self._saved_text = self._editor.value = TEMPLATE

    def _open(self, event: Any) -> None:
        path = self._desk.workspace.effects / f"{event.value}.py"
        if event.value in self._desk.own_effects():
            try:
                self._saved_text = self._editor.value = path.read_text(encoding="utf-8")
            except (OSError, ValueError) as error:
                self._desk.notify_refusal(str(error))

    async def _changed(self) -> None:
        self._unsaved.set(self._editor.value != self._saved_text)
        self._typed += 1
        typed = self._typed
        await asyncio.sleep(_PAUSE_S)
        if typed == self._typed:
            await self._check()

    async def _check(self) -> CheckedFile | None:
        """Check the current text; None = it has changed meanwhile."""
        desk, typed, text = self._desk, self._typed, str(self._editor.value)
        if not desk.visit.has_role(Role.engineer):
            desk.notify_refusal(desk.visit.do("lab check", Role.engineer, str))
            return None
        self._icon.props("name=hourglass_empty")
        checked = await run.io_bound(desk.lab.check_effect, named(text), text)
        if checked is None or typed != self._typed:
            return None
        self._icon.props(f"name={'check_circle' if checked.good else 'error'}")
        self._icon.style(f"color: {'#2c9e4b' if checked.good else '#d64545'}")
        right = f"{self._t('The effect is right.')} {checked.law}"
        self._check_output.text = right if checked.good else "\n".join(checked.output)
        lines = {int(n) for line in checked.output for n in _LINE.findall(line)}
        count = len(text.splitlines())
        self._editor.decorations = [
            {"kind": "line", "line": n, "class": "wrong-line"} for n in lines if 0 < n <= count
        ]
        return checked

    def _infer(self) -> None:
        desk = self._desk
        if (subject := desk.subject_or_refusal()) is not None:
            shared = [desk.effect_file(str(b)) for b in self._shared.value or []]
            desk.ask(desk.tasks.discover(subject, free_name(desk.own_effects()), shared))

    async def _fit(self) -> None:
        desk, text = self._desk, str(self._editor.value)
        if (subject := desk.subject_or_refusal()) is None:
            return
        name = named(text)
        save = partial(desk.lab.save_effect, name, text)
        if await do(desk.visit, "lab effect", Role.engineer, save, f"{name}.py"):
            self._saved_text = text
            self._unsaved.set(self._editor.value != text)
            shared = [desk.effect_file(str(b)) for b in self._shared.value or [] if b != name]
            desk.ask(desk.tasks.fit_own(subject, name, shared))
            await desk.changed()


def free_name(used: Sequence[str]) -> str:
    """Unused name for an effect: discovered, discovered_2, …"""
    numbers = (f"discovered_{n}" for n in range(2, 10_000))
    return next(n for n in ("discovered", *numbers) if n not in used)


def named(text: str) -> str:
    """Name of the effect in a text, which is also its file's; `my_effect` if there is none."""
    matched = _NAMED.search(text)
    return "my_effect" if matched is None else matched[1]
