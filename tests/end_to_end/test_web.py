"""The pages in a real browser: cables inserted, a fault acknowledged, settings, films, login."""

from __future__ import annotations

import http.client
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import pytest

from cell.plant.client import Client
from cell.plant.users import Role, Users
from cell.records.folder import Record
from cell.records.recording import form
from cell.records.recording.writer import RecordingWriter
from cell.records.result import Outcome, Result
from cell.web.audit import audit_file
from tests.waiting import free_port, listens, wait_until
from tools.plant.browser import Browser

from .conftest import _QUICK, _SMALL, CONFIG, WINDY, changed, unrecorded

#: Shown as text wherever it appears; run nowhere.
PART = "<img src=x onerror=document.title='run'>"


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
def browser(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    """Chromium; with the parameter `logged` it keeps a log of what it asks the network for."""
    try:
        browser = Browser(tmp_path / "browser", logged=getattr(request, "param", "") == "logged")
    except RuntimeError as error:
        pytest.skip(str(error))
    with browser:
        yield browser.driver


#: The link of the history's second row, which the page may replace while it loads.
SECOND_ROW = "[data-test=cycles] tbody tr:nth-child(2) a"

#: Is an element where it was two pictures ago, and nothing that holds it animated?
_STANDS_STILL = """
const [element, done] = arguments;
const place = () => JSON.stringify(element.getBoundingClientRect());
const before = place();
requestAnimationFrame(() => requestAnimationFrame(() => done(
    place() === before && !document.getAnimations().some(
        (a) => a.playState === 'running' && a.effect.target.contains(element)))));
"""


class LivePage:
    """The live page, as a person uses it."""

    def __init__(self, browser: Any) -> None:
        self._browser = browser

    def text(self, what: str) -> str:
        """Of an element; "" = there is none yet."""
        return self.text_at(f"[data-test='{what}']")

    def text_at(self, css: str) -> str:
        """The same, of an element anywhere."""
        script = "const e = document.querySelector(arguments[0]); return e ? e.innerText : ''"
        return str(self._browser.execute_script(script, css))

    def click(self, what: str) -> None:
        """Once it stands still: a click at where a moving element was goes to what is behind it.

        what  as `data-test` names it, or a CSS selector that begins with a bracket
        """
        self._do(what, lambda element: element.click(), still=True)

    def click_until(self, what: str, where: str, said: str) -> None:
        """Once more if the command was refused: on a busy computer its page may be too old."""

        def done() -> bool:
            self.click(what)
            end_s = time.monotonic() + 15.0
            while self.text(where) != said and time.monotonic() < end_s:
                time.sleep(0.1)
            return self.text(where) == said

        wait_until(done)

    def command(self, what: str, state: str) -> None:
        """Press until the cell is in this state: on a busy computer a click may come too late."""

        def done() -> bool:
            self._attempt(what, lambda element: element.click(), still=True)
            end_s = time.monotonic() + 10.0
            while self.text("state") != state and time.monotonic() < end_s:
                time.sleep(0.05)
            return self.text("state") == state

        wait_until(done, why=lambda: f"{what}: {self.text('state')}, not {state}")

    def start(self, cell: Client) -> None:
        """Start one cycle.  It may have ended before a slow browser shows that it runs."""
        before = cell.status().cycle

        def done() -> bool:
            self._attempt("start", lambda element: element.click(), still=True)
            end_s = time.monotonic() + 10.0
            while cell.status().cycle == before and time.monotonic() < end_s:
                time.sleep(0.05)
            return cell.status().cycle != before

        wait_until(done, why=lambda: f"start: {self.text('state')}")

    def type(self, what: str, text: str) -> None:
        self._do(what, lambda element: element.send_keys(text))

    def enter(self, what: str, text: str) -> None:
        """In place of what is there."""
        self._do(what, lambda element: element.send_keys("\ue009a\ue000", text))  # control and a

    def enter_until(self, what: str, text: str, where: str, said: str) -> None:
        """Once more if the field was just made anew, as by a search that is still under way."""

        def done() -> bool:
            self.enter(what, text)
            end_s = time.monotonic() + 5.0
            while said not in self.text(where) and time.monotonic() < end_s:
                time.sleep(0.1)
            return said in self.text(where)

        wait_until(done)

    def _do(self, what: str, act: Callable[[Any], None], still: bool = False) -> None:
        """Once the element is there, and can be used; `still`: does not move as dialogs do."""
        wait_until(lambda: self._attempt(what, act, still), why=lambda: f"{what} cannot be used")

    def _attempt(self, what: str, act: Callable[[Any], None], still: bool) -> bool:
        from selenium.common.exceptions import (
            ElementClickInterceptedException,
            WebDriverException,
        )

        try:
            css = what if what.startswith("[") else f"[data-test='{what}']"
            element = self._browser.find_element("css selector", css)
            if not (element.is_enabled() and element.is_displayed()):
                return False
            if still and not self._browser.execute_async_script(_STANDS_STILL, element):
                return False
            act(element)
        except ElementClickInterceptedException:  # below the bar with the links
            self._browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
            return False
        except WebDriverException:  # made anew at this moment
            return False
        return True

    def reaches(self, state: str) -> None:
        wait_until(
            lambda: self.text("state") == state, why=lambda: f"{self.text('state')}, not {state}"
        )


def live(browser: Any, started: Started, config: Path, runs: Path) -> tuple[LivePage, Client, int]:
    """The live page of a cell that waits, which has taken control; the cell; the page's port."""
    port = free_port()
    started("run", "-c", config, "--cycles", "forever", "--runs", runs)
    started("serve", "-c", config, "--runs", runs, "--port", port)
    wait_until(lambda: listens(port))
    browser.get(f"http://127.0.0.1:{port}/")
    page = LivePage(browser)
    page.reaches("Idle")
    page.click("take")
    wait_until(lambda: page.text("control") == "You have control.")
    return page, Client(runs), port


@pytest.mark.parametrize("browser", ["logged"], indirect=True)
def test_cables_inserted_held_stopped_and_acknowledged_from_the_page(
    browser: Any, started: Started, config: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    page, cell, port = live(browser, started, config, runs)
    for number in (1, 2, 3):
        page.type("part", f"{PART}{number}")
        page.start(cell)
        wait_until(lambda number=number: cell.status().counts.get("inserted") == number)
        page.reaches("Idle")
    assert f"Part {PART}3" in page.text("cycle")
    wait_until(lambda: page.text("outcome") == "inserted")

    page.command("start", "Execute")
    page.command("hold", "Held")
    page.command("stop", "Stopped")
    wait_until(lambda: page.text("cause") == "stop by web:local")
    page.type("by", "Ada")
    page.type("note", "cable taken out")
    page.click("acknowledge")
    wait_until(lambda: cell.status().fault is None)
    assert cell.status().state == "stopped"  # nothing moves before the reset
    page.command("reset", "Idle")
    done = [json.loads(line) for line in audit_file(runs).read_text("utf-8").splitlines()]
    actions = ["take control", *["start"] * 4, "hold", "stop", "acknowledge", "reset"]
    assert [d["action"] for d in done if d["done"]] == actions

    browser.get(f"http://127.0.0.1:{port}/history")
    rows = wait_until(lambda: browser.find_elements("css selector", "[data-test=cycles] tbody a"))
    assert len(rows) == 4
    assert f"{PART}3" in page.text("cycles")
    page.click(SECOND_ROW)
    wait_until(lambda: "inserted at offset" in page.text("says"))
    assert "`recording: null`" in page.text("no-film")
    assert f"Part {PART}3" in page.text_at("main, .q-page")
    assert browser.title == "Cable cell"
    messages = [json.loads(e["message"])["message"] for e in browser.get_log("performance")]
    sent = [m["params"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    asked = {urlsplit(s["request"]["url"]) for s in sent}
    of_net = [u for u in asked if u.scheme in ("http", "https", "ws", "wss")]
    assert {u.hostname for u in of_net} == {"127.0.0.1"}


def test_a_missed_cable_is_told_and_the_next_one_is_inserted(
    browser: Any, started: Started, config: Path, tmp_path: Path
) -> None:
    # In the simulated world's own time: what a slow computer would miss changes outcomes.
    own_time = ("  real_time_factor: 2.0\n", "")
    windy = changed(config, tmp_path / "windy.yaml", [own_time, *WINDY])
    page, cell, port = live(browser, started, windy, tmp_path / "runs")
    why = {"rejected": "probability", "missed": "the tip missed", "inserted": ""}
    for outcome in why:
        page.start(cell)
        wait_until(
            lambda outcome=outcome: page.text("outcome") == outcome,
            why=lambda: f"{page.text('state')}: {page.text('outcome')} {page.text('why')}",
        )
        assert why[outcome] in page.text("why")
        page.reaches("Idle")
        assert cell.status().fault is None
    wait_until(lambda: page.text("strip").split() == ["–", "✗", "✓"])
    assert cell.status().counts == {"rejected": 1, "missed": 1, "inserted": 1}

    browser.get(f"http://127.0.0.1:{port}/history")
    wait_until(lambda: "1 × missed: the tip missed the destination by" in page.text("reasons"))
    wait_until(lambda: "of inserted cables (1)" in page.text("lost-said"))
    table = page.text("lost-time")
    assert all(cause in table for cause in ("rejected", "missed", "waiting for a start"))
    page.click(SECOND_ROW)  # the newest stands first
    wait_until(lambda: "the tip missed the destination by" in page.text("says"))


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Folder of a cycle of three frames."""
    made = Record(tmp_path / "runs", 3, datetime(2026, 11, 24, 6, 30))
    seconds = {"lower": 0.5}
    made.close(Result(3, Outcome.MISSED, str(made.folder), seconds=seconds, part="A-1"))
    begun = {form.EPOCH: "0", "format": form.FORMAT}
    writer = RecordingWriter(made.folder / form.FILE, begun)
    for index in range(3):
        writer.frame(index, 1.0 + index, 48, 64, bytes(48 * 64))
    corners = [[10, 10], [20, 10], [20, 30], [10, 30]]
    writer.event(form.CYCLE, 1.0, {"cycle": 3, "destination_px": corners})
    destination = {"x_m": [-0.02, -0.01], "y_m": [0.0, 0.01]}
    writer.event(form.SETTINGS, 1.0, {"settings": {"destination": destination}})
    table = [{"offset_m": o, "probability": p, "margin_m": 0.0} for o, p in ((0, 0.1), (0.01, 1))]
    tip_m = [[0.0, 0.0], [-0.015, 0.005]]
    decision = {"offset_m": 0.01, "table": table, "tip_m": tip_m}
    writer.event(form.DECISION, 2.0, decision)
    passage = {"t_s": [0.1, 0.2], "tip_m": tip_m, "predicted_m": tip_m}
    writer.event(form.PASSAGE, 3.0, passage)
    writer.close({})
    return made.folder


@pytest.fixture
def uncalibrated(tmp_path: Path) -> Path:
    view = "  view: {metres_per_pixel: 0.0002, origin_column_px: 1000, origin_row_px: 150}\n"
    hidden = f"\nworld:\n  camera: {view.strip().removeprefix('view: ')}\n"
    edits = [(view, ""), ("\nworld:", f"\ncalibration: {{folder: {tmp_path / 'calib'}}}\n{hidden}")]
    path = changed(CONFIG, tmp_path / "cell.yaml", edits)
    path.write_text(path.read_text("utf-8").replace("  # hidden from the cell", ""), "utf-8")
    return path


def faults_of(browser: Any) -> list[str]:
    """What axe-core finds serious on the page, light and dark; none without axe-core."""
    try:
        script = resources.files("axe_core_python").joinpath("axe.min.js").read_text("utf-8")
    except ModuleNotFoundError:
        return []
    browser.execute_script(script)
    found = []
    for dark in ("false", "true"):
        browser.execute_script(f"Quasar.Dark.set({dark})")
        said = browser.execute_async_script(
            "const done = arguments[0]; axe.run({resultTypes: ['violations']}).then(done)"
        )
        found += [
            f"{browser.current_url} dark {dark}: {v['help']}: {v['nodes'][0]['html']}"
            for v in said["violations"]
            if v["impact"] in ("serious", "critical")
        ]
    return found


def test_settings_are_written_a_film_is_seen_and_a_camera_calibrated(
    browser: Any, started: Started, uncalibrated: Path, film: Path, tmp_path: Path
) -> None:
    port, page = free_port(), LivePage(browser)
    at = f"http://127.0.0.1:{port}"
    started("serve", "-c", uncalibrated, "--runs", tmp_path / "runs", "--port", port)
    wait_until(lambda: listens(port))

    browser.get(f"{at}/calibration")
    page.click_until("start-camera", "guided", "calibrate camera")
    calibrating = browser.current_window_handle
    browser.switch_to.new_window("tab")
    browser.get(f"{at}/settings")
    page.type("search", "motion.hold_s")
    entries = browser.find_elements("css selector", ".entry")
    wait_until(lambda: sum(e.is_displayed() for e in entries) == 1)
    page.enter_until("motion.hold_s", "31", "motion.hold_s:said", "less than or equal to 30")
    page.enter_until("motion.hold_s", "0.8", "checked", "Changes: 1. The settings are right.")
    serious = faults_of(browser)
    page.click("differences")
    wait_until(lambda: "+  hold_s: 0.8" in page.text_at(".diff"))
    page.click("write")
    wait_until(lambda: "Changes: 0." in page.text("checked"))
    written = uncalibrated.read_text("utf-8")
    assert "hold_s: 0.8" in written and "# the tip must pass it from right to left" in written
    assert "hold_s: 1.0" in (tmp_path / "cell.settings" / "0001.yaml").read_text("utf-8")

    browser.get(f"{at}/cycle/{film.name}")
    wait_until(lambda: page.text("time") == "0.000 s · 1/3")
    page.type("slider", "\ue014\ue014")  # arrow right
    wait_until(lambda: page.text("time") == "2.000 s · 3/3")
    shown = "const i = document.getElementById('film-frame'); return i.naturalWidth"
    wait_until(lambda: browser.execute_script(shown) == 64)
    serious += faults_of(browser)
    headings = {e.text for e in browser.find_elements("css selector", "[role=heading]")}
    assert headings >= {"Path of the tip", "Error of the forecast", "Decision"}
    page.click("replay")
    wait_until(
        lambda: f"{film / form.FILE}" in page.text("replayed")
    )  # which lacks a cycle's poses
    page.click("keep")
    wait_until(lambda: page.text("kept") == "The film is kept for good.")
    assert (film / "keep").exists()
    for path in ("/", "/history"):
        browser.get(at + path)
        wait_until(lambda: browser.find_elements("css selector", "[role=heading]"))
        serious += faults_of(browser)

    browser.switch_to.window(calibrating)
    wait_until(lambda: page.text("guided") == "calibrate camera: done")
    assert (tmp_path / "calib" / "camera.yaml").exists()
    assert "20 of 20" in page.text("guided-said") or "view 20" in page.text("guided-said")
    wait_until(lambda: "valid" in page.text_at(".plain-table"))
    serious += faults_of(browser)
    assert serious == []


def test_what_is_typed_is_kept_from_a_click_and_buttons_say_what_they_need(
    browser: Any, started: Started, uncalibrated: Path, tmp_path: Path
) -> None:
    """A click on another language led to the live page, and threw away what was typed."""
    port, page = free_port(), LivePage(browser)
    at = f"http://127.0.0.1:{port}"
    started("serve", "-c", uncalibrated, "--runs", tmp_path / "runs", "--port", port)
    wait_until(lambda: listens(port))
    asks = """
        const leave = new Event('beforeunload', {cancelable: true});
        window.dispatchEvent(leave);
        return leave.defaultPrevented;
    """
    browser.get(f"{at}/settings")
    page.type("search", "motion.hold_s")
    assert not browser.execute_script(asks)
    page.enter_until("motion.hold_s", "0.8", "checked", "Changes: 1. The settings are right.")
    wait_until(lambda: browser.execute_script(asks))
    browser.execute_script("unsaved.clear()")
    browser.find_element("link text", "DE").click()
    wait_until(lambda: browser.execute_script("return document.documentElement.lang") == "de")
    assert browser.current_url == f"{at}/settings"

    browser.get(f"{at}/lab?tab=diagnose")
    wait_until(lambda: page.text("needs-study") == "Wählen Sie zuerst eine Studie.")
    for name in ("diagnose", "suggest"):
        (button,) = browser.find_elements("css selector", f"[data-test={name}]")
        assert button.is_displayed() and not button.is_enabled()
    browser.get(f"{at}/lab?tab=line")
    wait_until(lambda: browser.find_elements("css selector", "[data-test=undo][disabled]"))
    assert faults_of(browser) == []


def test_with_users_nothing_is_shown_before_the_login(
    started: Started, config: Path, tmp_path: Path
) -> None:
    runs, port = tmp_path / "runs", free_port()
    Users(tmp_path / "users.json").add("ada", Role.watch, "correct horse")
    started(
        "serve", "-c", config, "--runs", runs, "--port", port, "--users", tmp_path / "users.json"
    )
    wait_until(lambda: listens(port))

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
    assert shown.status == 200 and 'data-test":"start"' not in shown.text
    assert "You may not see this page." in ask("GET", "/settings", **cookie).text
    for path in ("/cycles/..%2F..%2Fetc/report", "/cycles/../cell.yaml", "/cycles/x/newest"):
        assert ask("GET", path, **cookie).status == 404
    ask("GET", "/logout", **cookie)
    assert ask("GET", "/", **cookie).getheader("location") == "/login"  # replayed
