"""Simulates viewers of the cell's live page without a browser: requests it, then follows it.

    python -m tools.plant.viewer PORT [--viewers 5 --stalled 1]

The viewers follow the live page until the process is ended; stalled ones read nothing.
"""

from __future__ import annotations

import argparse
import re
import signal
import threading
from contextlib import ExitStack
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import urlopen

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from tools.processes import wait_until

#: Delay before a retry of a missing server, s; time limit of an answer, s.
_AGAIN_S, _ANSWER_S = 0.5, 30.0
#: The page's own number, in its text.
_CLIENT = re.compile(r"'client_id': '([0-9a-f-]{36})'")
#: Messages of engine.io and socket.io.
_PING, _PONG, _CONNECT, _EVENT = "2", "3", "40", "42"


class Viewer:
    """Follows the live page of `port` on loopback within a `with`; reconnects to a new server.

    stalled  it reads no updates of the page
    updates  number of received updates of the page
    """

    def __init__(self, port: int, *, stalled: bool = False) -> None:
        self.updates = 0
        self._stalled = stalled
        self._at = f"127.0.0.1:{port}"
        self._over, self._follows = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._look, name="viewer", daemon=True)

    def __enter__(self) -> Viewer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def wait(self) -> None:
        """Wait until it follows the page.  Raises RuntimeError: it cannot."""
        wait_until(self._follows.is_set)

    def _look(self) -> None:
        while not self._over.is_set():
            try:
                self._follow(self._request_page())
            except (URLError, OSError, WebSocketException):
                self._follows.clear()
                self._over.wait(_AGAIN_S)

    def _request_page(self) -> str:
        """Request the page; its number.  Raises URLError, OSError."""
        with urlopen(f"http://{self._at}/", timeout=_ANSWER_S) as answer:
            matched = _CLIENT.search(answer.read().decode())
        if matched is None:
            raise RuntimeError("the page does not say its number as it used to")
        return matched[1]

    def _follow(self, client: str) -> None:
        """Read the updates of the page.  Raises OSError, WebSocketException."""
        parameters = {"EIO": 4, "transport": "websocket", "implicit_handshake": "true"}
        parameters |= {"client_id": client, "tab_id": client, "document_id": client}
        query = urlencode({**parameters, "next_message_id": 0})
        url = f"ws://{self._at}/_nicegui_ws/socket.io/?{query}"
        with connect(url, origin=f"http://{self._at}", open_timeout=_ANSWER_S) as socket:  # type: ignore[arg-type]
            socket.recv(_ANSWER_S)
            socket.send(_CONNECT)
            self._follows.set()
            if self._stalled:
                self._over.wait()
            while not self._over.is_set():
                try:
                    message = str(socket.recv(_AGAIN_S))
                except TimeoutError:
                    continue
                if message == _PING:
                    socket.send(_PONG)
                self.updates += message.startswith(_EVENT)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("port", type=int)
    parser.add_argument("--viewers", type=int, default=5)
    parser.add_argument("--stalled", type=int, default=1)
    options = parser.parse_args()
    with ExitStack() as stack:
        for number in range(options.viewers):
            viewer = stack.enter_context(Viewer(options.port, stalled=number < options.stalled))
            viewer.wait()
        print("they look", flush=True)
        signal.pause()


if __name__ == "__main__":
    main()
