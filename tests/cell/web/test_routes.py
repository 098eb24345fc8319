"""Every route of the pages' server, asked without a login and by each role."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx
import pytest

from cell.plant.users import Role, Users
from tests.waiting import free_port, wait_until

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
PASSWORD, TOKEN = "a long password", "a token"
_ROUTES = """
import json, sys
from pathlib import Path
from nicegui import core
from cell.cli.serve import _room
from cell.plant.users import Users
from cell.web.serve import application
room = _room(Path(sys.argv[1]), Path(sys.argv[2]), None)
app = application(room, Users(Path(sys.argv[2]) / "users.json"), False)
routes = [*app.routes, *core.app.routes]
print(json.dumps([[r.path, sorted(getattr(r, "methods", None) or [])] for r in routes]))
"""
#: Least role → method and path.  Everybody may log in; nothing else is open.
TABLE: dict[Role | None, set[tuple[str, str]]] = {
    None: {("GET", "/login"), ("POST", "/login")},
    Role.watch: {
        *(("GET", path) for path in ("/", "/history", "/logout", "/choose", "/metrics")),
        *(("GET", f"/cycles/{{name}}/{what}") for what in ("newest", "report")),
        ("GET", "/cycles/{name}/frames/{number}.jpg"),
        ("GET", "/cycles/{name}/pictures/{picture}"),
        ("GET", "/cycle/{name}"),
        ("GET", "/live/{number}.jpg"),
    },
    Role.engineer: {
        *(("GET", path) for path in ("/lab", "/calibration", "/settings")),
        ("GET", "/calibration/{name}"),
        ("GET", "/lab/results/{name}/{page}"),
        ("POST", "/lab/upload"),
    },
}
#: NiceGUI's own files and its socket, and the manual: for whoever is logged in.
_OF_NICEGUI = ("/_nicegui", "/static", "/manual")


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder, port = tmp_path_factory.mktemp("served"), free_port()
    users = Users(folder / "users.json")
    for role in Role:
        users.add(role.name, role, PASSWORD)
    (token := folder / "token").write_text(f"{TOKEN}\n")
    token.chmod(0o600)
    words = ["serve", "-c", CONFIG, "--runs", folder / "runs", "--port", port]
    words += ["--users", users.file, "--metrics-token", token]
    process = subprocess.Popen([sys.executable, "-m", "cell", *map(str, words)])
    address = f"http://127.0.0.1:{port}"

    def answers() -> bool:
        try:
            return httpx.get(f"{address}/login").status_code == 200
        except httpx.ConnectError:
            return False

    wait_until(answers)
    yield address
    process.terminate()
    process.wait(30)


def logged_in(address: str, role: Role | None) -> httpx.Client:
    client = httpx.Client(base_url=address, headers={"Origin": address}, timeout=60.0)
    if role is not None:
        data = {"name": role.name, "password": PASSWORD}
        assert client.post("/login", data=data).headers["location"] == "/"
    return client


def test_the_table_has_every_route(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _ROUTES, str(CONFIG), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    routes = {
        (method, path)
        for path, methods in json.loads(done.stdout.splitlines()[-1])
        if path and not path.startswith(_OF_NICEGUI)
        for method in methods
        if method != "HEAD"
    }
    assert routes == set.union(*TABLE.values())


@pytest.mark.parametrize("role", [None, *Role], ids=str)
def test_each_route_is_open_from_its_least_role_on(address: str, role: Role | None) -> None:
    every = [(path, method, least) for least, rows in TABLE.items() for method, path in rows]
    every.sort(key=lambda row: (row[0] == "/logout", *row[:2]))  # it ends the session
    with closing(logged_in(address, role)) as client:
        for path, method, least in every:
            status = client.request(method, re.sub(r"{\w+}", "1", path)).status_code
            if path == "/login":
                assert status in (200, 401), (method, status)
            elif least is None or (role is not None and role >= least):
                assert status in (200, 303, 404, 422), (method, path, status)
            elif role is None:
                assert status in (303, 401), (method, path, status)
            else:
                assert status == 403, (method, path, status)


def test_the_token_opens_the_metrics_and_nothing_else(address: str) -> None:
    right, wrong = ({"Authorization": f"Bearer {t}"} for t in (TOKEN, "another"))
    with httpx.Client(base_url=address) as client:
        read = client.get("/metrics", headers=right)
        assert read.status_code == 200 and "cell_connected 0.0" in read.text
        assert client.get("/metrics", headers=wrong).status_code == 401
        assert client.get("/metrics").status_code == 401
        assert client.get("/history", headers=right).status_code == 303
        assert client.post("/metrics", headers=right).status_code in (401, 403)
