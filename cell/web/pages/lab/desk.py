"""State shared by the panels of one open lab page: chosen study, jobs, changes."""

from __future__ import annotations

import shlex
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from nicegui import ui

from cell.plant.users import Role
from cell.web.cycle_view import cycle_folder
from cell.web.jobs import JobTask
from cell.web.lab_tasks import LabTasks, Subject, page_file
from cell.web.theme import N_, notify_refusal
from cell.web.visit import Visit, do
from cell.web.workspace import is_name

#: Callback of a part of the page when a study was chosen, or a job has ended.
Listener = Callable[[], Awaitable[None]]


class Desk:
    """One open page of the lab."""

    def __init__(self, visit: Visit) -> None:
        self.visit, self.t, self.lab = visit, visit.t, visit.room.lab
        self.workspace = self.lab.workspace
        self.tasks = LabTasks(self.workspace, visit.room.config)
        self.subject: Subject | None = None
        self._made_next = ""
        self.cycles: list[Path] = []
        request = ui.context.client.request
        theme = "" if request is None else request.cookies.get("theme", "")
        self._dark = theme == "dark"
        self._asks_browser = theme not in ("dark", "light")
        self.submitted: Callable[[], None] = lambda: None
        self._listeners: list[Listener] = []

    def listen(self, listener: Listener) -> None:
        """Register a callback of a part for changes."""
        self._listeners.append(listener)

    async def changed(self) -> None:
        """Notify all parts: a study was chosen, or a job has ended."""
        if self._made_next and (made := self.find(self._made_next)) is not None:
            self.subject, self._made_next = made, ""
        for listener in self._listeners:
            await listener()

    def choose_when_made(self, name: str) -> None:
        """Choose the study of this name once a job has made it, if it succeeds."""
        self._made_next = name

    async def begin(self) -> None:
        """Fill the parts, once the browser is connected."""
        if self._asks_browser:
            query = "window.matchMedia('(prefers-color-scheme: dark)').matches"
            with suppress(TimeoutError):
                self._dark = bool(await ui.run_javascript(f"return {query}", timeout=3.0))
        await self.changed()

    @property
    def editor_theme(self) -> Any:
        """Theme of an editor, equal to the page's."""
        return "vscodeDark" if self._dark else "vscodeLight"

    async def choose(self, name: str) -> None:
        """Choose the study, or the recorded cycle, of this name."""
        self.subject, self._made_next = self.find(name), ""
        if self.subject is not None:
            ui.navigate.history.replace(f"/lab?study={name}")
        await self.changed()

    def find(self, name: str) -> Subject | None:
        """The study or the cycle of a name; None = there is none."""
        if not is_name(name):
            return None
        subject = Subject(name, self.workspace.studies / name)
        if subject.is_there:
            return subject
        cycle = cycle_folder(self.visit.room.runs, name)
        return None if cycle is None else Subject(name, cycle, True)

    def ask(self, task: JobTask, asked_s: float | None = None) -> bool:
        """Put a job in the queue, with an audit entry; whether it was accepted.

        asked_s  of a job that moves the arm, as of `Visit.do`
        """
        visit, jobs = self.visit, self.lab.jobs

        def submit() -> str:
            return jobs.submit(task, visit.name)

        def act() -> str:
            return visit.room.with_devices(submit) if task.moves else submit()

        words = task.typed.splitlines()[-1]
        refused = visit.do(f"lab {task.title.lower()}", Role.engineer, act, words, asked_s=asked_s)
        self.submitted()
        self.notify_refusal(refused)
        return not refused

    async def run_promotion(self, words: Sequence[str]) -> bool:
        """Run a promotion, with an audit entry of its result; whether it succeeded."""
        messages: list[str] = []

        def act() -> str:
            ran = self.lab.promoted(words)
            messages.append(ran.printed.strip())
            return "" if ran.code == 0 else ran.output.strip() or "it took too long"

        typed = shlex.join(["cell", *words])
        done = await do(self.visit, f"lab {words[0]}", Role.engineer, act, typed)
        if done and messages:
            ui.notify(messages[0], type="positive", multi_line=True, close_button=self.t("Close"))
        return done

    def notify_refusal(self, refused: str | None) -> None:
        """Show the reason of a refusal."""
        notify_refusal(refused, self.t)

    def subject_or_refusal(self) -> Subject | None:
        """The chosen study; without one, show a request to choose one."""
        if self.subject is None:
            self.notify_refusal("Choose a study first.")
        return self.subject

    def result(self, file: str) -> Path | None:
        """A file of results of the chosen study; None = no study is chosen."""
        return None if self.subject is None else self.workspace.results(self.subject.name) / file

    def models(self) -> list[str]:
        """Models fitted to the chosen study, the oldest first."""
        folder = self.result("models")
        return [] if folder is None else self.workspace.names(folder, ".json")[::-1]

    def own_effects(self) -> list[str]:
        """Names of the typed effects."""
        return self.workspace.names(self.workspace.effects, ".py")

    def effect_file(self, name: str) -> str:
        """Argument of a command for an effect: name in the library, or file of a typed one."""
        path = self.workspace.effects / f"{name}.py"
        return str(path) if path.exists() else name


def set_names(choice: ui.select, names: Sequence[str]) -> None:
    """Set the options of a multiple choice, without a change of the selection."""
    choice.set_options(list(names), value=[n for n in choice.value or [] if n in names])


class ShownFiles:
    """The files that a part of the page shows, as they were when it was filled."""

    def __init__(self) -> None:
        self._stamps: list[tuple[Path, int]] | None = None

    def changed(self, files: Sequence[Path]) -> bool:
        """Whether one of them has changed, is new or is gone since the last call."""
        before = self._stamps
        self._stamps = [(p, p.stat().st_mtime_ns) for p in files if p.exists()]
        return self._stamps != before


class NeedsStudy:
    """Buttons that are disabled without a study, and the sentence with the reason."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self._buttons: list[ui.button] = []

    def of(self, *buttons: ui.button) -> None:
        """Register these buttons, and put the sentence after them."""
        self._buttons += buttons
        self._why = ui.label().classes("quiet").props("data-test=needs-study")
        self.refresh()

    def refresh(self) -> None:
        """Update buttons and sentence."""
        t, subject = self._desk.t, self._desk.subject
        is_ready = subject is not None and not subject.to_import
        why = t(N_("Make the study first.")) if subject else t(N_("Choose a study first."))
        self._why.text = "" if is_ready else why
        for button in self._buttons:
            button.set_enabled(is_ready)


def frame(desk: Desk, page: str, title: str, *, opened: bool = False) -> None:
    """A page that a command wrote of the chosen study, in a sandboxed frame."""
    subject = desk.subject
    if subject is None:
        return
    path = page_file(desk.workspace, subject.name, page)
    if not path.is_file():
        return
    address = f"/lab/results/{subject.name}/{page}?v={path.stat().st_mtime_ns}"
    with ui.expansion(title, icon="insights", value=opened).classes("w-full") as expansion:
        place = ui.element("div").classes("w-full")

    def show(opened_now: bool) -> None:
        place.clear()
        if opened_now:
            with place:
                shown = ui.element("iframe").props(f'src="{address}" sandbox="allow-scripts"')
                shown.props(f'title="{title}"').classes("w-full bg-white")
                shown.style("height: 80vh; border: 0")

    show(opened)
    expansion.on_value_change(lambda event: show(bool(event.value)))


def output(title: str, log: Path | None) -> None:
    """Folded element with the output of a command."""
    if log is not None and log.is_file():
        with ui.expansion(title, icon="terminal").classes("w-full"):
            printed(log)


def printed(log: Path | None) -> None:
    """Output of a command."""
    text = ui.label("\n".join(_lines(log)))
    text.classes("whitespace-pre font-mono text-xs overflow-x-auto w-full")


def first_lines(log: Path | None) -> list[str]:
    """The sentences with which a command's output begins, before its first table."""
    lines = _lines(log)
    head: list[str] = []
    for line in lines[:6]:
        if not line.strip() or line.startswith("   "):
            break
        head.append(line)
    return head


def notes_after_tables(log: Path | None, heads: Sequence[str]) -> list[str]:
    """Lines that a command printed after its tables, from the first that is one of `heads`."""
    lines = _lines(log)
    begins = [i for i, line in enumerate(lines) if line.strip() in heads]
    return lines[begins[0] :] if begins else []


def _lines(log: Path | None) -> list[str]:
    """Lines of a command's output; none if it cannot be read."""
    try:
        return [] if log is None else log.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []
