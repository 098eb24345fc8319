"""The pages in a real browser: cables inserted, hold, stop, a fault acknowledged; the login."""

from __future__ import annotations

import http.client
import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import pytest

from cell.plant.client import Client
from cell.web.audit import audit_file
from cell.web.users import Role, Users

from .conftest import _QUICK, _SMALL, CONFIG, changed, unrecorded

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--accept-lang=en", "--window-size=1440,900"),
)
#: Shown as text wherever it appears; run nowhere.
PART = "<img src=x onerror=document.title='run'>"


def free_port() -> int:
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        return int(tried.getsockname()[1])


def until(reached: Callable[[], Any], within_s: float = 90.0) -> Any:
    end_s = time.monotonic() + within_s
    while not (found := reached()):
        assert time.monotonic() < end_s
        time.sleep(0.1)
    return found


def answers(port: int) -> bool:
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


class Started:
    """Processes of `cell`, ended by the fixture."""

    def __init__(self) -> None:
        self._all: list[subprocess.Popen[bytes]] = []

    def __call__(self, *words: object) -> None:
        command = [sys.executable, "-m", "cell", *map(str, words)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._all.append(subprocess.Popen(command, **quiet))

    def end(self) -> list[int]:
        for process in self._all:
            process.terminate()
        return [process.wait(30) for process in self._all]


@pytest.fixture
def started() -> Iterator[Started]:
    started = Started()
    yield started
    started.end()


@pytest.fixture
def config(tmp_path: Path) -> Path:
    pace = ("  effects: {} ", "  real_time_factor: 2.0\n  effects: {} ")
    return unrecorded(changed(CONFIG, tmp_path / "cell.yaml", [*_QUICK, *_SMALL, pace]))


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Any]:
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("needs chromium and chromedriver: apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path / 'browser'}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    yield driver
    driver.quit()


class LivePage:
    """The live page, as a person uses it."""

    def __init__(self, browser: Any) -> None:
        self._browser = browser

    def text(self, what: str) -> str:
        return str(self._browser.find_element("css selector", f"[data-test={what}]").text)

    def click(self, what: str) -> None:
        button = self._browser.find_element("css selector", f"[data-test={what}]")
        until(lambda: button.is_enabled() and button.is_displayed())
        button.click()

    def type(self, what: str, text: str) -> None:
        self._browser.find_element("css selector", f"[data-test={what}]").send_keys(text)

    def reaches(self, state: str) -> None:
        until(lambda: self.text("state") == state)


def test_cables_inserted_held_stopped_and_acknowledged_from_the_page(
    browser: Any, started: Started, config: Path, tmp_path: Path
) -> None:
    runs, port = tmp_path / "runs", free_port()
    started("run", "-c", config, "--cycles", "forever", "--out", runs)
    started("serve", "-c", config, "--runs", runs, "--port", port)
    until(lambda: answers(port))
    browser.get(f"http://127.0.0.1:{port}/")
    page, cell = LivePage(browser), Client(runs)
    page.reaches("Idle")
    page.click("take")
    until(lambda: page.text("control") == "You have control.")
    for number in (1, 2, 3):
        page.type("part", f"{PART}{number}")
        page.click("start")
        until(lambda number=number: cell.status().counts.get("inserted") == number)
        page.reaches("Idle")
    assert f"Part {PART}3" in page.text("cycle")
    until(lambda: page.text("outcome") == "Newest cable: inserted")

    page.click("start")
    page.reaches("Execute")
    page.click("hold")
    page.reaches("Held")
    page.click("stop")
    page.reaches("Stopped")
    until(lambda: page.text("cause") == "stop by web:local")
    page.type("by", "Ada")
    page.type("note", "cable taken out")
    page.click("acknowledge")
    page.reaches("Idle")
    assert cell.status().fault is None
    done = [json.loads(line) for line in audit_file(runs).read_text("utf-8").splitlines()]
    actions = ["take control", *["start"] * 4, "hold", "stop", "reset"]
    assert [(d["action"], d["done"]) for d in done] == [(action, True) for action in actions]

    browser.get(f"http://127.0.0.1:{port}/history")
    rows = until(lambda: browser.find_elements("css selector", "[data-test=cycles] tbody a"))
    assert len(rows) == 4
    rows[1].click()
    frame = until(lambda: browser.find_elements("css selector", "iframe"))[0]
    browser.switch_to.frame(frame)
    until(lambda: "inserted at offset" in browser.find_element("css selector", "body").text)
    browser.switch_to.default_content()
    assert browser.title == "Cable cell"
    messages = [json.loads(e["message"])["message"] for e in browser.get_log("performance")]
    sent = [m["params"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    asked = {urlsplit(s["request"]["url"]) for s in sent}
    of_net = [u for u in asked if u.scheme in ("http", "https", "ws", "wss")]
    assert {u.hostname for u in of_net} == {"127.0.0.1"}


def test_with_users_nothing_is_shown_before_the_login(
    started: Started, config: Path, tmp_path: Path
) -> None:
    runs, port = tmp_path / "runs", free_port()
    Users(tmp_path / "users.json").add("ada", Role.watch, "correct horse")
    started(
        "serve", "-c", config, "--runs", runs, "--port", port, "--users", tmp_path / "users.json"
    )
    until(lambda: answers(port))

    def ask(method: str, path: str, form: dict[str, str] | None = None, **headers: str) -> Any:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
        if form is not None:
            headers["Content-Type"] = "application/x-www-form-urlencoded"
        connection.request(method, path, urlencode(form or {}), headers)
        answer = connection.getresponse()
        answer.text = answer.read().decode()  # type: ignore[attr-defined]
        connection.close()
        return answer

    own = {"Origin": f"http://127.0.0.1:{port}"}
    right = {"name": "ada", "password": "correct horse"}
    assert ask("GET", "/").getheader("location") == "/login"
    assert "password" in ask("GET", "/login").text
    assert ask("POST", "/login", right).status == 403
    assert ask("POST", "/login", right, Origin="http://evil.example").status == 403
    assert ask("POST", "/login", {**right, "password": "wrong"}, **own).status == 401
    entered = ask("POST", "/login", right, **own)
    assert entered.status == 303
    said = entered.getheader("set-cookie")
    assert "HttpOnly" in said and "samesite=strict" in said.lower()
    cookie = {"Cookie": said.split(";")[0]}
    shown = ask("GET", "/", **cookie)
    assert shown.status == 200 and "data-test=start" not in shown.text
    assert "You may not see this page." in ask("GET", "/settings", **cookie).text
    for path in ("/cycles/..%2F..%2Fetc/report", "/cycles/../cell.yaml", "/cycles/x/newest.png"):
        assert ask("GET", path, **cookie).status == 404
    ask("GET", "/logout", **cookie)
    assert ask("GET", "/", **cookie).getheader("location") == "/login"  # replayed
