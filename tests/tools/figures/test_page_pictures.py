"""Pictures of pages: their cell is as intended, and a page that still moves is not taken."""

from __future__ import annotations

import io
from datetime import datetime
from pathlib import Path

from PIL import Image

from cell.settings import load_settings
from tools.figures.page_pictures import photograph, settings_text


def test_the_cell_has_a_low_opening_and_a_shift_that_begins_now(tmp_path: Path) -> None:
    path = tmp_path / "line3.yaml"
    path.write_text(settings_text(datetime(2026, 11, 29, 7, 5)), encoding="utf-8")
    settings = load_settings(path)
    low, high = settings.destination.y_m
    assert 0.004 < high - low < 0.005
    assert settings.motion.freedom.window_s == 0.0
    assert settings.world is not None and settings.world.real_time_factor == 1.0
    assert settings.world.rigidity_variation == 0.15
    assert [str(shift) for shift in settings.ledger.shifts] == ["07:05"]


class Driver:
    """A page that is drawn from the third photograph on."""

    def __init__(self) -> None:
        self.taken = 0

    def get_screenshot_as_png(self) -> bytes:
        self.taken += 1
        file = io.BytesIO()
        Image.new("RGB", (40, 30), (min(self.taken, 3) * 80, 0, 0)).save(file, "PNG")
        return file.getvalue()


def test_a_page_is_taken_once_it_no_longer_changes(tmp_path: Path) -> None:
    driver, path = Driver(), tmp_path / "page.png"
    photograph(driver, path, pause_s=0.0)
    assert driver.taken == 4
    with Image.open(path) as picture:
        assert picture.size == (40, 30)
        assert picture.convert("RGB").getpixel((5, 5)) == (240, 0, 0)
