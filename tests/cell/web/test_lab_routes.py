"""Uploads to the lab, and pages out of it: only for engineers, and only what is there."""

from __future__ import annotations

import asyncio
import io
import json
import zipfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from httpx import ASGITransport, AsyncClient, Response

from cell.plant.client import Client
from cell.plant.users import Role, User
from cell.settings import load_settings
from cell.web import guard, workspace
from cell.web.guard import COOKIE, MOST_BYTES, Guard
from cell.web.serve import lab_routes
from cell.web.sessions import Sessions
from cell.web.visit import PagesContext
from cell.web.watching import CellWatch

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
USERS = {role.name: User(role.name, role) for role in Role}
OWN = {"Origin": "http://127.0.0.1"}


class Served:
    """The lab's routes behind the guard, asked by users of each role."""

    def __init__(self, runs: Path) -> None:
        settings, client = load_settings(CONFIG), Client(runs)
        self.sessions = Sessions(USERS.get)
        watch = CellWatch(client, settings, runs)
        self.room = PagesContext(CONFIG, settings, runs, client, watch, self.sessions)
        app = FastAPI(openapi_url=None)
        lab_routes(app, self.room)
        self._app = Guard(app, self.sessions, False)

    def headers(self, role: str) -> dict[str, str]:
        return {**OWN, "Cookie": f"{COOKIE}={self.sessions.begin(USERS[role])}"}

    def get(self, path: str, role: str = "engineer") -> Response:
        return self._asked("GET", path, headers=self.headers(role))

    def upload(self, files: dict[str, bytes], role: str = "engineer", **headers: str) -> Response:
        sent = [("files", (name, io.BytesIO(content))) for name, content in files.items()]
        headers = {**self.headers(role), **headers}
        return self._asked("POST", "/lab/upload", files=sent, headers=headers)

    def upload_without_length(self, size: int) -> Response:
        async def body() -> AsyncIterator[bytes]:
            yield b'--x\r\ncontent-disposition: form-data; name="files"; filename="a.csv"\r\n\r\n'
            for _ in range(size >> 16):
                yield bytes(1 << 16)

        headers = {**self.headers("engineer"), "content-type": "multipart/form-data; boundary=x"}
        return self._asked("POST", "/lab/upload", content=body(), headers=headers)

    def _asked(self, method: str, path: str, **request: Any) -> Response:
        async def ask() -> Response:
            over = ASGITransport(app=self._app)  # type: ignore[arg-type]
            async with AsyncClient(transport=over, base_url="http://127.0.0.1") as client:
                return await client.request(method, path, **request)

        return asyncio.run(ask())

    def audited(self) -> list[tuple[str, str, bool]]:
        lines = self.room.audit.file.read_text("utf-8").splitlines()
        return [(d["by"], d["action"], d["done"]) for d in map(json.loads, lines)]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    served = Served(tmp_path / "runs")
    with served.room.lab.jobs:
        yield served


def test_only_an_engineer_uploads_and_it_is_logged(served: Served) -> None:
    for role in ("watch", "operate"):
        answer = served.upload({"a.csv": b"1"}, role)
        assert (answer.status_code, "may not" in answer.json()["error"]) == (403, True)
    assert not served.room.lab.workspace.folder.exists()
    answer = served.upload({"a.csv": b"1"})
    assert answer.json() == {"name": "a", "is_study": False, "files": ["a.csv"]}
    assert served.audited() == [
        ("watch", "lab upload", False),
        ("operate", "lab upload", False),
        ("engineer", "lab upload", True),
    ]


def test_attacks_are_refused_with_what_is_wrong(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workspace, "MOST_UNPACKED", 8 << 20)
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as made:
        for n in range(9):
            made.writestr(f"{n}.csv", bytes(1 << 20))
    assert len(bomb.getvalue()) < MOST_BYTES
    answer = served.upload({"bomb.zip": bomb.getvalue()})
    assert (answer.status_code, "over 8 MiB" in answer.json()["error"]) == (422, True)
    assert "leads out" in served.upload({"../../a.csv": b"1"}).json()["error"]
    assert "not taken" in served.upload({"law.py": b"import os"}).json()["error"]
    assert served.upload({"a.csv": b"1"}, Origin="http://evil.example").status_code == 403
    claimed = {"content-length": str(1 << 30)}
    assert served.upload({"a.csv": b"1"}, **claimed).status_code == 413
    monkeypatch.setattr(guard, "MOST_BYTES", 1 << 20)
    assert served.upload_without_length(2 << 20).status_code == 413
    folder = served.room.lab.workspace.folder
    assert [p.name for p in folder.rglob("*.csv")] == []


def test_pages_are_sandboxed_and_of_the_workspace_only(served: Served, tmp_path: Path) -> None:
    kept = served.room.lab.workspace
    page = kept.results("made") / "look.html"
    page.parent.mkdir(parents=True)
    page.write_text("<script>1</script>")
    (page.parent / "secret.html").write_text("x")
    answer = served.get("/lab/results/made/look.html")
    assert answer.text == "<script>1</script>"
    assert answer.headers["content-security-policy"].startswith("sandbox allow-scripts;")
    assert served.get("/lab/results/made/look.html", "operate").status_code == 403
    (kept.results("other")).symlink_to(tmp_path)
    (tmp_path / "look.html").write_text("outside")
    for path in ("made/secret.html", "..%2F..%2Fx/look.html", "other/look.html", "none/look.html"):
        assert served.get(f"/lab/results/{path}").status_code == 404
