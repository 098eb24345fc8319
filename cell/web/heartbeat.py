"""Heartbeats of an open page: they bound the age of its data and of commands given on it.

The page asks, and the server answers with a number.  The picture is not older than the newest
question that was answered.  A command quotes the newest number that its page had: so it was not
given before that was sent.  No clock of the browser is compared with one of the server.
"""

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Callable

from nicegui import ui
from nicegui.events import GenericEventArguments

from cell.web.theme import N_, asset
from cell.web.wording import Translate

#: A picture is shown as unknown, and nothing can be pressed, if it is older, s.
LOST_S = 1.5
#: The page asks so often, s; again without an answer.
_EVERY_S, _AGAIN_S = 0.3, 1.0
#: So many numbers are known; a page asks not more often than `_EVERY_S`.
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
        "since": t(N_("State unknown since")),
        "lost": t(
            N_("no answer. If it comes late it is refused. Look at the cell, then give it again.")
        ),
    }
    times = {"LOST": LOST_S, "EVERY": _EVERY_S, "AGAIN": _AGAIN_S}
    values = {name: f"{1e3 * seconds:g}" for name, seconds in times.items()}
    script = asset("heartbeat.js", WORDS=json.dumps(words), **values)
    ui.add_body_html(f"<script>{script}</script>")
    plate = ui.element("div").classes("no-connection-plate no-data")
    with plate.props("role=alert data-test=unknown"):
        ui.label(t(N_("No connection"))).classes("state-plate")
        ui.label().classes("text-xl").props("id=no-connection-since")
    ui.label().classes("no-answer-said wrong").props("role=alert id=no-answer data-test=no-answer")

    def answer(asked: GenericEventArguments) -> None:
        if isinstance(asked.args, int | float):
            ui.run_javascript(f"cell.heard({float(asked.args)!r}, {heartbeats.send()})")

    ui.on("heartbeat", answer)


def on_press(
    heartbeats: Heartbeats, button: ui.button, what: str, act: Callable[[float], Awaitable[None]]
) -> None:
    """Connect a button that may move the arm to an action that gets the age of the page.

    what  in the language of the page: it is said if nothing answers
    act   gets the time, on the monotonic clock, since when the button may have been pressed
    """

    async def pressed(given: GenericEventArguments) -> None:
        beat, number = given.args if isinstance(given.args, list) else (0, 0)
        try:
            await act(heartbeats.sent_s(beat))
        finally:
            ui.run_javascript(f"cell.done({int(number)})")

    button.on("click", pressed, js_handler=f"() => cell.give(emit, {json.dumps(what)})")
