"""How soon pages are there and answer while a simulated cell makes cycles, and what that costs.

    python -m tools.plant.pages_times [--turns 5]

The cell, with smaller pictures, works at the speed of reality, beside `cell serve` and headless
Chromium on the same computer.  Each page is opened with an empty cache, until its content is there;
then something is clicked or typed until the answer can be seen.  Printed are medians and longest
times, the CPU time of the pages' process for a visit, and the computer's load.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from cell.plant.client import Client
from cell.records.recording import form
from cell.records.recording.retention import KEPT
from tools.plant.adapter_kills import made, quick, service
from tools.plant.around import wait_until
from tools.plant.browser import Browser, Pages
from tools.plant.pages_soak import going_on

#: A page is there, and answers, within so long, s.
COLD_S, ANSWER_S = 2.0, 0.2
#: Cycles that are in the history before it begins.
_BEFORE = 3
#: A page, a condition in JavaScript that its content is there.
_THERE = (
    ("Live", "/", "text('state').length > 0 && text('outcome').length > 0"),
    ("History", "/history", "document.querySelector('[data-test=cycles] tbody a') !== null"),
    ("Cycle", "/cycle/{cycle}", "text('says').length > 0 && loaded('#film-frame')"),
    ("Lab", "/lab", "document.querySelector('[data-test=drop][data-ready]') !== null"),
    ("Calibration", "/calibration", "document.querySelector('.plain-table td') !== null"),
    ("Settings", "/settings", "document.querySelector('.entry input') !== null"),
)
#: What is done, JavaScript, and the condition that it is answered.  Calibrations can be looked at
#: only while a cell runs.
_DONE = {
    "Live": ("click('take')", "text('control') === 'You have control.'"),
    "History": (
        "type('Part', 'none')",
        "document.querySelector('[data-test=cycles] tbody a') === null",
    ),
    "Cycle": ("click('keep')", "text('kept') === 'The film is kept for good.'"),
    "Lab": ("click('tab-line')", "shown('candidate-name')"),
    "Settings": ("type('Search', 'hold_s')", "shown('motion.hold_s') && !shown('cable.width_m')"),
}
_WORDS = """
const at = (what) => document.querySelector(`[data-test='${what}']`);
const text = (what) => { const e = at(what); return e ? e.innerText : ''; };
const shown = (what) => { const e = at(what); return e !== null && e.offsetParent !== null; };
const loaded = (css) => { const e = document.querySelector(css); return e && e.naturalWidth > 0; };
const click = (what) => at(what).click();
const type = (label, words) => {
  const e = document.querySelector(`input[aria-label='${label}']`);
  e.value = words; e.dispatchEvent(new Event('input', {bubbles: true}));
};
"""
#: Runs in the page: milliseconds from an action until a condition holds.
_TIMED = (
    _WORDS
    + """
const done = arguments[arguments.length - 1], begun = performance.now();
%s;
const look = () => {
  if (%s) done(performance.now() - begun);
  else if (performance.now() - begun > 60000) done(-1);
  else setTimeout(look, 4);
};
look();
"""
)


@dataclass
class Times:
    """Of one page: s until it was there, s until it answered, s of CPU time of a visit."""

    cold_s: list[float] = field(default_factory=list)
    answer_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def add(self, other: Times) -> None:
        """Those of another visit."""
        self.cold_s += other.cold_s
        self.answer_s += other.answer_s
        self.cpu_s += other.cpu_s


def configs_in(folder: Path) -> tuple[Path, Path]:
    """The simulated cell at the speed of reality; and the same for the pages, to be calibrated."""
    content = yaml.safe_load(quick(folder / "quick.yaml").read_text(encoding="utf-8"))
    content["world"]["real_time_factor"] = 1.0
    content["recording"] = {"keep_every": 1}
    cell, shown = folder / "cell.yaml", folder / "shown.yaml"
    cell.write_text(yaml.safe_dump(content), encoding="utf-8")
    content["world"]["camera"] = content["camera"].pop("view")
    content["calibration"] = {"folder": str(folder / "calib")}
    shown.write_text(yaml.safe_dump(content), encoding="utf-8")
    return cell, shown


def visited(browser: Browser, pages: Pages, name: str, path: str, there: str) -> Times:
    """One visit with an empty cache."""
    driver, found = browser.driver, Times()
    driver.get("about:blank")
    driver.execute_cdp_cmd("Network.clearBrowserCache", {})
    cpu_s, begun_s = pages.cpu_s(), time.perf_counter()
    driver.get(pages.url + path)
    ask = f"{_WORDS} return Boolean({there})"
    browser.until(lambda: driver.execute_script(ask))
    found.cold_s.append(time.perf_counter() - begun_s)
    found.cpu_s.append(pages.cpu_s() - cpu_s)
    if name in _DONE:
        ms = driver.execute_async_script(_TIMED % _DONE[name])
        if ms < 0.0:
            raise RuntimeError(f"{name} does not answer: {browser.text('body')[:500]}")
        found.answer_s.append(ms * 1e-3)
    return found


def told(name: str, times: Times) -> bool:
    """Print what was measured, and say whether it is soon enough."""

    def both(values: list[float]) -> str:
        return f"{statistics.median(values):.2f} s, at most {max(values):.2f} s"

    answers = both(times.answer_s) if times.answer_s else "–"
    print(
        f"{name:12s} there {both(times.cold_s)}; answers {answers}; "
        f"{statistics.median(times.cpu_s):.2f} s of CPU; load {os.getloadavg()[0]:.1f}",
        flush=True,
    )
    answered = not times.answer_s or statistics.median(times.answer_s) <= ANSWER_S
    return answered and statistics.median(times.cold_s) <= COLD_S


def makes_cycles(client: Client) -> Callable[[threading.Event], None]:
    """Cables, one after another, until it is over."""

    def task(over: threading.Event) -> None:
        messages = client.follow()
        while not over.is_set():
            made(client, messages, lambda step: None)

    return task


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--turns", type=int, default=5, help="visits of each page")
    given = parser.parse_args()
    found = {name: Times() for name, *_ in _THERE}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        cell, shown = configs_in(folder)
        runs = folder / "runs"
        stack.enter_context(service(cell, runs, folder / "log"))
        client = Client(runs, timeout_s=60.0).connect(300.0)
        messages = client.follow()
        results = [made(client, messages, lambda step: None).result for _ in range(_BEFORE)]
        film = Path(results[0]["folder"]) / form.FILE
        wait_until(film.exists)
        stack.enter_context(going_on(makes_cycles(client)))
        pages = stack.enter_context(Pages(shown, runs))
        browser = stack.enter_context(Browser(folder / "browser"))
        for _ in range(given.turns):
            for title, path, there in _THERE:
                once = visited(browser, pages, title, path.format(cycle=film.parent.name), there)
                found[title].add(once)
                if title == "Cycle":  # as it was, for the next time
                    (film.parent / KEPT).unlink()
    soon = [told(title, times) for title, times in found.items()]
    return int(not all(soon))


if __name__ == "__main__":
    sys.exit(main())
