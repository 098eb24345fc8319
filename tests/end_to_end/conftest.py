"""A simulated cell that is quick: fewer frames and offsets, everything else as shipped."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from cell.build import cell_with, twin_devices
from cell.settings import Settings, load_settings
from cell.simulated.twins import build_twins

CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"
EMULATED = CONFIG.parent / "emulated.yaml"

_QUICK = [
    ("frame_rate_hz: 200.0", "frame_rate_hz: 100.0"),
    ("hold_s: 1.0", "hold_s: 0.4"),
    ("step_m: 0.002", "step_m: 0.004"),
]


@pytest.fixture(scope="session")
def quick_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = CONFIG.read_text(encoding="utf-8")
    for old, new in _QUICK:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("config") / "quick.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def quick(quick_config: Path) -> Settings:
    return load_settings(quick_config)


@pytest.fixture
def live(quick: Settings, tmp_path: Path) -> Callable[..., SimpleNamespace]:
    """A live cell with its twins; `at` maps a step's name to what happens when it begins."""

    def build(
        at: dict[str, Callable[[SimpleNamespace], None]] | None = None,
        *,
        settings: Settings = quick,
        seed: int = 1,
        cycles: int = 1,
    ) -> SimpleNamespace:
        twins = build_twins(settings, seed, cycles)
        happens = dict(at or {})
        live = SimpleNamespace(twins=twins, steps=[], runs=tmp_path / "runs")

        def on_step(number: int, step: str) -> None:
            live.steps.append(step)
            if step in happens:
                happens.pop(step)(live)

        live.cell = cell_with(settings, twin_devices(twins), live.runs, on_step)
        return live

    return build


#: What makes a cycle light enough for a computer that does other things meanwhile; the protocols,
#: the rates of the arm and the order of work stay as they are.
_LIGHT = [
    ("width_px: 800 ", "width_px: 640 "),
    ("height_px: 640", "height_px: 512"),
    ("frame_rate_hz: 60.0", "frame_rate_hz: 50.0"),
    ("metres_per_pixel: 0.00032", "metres_per_pixel: 0.0004"),
    ("origin_column_px: 625, origin_row_px: 93.75", "origin_column_px: 500, origin_row_px: 75"),
    ("hold_s: 1.0", "hold_s: 0.5"),
    ("decide_s: 0.7 ", "decide_s: 1.5 "),
    ("step_m: 0.002", "step_m: 0.01"),
]


@pytest.fixture(scope="module")
def light_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings with addresses that nobody else uses."""
    folder = tmp_path_factory.mktemp("emulated")
    worker = os.getpid() % 60000
    host = f"127.{120 + worker // 250 % 100}.{1 + worker % 250}.9"
    text = EMULATED.read_text(encoding="utf-8")
    for old, new in (
        *_LIGHT,
        ("host: 127.0.0.2", f"host: {host}"),
        ("tcp://127.0.0.2:", f"tcp://{host}:"),
        ("/tmp/cable-cell-gripper", str(folder / "gripper")),
    ):
        assert old in text
        text = text.replace(old, new)
    path = folder / "light.yaml"
    path.write_text(text, encoding="utf-8")
    return path
