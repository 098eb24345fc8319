"""Measures the memory of the pages' process over a shift, with five tabs, one of them stalled.

    python -m tools.plant.pages_soak [--hours 8] [--speed 100] [--cycle-s 15]

One simulated cycle is recorded with all notices of the cell.  A link then repeats them, as a cell
with a cycle every `--cycle-s`, but `--speed` times faster; each cycle is in the ledger and has its
folder, film included.  Two tabs of a browser show the live page, one changes between the history
and cycles, one through the lab.  A second browser's live page is halted (SIGSTOP) for most of the
time.  The resident memory is printed, and its growth after the first tenth.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cell.plant.client import Client
from cell.plant.link import Link
from cell.plant.messages import CommandReply, MessageKind, Notice, Request, Status
from cell.records.ledger.entry import entry_of_folder
from cell.records.ledger.ledger import Ledger
from cell.records.recording import form
from cell.run.machine import CellState, MachineEvent
from cell.settings import load_settings
from cell.settings.provenance import line_name
from tools.plant.adapter_kills import quick, service
from tools.plant.browser import Browser, Pages
from tools.processes import going_on

MIB = 1 << 20
#: Largest permitted growth of the process after the first tenth, bytes.
MOST_GROWTH = 20 * MIB
#: Intervals of the memory samples and of the page changes, s.
_LOOK_S, _CHANGE_S = 2.0, 10.0
#: Durations for which the stalled browser is halted and running, s.
_HALTED_S, _BACK_S = 40.0, 8.0
#: Largest number of folders of cycles: older ones are removed, as by a retention.
_FOLDERS = 300


@dataclass(frozen=True)
class Recorded:
    """Notices of one cycle, and its folder."""

    notices: tuple[Notice, ...]
    folder: Path


def recorded(folder: Path, config: Path) -> Recorded:
    """Run one simulated cycle, and return its notices and folder."""
    runs = folder / "made"
    with service(config, runs, folder / "log"):
        client = Client(runs, timeout_s=60.0).connect(300.0)
        notices: list[Notice] = []
        started = False
        for message in client.follow():
            waits = message.data if isinstance(message, Notice) else vars(message)
            if "start" in waits.get("waiting_for", ()):
                if started:
                    break
                started = client.send(Request(MachineEvent.START, "tool", part="A-1")).accepted
            elif isinstance(message, Notice) and started:
                notices.append(message)
        client.close()
    result = next(n for n in notices if n.kind is MessageKind.RESULT)
    return Recorded(tuple(notices), Path(result.data["folder"]))


class Line:
    """Simulated line: publishes one recorded cycle repeatedly, each time with its records."""

    def __init__(self, notices_of: Recorded, config: Path, runs: Path, cycle_s: float) -> None:
        self._recorded, self._runs, self._cycle_s = notices_of, runs, cycle_s
        self._line = line_name(load_settings(config))
        self.cycles = self.notices = 0
        self._folders: list[Path] = []

    def until(self, over: threading.Event) -> None:
        """Make cycles."""
        refused = CommandReply(False, CellState.EXECUTE, "this cell only publishes")
        begun = Status("", 0, CellState.IDLE, time.time(), waiting_for=("start",))
        self._runs.mkdir(parents=True, exist_ok=True)
        ledger = Ledger(self._runs, create=True)
        with Link(self._runs, begun, lambda _: refused) as link:
            next_s = time.monotonic()
            while not over.is_set():
                self._cycle(link, ledger, over)
                next_s = max(next_s + self._cycle_s, time.monotonic() - 10.0 * self._cycle_s)
                over.wait(max(0.0, next_s - time.monotonic()))
        ledger.close()

    def _cycle(self, link: Link, ledger: Ledger, over: threading.Event) -> None:
        self.cycles += 1
        at = datetime.now()
        name = f"{at:%Y%m%dT%H%M%S}.{at.microsecond // 1000:03d}-{self.cycles}"
        folder = self._runs / name
        shutil.copytree(self._recorded.folder, folder, copy_function=os.link)
        film = folder / form.FILE
        film.rename(folder / form.PART)
        entry = entry_of_folder(folder, self._line)
        assert entry is not None
        ledger.write([replace(entry, cycle=self.cycles, ended=None, result=None)])
        pause_s = 0.6 * self._cycle_s / len(self._recorded.notices)
        for notice in self._recorded.notices:
            if notice.kind is MessageKind.RESULT:
                (folder / form.PART).rename(film)
                part = f"A-{self.cycles}"
                result = replace(entry.result, part=part) if entry.result is not None else None
                now = datetime.now(UTC)
                ledger.write(
                    [replace(entry, cycle=self.cycles, part=part, ended=now, result=result)]
                )
            link.publish(notice.kind, self._numbered(notice, folder))
            self.notices += 1
            over.wait(pause_s)
        self._folders.append(folder)
        if len(self._folders) > _FOLDERS:
            shutil.rmtree(self._folders.pop(0))

    def _numbered(self, notice: Notice, folder: Path) -> dict[str, Any]:
        new = {"cycle": self.cycles, "part": f"A-{self.cycles}", "folder": str(folder)}
        new["since"] = time.time()
        return {k: new.get(k, v) for k, v in notice.data.items()}


def stalls(browser: Browser) -> Callable[[threading.Event], None]:
    """Task that halts and resumes a browser repeatedly."""

    def task(over: threading.Event) -> None:
        while not over.is_set():
            processes = browser.processes
            for number, pause_s in ((signal.SIGSTOP, _HALTED_S), (signal.SIGCONT, _BACK_S)):
                for process in processes:
                    with suppress(ProcessLookupError):
                        os.kill(process, number)
                over.wait(pause_s)

    return task


def people(browser: Browser, url: str) -> Iterator[None]:
    """Open four tabs; each `next()` opens a further page in one of them, as a person would."""
    driver = browser.driver
    for _ in range(2):
        browser.tab(f"{url}/")
        browser.until(lambda: browser.text("[data-test=outcome]"))
    history, lab = browser.tab(f"{url}/history"), browser.tab(f"{url}/lab")
    parts = ("study", "compare", "diagnose", "own", "line")
    link = "const a = document.querySelector('[data-test=cycles] tbody a'); a && a.click(); "
    turn = 0
    while True:
        yield
        turn += 1
        driver.switch_to.window(history)
        if turn % 2:
            browser.until(lambda: driver.execute_script(f"{link} return a !== null"))
            browser.until(lambda: browser.text("[data-test=says]"))
        else:
            driver.get(f"{url}/history")
        driver.switch_to.window(lab)
        if turn % 10 == 0:
            driver.get(f"{url}/lab")
        part = f"[data-test=tab-{parts[turn % 5]}]"
        browser.until(lambda part=part: driver.find_elements("css selector", part))
        driver.execute_script(f"document.querySelector('{part}').click()")


def soak(folder: Path, cycle: Recorded, config: Path, count: int, cycle_s: float) -> bool:
    """Run `count` cycles; returns whether the growth of memory is within the limit.

    cycle_s  least duration of a cycle: a busy computer takes longer
    """
    line = Line(cycle, config, folder / "runs", cycle_s)
    samples: list[int] = []
    with ExitStack() as stack:
        stack.enter_context(going_on(line.until))
        pages = stack.enter_context(Pages(config, folder / "runs"))
        browser = stack.enter_context(Browser(folder / "browser"))
        halted = stack.enter_context(Browser(folder / "halted"))
        halted.driver.get(f"{pages.url}/")
        halted.until(lambda: halted.text("[data-test=outcome]"))
        looks = people(browser, pages.url)
        next(looks)
        stack.enter_context(going_on(stalls(halted)))
        begun_s = changed_s = time.monotonic()
        cpu_s, cycles, notices = pages.cpu_s(), line.cycles, line.notices
        while line.cycles - cycles < count:
            now_s = time.monotonic()
            samples.append(pages.rss_bytes())
            if now_s - changed_s > _CHANGE_S:
                changed_s = now_s
                next(looks)
            if len(samples) % 15 == 1:
                print(f"{now_s - begun_s:6.0f} s  {samples[-1] / MIB:7.1f} MiB", flush=True)
            time.sleep(_LOOK_S)
        cpu_s, lasts_s = pages.cpu_s() - cpu_s, time.monotonic() - begun_s
        cycles, notices = line.cycles - cycles, line.notices - notices
    print(f"{cycles} cycles, {notices} notices in {lasts_s:.0f} s; {cpu_s / lasts_s:.0%} of a core")
    return report_growth(samples)


def report_growth(samples: list[int]) -> bool:
    """Print the growth of memory; returns whether it is within the limit.

    samples  bytes at equal intervals; the first tenth is ignored
    """
    later = samples[len(samples) // 10 :]
    few = max(1, len(later) // 8)
    first, last, most = statistics.median(later[:few]), statistics.median(later[-few:]), max(later)
    growth = last - first
    print(
        f"{first / MIB:.1f} MiB after the first tenth, {last / MIB:.1f} MiB at the end, at most "
        f"{most / MIB:.1f} MiB: {growth / MIB:+.1f} MiB, allowed {MOST_GROWTH / MIB:.0f} MiB"
    )
    return growth <= MOST_GROWTH


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--hours", type=float, default=8.0, help="worth of updates")
    parser.add_argument("--speed", type=float, default=100.0, help="so many times faster")
    parser.add_argument("--cycle-s", type=float, default=15.0, help="a cycle of the cell takes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = quick(folder / "cell.yaml", {"keep_every": 1})
        cycle = recorded(folder, config)
        count = max(1, round(options.hours * 3600.0 / options.cycle_s))
        return int(not soak(folder, cycle, config, count, options.cycle_s / options.speed))


if __name__ == "__main__":
    sys.exit(main())
