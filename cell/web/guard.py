"""Checks every request before a page handles it: host, origin, size, session, role, rate."""

from __future__ import annotations

import asyncio
import hmac
import os
import sys
import time
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.auto import AutoHTTPProtocol

from cell.computer.peers import user_of_peer
from cell.plant.users import Users
from cell.web.sessions import LoginSession, Sessions, local_session

COOKIE = "cell_session"
LOGIN = "/login"
METRICS = "/metrics"
#: Largest body of a request, bytes: files for the lab.
MOST_BYTES = 64 << 20
#: Least rate of a body, bytes/s, after a delay, s.
LEAST_RATE, BODY_S = 50e3, 10.0
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
#: Nothing is loaded from outside; NiceGUI itself compiles templates and has inline styles.
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self'; "
    "frame-ancestors 'self'; base-uri 'self'; form-action 'self'; object-src 'none'"
)
#: Headers of pages that commands wrote: their scripts have no access to these pages.
SANDBOX = {
    "content-security-policy": "sandbox allow-scripts; default-src 'unsafe-inline' data:; "
    "frame-ancestors 'self'"
}
_HEADERS = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
}


#: Time after each answer during which browsers use TLS only for this host, s.  It holds for all of
#: the host's services, and is short so that it can be withdrawn.
_TLS_ONLY_S = 30 * 86400


class _BodyError(Exception):
    """A body without a stated length grew too long, or came too slowly."""


def same_origin(origin: str | None, host: str, secure: bool) -> bool:
    """Whether a request with this `Origin` comes from this server's own pages."""
    if not origin:
        return False
    parts = urlsplit(origin)
    return parts.scheme == ("https" if secure else "http") and parts.netloc == host


def is_loopback(host: str) -> bool:
    """Whether a `Host` header names this computer, against DNS rebinding."""
    return urlsplit(f"//{host}").hostname in LOOPBACK


class Guard:
    """ASGI middleware: the inner application gets only permitted requests.

    sessions  None = loopback without accounts
    secure    whether it is reached by TLS
    users     accounts: once some exist, a server without sessions refuses everybody
    token     gives access to the metrics only, without a login; empty = none does
    """

    def __init__(
        self,
        app: ASGIApp,
        sessions: Sessions | None,
        secure: bool,
        users: Users | None = None,
        token: str = "",
    ) -> None:
        self._bearer = f"Bearer {token}" if token else ""
        self._app = app
        self._users = users
        self._sessions = sessions
        self._secure = secure
        tls = {"strict-transport-security": f"max-age={_TLS_ONLY_S}"} if secure else {}
        self._headers = _HEADERS | tls

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it on with its session in `state`."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        if self._may_scrape(connection):
            await self._app(scope, receive, send)
            return
        session = self._session(connection)
        if refused := self._refusal(connection, session):
            await _refuse(scope, receive, send, *refused)
            return
        scope.setdefault("state", {})["session"] = session
        body, begun, refusal = _Body(), False, 0

        async def heard() -> Message:
            nonlocal refusal
            if scope["type"] == "http" and not body.is_complete:
                message, refusal = await body.receive(receive)
                if refusal:
                    raise _BodyError
            else:
                message = await receive()
            if message["type"] == "websocket.receive" and self._ended(session):
                return {"type": "websocket.disconnect", "code": 1008}
            return message

        async def sent(message: Message) -> None:
            nonlocal begun
            if refusal and not begun:
                return  # the application's answer to the aborted body: the refusal follows
            begun = True
            if message["type"] == "http.response.start":
                message.setdefault("headers", [])
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            await self._app(scope, heard, sent)
        except _BodyError:
            if begun:
                raise
            await _refuse(scope, receive, send, refusal)

    def _may_scrape(self, request: HTTPConnection) -> bool:
        """Whether a request for the metrics has their token."""
        if not self._bearer or request["path"] != METRICS or request.get("method") != "GET":
            return False
        given = request.headers.get("authorization", "")
        return hmac.compare_digest(given.encode(), self._bearer.encode())

    def _session(self, request: HTTPConnection) -> LoginSession | None:
        if self._sessions is None:
            return local_session()
        return self._sessions.of(request.cookies.get(COOKIE))

    def _ended(self, session: LoginSession | None) -> bool:
        """Whether the session of an open socket has ended: its messages are ignored."""
        if self._sessions is None:
            return self._has_accounts()
        if session is None:
            return False
        return self._sessions.renewed(session.key, used=False) is None

    def _refusal(
        self, request: HTTPConnection, session: LoginSession | None
    ) -> tuple[int, str] | tuple[int] | None:
        """Status code of the refusal, and its reason if the code has several; None = allowed."""
        scope, headers = request.scope, request.headers
        host = headers.get("host", "")
        if self._sessions is None and not is_loopback(host):
            return (421,)
        if self._sessions is None and self._has_accounts():
            return (503,)
        if self._sessions is None and not _is_of_this_user(scope):
            return 403, _OTHER_USER
        changes = scope["type"] == "websocket" or scope["method"] not in _SAFE
        socket = scope["path"].startswith("/_nicegui_ws")  # by long polling, too
        origin = headers.get("origin")
        if (changes or (socket and origin)) and not same_origin(origin, host, self._secure):
            return 403, _OTHER_ORIGIN if origin else _NO_ORIGIN
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > MOST_BYTES:
            return (413,)
        if session is None and scope["path"] != LOGIN:
            plain = scope["type"] == "http" and scope["method"] == "GET"
            to_login = plain and not scope["path"].startswith(("/_nicegui", METRICS))
            return (303,) if to_login else (401,)
        return None

    def _has_accounts(self) -> bool:
        """Whether users were added since this server began without; True if unknown."""
        try:
            return self._users is not None and len(self._users) > 0
        except (OSError, ValueError):
            return True


class _Body:
    """The body of a request while it arrives."""

    def __init__(self) -> None:
        self.is_complete = False
        self._bytes, self._waited_s = 0, 0.0

    async def receive(self, receive: Receive) -> tuple[Message, int]:
        """The next message, and the status code of a refusal; 0 = it is allowed."""
        started_s = time.monotonic()
        try:
            async with asyncio.timeout(BODY_S + self._bytes / LEAST_RATE - self._waited_s):
                message = await receive()
        except TimeoutError:
            return {"type": "http.disconnect"}, 408
        self._waited_s += time.monotonic() - started_s
        if message["type"] == "http.request":
            self._bytes += len(message.get("body", b""))
            self.is_complete = not message.get("more_body", False)
        return message, 413 if self._bytes > MOST_BYTES else 0


def _is_of_this_user(scope: Scope) -> bool:
    """Whether a connection is of this server's user, or of root; True if the system hides it."""
    client, server = scope.get("client"), scope.get("server")
    if sys.platform != "linux" or client is None or server is None:
        return True
    try:
        user = user_of_peer((client[0], client[1]), (server[0], server[1]))
    except ValueError:  # no connection by TCP
        return True
    return user in (0, os.getuid())


_REFUSALS = {
    **{303: "log in", 401: "log in", 413: "too long", 408: "too slow", 421: "not this host"},
    503: "users were added: start cell serve again, and log in",
}
_OTHER_USER = "from a program of another user of this computer: cell user add makes accounts"
_NO_ORIGIN = "the header Origin is missing: send the address of these pages in it"
_OTHER_ORIGIN = "the header Origin names another site: send the address of these pages in it"


async def _refuse(
    scope: Scope, receive: Receive, send: Send, status: int, reason: str = ""
) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = dict(_HEADERS)
    if status in (408, 413):  # the rest of the body is not read
        headers["connection"] = "close"
    if status == 303:
        headers["location"] = LOGIN
    await PlainTextResponse(reason or _REFUSALS[status], status, headers)(scope, receive, send)


#: Time limit for the head of a request after the connection or the last answer, s.
HEAD_S = 10.0


class TimedHttp(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
    """uvicorn's protocol with a time limit for the head of a request."""

    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the first request."""
        super().connection_made(transport)
        self._start_timer()

    def data_received(self, data: bytes) -> None:
        """Receive data; the timer runs from the first piece of a head to its end."""
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
        """Stop the timer."""
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
