"""Takes what happens from the cell into the outbox, in a thread of its own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from cell.plant.client import Client
from cell.plant.messages import Status
from cell.plant.mqtt.outbox import MqttOutbox, OutboxError
from cell.plant.wire import LinkError
from drivers.threads import GuardedThread, said

_LOG = logging.getLogger(__name__)

#: After a failure of the disk it is tried again, s.
_AGAIN_S = 1.0


class Taker:
    """Follows a cell within a `with`.

    runs    folder of the cell's records
    outbox  where notices are put
    tell    called, from the thread, when there is something new
    """

    def __init__(self, runs: Path, outbox: MqttOutbox, tell: Callable[[], None]) -> None:
        self._client = Client(runs, on_lost=self._lost, on_there=self._there)
        self._outbox = outbox
        self._tell = tell
        self._over = threading.Event()
        self._thread = GuardedThread("taker", self._run, self._died)
        self.is_cell = False
        self.error: LinkError | None = None

    def __enter__(self) -> Taker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._client.close()
        self._thread.join(5.0)

    def status(self) -> Status | None:
        """State of the cell now; None = it is not reached."""
        try:
            return self._client.status()
        except LinkError:
            return None

    def _lost(self) -> None:
        self.is_cell = False
        _LOG.warning("the cell is away: it is waited for")
        self._tell()

    def _there(self) -> None:
        if not self.is_cell:
            self.is_cell = True
            self._tell()

    def _died(self, error: BaseException) -> None:
        """The adapter ends with this error, and is started again."""
        self.error = LinkError(said(error))
        self._tell()

    def _run(self) -> None:
        after, asked = self._outbox.taken(), ""
        while not self._over.is_set():
            try:
                for message in self._client.follow(after):
                    self._there()
                    if not isinstance(message, Status):
                        self._outbox.put(message)
                        after = message.run, message.sequence
                        self._tell()
                    elif message.sequence == 0 or asked == message.run:
                        after = message.run, message.sequence
                        self._outbox.begin_at(after)
                    else:  # what this run has told before, as far as the cell still knows it
                        asked = message.run
                        after = asked, 0
                        break
            except OutboxError as error:
                _LOG.error("%s; tried again", error)
                after = self._outbox.taken() if after is None else after
                self._over.wait(_AGAIN_S)
            except LinkError as error:
                if not self._over.is_set():
                    self.error = error
                    self._tell()
                return
