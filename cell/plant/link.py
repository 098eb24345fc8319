"""The link: a running cell publishes notices to programs on its computer, and gets requests.

The cycle only puts notices into a queue.  Threads of the link write them to a Unix socket, and
wait for none of its clients, however slow.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any
from uuid import uuid4

from cell.files.words import error_text
from cell.plant.messages import (
    COMMANDS,
    CommandReply,
    MessageKind,
    Notice,
    Request,
    Status,
    possible_in,
    status_after,
)
from cell.plant.server import CommandServer, Journal
from cell.plant.wire import line_of, socket_of
from cell.run.commands import INTERRUPTING, too_old
from cell.run.machine import MachineEvent
from drivers.threads import GuardedThread

_LOG = logging.getLogger(__name__)

#: Longest wait for the threads at the end of the link, s.
_CLOSE_S = 2.0

#: Notices of this time are written and sent together, s.  A plant polls every 50 to 100 ms; the
#: cycle, which publishes four notices while it computes the choice, keeps its core.
_TOGETHER_S = 0.04

Handler = Callable[[Request], CommandReply]


class Link:
    """The cell's end of the link, open within a `with`; without it nothing is published.

    runs     folder of the records; the socket is next to it
    status   at the beginning; `run`, `sequence` and `possible` are filled in
    handler  answers requests, one at a time, in a thread of the link
    obeyed   commands that this cell accepts in any state

    raises  LinkError, from `with`: another cell runs there, or there can be no socket
    """

    def __init__(
        self,
        runs: Path,
        status: Status,
        handler: Handler,
        obeyed: Collection[MachineEvent] = COMMANDS,
    ) -> None:
        self.path = socket_of(runs)
        self.run = uuid4().hex
        self._handler = handler
        self._obeyed = obeyed
        self._journal = Journal()
        self._status = replace(
            status, run=self.run, sequence=0, possible=possible_in(status.state, obeyed)
        )
        self._since_s = time.monotonic()
        self._sequence = 0
        self._numbering = threading.Lock()
        self._taking_in = threading.Lock()
        self._new: deque[Notice] = deque()
        self._bell: SimpleQueue[bool] = SimpleQueue()
        self._requests: SimpleQueue[tuple[Request, Callable[[CommandReply], None]] | None] = (
            SimpleQueue()
        )
        self._opened = ExitStack()

    def publish(self, kind: MessageKind, data: Mapping[str, Any]) -> Notice:
        """Send a notice to all programs, without waiting for any; from any thread.

        data  is not changed afterwards
        """
        with self._numbering:
            self._sequence += 1
            ran_s = time.monotonic()
            notice = Notice(self.run, self._sequence, time.time(), kind, data, ran_s)
            self._new.append(notice)
        self._bell.put(True)  # no call of the system: another thread would get its turn
        return notice

    def status(self) -> Status:
        """State of the cell, with all that was published before."""
        with self._taking_in:
            self._take_in()
            return replace(self._status, state_seconds=self._seconds(time.monotonic()))

    def __enter__(self) -> Link:
        with ExitStack() as stack:
            server = stack.enter_context(
                CommandServer(self.path, self.run, self._journal, self.status, self._ask)
            )
            threads = [
                GuardedThread(
                    "link", partial(self._publish_loop, server), lambda _: server.abandon()
                ),
                GuardedThread("requests", self._serve_requests, lambda _: server.abandon()),
            ]
            for thread in threads:
                thread.start()
                stack.callback(thread.join, _CLOSE_S)
            stack.callback(self._requests.put, None)
            stack.callback(self._bell.put, False)
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def _take_in(self) -> None:
        """Add new notices to status and journal; only one thread at a time."""
        while self._new:
            notice = self._new.popleft()
            if notice.kind is MessageKind.STATE:
                seconds = self._seconds(notice.ran_s)
                self._status = replace(self._status, state_seconds=seconds)
                self._since_s = notice.ran_s
            try:
                self._status = status_after(self._status, notice, self._obeyed)
                self._journal.add(line_of("notice", asdict(notice)))
            except (KeyError, TypeError, ValueError):  # a mistake of the program
                _LOG.exception("notice %s", notice)
                self._status = replace(self._status, sequence=notice.sequence)
                self._journal.add(line_of("notice", asdict(replace(notice, data={}))))

    def _seconds(self, now_s: float) -> dict[str, float]:
        """Time spent in each state, the present one included, s."""
        seconds, state = dict(self._status.state_seconds), self._status.state.value
        seconds[state] = seconds.get(state, 0.0) + now_s - self._since_s
        return seconds

    def _publish_loop(self, server: CommandServer) -> None:
        """Process published notices, and let the server send many at once."""
        goes_on = True
        while goes_on:
            goes_on = self._bell.get()
            if goes_on:
                time.sleep(_TOGETHER_S)
                goes_on = self._all_rung()
            with self._taking_in:
                self._take_in()
            server.wake()

    def _all_rung(self) -> bool:
        """Whether the link goes on, after all that rang since."""
        goes_on = True
        with suppress(Empty):
            while goes_on:
                goes_on = self._bell.get_nowait()
        return goes_on

    def _ask(self, request: Request, then: Callable[[CommandReply], None]) -> None:
        self._requests.put((request, then))

    def _serve_requests(self) -> None:
        """Let the handler answer one request after another, unless it comes too late."""
        while (entry := self._requests.get()) is not None:
            request, then = entry
            try:
                answer = self._too_old(request) or self._handler(request)
            except Exception as error:  # it must not end the cell, nor this thread
                _LOG.exception("request %s", request)
                reason = error_text(error)
                answer = CommandReply(False, self.status().state, reason)
            then(answer)

    def _too_old(self, request: Request) -> CommandReply | None:
        """The refusal of a delayed request; a stop is obeyed however late."""
        if request.command in INTERRUPTING:
            return None
        name = "product" if request.command is None else request.command.value
        late = too_old(name, request.asked_s)
        return CommandReply(False, self.status().state, late, "asked_s") if late else None
