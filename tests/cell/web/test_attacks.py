"""Attacks on the pages as they are served: by roles, replayed sessions, names, lengths."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest
from nicegui import core
from starlette.websockets import WebSocketDisconnect

from cell.plant.client import Client
from cell.plant.messages import Status
from cell.plant.users import Role, User, Users
from cell.records.folder import Record
from cell.records.recording import form
from cell.records.recording.writer import RecordingWriter
from cell.records.result import Outcome, Result
from cell.run.machine import CellState, MachineEvent
from cell.settings import load_settings
from cell.web.guard import COOKIE, Guard, TimedHttp
from cell.web.serve import application, serve
from cell.web.sessions import IDLE_S, MOST_WRONG, Sessions
from cell.web.visit import PagesContext, Visit
from cell.web.watching import CellWatch, WatchedState

with warnings.catch_warnings():  # starlette wishes for another client than we have
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
USERS = {role.name: User(role.name, role) for role in Role}
#: Where the client that asks thinks it is.
AT = "http://testserver"
UPGRADE = {"upgrade": "websocket"}
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
#: Shown as text wherever it appears.
PART = "<script>document.title='run'</script>"


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Served:
    """All pages behind their guard, with a cycle that has a film."""

    def __init__(self, folder: Path) -> None:
        runs = folder / "runs"
        settings, client = load_settings(CONFIG), Client(runs)
        self.clock, self.cycle = Clock(), film(runs)
        self.sessions = Sessions(USERS.get, self.clock)
        watch = CellWatch(client, settings, runs)
        self.room = PagesContext(CONFIG, settings, runs, client, watch, self.sessions)
        app = application(self.room, Users(folder / "users.json"), False)
        self.web = TestClient(Guard(app, self.sessions, False), AT, follow_redirects=False)

    def log_in(self, role: str) -> dict[str, str]:
        """Headers of somebody with a new session."""
        return {"cookie": f"{COOKIE}={self.sessions.begin(USERS[role])}", "origin": AT, **UPGRADE}

    def socket(self, headers: dict[str, str]) -> str:
        """What a new socket is told first; "" = it was refused."""
        try:
            with self.web.websocket_connect(SOCKET, headers=headers) as socket:
                return socket.receive_text()
        except WebSocketDisconnect:
            return ""


def film(runs: Path) -> Path:
    made = Record(runs, 3, datetime(2026, 11, 24, 6, 30))
    made.close(Result(3, Outcome.MISSED, str(made.folder), part=PART, reason=PART))
    writer = RecordingWriter(made.folder / form.FILE, {form.EPOCH: "0", "format": form.FORMAT})
    writer.frame(0, 1.0, 48, 64, bytes(48 * 64))
    writer.close({})
    return made.folder


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Once more in a process where it was served before: tests of a file may come in two parts."""
    core.app.middleware_stack = None
    served = Served(tmp_path_factory.mktemp("pages"))
    with served.web:
        yield served


@pytest.mark.parametrize("role", ["watch", "operate"])
@pytest.mark.parametrize("path", ["/settings", "/calibration", "/lab"])
def test_pages_of_engineers_are_not_built_for_others(served: Served, role: str, path: str) -> None:
    shown = served.web.get(path, headers=served.log_in(role))
    assert shown.status_code == 403 and "You may not see this page." in shown.text
    for inside in ("data-test=search", "data-test=promote", "data-test=editor", "hold_s"):
        assert inside not in shown.text


def test_who_may_only_watch_is_told_so_in_place_of_buttons(served: Served) -> None:
    for role in ("watch", "operate"):
        shown = served.web.get("/", headers=served.log_in(role)).text
        assert ("You may only watch" in shown, 'data-test":"start"' in shown) == (
            role == "watch",
            role == "operate",
        )


def test_a_refused_origin_is_named(served: Served) -> None:
    """Curl without the header was told to make accounts, although one existed."""
    for headers, said in (
        ({}, "the header Origin is missing: send"),
        ({"origin": "http://evil.example"}, "the header Origin names another site: send"),
    ):
        refused = served.web.post("/login", data={"name": "ada"}, headers=headers)
        assert refused.status_code == 403 and refused.text.startswith(said)


@pytest.mark.parametrize("path", ["/calibration/coverage.png", "/calibration/camera"])
def test_calibrations_are_read_by_engineers_only(served: Served, path: str) -> None:
    for role, status in (("watch", 403), ("operate", 403), ("engineer", 404)):
        assert served.web.get(path, headers=served.log_in(role)).status_code == status


def test_a_login_that_must_wait_is_in_the_log_once_and_no_header_evades_it(served: Served) -> None:
    """Of 429s the log said nothing, and `X-Forwarded-For` named another address each time."""
    statuses = []
    for n in range(MOST_WRONG + 3):
        headers = {"origin": AT, "x-forwarded-for": f"10.0.0.{n}"}
        given = {"name": "mallory", "password": "guessed"}
        statuses.append(served.web.post("/login", data=given, headers=headers).status_code)
    assert statuses == [401] * MOST_WRONG + [429] * 3
    lines = map(json.loads, served.room.audit.file.read_text("utf-8").splitlines())
    said = [line["note"] for line in lines if line["by"] == "mallory"]
    assert said == ["from testclient"] * MOST_WRONG + [
        "from testclient; too many wrong passwords of mallory from testclient"
    ]


def test_the_server_takes_no_address_from_a_header(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    options: dict[str, object] = {}
    monkeypatch.setattr("uvicorn.run", lambda app, **given: options.update(given))
    monkeypatch.setattr("cell.web.serve.application", lambda *_: None)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    serve(served.room, Users(served.room.runs / "users.json"), ("127.0.0.1", 0), None)
    assert (options["proxy_headers"], options["http"]) == (False, TimedHttp)


@pytest.mark.parametrize(
    "came, back",
    [
        (f"{AT}/lab?study=a", "/lab?study=a"),
        (f"{AT}/settings", "/settings"),
        ("http://evil.example/settings", "/"),
        (f"{AT}//evil.example", "/"),
        ("", "/"),
    ],
)
def test_a_choice_of_language_leads_back_to_its_page(served: Served, came: str, back: str) -> None:
    """It led to the live page, and what was typed was lost."""
    headers = {**served.log_in("engineer"), "referer": came}
    answer = served.web.get("/choose?language=de", headers=headers)
    assert (answer.status_code, answer.headers["location"]) == (303, back)
    assert "beforeunload" in served.web.get("/settings", headers=headers).text


def test_without_a_study_nothing_is_diagnosed_and_without_a_promotion_nothing_undone(
    served: Served,
) -> None:
    shown = served.web.get("/lab", headers=served.log_in("engineer")).text
    for button in ("diagnose", "suggest", "fit-own", "infer", "fit"):
        (props,) = re.findall(rf'"props":(\{{[^}}]*"data-test":"{button}"[^}}]*\}})', shown)
        assert '"disable":true' in props, button
    assert "Choose a study first." in shown


def test_a_cycle_that_is_not_there_is_not_found(served: Served) -> None:
    assert served.web.get("/cycle/none", headers=served.log_in("watch")).status_code == 404


ENGINEERS = ["write settings", "calibrate camera", "remove recording", "keep recording"]
ENGINEERS += ["lab promote", "lab check", "lab fit"]


@pytest.mark.parametrize("role", ["watch", "operate"])
@pytest.mark.parametrize("what", ENGINEERS)
def test_what_engineers_do_is_not_done_for_others(served: Served, role: str, what: str) -> None:
    session = served.sessions.of(served.sessions.begin(USERS[role]))
    assert session is not None
    done: list[str] = []

    def act() -> str:
        done.append(what)
        return ""

    assert "may not" in Visit(served.room, session, "p", "en", str).do(what, Role.engineer, act)
    assert done == []
    said = json.loads(served.room.audit.file.read_text("utf-8").splitlines()[-1])
    assert (said["by"], said["action"], said["done"]) == (role, what, False)


def test_who_loses_a_role_loses_its_deeds_on_a_page_that_is_open(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = served.sessions.of(served.sessions.begin(USERS["engineer"]))
    assert session is not None
    visit = Visit(served.room, session, "p", "en", str)
    assert visit.do("write settings", Role.engineer, str) == ""
    monkeypatch.setitem(USERS, "engineer", User("engineer", Role.operate))
    assert "may not" in visit.do("write settings", Role.engineer, str)


def test_no_socket_without_a_session_nor_from_another_site(served: Served) -> None:
    known = served.log_in("watch")
    assert served.socket(known).startswith("0{")
    assert served.socket({"origin": AT, **UPGRADE}) == ""
    assert served.socket({**known, "origin": "http://evil.example"}) == ""
    assert served.socket({"cookie": known["cookie"], **UPGRADE}) == ""


@pytest.mark.parametrize("ends", ["logout", "time"])
def test_a_session_that_has_ended_opens_nothing_and_its_sockets_hear_nobody(
    served: Served, ends: str
) -> None:
    known = served.log_in("operate")
    assert served.web.get("/", headers=known).status_code == 200
    with served.web.websocket_connect(SOCKET, headers=known) as socket:
        assert socket.receive_text().startswith("0{")
        if ends == "logout":
            assert served.web.get("/logout", headers=known).headers["location"] == "/login"
        else:
            served.clock.now_s += IDLE_S + 1.0
        socket.send_text("40")
        assert socket.receive()["type"] == "websocket.close"
    for path in ("/", "/history", f"/cycles/{served.cycle.name}/frames/0.jpg"):
        assert served.web.get(path, headers=known).headers["location"] == "/login"
    assert served.socket(known) == ""


@pytest.mark.parametrize(
    "path",
    [
        "/cycles/..%2F..%2Fetc/frames/0.jpg",
        "/cycles/{cycle}/frames/-1.jpg",
        "/cycles/{cycle}/frames/7.jpg",
        "/cycles/{cycle}/pictures/..%2Fresult.json",
        "/cycles/{cycle}/pictures/result.json",
        "/calibration/..%2Fcell.yaml",
        "/lab/results/..%2F..%2Fruns/look.html",
    ],
)
def test_no_path_leads_out(served: Served, path: str) -> None:
    asked = path.format(cycle=served.cycle.name)
    answer = served.web.get(asked, headers=served.log_in("engineer"))
    assert answer.status_code in (404, 422)
    assert b"outcome" not in answer.content


def test_a_cycle_leads_engineers_to_what_the_model_lacks(served: Served) -> None:
    path = f"/lab?study={served.cycle.name}&tab=diagnose"
    for role, is_there in (("engineer", True), ("operate", False)):
        shown = served.web.get(f"/cycle/{served.cycle.name}", headers=served.log_in(role)).text
        assert (json.dumps(path)[1:-1] in shown.replace("&amp;", "&")) is is_there
    lab = served.web.get(path, headers=served.log_in("engineer")).text
    assert re.search(r'"model-value":"diagnose"', lab)


def test_a_frame_is_shown_to_who_may_watch(served: Served) -> None:
    path = f"/cycles/{served.cycle.name}/frames/0.jpg"
    assert served.web.get(path, headers=served.log_in("watch")).status_code == 200


def test_a_script_as_part_id_is_text_in_the_report(served: Served) -> None:
    path = f"/cycles/{served.cycle.name}/report"
    shown = served.web.get(path, headers=served.log_in("watch"))
    assert PART not in shown.text and "&lt;script&gt;" in shown.text
    assert shown.headers["content-security-policy"].startswith("sandbox")


@pytest.mark.parametrize("path", ["/login", "/lab/upload"])
def test_a_body_of_a_gibibyte_is_refused_before_it_is_read(served: Served, path: str) -> None:
    headers = {**served.log_in("engineer"), "content-length": str(1 << 30)}
    assert served.web.post(path, content=b"", headers=headers).status_code == 413


HELD = (CellState.HELD, (MachineEvent.UNHOLD, MachineEvent.STOP))


@pytest.mark.parametrize(
    "state, possible", [(CellState.EXECUTE, (MachineEvent.HOLD, MachineEvent.STOP)), HELD]
)
def test_no_button_takes_the_place_of_its_opposite(
    served: Served, state: CellState, possible: tuple[MachineEvent, ...]
) -> None:
    """Who pressed Hold twice could press Continue, which came where Hold had been."""
    served.room.client.heard_s = float("inf")
    served.room.watch._state = WatchedState(Status("run", 1, state, 0.0, possible=possible), True)
    shown = served.web.get("/", headers=served.log_in("operate")).text
    served.room.watch._state = WatchedState()
    for button in ("hold", "unhold"):
        (classes,) = re.findall(rf'"class":(\[[^]]*\])[^[]*"data-test":"{button}"', shown)
        assert json.loads(classes) == ["big-button"], f"{button} is hidden"
