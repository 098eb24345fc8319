"""A simulated cell that is quick: fewer frames and offsets, everything else as shipped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from cell.build import build_twins, cell_with, twin_devices
from cell.settings import Settings, load_settings

CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"

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
