"""Warming up works for any cable that the settings allow, and is done once."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest

from cell.cable.geometry import Cable
from cell.computer.second_process import SecondProcess
from cell.run.warm_up import made_up_picture, second_process, warm_up
from cell.vision.detect import VisionOptions, detect_all
from cell.vision.marks import JawMarks

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
SMALL = JawMarks(((0.002, 0.003), (0.002, -0.003), (0.012, 0.003)), 0.001)


@pytest.mark.parametrize(
    "cable", [Cable(0.1, 0.0074, 0.016, 1e-4), Cable(0.3, 0.02, 0.01, 5e-4)], ids=["paper", "long"]
)
def test_it_works_for_any_cable_and_is_done_once(cable: Cable) -> None:
    warm_up(cable)
    begun_s = time.perf_counter()
    for _ in range(100):
        warm_up(cable)
    assert time.perf_counter() - begun_s < 0.1


@pytest.mark.parametrize(
    "options",
    [
        VisionOptions(0.1),
        VisionOptions(0.3, cable_is="light", line_width_px=2.0),
        VisionOptions(0.05, length_tolerance_m=0.001, marks=SMALL),
    ],
    ids=["paper", "long and light", "short"],
)
def test_the_cable_of_the_made_up_picture_is_seen(options: VisionOptions) -> None:
    """So that everything is compiled that a real one will need."""
    image, view = made_up_picture(options)
    for sighting in detect_all([(0.0, image), (0.01, image)], view, options):
        assert sighting.seen, sighting.unseen
        assert sighting.length_m == pytest.approx(options.free_length_m, abs=0.0015)


ONE_CYCLE = """
from pathlib import Path
from cell.wiring.build import cell_with, twin_devices
from cell.wiring.twins import build_twins
from cell.run.plans import INSERTING
from cell.settings import load_settings

def loaded():
    return compiled() | {name for name in sys.modules if name.startswith("scipy.")}

early = set()
settings = load_settings(Path(sys.argv[1]))
twins = build_twins(settings, 1, 1)
if __name__ == "__main__":
    on_step = lambda number, step: early.update(loaded()) if step == "reset" else None
    cell = cell_with(settings, twin_devices(twins), Path(sys.argv[2]), on_step)
    plan = {plan}
    print(cell.run_cycle(1, plan).outcome.value, *sorted(loaded() - early), sep="\\n")
"""

#: What is compiled does not depend on how many pictures and offsets there are.
FEWER = (("frame_rate_hz", 200.0, 100.0), ("hold_s", 1.0, 0.4), ("step_m", 0.002, 0.004))


@pytest.mark.parametrize(
    ("plan", "outcome"),
    [("INSERTING", "inserted"), ("cell.rehearsal(INSERTING, 1.0)", "rehearsed")],
    ids=["cycle", "dry run"],
)
def test_nothing_is_compiled_or_imported_while_the_cell_moves(
    knowing_what_is_compiled: Callable[..., list[str]], tmp_path: Path, plan: str, outcome: str
) -> None:
    """Loading it takes 0.5 s, in which no picture is taken and no command is given in time."""
    text = CONFIG.read_text(encoding="utf-8")
    for name, as_shipped, fewer in FEWER:
        assert f"{name}: {as_shipped}" in text
        text = text.replace(f"{name}: {as_shipped}", f"{name}: {fewer}")
    config = tmp_path / "fewer.yaml"
    config.write_text(text, encoding="utf-8")
    script = ONE_CYCLE.replace("{plan}", plan)
    assert knowing_what_is_compiled(script, config, tmp_path / "runs") == [outcome]


@pytest.mark.parametrize("compiles", [False, True])
def test_two_processes_compile_where_much_is_to_be_compiled(
    compiles: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.run.warm_up.is_to_be_compiled", lambda function: compiles)
    with ThreadPoolExecutor(1) as thread, second_process(thread) as process:
        assert (process is not None) is compiles
        if process is not None:
            assert process.submit(os.getpid).result() != os.getpid()
    with SecondProcess() as given, second_process(given) as process:
        assert process is given


def test_whoever_interrupts_the_compilation_does_not_wait_for_the_second_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cell.run.warm_up.is_to_be_compiled", lambda function: True)
    with (
        ThreadPoolExecutor(1) as thread,
        pytest.raises(KeyboardInterrupt),
        second_process(thread) as process,
    ):
        assert process is not None
        process.submit(os.getpid).result()
        waits = process.submit(time.sleep, 600.0)
        raise KeyboardInterrupt
    assert isinstance(waits.exception(60.0), BrokenExecutor)
