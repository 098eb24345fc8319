"""Connections that are closed if a request's head does not come in time."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.auto import AutoHTTPProtocol

#: The head of a request must have come so long after the connection or the last answer, s.
HEAD_S = 10.0


class TimedHttp(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
    """uvicorn's protocol, which alone waits for ever for the rest of a request's head."""

    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the first request."""
        super().connection_made(transport)
        self._start_timer()

    def data_received(self, data: bytes) -> None:
        """Take data; the clock runs from the first piece of a head to its end."""
        super().data_received(data)
        if self._has_request():
            self._stop_timer()
        elif self._timer is None and self.transport.get_protocol() is self:
            self._start_timer()

    def handle_websocket_upgrade(self, *event: Any) -> None:
        """Hand the connection over to a socket, which has pings."""
        self._stop_timer()
        super().handle_websocket_upgrade(*event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the clock."""
        self._stop_timer()
        super().connection_lost(exc)

    def _has_request(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _start_timer(self) -> None:
        self._timer = self.loop.call_later(HEAD_S, self._close)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _close(self) -> None:
        self._timer = None
        if not self._has_request():
            self.transport.close()
