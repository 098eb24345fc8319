"""The live page in a browser, on one screen: nothing scrolls, no text is clipped, in any state."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cell.web.wording import translation
from tests.waiting import free_port, listens, wait_until

from .live_states import NOW, states
from .test_web import LivePage, browser, faults_of  # noqa: F401

SIZES = {"wide": (1920, 1080), "laptop": (1440, 900), "small": (1024, 768), "phone": (390, 844)}
#: Whether the page is larger than the screen, and elements that are larger than their place.
_TOO_LARGE = """
const clipped = [...document.querySelectorAll('.live *, header *')].filter((e) =>
    e.checkVisibility() && e.clientHeight && !e.closest('svg, .q-field') &&
    (e.scrollWidth > e.clientWidth + 1 || e.scrollHeight > e.clientHeight + 1));
const page = document.documentElement, scrolls = [];
if (page.scrollWidth > innerWidth) scrolls.push('sideways');
if (page.scrollHeight > innerHeight) scrolls.push('down');
return [scrolls, clipped.map((e) => `${e.className}: ${e.innerText}`)];
"""
_LETTERS_PX = """
return ['state', 'outcome'].map((name) => parseFloat(
    getComputedStyle(document.querySelector(`[data-test=${name}]`)).fontSize));
"""


@pytest.fixture
def choose(tmp_path: Path) -> Iterator[tuple[int, Callable[[str], None]]]:
    """Port of pages without a cell, and a function that chooses their state."""
    runs = tmp_path / "runs"
    newest = runs / f"{NOW:%Y%m%d}T142900.000-20"
    newest.mkdir(parents=True)
    (newest / "state.json").write_text("{}", "utf-8")
    for path in (newest / "outcome.jpg", runs / "live.jpg"):
        cv2.imwrite(str(path), np.full((1024, 1280), 128, np.uint8))
    port = free_port()
    command = [sys.executable, "-m", "tests.end_to_end.live_states", str(runs), str(port)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, text=True)
    wait_until(lambda: listens(port))

    def say(name: str) -> None:
        assert process.stdin is not None
        process.stdin.write(f"{name}\n")
        process.stdin.flush()

    yield port, say
    process.kill()
    process.communicate()


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_live_page_is_one_screen_in_every_state(
    browser: Any,  # noqa: F811
    choose: tuple[int, Callable[[str], None]],
    tmp_path: Path,
    language: str,
) -> None:
    port, say = choose
    page, t = LivePage(browser), translation(language)
    browser.get(f"http://127.0.0.1:{port}/choose?language={language}")
    wrong: list[object] = []
    for size, (width, height) in SIZES.items():
        shape = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape)
        browser.get(f"http://127.0.0.1:{port}/")
        for name, seen in states(tmp_path / "runs").items():
            say(name)
            known = seen.status if seen.connected else None
            word = known.state.value.capitalize() if known else "No cell runs"
            word = "No connection" if seen.unknown_s else word
            last = seen.status.last if seen.status else None
            shown = t(word), t(str((last or {}).get("outcome", "")))
            wait_until(lambda s=shown: (page.text("state"), page.text("outcome")) == s)
            scrolls, clipped = browser.execute_script(_TOO_LARGE)
            scrolls = [s for s in scrolls if size != "phone" or s == "sideways"]
            if scrolls or clipped:
                wrong.append((size, name, scrolls, clipped))
            assert min(browser.execute_script(_LETTERS_PX)) >= 40.0
            if size == "laptop" and name in ("idle", "fault"):
                wrong += faults_of(browser)
    assert wrong == []


def test_what_is_shown_in_a_fault_and_why_buttons_are_disabled(
    browser: Any,  # noqa: F811
    choose: tuple[int, Callable[[str], None]],
) -> None:
    port, say = choose
    page = LivePage(browser)
    say("fault")
    browser.get(f"http://127.0.0.1:{port}/")
    page.reaches("Stopped")
    wait_until(lambda: "protective stop" in page.text("cause"))
    assert "Handshake with the PLC has ended" in page.text("adapters")
    marks = page.text("strip").split()
    assert (len(marks), marks[2], marks[10], marks[-1]) == (20, "–", "✗", "!")
    why = {
        name: browser.find_element("css selector", f"[data-test={name}]").get_attribute("title")
        for name in ("start", "stop")
    }
    assert why == {"start": "Take control first.", "stop": "Not possible in this state."}
    say("held")
    page.reaches("Held")
    say("running")
    page.reaches("Execute")
    wait_until(lambda: page.text("step").startswith("filming the swing · "))
    (picture,) = browser.find_elements("css selector", "[data-test=camera]")
    wait_until(lambda: str(picture.get_attribute("src")).endswith("/live/1.jpg"))
