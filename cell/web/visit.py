"""An open page of one person: session, language, and context."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from nicegui import run, ui

from cell.plant.client import Client
from cell.plant.messages import Request
from cell.plant.users import Role
from cell.plant.wire import LinkError
from cell.run.commands import too_old
from cell.run.machine import MachineEvent
from cell.settings.model import Settings
from cell.web.audit import Audit, audit_file
from cell.web.camera import Films, LiveCamera
from cell.web.guided import Guided
from cell.web.heartbeat import Heartbeats
from cell.web.lab import Lab
from cell.web.sessions import Control, LoginSession, Sessions
from cell.web.theme import notify_refusal
from cell.web.watching import CellWatch
from cell.web.wording import Translate
from cell.web.workspace import Workspace

#: Commands that need no control of the cell: every operator may stop it.
_ALWAYS = frozenset({MachineEvent.STOP})
#: Longest part id, characters, as in the ledger.
_LONGEST_PART = 200


@dataclass(eq=False)
class PagesContext:
    """Shared context of all pages.

    sessions  None = loopback without accounts
    """

    config: Path
    settings: Settings
    runs: Path
    client: Client
    watch: CellWatch
    sessions: Sessions | None

    def __post_init__(self) -> None:
        self.control, self.audit = Control(), Audit(audit_file(self.runs))
        self.films, self.camera, self.guided = Films(), LiveCamera(self.runs), Guided()
        self._taking = threading.Lock()  # held while something that moves the arm is begun

    @cached_property
    def lab(self) -> Lab:
        """Shared state of the lab's pages, made at the first use."""
        return Lab(Workspace.of_runs(self.runs))

    def with_devices(self, begin: Callable[[], str]) -> str:
        """Begin a motion of the arm if the devices are free; reason of a refusal, or ""."""
        with self._taking:
            if self.watch.state.may_run:
                return "a cell runs and has the devices: end it first"
            if self.guided.state.runs:
                return f"{self.guided.state.title} is under way"
            if self.lab.jobs.moves:
                return "a cable is being measured: wait for its end"
            return begin()


@dataclass(frozen=True)
class Visit:
    """An open page.

    page        identifier among all open pages
    t           translates a message into its language
    heartbeats  sent to it
    """

    room: PagesContext
    session: LoginSession
    page: str
    language: str
    t: Translate
    heartbeats: Heartbeats = field(default_factory=Heartbeats)

    @property
    def name(self) -> str:
        """Name of the person's account."""
        return self.session.user.name

    def has_role(self, role: Role, *, used: bool = True) -> bool:
        """Whether the session still has this role; `used`: a person has just acted."""
        session: LoginSession | None = self.session
        if self.room.sessions is not None:
            session = self.room.sessions.renewed(self.session.key, used=used)
        return session is not None and session.user.role >= role

    def stays(self, role: Role, *, used: bool = True) -> bool:
        """As `has_role`; without it the page gives way to the login."""
        if may := self.has_role(role, used=used):
            return may
        ui.navigate.to("/login")
        return False

    def do(
        self,
        action: str,
        role: Role,
        act: Callable[[], str],
        note: str = "",
        *,
        asked_s: float | None = None,
    ) -> str:
        """Perform an action, and write it to the audit log, done or refused.

        act      performs it; returns why it failed, or ""
        asked_s  if the arm may move: earliest time of the request, refused when too old
        returns  why it was not done, or that its log entry failed, in English, or ""
        """
        denied = "you may not do this, or your session has ended"
        late = "" if asked_s is None else too_old(action, asked_s)
        refused = (late or act()) if self.has_role(role) else denied
        try:
            self.room.audit.write(
                self.name, action, not refused, "; ".join(filter(None, (note, refused)))
            )
        except OSError as error:
            file, why = self.room.audit.file, error.strerror
            return refused or f"done, but it cannot be written to {file}: {why}; make room there"
        return refused

    def acknowledge(self, asked_s: float, by: str, note: str) -> str:
        """Acknowledge a fault or a stop; nothing moves.  Reason of a refusal, or "".

        asked_s, by  as of `command`
        """
        return self._ask(Request(None, self._who(by), note, asked_s=asked_s))

    def command(self, event: MachineEvent, asked_s: float, part: str = "") -> str:
        """Send a command to the cell, and wait for the answer; reason of a refusal, or "".

        asked_s  earliest time of the request, on the monotonic clock
        """
        return self._ask(Request(event, self._who(), part=part or None, asked_s=asked_s))

    def _who(self, by: str = "") -> str:
        """Name of the person; `by` = name that a person of a shared account has entered."""
        return f"web:{self.name}" + (f" ({by})" if by and by != self.name else "")

    def _ask(self, request: Request) -> str:
        event, part = request.command, request.part or ""
        action = "acknowledge" if event is None else event.value

        def act() -> str:
            holder = self.room.control.keep_alive(self.page)
            if event not in _ALWAYS and (holder is None or holder.page != self.page):
                return "take control first: somebody else has it, or nobody"
            if len(part) > _LONGEST_PART or not part.isprintable():
                return f"a part id has at most {_LONGEST_PART} printable characters"
            try:
                answer = self.room.client.send(request)
            except LinkError as error:
                return str(error)
            return "" if answer.accepted else answer.reason

        return self.do(action, Role.operate, act, request.note)


async def do(
    visit: Visit,
    action: str,
    role: Role,
    act: Callable[[], str],
    note: str = "",
    *,
    asked_s: float | None = None,
) -> bool:
    """`Visit.do` in a thread; a refusal is shown.  Whether it was done."""
    refused = await run.io_bound(visit.do, action, role, act, note, asked_s=asked_s)
    notify_refusal(refused, visit.t)
    return not refused
