"""Photograph the pages of a simulated cell with Chromium, for the manual.

python -m tools.figures.page_pictures [-o docs/images] [--only history settings]
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import Image

from tools.plant.browser import Browser, Pages
from tools.processes import Program, wait_until
from tools.shipped_settings import FAKE, with_entries

CABLES = 12
#: An opening so low that a few cables are rejected; the cell moves in real time.
CHANGES = {
    "destination.y_m": [-0.1082, -0.1038],
    "motion.start": {},
    "world.real_time_factor": 1.0,
}
SIZES_PX = {
    "live": (1152, 720),
    "history": (1152, 1000),
    "settings": (1152, 620),
    "fault": (390, 844),
}
_COLOURS = 256


def _cell(*words: object) -> list[str]:
    return [sys.executable, "-m", "cell", *map(str, words)]


def settings_text(now: datetime) -> str:
    """Settings of the cell, whose shift begins at this local time."""
    return with_entries(FAKE, CHANGES | {"ledger": {"shifts": [f"{now:%H:%M}"]}})


def photograph(driver: Any, path: Path, pause_s: float = 1.0) -> None:
    """Photograph a page of `driver` once two photographs, `pause_s` apart, are equal."""
    before, now = b"", driver.get_screenshot_as_png()
    while now != before:
        time.sleep(pause_s)
        before, now = now, driver.get_screenshot_as_png()
    picture = Image.open(io.BytesIO(now)).convert("RGB")
    picture.quantize(_COLOURS, kmeans=1).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} KiB")


def _type_wrong_setting(browser: Browser) -> None:
    """Search an entry and give it a value beyond its limit."""
    for name, text in (("search", "motion.hold"), ("motion.hold_s", "31")):
        css = f"[data-test='{name}'], [data-test='{name}'] input"
        browser.until(lambda: browser.driver.find_elements("css selector", css))  # noqa: B023
        field = browser.driver.find_elements("css selector", css)[-1]
        browser.until(field.is_displayed)
        field.send_keys("\ue009a\ue000" + text)  # in place of all that is there
    browser.until(lambda: "30" in browser.text("[data-test='motion.hold_s:said']"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/images"))
    parser.add_argument("--only", nargs="+", choices=SIZES_PX, default=list(SIZES_PX))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="line3-") as name:
        folder = Path(name)
        config, runs = folder / "line3.yaml", folder / "runs"
        config.write_text(settings_text(datetime.now()), encoding="utf-8")
        words = ("--config", config, "--runs", runs)
        insert = _cell("run", *words, "--cycles", CABLES, "--part-id", "LOT7-0001")
        subprocess.run(insert, check=False, stdout=subprocess.DEVNULL)  # 1: some are rejected
        cell = Program(_cell("run", *words, "--cycles", "forever"))
        try:
            with Pages(config, runs) as pages, Browser(folder / "browser") as browser:
                _take(options.only, options.out, browser, pages.url, words)
        finally:
            cell.process.terminate()
            cell.process.wait()
            cell.end()


def _take(
    names: list[str], out: Path, browser: Browser, url: str, words: tuple[object, ...]
) -> None:
    """Photograph the pages of these names; `words` name the cell that runs."""

    def stop() -> None:
        start = _cell("send", "start", "--part", "LOT7-0013", *words[2:])
        subprocess.run(start, check=True, stdout=subprocess.DEVNULL)
        by = ("--by", "Ada", "--note", "guard opened")
        subprocess.run(_cell("send", "stop", *by, *words[2:]), check=True)
        browser.until(lambda: browser.text("[data-test=state]") == "Stopped")

    ready: dict[str, Callable[[], None]] = {
        "live": lambda: None,
        "history": lambda: browser.until(lambda: browser.text("[data-test=cycles] td")),
        "settings": lambda: _type_wrong_setting(browser),
        "fault": stop,
    }
    for name in names:
        size = dict(zip(("width", "height"), SIZES_PX[name], strict=True))
        size |= {"deviceScaleFactor": 1, "mobile": False}
        browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.driver.execute_cdp_cmd("Emulation.setScrollbarsHidden", {"hidden": True})
        browser.driver.get(f"{url}/" + ("" if name in ("live", "fault") else name))
        if name in ("live", "fault"):
            wait_until(lambda: browser.text("[data-test=state]") == "Idle")
        ready[name]()
        photograph(browser.driver, out / f"web_{name}.png")


if __name__ == "__main__":
    main()
