"""Heartbeats of an open page: they bound the age of its data and of commands given on it.

The page sends a request, and the server answers with a number.  The page's data are not older than
its newest answered request.  A command quotes the newest number of its page, so it was given after
that number was sent.  No clock of the browser is compared with one of the server.
"""

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Callable

from nicegui import ui
from nicegui.events import GenericEventArguments

from cell.web.theme import N_, asset
from cell.web.wording import Translate

#: Largest age of a page's data, s; older data are shown as unknown, and buttons are disabled.
LOST_S = 1.5
#: Interval of a page's requests, s; also the time after which one is repeated.
_EVERY_S, _AGAIN_S = 0.3, 1.0
#: Time in which a page that was opened may make its first connection, s.
_OPENING_S = 5.0
#: Number of stored heartbeats; a page sends requests at most every `_EVERY_S`.
_KNOWN = 100


class Heartbeats:
    """Heartbeat numbers that were sent to one page, and when."""

    def __init__(self) -> None:
        self._newest = 0
        self._sent_s: dict[int, float] = {}

    def send(self) -> int:
        """The next number, which is sent now."""
        self._newest += 1
        self._sent_s[self._newest] = time.monotonic()
        self._sent_s.pop(self._newest - _KNOWN, None)
        return self._newest

    def sent_s(self, number: object) -> float:
        """When a number was sent, on the monotonic clock; 0 = too long ago, or never."""
        return self._sent_s.get(number, 0.0) if isinstance(number, int) else 0.0


def begin(heartbeats: Heartbeats, t: Translate) -> None:
    """Start the page's heartbeat, and show how old its data are."""
    words = {
        "opening": t(N_("Connecting …")),
        "none": t(N_("No connection")),
        "since": t(N_("State unknown since")),
        "lost": t(
            N_("no answer. If it comes late it is refused. Look at the cell, then give it again.")
        ),
    }
    times = {"LOST": LOST_S, "EVERY": _EVERY_S, "AGAIN": _AGAIN_S, "OPENING": _OPENING_S}
    values = {name: f"{1e3 * seconds:g}" for name, seconds in times.items()}
    script = asset("heartbeat.js", WORDS=json.dumps(words), **values)
    ui.add_body_html(f"<script>{script}</script>")
    plate = ui.element("div").classes("no-connection-plate no-data")
    with plate.props("role=alert data-test=unknown"):
        ui.label().classes("state-plate").props("id=no-connection-word")
        ui.label().classes("text-xl").props("id=no-connection-since")
    ui.label().classes("no-answer-said wrong").props("role=alert id=no-answer data-test=no-answer")

    def answer(event: GenericEventArguments) -> None:
        if isinstance(event.args, int | float):
            ui.run_javascript(f"cell.heard({float(event.args)!r}, {heartbeats.send()})")

    ui.on("heartbeat", answer)


def on_press(
    heartbeats: Heartbeats, button: ui.button, action: str, act: Callable[[float], Awaitable[None]]
) -> None:
    """Connect a button that may move the arm to an action that gets the age of the page.

    action  its name in the language of the page, for the message without an answer
    act     gets the earliest time, on the monotonic clock, of the press
    """

    async def pressed(event: GenericEventArguments) -> None:
        beat, number = event.args if isinstance(event.args, list) else (0, 0)
        try:
            await act(heartbeats.sent_s(beat))
        finally:
            ui.run_javascript(f"cell.done({int(number)})")

    button.on("click", pressed, js_handler=f"() => cell.give(emit, {json.dumps(action)})")
