"""Runs the handshake: reads bits and status, sends requests to the cell, sets the PLC's bits."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from cell.plant.client import Client
from cell.plant.handshake.carrier import UNKNOWN, Carrier, CarrierError, Inputs, Outputs
from cell.plant.handshake.rules import Ask, Memory, evaluate, inputs_lost, not_obeyed, obeyed
from cell.plant.messages import Request, Status
from cell.plant.wire import LinkError, ProtocolError
from cell.run.commands import OLDEST_S
from drivers.threads import GuardedThread, only_logged

_LOG = logging.getLogger(__name__)

#: Bits and cell are looked at so often, and at once when something happens in the cell, s.
_LOOK_S = 0.05
#: A cell that does not answer for so long is lost, s; on a computer under load it may take 1 s.
_ANSWER_S = 1.5


class HandshakeAdapter:
    """Translates the PLC's signals to requests, and the cell's state to signals.

    carrier  of the bits, opened and closed by the caller
    runs     folder of the cell's records
    by       who is said to have asked
    """

    def __init__(self, carrier: Carrier, runs: Path, by: str) -> None:
        self._carrier = carrier
        self._client = Client(runs, timeout_s=_ANSWER_S)
        self._by = by
        self._memory = Memory()
        self._news = threading.Event()
        self._over = threading.Event()
        self._said: dict[str, str] = {}
        self._outputs: Outputs | None = None
        self._looked_s = time.monotonic()
        self._no_edges_until_s = 0.0

    def run(self) -> None:
        """Look until `end`; the PLC then reads a fault.

        raises  ProtocolError: cell and program are of different versions
        """
        following = GuardedThread("follow", self._follow, only_logged)
        following.start()
        try:
            while not self._over.is_set():
                self._news.wait(_LOOK_S)
                self._news.clear()
                self.poll()
        finally:
            self._write_outputs(UNKNOWN)
            self._over.set()
            self.close()
            following.join(_ANSWER_S)

    def end(self) -> None:
        """End soon; safe in a signal's handler."""
        self._over.set()

    def close(self) -> None:
        """Close the connection to the cell.  `run` does it; a caller of `poll` alone must."""
        self._client.close()

    def poll(self) -> None:
        """Look once.  Raises ProtocolError.

        An input has changed since the look before: so old are the commands that follow from it.
        After this process was halted, a start or an acknowledgement that has piled up is no edge.
        """
        asked_s, self._looked_s = self._looked_s, time.monotonic()
        if self._looked_s - asked_s > OLDEST_S:
            self._no_edges_until_s = self._looked_s + OLDEST_S
        inputs, status, before = self._inputs(), self._status(), self._memory
        if inputs is None:
            self._memory = inputs_lost(before)
            self._write_outputs(UNKNOWN)
            return
        if self._looked_s < self._no_edges_until_s:
            before = inputs_lost(before)
        asks, outputs, after = evaluate(inputs, status, before)
        self._write_outputs(outputs)
        for ask in asks:
            if self._ask(ask, asked_s):
                self._write_outputs(obeyed(ask, outputs))
            else:
                after = not_obeyed(ask, before, after)
        self._memory = after

    def _inputs(self) -> Inputs | None:
        try:
            inputs = self._carrier.read()
        except CarrierError as error:
            self._warn_once("plc", f"the PLC is away: {error}; nothing is started")
            return None
        self._warn_once("plc", "")
        return inputs

    def _status(self) -> Status | None:
        try:
            status = self._client.status()
        except ProtocolError:
            raise
        except LinkError as error:
            self._warn_once("cell", f"the cell is away: {error}; it is waited for")
            return None
        self._warn_once("cell", "")
        return status

    def _ask(self, ask: Ask, asked_s: float) -> bool:
        """Whether the cell obeys."""
        what = ask.command.value
        try:
            asked = Request(ask.command, self._by, ask.note, product=ask.product, asked_s=asked_s)
            answer = self._client.send(asked)
        except LinkError as error:
            self._warn_once(what, f"{what}: what became of it is not known: {error}")
            return False
        self._warn_once(what, "" if answer.accepted else f"{what}: {answer.reason}")
        if answer.accepted:
            _LOG.info("%s %s: %s", what, ask.note, answer.state.value)
        return answer.accepted

    def _write_outputs(self, outputs: Outputs) -> None:
        try:
            self._carrier.write(outputs)
        except CarrierError as error:
            self._warn_once("plc", f"the PLC is away: {error}; nothing is started")
        if outputs != self._outputs:
            _LOG.info("told: %s", outputs)
            self._outputs = outputs

    def _warn_once(self, about: str, what: str) -> None:
        """Warn once of what has changed; empty = all is well."""
        before = self._said.get(about, "")
        if what == before:
            return
        self._said[about] = what
        if what:
            _LOG.warning(what)
        elif before and about in ("plc", "cell"):
            _LOG.warning("the %s is there again", {"plc": "PLC", "cell": "cell"}[about])

    def _follow(self) -> None:
        try:
            for _ in self._client.follow():
                self._news.set()
        except LinkError:  # the look finds it, too, and tells it
            self._news.set()
