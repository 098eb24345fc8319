"""Strip of jobs, always visible: running command, progress, output, cancel."""

from __future__ import annotations

from functools import partial

from nicegui import ui

from cell.plant.users import Role
from cell.web.jobs import OPEN, Job, JobState
from cell.web.lab_views import falling_errors
from cell.web.pages.lab.desk import Desk
from cell.web.theme import AMBER, BLUE, GREEN, N_, RED, chart, outlined, show_option

_EVERY_S = 0.4
_WORDS = {
    JobState.QUEUED: (N_("waits"), "schedule", BLUE),
    JobState.RUNNING: (N_("at work"), "sync", BLUE),
    JobState.CANCELLING: (N_("is being cancelled"), "hourglass_bottom", AMBER),
    JobState.DONE: (N_("done"), "check_circle", GREEN),
    JobState.FAILED: (N_("ended with an error"), "error", RED),
    JobState.CANCELLED: (N_("cancelled"), "cancel", AMBER),
}
#: Number of jobs that are shown, open ones first; number of lines of a failed one.
_SHOWN, _LINES = 4, 12


class Strip:
    """Rows of the jobs, updated in place."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._t = desk, desk.t
        self._version = -1
        self._ended = self._ended_jobs()
        with ui.card().classes("w-full gap-2 p-3") as self._card:
            self._card.props("data-test=jobs role=status")
            self._rows = [_StripRow(self._desk) for _ in range(_SHOWN)]
        ui.timer(_EVERY_S, self._update)
        self._desk.submitted = self._show
        self._show()

    async def _update(self) -> None:
        if not self._desk.visit.stays(Role.engineer, used=False):
            return
        if self._version == self._desk.lab.jobs.version:
            return
        self._show()
        ended = self._ended_jobs()
        if ended - self._ended:
            self._ended = ended
            await self._desk.changed()

    def _show(self) -> None:
        self._version = self._desk.lab.jobs.version
        jobs = self._desk.lab.jobs.listed()
        shown = [j for j in jobs if j.state in OPEN][::-1]
        shown += [j for j in jobs if j.state not in OPEN][: max(1, 2 - len(shown))]
        for i, row in enumerate(self._rows):
            row.show(shown[i] if i < len(shown) else None)
        self._card.set_visibility(bool(shown))

    def _ended_jobs(self) -> set[int]:
        return {j.number for j in self._desk.lab.jobs.listed() if j.state not in OPEN}


class _StripRow:
    """One job."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._number = desk, 0
        self._drawn = (0, 0)
        with ui.column().classes("w-full gap-1") as self._place:
            with ui.row().classes("w-full items-center gap-2 no-wrap"):
                self._icon = ui.icon("sync").classes("text-2xl")
                self._what = ui.label().classes("font-bold").props("data-test=job")
                self._progress = ui.label().classes("grow").props("data-test=progress")
                self._cancel = outlined(desk.t("Cancel"), "cancel", self._cancelled, "stop")
                self._cancel.props("dense")
            self._bar = ui.linear_progress(0.0, show_value=False, size="6px")
            self._errors = chart({}, "h-56").props("data-test=fit-errors")
            self._output = ui.label().classes("whitespace-pre-line break-words text-sm")
            self._output.props("data-test=said")
            self._typed = ui.label().classes("font-mono text-xs break-all opacity-70 select-all")

    def show(self, job: Job | None) -> None:
        """Show a job, or nothing."""
        self._place.set_visibility(job is not None)
        if job is None:
            return
        t, self._number = self._desk.t, job.number
        word, icon, colour = _WORDS[job.state]
        self._icon.props(f"name={icon}").style(f"color: {colour}")
        self._what.text = f"{t(job.task.title)} · {job.task.subject} · {t(word)}"
        steps = len(job.task.commands)
        step = f"{job.step + 1}/{steps}: " if steps > 1 and job.state in OPEN else ""
        self._progress.text = f"{step}{job.progress}" if job.state in OPEN else ""
        self._cancel.set_visibility(job.state in OPEN)
        self._bar.set_visibility(job.state in (JobState.RUNNING, JobState.CANCELLING))
        self._bar.props(f"{'' if job.share is not None else 'indeterminate'}")
        if job.share is not None:
            self._bar.props(remove="indeterminate")
            self._bar.value = round(job.share, 3)
        self._errors.set_visibility(len(job.errors) > 1)
        if len(job.errors) > 1 and self._drawn != (job.number, len(job.errors)):
            self._drawn = job.number, len(job.errors)
            show_option(self._errors, falling_errors(job.errors, t))
        self._output.text = "\n".join(job.output[-_LINES:])
        self._output.set_visibility(bool(job.output))
        self._typed.text = job.task.typed.splitlines()[min(job.step, steps - 1)]

    def _cancelled(self) -> None:
        desk, number = self._desk, self._number
        cancel = partial(desk.lab.jobs.cancel, number)
        desk.notify_refusal(desk.visit.do("lab cancel", Role.engineer, cancel, str(number)))
        desk.submitted()
