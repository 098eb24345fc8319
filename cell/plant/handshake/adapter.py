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

#: Interval at which bits and cell are polled; an event of the cell polls at once, s.
_POLL_S = 0.05
#: Longest wait for an answer of the cell, s; on a computer under load it may take 1 s.
_ANSWER_S = 1.5


class HandshakeAdapter:
    """Translates the PLC's signals to requests, and the cell's state to signals.

    carrier  of the bits, opened and closed by the caller
    runs     folder of the cell's records
    by       sender that the requests name
    """

    def __init__(self, carrier: Carrier, runs: Path, by: str) -> None:
        self._carrier = carrier
        self._client = Client(runs, timeout_s=_ANSWER_S)
        self._by = by
        self._memory = Memory()
        self._news = threading.Event()
        self._over = threading.Event()
        self._warnings: dict[str, str] = {}
        self._outputs: Outputs | None = None
        self._polled_s = time.monotonic()
        self._no_edges_until_s = 0.0

    def run(self) -> None:
        """Poll until `end`; the PLC then reads a fault.

        raises  ProtocolError: cell and program are of different versions
        """
        following = GuardedThread("follow", self._follow, only_logged)
        following.start()
        try:
            while not self._over.is_set():
                self._news.wait(_POLL_S)
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
        """Poll once.  Raises ProtocolError.

        A request carries the time of the poll before, since which its input has changed.
        After this process was halted, a delayed start or acknowledgement is no edge.
        """
        requested_s, self._polled_s = self._polled_s, time.monotonic()
        if self._polled_s - requested_s > OLDEST_S:
            self._no_edges_until_s = self._polled_s + OLDEST_S
        inputs, status, before = self._inputs(), self._status(), self._memory
        if inputs is None:
            self._memory = inputs_lost(before)
            self._write_outputs(UNKNOWN)
            return
        if self._polled_s < self._no_edges_until_s:
            before = inputs_lost(before)
        asks, outputs, after = evaluate(inputs, status, before)
        self._write_outputs(outputs)
        for ask in asks:
            if self._ask(ask, requested_s):
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

    def _ask(self, ask: Ask, time_s: float) -> bool:
        """Send a request; whether the cell accepts it."""
        name = ask.command.value
        try:
            request = Request(ask.command, self._by, ask.note, product=ask.product, asked_s=time_s)
            answer = self._client.send(request)
        except LinkError as error:
            self._warn_once(name, f"{name}: what became of it is not known: {error}")
            return False
        self._warn_once(name, "" if answer.accepted else f"{name}: {answer.reason}")
        if answer.accepted:
            _LOG.info("%s %s: %s", name, ask.note, answer.state.value)
        return answer.accepted

    def _write_outputs(self, outputs: Outputs) -> None:
        try:
            self._carrier.write(outputs)
        except CarrierError as error:
            self._warn_once("plc", f"the PLC is away: {error}; nothing is started")
        if outputs != self._outputs:
            _LOG.info("told: %s", outputs)
            self._outputs = outputs

    def _warn_once(self, subject: str, warning: str) -> None:
        """Log a warning when it changes; empty = no trouble any more."""
        before = self._warnings.get(subject, "")
        if warning == before:
            return
        self._warnings[subject] = warning
        if warning:
            _LOG.warning(warning)
        elif before and subject in ("plc", "cell"):
            _LOG.warning("the %s is there again", {"plc": "PLC", "cell": "cell"}[subject])

    def _follow(self) -> None:
        try:
            for _ in self._client.follow():
                self._news.set()
        except LinkError:  # the next poll detects and logs it
            self._news.set()
