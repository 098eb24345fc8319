"""The pages of a cell as a process, and headless Chromium as their client, on loopback."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cell.computer.watched import cpu_s
from tools.processes import Program, family, free_port, listens, status_of, wait_until

_FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-background-timer-throttling", "--disable-renderer-backgrounding"),
    *("--accept-lang=en", "--window-size=1440,900"),
)
#: Time limit of a browser's page, s, for a busy computer.
_LOAD_S = 120.0
_KIB = 1024


class Pages:
    """Runs `cell serve` within a `with`, and measures its resources."""

    def __init__(self, config: Path, runs: Path, port: int | None = None) -> None:
        self.port = port or free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        words = ["-c", str(config), "--runs", str(runs), "--port", str(self.port)]
        self.program = Program([sys.executable, "-m", "cell", "serve", *words])

    def __enter__(self) -> Pages:
        self.wait()
        return self

    def __exit__(self, *_: object) -> None:
        self.program.end()

    def wait(self) -> None:
        """Wait until it answers.  Raises RuntimeError: it does not begin."""
        wait_until(lambda: listens(self.port), self.program)

    def rss_bytes(self) -> int:
        """Resident memory of the process and its child processes."""
        each = (status_of(pid).get("VmRSS", "0 kB") for pid in family(self.program.process.pid))
        return sum(_KIB * int(size.split()[0]) for size in each)

    def cpu_s(self) -> float:
        """CPU time of the process so far, s."""
        return cpu_s(self.program.process.pid)


class Browser:
    """Headless Chromium within a `with`.  Raises RuntimeError: it is not installed.

    logged  it keeps a log of its network requests
    """

    def __init__(self, folder: Path, *, logged: bool = False) -> None:
        chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
        if chromium is None or driver is None:
            raise RuntimeError("chromium and chromedriver: apt-get install chromium-driver")
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = chromium
        for flag in (*_FLAGS, f"--user-data-dir={folder}"):
            options.add_argument(flag)
        if logged:
            options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
        options.page_load_strategy = "eager"
        self._service = Service(driver)
        self.driver: Any = webdriver.Chrome(options=options, service=self._service)
        self.driver.set_page_load_timeout(_LOAD_S)
        self.driver.set_script_timeout(_LOAD_S)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.quit()

    @property
    def processes(self) -> list[int]:
        """Process ids of Chromium, without the driver's."""
        return family(self._service.process.pid)[1:]

    def tab(self, url: str) -> str:
        """Open an address in a new tab; the tab's handle."""
        self.driver.switch_to.new_window("tab")
        self.driver.get(url)
        return str(self.driver.current_window_handle)

    def text(self, css: str) -> str:
        """Text of an element; "" = there is none yet."""
        script = "const e = document.querySelector(arguments[0]); return e ? e.innerText : ''"
        return str(self.driver.execute_script(script, css))

    def until(self, reached: Callable[[], object]) -> None:
        """Wait for a condition.  Raises RuntimeError, with the page's text: it is not met."""
        until_s = time.monotonic() + _LOAD_S
        while not reached():
            if time.monotonic() > until_s:
                raise RuntimeError(f"{self.driver.current_url}: {self.text('body')[:500]}")
            time.sleep(0.01)
