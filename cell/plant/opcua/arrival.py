"""When the messages of clients have come: not later than they are looked at, but maybe long before.

A client's own time is of another clock.  So the server notes when it last had nothing to do: what
it reads after it was halted has waited since then.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from contextvars import ContextVar
from typing import Any

from asyncua import Server
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol

#: The message under way has come at this time or later, on the monotonic clock, s.
came_s: ContextVar[float] = ContextVar("came_s")

#: How often it is noted that the server has nothing to do, s.
_EVERY_S = 0.1


class Idle:
    """When the event loop has taken in all that was there, within a task of `note`."""

    def __init__(self) -> None:
        now_s = time.monotonic()
        self._noted_s: deque[float] = deque((now_s, now_s), maxlen=2)

    @property
    def since_s(self) -> float:
        """What is read now has come since then: the last note may be of the same round."""
        return self._noted_s[0]

    async def note(self) -> None:
        """Note it for ever."""
        while True:
            self._noted_s.append(time.monotonic())
            await asyncio.sleep(_EVERY_S)


class _Connection(OPCUAProtocol):  # type: ignore[misc]
    """A connection that knows since when each of its messages may have waited."""

    def __init__(self, idle: Idle, **given: Any) -> None:
        super().__init__(**given)
        self._idle = idle
        self._came_s: deque[float] = deque()

    def data_received(self, data: bytes) -> None:
        """Take in messages."""
        waiting = self.messages.qsize()
        super().data_received(data)
        self._came_s.extend([self._idle.since_s] * (self.messages.qsize() - waiting))

    async def _process_one_msg(self, header: Any, buf: Any) -> bool:
        came_s.set(self._came_s.popleft())
        return bool(await super()._process_one_msg(header, buf))


class _Connections(BinaryServer):  # type: ignore[misc]
    """Listens for connections."""

    def __init__(self, idle: Idle, *given: Any) -> None:
        super().__init__(*given)
        self._idle = idle

    def _make_protocol(self) -> OPCUAProtocol:
        return _Connection(
            self._idle,
            iserver=self.iserver,
            policies=self._policies,
            clients=self.clients,
            closing_tasks=self.closing_tasks,
            limits=self.limits,
        )


class TimedServer(Server):  # type: ignore[misc]
    """asyncua's server, whose messages have a time."""

    async def start(self) -> None:
        """Listen.  Raises OSError."""
        await self._setup_server_nodes()
        await self.iserver.start()
        idle = Idle()
        self._noting = asyncio.create_task(idle.note())
        try:
            address = self._get_bind_socket_info()
            self.bserver = _Connections(idle, self.iserver, *address, self.limits)
            self.bserver.set_policies(self._policies)
            await self.bserver.start()
        except BaseException:
            self._noting.cancel()
            await self.iserver.stop()
            raise

    async def stop(self) -> None:
        """End."""
        self._noting.cancel()
        await super().stop()
