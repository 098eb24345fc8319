"""A simulated cell that is quick: fewer, smaller pictures, fewer offsets, a coarser world."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.plan import correction
from cell.settings import Settings, load_settings
from cell.wiring.build import cell_with, twin_devices
from cell.wiring.twins import build_twins

from .forked import Forking

CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"
EMULATED = CONFIG.parent / "emulated.yaml"

_QUICK = [
    ("frame_rate_hz: 200.0", "frame_rate_hz: 60.0"),
    ("hold_s: 1.0", "hold_s: 0.4"),
    ("step_m: 0.002", "step_m: 0.004"),
    ("damping_ratio: [0.02, 0.06]\n", "damping_ratio: [0.02, 0.06]\n  segments: 60\n"),
]


#: The pictures of the emulated cell: the same field of view.
_SMALL = [
    ("width_px: 1280", "width_px: 800"),
    ("height_px: 1024", "height_px: 640"),
    ("metres_per_pixel: 0.0002,", "metres_per_pixel: 0.00032,"),
    ("origin_column_px: 1000, origin_row_px: 150", "origin_column_px: 625, origin_row_px: 93.75"),
]


#: Of `_QUICK`, where the noise that is left decides.
_MORE_FRAMES = ("frame_rate_hz: 60.0", "frame_rate_hz: 100.0")

#: A world in which a few good chances are wrong.
WINDY = [
    _MORE_FRAMES,
    ("  segments: 60\n", ""),
    ("effects: {}", "effects: {draught: {wind_x_m_per_s: 1.6, wind_y_m_per_s: 1.6}}"),
    ("gripper:\n", "choice: {min_probability: 0.3}\n\ngripper:\n"),
    ("motion:\n", "motion:\n  start: {}\n"),
]


def changed(config: Path, path: Path, changes: list[tuple[str, str]]) -> Path:
    text = config.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return path


def unrecorded(config: Path) -> Path:
    """The same settings with no frames recorded: tests that do not ask for them are quicker."""
    with config.open("a", encoding="utf-8") as file:
        file.write("\nrecording: null\n")
    return config


def run(*words: object, typed: str | None = None) -> subprocess.CompletedProcess[str]:
    """A command as a user gives it, in this process: where its start is not what is tested."""
    given = [str(word) for word in words]
    done = CliRunner().invoke(app, given, input=typed)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return subprocess.CompletedProcess(given, done.exit_code, done.stdout, done.stderr)


def said(*words: object) -> tuple[int, str, str]:
    """Exit code, output and errors of a command, as by `run`."""
    done = run(*words)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="session")
def forking() -> Iterator[Forking]:
    """Commands in processes of their own that need not import all modules again."""
    with Forking() as forking:
        yield forking


@pytest.fixture(scope="session")
def recorded_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return changed(CONFIG, tmp_path_factory.mktemp("config") / "recorded.yaml", [*_QUICK, *_SMALL])


@pytest.fixture(scope="session")
def sharp_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures as large as shipped, for what is measured to a hundredth of a millimetre."""
    path = tmp_path_factory.mktemp("config") / "sharp.yaml"
    return unrecorded(changed(CONFIG, path, _QUICK))


@pytest.fixture(scope="session")
def quick_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "quick.yaml"
    return unrecorded(changed(CONFIG, path, [*_QUICK, *_SMALL]))


@pytest.fixture(scope="session")
def dense_config(quick_config: Path) -> Path:
    """More frames, for tests in which the noise that they leave decides."""
    return changed(quick_config, quick_config.with_name("dense.yaml"), [_MORE_FRAMES])


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


@pytest.fixture
def hopeless(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """With feedback: in so many insertions nothing brings the tip through; then all goes well."""

    def until(tries: int) -> None:
        begun: list[object] = []

        def chance(answers: Any, *asked: Any) -> float:
            if not begun or begun[-1] is not answers:
                begun.append(answers)
            return 0.03 if len(begun) <= tries else 1.0

        monkeypatch.setattr(correction, "best_tail", lambda *asked: None)
        monkeypatch.setattr(correction, "probability_of_passing", chance)

    return until


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
    addresses = [
        ("host: 127.0.0.2", f"host: {host}"),
        ("tcp://127.0.0.2:", f"tcp://{host}:"),
        ("/tmp/cable-cell-gripper", str(folder / "gripper")),
    ]
    return changed(EMULATED, folder / "light.yaml", [*_LIGHT, *addresses])
