"""Who may do what: logins, sessions, origins, paths, control; attacks are refused."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path
from time import monotonic
from types import MappingProxyType
from typing import Any

import pytest
import uvicorn

from cell.cli.serve import typed_password
from cell.computer.peers import user_of_peer
from cell.plant.client import Client
from cell.plant.messages import CommandReply, Request
from cell.plant.users import Role, User, Users
from cell.records.ledger.actions import listed_actions, take_over
from cell.records.ledger.ledger import Ledger
from cell.run.machine import CellState, MachineEvent
from cell.settings import load_settings
from cell.web.audit import Audit, audit_file
from cell.web.cycle_view import cycle_folder
from cell.web.guard import MOST_BYTES, Guard, TimedHttp
from cell.web.jobs import Jobs, JobTask
from cell.web.serve import may_be_served
from cell.web.sessions import (
    IDLE_S,
    LONGEST_S,
    LOST_S,
    MOST_WRONG,
    MOST_WRONG_IN_ALL,
    MOST_WRONG_OF_ADDRESS,
    Control,
    LoginSession,
    Sessions,
    local_session,
)
from cell.web.visit import PagesContext, Visit
from cell.web.watching import CellWatch

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
ADA = User("ada", Role.operate)


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def sessions(clock: Clock) -> Sessions:
    return Sessions({"ada": ADA}.get, clock)


def asked(
    guard: Guard,
    path: str = "/",
    *,
    method: str = "GET",
    kind: str = "http",
    body: bytes = b"",
    ends: Mapping[str, tuple[str, int]] = MappingProxyType({}),
    **headers: str,
) -> int:
    """Status of the answer; of a websocket 101, or 403 if it was refused."""
    given = {"host": "cell.plant", **headers}
    scope = {
        **ends,
        "type": kind,
        "path": path,
        "method": method,
        "headers": [(k.replace("_", "-").encode(), v.encode()) for k, v in given.items()],
    }
    said: list[MutableMapping[str, Any]] = []

    async def receive() -> MutableMapping[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: MutableMapping[str, Any]) -> None:
        said.append(message)

    asyncio.run(guard(scope, receive, send))
    if kind == "websocket":
        return 101 if said[0]["type"] == "websocket.accept" else 403
    return int(said[0]["status"])


async def inner(scope: Any, receive: Any, send: Any) -> None:
    assert isinstance(scope["state"]["session"], LoginSession) or scope["path"] == "/login"
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await receive()
    await send({"type": "http.response.start", "status": 200, "headers": []})


def test_without_a_login_there_is_only_the_login(sessions: Sessions) -> None:
    guard = Guard(inner, sessions, True)
    assert asked(guard) == 303
    assert asked(guard, "/login") == 200
    assert asked(guard, "/_nicegui/assets.js") == 401
    assert asked(guard, "/cycles/x/report", cookie="cell_session=guessed") == 303
    socket = {"kind": "websocket", "origin": "https://cell.plant"}
    assert asked(guard, "/_nicegui_ws/socket.io/", **socket) == 403
    cookie = f"cell_session={sessions.begin(ADA)}"
    assert asked(guard, cookie=cookie) == 200
    assert asked(guard, "/_nicegui_ws/socket.io/", cookie=cookie, **socket) == 101


def test_what_comes_from_another_site_is_refused(sessions: Sessions) -> None:
    guard = Guard(inner, sessions, True)
    cookie = f"cell_session={sessions.begin(ADA)}"
    for origin in ("https://evil.example", "http://cell.plant", "null", ""):
        socket = {"kind": "websocket", "origin": origin, "cookie": cookie}
        assert asked(guard, "/_nicegui_ws/socket.io/", **socket) == 403
        assert asked(guard, "/login", method="POST", origin=origin, cookie=cookie) == 403
    polled = {"origin": "https://evil.example", "cookie": cookie}
    assert asked(guard, "/_nicegui_ws/socket.io/", **polled) == 403
    assert asked(guard, "/login", method="POST", origin="https://cell.plant") == 200


def test_on_loopback_a_foreign_name_is_refused() -> None:
    guard = Guard(inner, None, False)
    assert asked(guard, host="localhost:8080") == 200
    assert asked(guard, host="[::1]:8080") == 200
    assert asked(guard, host="rebound.example:8080") == 421


def test_a_server_without_accounts_closes_once_there_are_some(tmp_path: Path) -> None:
    users = Users(tmp_path / "users.json")
    guard = Guard(inner, None, False, users)
    assert asked(guard, host="localhost") == 200
    users.add("ada", Role.watch, "correct horse")
    assert asked(guard, host="localhost") == 503
    opened = {"kind": "websocket", "origin": "http://localhost", "host": "localhost"}
    assert asked(guard, "/_nicegui_ws/socket.io/", **opened) == 403
    users.file.chmod(0o644)  # nobody can tell
    assert asked(guard, host="localhost") == 503


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the system does not tell")
@pytest.mark.parametrize("family", ["127.0.0.1", "::1"])
def test_the_user_of_a_connection_is_known(family: str) -> None:
    kind = socket.AF_INET6 if ":" in family else socket.AF_INET
    with socket.create_server((family, 0), family=kind) as server:
        here = server.getsockname()[:2]
        with socket.create_connection(here) as client:
            peer = client.getsockname()[:2]
            assert user_of_peer(peer, here) == os.getuid()
            assert user_of_peer((family, peer[1] % 60000 + 1), here) is None


def test_without_accounts_only_who_runs_the_server_is_let_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ends = {"client": ("127.0.0.1", 4711), "server": ("127.0.0.1", 8080)}
    for user, status in ((os.getuid(), 200), (0, 200), (os.getuid() + 1, 403), (None, 403)):
        monkeypatch.setattr("cell.web.guard.user_of_peer", lambda *_, user=user: user)
        guard = Guard(inner, None, False)
        assert asked(guard, host="localhost", ends=ends) == status


def test_a_body_that_is_too_long_is_refused() -> None:
    guard = Guard(inner, None, False)
    given = {"method": "POST", "host": "localhost", "origin": "http://localhost"}
    assert asked(guard, content_length=str(1 << 30), **given) == 413
    assert asked(guard, content_length="-1", **given) == 413
    assert asked(guard, body=bytes(MOST_BYTES + 1), **given) == 413


def test_a_body_that_stops_half_way_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a request kept its connection as long as it liked."""
    monkeypatch.setattr("cell.web.guard.BODY_S", 0.05)
    said: list[MutableMapping[str, Any]] = []
    pieces = [{"type": "http.request", "body": b"half", "more_body": True}]

    async def receive() -> MutableMapping[str, Any]:
        return pieces.pop() if pieces else await asyncio.sleep(60, {"type": "http.disconnect"})

    async def send(message: MutableMapping[str, Any]) -> None:
        said.append(message)

    async def reading(scope: Any, receive: Any, send: Any) -> None:
        while (await receive()).get("more_body"):
            pass
        await send({"type": "http.response.start", "status": 200, "headers": []})

    headers = [(b"host", b"localhost"), (b"origin", b"http://localhost")]
    scope = {"type": "http", "path": "/login", "method": "POST", "headers": headers}
    asyncio.run(Guard(reading, None, False)(scope, receive, send))
    assert said[0]["status"] == 408
    assert (b"connection", b"close") in said[0]["headers"]


@pytest.mark.parametrize(
    "heads", [(), (b"GET / HTTP/1.1\r\nHost: a",), (b"GET / HTTP/1.1\r\n\r\n", b"G")]
)
def test_a_head_that_stops_half_way_is_closed(
    monkeypatch: pytest.MonkeyPatch, heads: tuple[bytes, ...]
) -> None:
    monkeypatch.setattr("cell.web.guard.HEAD_S", 0.2)

    async def answer(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    async def closed_after() -> float:
        config = uvicorn.Config(answer, http=TimedHttp, lifespan="off", log_config=None)
        config.load()
        state = uvicorn.server.ServerState()
        server = await asyncio.get_running_loop().create_server(
            lambda: TimedHttp(config, state, {}), "127.0.0.1", 0
        )
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        for number, head in enumerate(heads):
            if number:
                await reader.readuntil(b"\r\n\r\n")
            writer.write(head)
        began_s = monotonic()
        await asyncio.wait_for(reader.read(), 10.0)
        writer.close()
        server.close()
        return monotonic() - began_s

    assert 0.1 < asyncio.run(closed_after()) < 5.0


def test_with_tls_browsers_come_by_tls_only(sessions: Sessions) -> None:
    def headers(secure: bool) -> dict[bytes, bytes]:
        said: list[MutableMapping[str, Any]] = []

        async def send(message: MutableMapping[str, Any]) -> None:
            said.append(message)

        async def receive() -> MutableMapping[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        scope = {"type": "http", "path": "/login", "method": "GET", "headers": []}
        asyncio.run(Guard(inner, sessions, secure)(scope, receive, send))
        return dict(said[0]["headers"])

    assert headers(True)[b"strict-transport-security"] == b"max-age=2592000"
    assert b"strict-transport-security" not in headers(False)


def test_sessions_expire_and_end(sessions: Sessions, clock: Clock) -> None:
    token = sessions.begin(ADA)
    clock.now_s = IDLE_S
    assert sessions.of(token) is not None
    clock.now_s += IDLE_S + 1.0
    assert sessions.of(token) is None
    token = sessions.begin(ADA)
    sessions.end(token)
    assert sessions.of(token) is None  # replayed
    token, begun = sessions.begin(ADA), clock.now_s
    while clock.now_s < begun + LONGEST_S:
        assert sessions.of(token) is not None
        clock.now_s += IDLE_S
    clock.now_s += 1.0
    assert sessions.of(token) is None


def test_an_open_page_alone_keeps_no_session(sessions: Sessions, clock: Clock) -> None:
    session = sessions.of(sessions.begin(ADA))
    assert session is not None
    for _ in range(3):
        clock.now_s += 0.4 * IDLE_S
        still = sessions.renewed(session.key, used=False)
    assert still is None


def test_who_was_removed_has_no_session() -> None:
    known = {"ada": ADA}
    sessions = Sessions(known.get)
    token = sessions.begin(ADA)
    known["ada"] = User("ada", Role.watch)
    session = sessions.of(token)
    assert session is not None and session.user.role is Role.watch
    known.clear()
    assert sessions.of(token) is None


def wrong(sessions: Sessions, name: str, address: str) -> bool:
    """Whether a password that is wrong was checked."""
    return sessions.count_login(name, address) is None


def test_after_wrong_passwords_one_must_wait(sessions: Sessions, clock: Clock) -> None:
    """Of a thousand requests at once every password was looked at: none was known to be wrong."""
    for _ in range(MOST_WRONG):
        assert wrong(sessions, "ada", "10.0.0.1")
        sessions.count_right("ada", "10.0.0.1")
    tried = [wrong(sessions, "ada", "10.0.0.1") for _ in range(1000)]
    assert tried == [True] * MOST_WRONG + [False] * (1000 - MOST_WRONG)
    assert wrong(sessions, "bob", "10.0.0.2")
    clock.now_s = 61.0
    assert wrong(sessions, "ada", "10.0.0.1")


def test_wrong_passwords_of_others_lock_nobody_out(sessions: Sessions) -> None:
    """Five wrong passwords by anybody locked the owner of the name out."""
    sessions.count_login("ada", "10.0.0.1")
    sessions.count_right("ada", "10.0.0.1")
    assert sum(wrong(sessions, "ada", "10.0.0.9") for _ in range(99)) == MOST_WRONG
    assert wrong(sessions, "ada", "10.0.0.1")
    for host in range(500):
        sessions.count_login("ada", f"10.0.1.{host}")
    assert wrong(sessions, "ada", "10.0.0.1")
    assert not wrong(sessions, "ada", "10.0.0.3")


def test_many_names_and_many_addresses_are_no_way_around(sessions: Sessions) -> None:
    of_address = sum(wrong(sessions, f"user{n}", "10.0.0.1") for n in range(1000))
    assert of_address == MOST_WRONG_OF_ADDRESS
    in_all = sum(wrong(sessions, "ada", f"10.1.{n}") for n in range(1000))
    assert of_address + in_all == MOST_WRONG_IN_ALL
    limits = [sessions.count_login("ada", "10.0.0.1") for _ in range(3)]
    assert [limit is not None and limit.is_first for limit in limits] == [False] * 3


def test_users_are_hashed_in_a_file_for_their_owner(tmp_path: Path) -> None:
    users = Users(tmp_path / "users.json")
    assert users.add("ada", Role.operate, "correct horse")
    assert users.file.stat().st_mode & 0o777 == 0o600
    assert "correct horse" not in users.file.read_text("utf-8")
    assert users.authenticate("ada", "correct horse") == ADA
    assert users.authenticate("ada", "wrong horse") is None
    assert users.authenticate("eve", "correct horse") is None
    for name, password in (("a/b", "correct horse"), ("bob", "short"), ("", "correct horse")):
        with pytest.raises(ValueError):
            users.add(name, Role.watch, password)
    users.file.chmod(0o644)
    with pytest.raises(ValueError, match="chmod 600"):
        users.named("ada")
    users.file.chmod(0o600)
    users.remove("ada")
    assert len(users) == 0


def test_a_password_comes_from_the_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    import io

    monkeypatch.setattr("sys.stdin", io.StringIO("from stdin\nmore\n"))
    assert typed_password() == "from stdin"


def test_beyond_loopback_tls_and_users_are_needed() -> None:
    assert may_be_served("127.0.0.1", False, 0, True) == ""
    assert "TLS" in may_be_served("0.0.0.0", False, 1, False)
    assert "user add" in may_be_served("0.0.0.0", True, 0, False)
    assert may_be_served("0.0.0.0", True, 1, False) == ""


def test_a_cycles_name_leads_nowhere_else(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    good = runs / "20261121T021043.800-3"
    good.mkdir(parents=True)
    (tmp_path / "20261121T021043.800-4").mkdir()
    (runs / "20261121T021043.800-5").symlink_to(tmp_path)
    assert cycle_folder(runs, good.name) == good
    for name in ("..", "../20261121T021043.800-4", "20261121T021043.800-5", "", "a\0b", "x"):
        assert cycle_folder(runs, name) is None


def test_one_page_has_control(clock: Clock) -> None:
    clock.now_s = 100.0
    control = Control(clock)
    assert control.take("page 1", "ada").page == "page 1"
    assert control.take("page 2", "bob").name == "ada"
    control.release("page 2")
    assert control.keep_alive("page 1") is not None
    assert control.take("page 3", "ada").page == "page 3"
    clock.now_s += LOST_S + 1.0
    assert control.keep_alive("page 2") is None
    assert control.take("page 2", "bob").name == "bob"


class Asked(Client):
    """A cell that obeys, and keeps what it was asked."""

    requests: list[Request]

    def send(self, request: Request) -> CommandReply:
        self.requests.append(request)
        return CommandReply(True, CellState.STARTING)


def visit(runs: Path, session: LoginSession, sessions: Sessions | None) -> Visit:
    settings, client = load_settings(CONFIG), Asked(runs)
    client.requests = []
    watch = CellWatch(client, settings, runs)
    room = PagesContext(CONFIG, settings, runs, client, watch, sessions)
    return Visit(room, session, "page 1", "en", str)


def test_who_may_only_watch_commands_nothing_and_it_is_logged(tmp_path: Path) -> None:
    eve = User("eve", Role.watch)
    sessions = Sessions({"eve": eve}.get)
    session = sessions.of(sessions.begin(eve))
    assert session is not None
    watching = visit(tmp_path / "runs", session, sessions)
    watching.room.control.take("page 1", "eve")
    assert "may not" in watching.command(MachineEvent.STOP, monotonic())
    assert watching.room.client.requests == []  # type: ignore[attr-defined]
    [line] = watching.room.audit.file.read_text("utf-8").splitlines()
    said = json.loads(line)
    assert (said["by"], said["action"], said["done"]) == ("eve", "stop", False)
    assert watching.room.audit.file.stat().st_mode & 0o777 == 0o600


def test_a_start_needs_control_and_a_stop_does_not(tmp_path: Path) -> None:
    operating = visit(tmp_path / "runs", local_session(), None)
    client = operating.room.client
    assert isinstance(client, Asked)
    now_s = monotonic()
    assert "take control" in operating.command(MachineEvent.START, now_s)
    assert operating.command(MachineEvent.STOP, now_s - 60.0) == ""
    operating.room.control.take("page 1", "local")
    assert operating.command(MachineEvent.RESET, now_s) == ""
    assert operating.acknowledge(now_s, "Ada", "cable taken out") == ""
    assert "printable" in operating.command(MachineEvent.START, now_s, "A\n")
    assert "printable" in operating.command(MachineEvent.START, now_s, "A" * 201)
    assert client.requests == [
        Request(MachineEvent.STOP, "web:local"),
        Request(MachineEvent.RESET, "web:local"),
        Request(None, "web:local (Ada)", "cable taken out"),
    ]
    assert [r.asked_s for r in client.requests] == [now_s - 60.0, now_s, now_s]


def test_what_is_pressed_on_an_old_picture_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A start that was pressed while the pages' server was halted moved the arm."""
    operating, done = visit(tmp_path / "runs", local_session(), None), []
    beats = operating.heartbeats
    first = beats.send()
    assert monotonic() - 0.5 < beats.sent_s(first) <= monotonic()
    for unknown in (0, 99, None, "1", [1]):
        assert beats.sent_s(unknown) == 0.0
    for _ in range(200):
        beats.send()
    assert beats.sent_s(first) == 0.0
    act = lambda: done.append(1) or ""  # noqa: E731
    refused = operating.do("calibrate", Role.operate, act, asked_s=monotonic() - 1.5)
    assert refused.startswith("calibrate was given 1.5 s ago, and is refused after 1 s")
    assert done == []
    assert operating.do("calibrate", Role.operate, act, asked_s=monotonic()) == ""


def test_a_line_torn_by_a_power_cut_tears_no_other(tmp_path: Path) -> None:
    """The acknowledgement after the power cut was glued to the torn line, and lost with it."""
    audit = Audit(audit_file(tmp_path / "runs"))
    audit.write("ada", "start", True)
    with audit.file.open("ab") as file:
        file.write(b'{"at": "2026-11')
    audit.write("ada", "reset", True, "cable taken out")
    audit.write("ada", "start", True)
    Ledger(tmp_path / "runs", create=True).close()
    take_over(tmp_path / "runs", audit.file, "line")
    assert [a.action for a in listed_actions(tmp_path / "runs")] == ["start", "reset", "start"]


def test_what_is_done_and_not_in_the_log_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk the cell was stopped, and whoever had stopped it was told nothing."""
    operating = visit(tmp_path / "runs", local_session(), None)
    monkeypatch.setattr("cell.web.audit.os.write", lambda *_: 3)
    said = operating.command(MachineEvent.STOP, monotonic())
    assert said.startswith("done, but it cannot be written to") and "No space left" in said
    assert operating.room.client.requests == [  # type: ignore[attr-defined]
        Request(MachineEvent.STOP, "web:local")
    ]
    assert "take control" in operating.command(MachineEvent.START, monotonic())


MOVING = JobTask("Measure", "cell", (("run",),), moves=True)


def test_what_moves_the_arm_begins_only_if_nothing_else_has_the_devices(tmp_path: Path) -> None:
    """A cable could be measured while a calibration moved the arm, and the other way round."""
    room = visit(tmp_path / "runs", local_session(), None).room
    waits = [sys.executable, "-c", "input()"]
    assert room.with_devices(lambda: room.guided.start("calibrate time", waits)) == ""
    began: list[str] = []
    assert "calibrate time is under way" in room.with_devices(lambda: began.append("run") or "")
    room.guided.close()

    def started(_: Sequence[str]) -> subprocess.Popen[str]:
        endless, pipe = [sys.executable, "-c", "import time; time.sleep(600)"], subprocess.PIPE
        return subprocess.Popen(
            endless, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        )

    with Jobs(started) as room.lab.jobs:
        assert room.with_devices(lambda: room.lab.jobs.submit(MOVING, "ada")) == ""
        refused = room.with_devices(lambda: room.guided.start("calibrate", waits))
        assert "is being measured" in refused and not room.guided.state.runs
    room.watch.reconnected()
    assert "a cell runs" in room.with_devices(lambda: began.append("run") or "")
    assert began == []
