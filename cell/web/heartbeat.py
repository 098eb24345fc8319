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

from cell.web.theme import N_
from cell.web.wording import Translate

#: A picture is shown as unknown, and nothing can be pressed, if it is older, s.
LOST_S = 1.5
#: The page asks so often, s; again without an answer.
_EVERY_S, _AGAIN_S = 0.3, 1.0
#: So many numbers are known; a page asks not more often than `_EVERY_S`.
_KNOWN = 100

_SCRIPT = """
<script>
(() => {
  const words = WORDS, key = 'cell-given';
  const now = () => performance.now();
  let asked = -1e9, answered = true, seen = 0, beat = 0, count = 0, lost = false;
  document.body.classList.add('unheard');  // what is pressed before the server listens is lost
  let given = [], gone = JSON.parse(sessionStorage.getItem(key) || '[]');
  const keep = () => sessionStorage.setItem(key, JSON.stringify([...gone, ...given]));
  const clock = (t) => new Date(t).toLocaleTimeString(document.documentElement.lang,
                                                      {hourCycle: 'h23'});
  const text = (id, said) => {
    const place = document.getElementById(id);
    if (place && place.textContent !== said) place.textContent = said;
  };
  const show = () => {
    const old = now() - seen > LOST;
    if (old !== lost && old) {
      text('no-connection-since', `${words.since} ${clock(Date.now() - (now() - seen))}`);
    }
    lost = old;
    document.body.classList.toggle('no-connection', lost);
    for (const button of document.querySelectorAll('main button, .q-dialog button')) {
      if (lost && !button.disabled) {
        button.disabled = true;
        button.dataset.lost = '1';
      } else if (!lost && button.dataset.lost) {
        button.disabled = button.classList.contains('disabled');
        delete button.dataset.lost;
      }
    }
    const open = [...gone, ...given.filter((g) => now() - g.since > LOST)];
    text('no-answer', open.map((g) => `${g.what}, ${clock(g.at)}: ${words.lost}`).join(' '));
    document.body.classList.toggle('no-answer', open.length > 0);
  };
  const look = () => {
    if (window.socket?.connected && window.did_handshake && (answered || now() - asked > AGAIN)) {
      asked = now();
      answered = false;
      emitEvent('heartbeat', asked);
    }
    show();
  };
  window.cell = {
    heard(question, number) {
      answered ||= question === asked;
      if (question > seen) [seen, beat] = [question, number];
      document.body.classList.remove('unheard');
      show();
    },
    give(emit, what) {
      if (lost || !beat) return;
      gone = [];
      given.push({what, number: ++count, at: Date.now(), since: now()});
      keep();
      emit(beat, count);
    },
    done(number) {
      given = given.filter((g) => g.number !== number);
      keep();
      show();
    },
  };
  setInterval(look, EVERY);
  document.addEventListener('visibilitychange', look);
  document.addEventListener('DOMContentLoaded', show);
})();
</script>
"""


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
    script = _SCRIPT.replace("WORDS", json.dumps(words))
    for name, seconds in (("LOST", LOST_S), ("EVERY", _EVERY_S), ("AGAIN", _AGAIN_S)):
        script = script.replace(name, f"{1e3 * seconds:g}")
    ui.add_body_html(script)
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
