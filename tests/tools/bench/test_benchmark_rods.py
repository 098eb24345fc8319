"""The benchmark of rods: searches are repeatable, and entrants agree on the tips."""

from __future__ import annotations

import csv
import subprocess
import sys
from dataclasses import replace
from math import inf, isnan
from pathlib import Path

import numpy as np
import pytest

from cell.cable.solver import DivergedError
from tools.bench import benchmark_rods as benchmark
from tools.bench.bench_task import RodTask, rod_tasks, tip_error
from tools.bench.rod_entrants import EngineEntrant, RodSetting, entrants
from tools.studies.rows import read_rows

ROOT = Path(__file__).parents[3]
STIFF = "6 cm, droop 0.5"


class Scripted:
    """An entrant whose error is that of its step plus that of its mesh, µm; it counts its runs."""

    name, package = "scripted", "numpy"

    def __init__(self) -> None:
        self.runs: list[RodSetting] = []

    def settings(self, task: RodTask):
        for n in (10, 20, 40):
            for step_s in 5e-3 / 2.0 ** np.arange(8):
                yield RodSetting(n, step_s, "only", 1e-6 * n / step_s)

    def runner(self, task: RodTask, setting: RodSetting):
        error_m = 1e-6 * ((1e3 * setting.step_s) ** 2 + 4e3 / setting.segments**2)

        def run() -> np.ndarray:
            self.runs.append(setting)
            return np.full((1, task.times_s.size, 2), error_m / np.sqrt(2.0))

        return run


def test_a_search_tries_cheap_settings_first_and_no_series_that_has_ended() -> None:
    task, entrant = rod_tasks()[STIFF].part(21), Scripted()
    tips = benchmark.RodReference(np.zeros((1, task.times_s.size, 2)))
    found = list(benchmark.searched(task, entrant, lambda: tips, inf, {}))
    work = [setting.work_s for _, setting in found]
    assert work == sorted(work)
    mesh_10 = [row.step_ms for row, setting in found if setting.segments == 10]
    assert min(mesh_10) > 0.1  # its own error, 40 µm, is reached with 1.25 ms
    rows = [row for row, _ in found]
    assert benchmark.cheapest(rows, task.name, "scripted", 30.0).segments == 20
    few = list(benchmark.searched(task, entrant, lambda: tips, 1.01 * sum(work[:2]), {}))
    assert [setting for _, setting in few] == [setting for _, setting in found[:2]]
    assert {
        s.segments for _, s in benchmark.searched(task, entrant, lambda: tips, inf, {}, 20)
    } == {20}


def test_what_is_known_is_not_run() -> None:
    task, entrant = rod_tasks()[STIFF].part(21), Scripted()
    tips = benchmark.RodReference(np.zeros((1, task.times_s.size, 2)))
    first = [row for row, _ in benchmark.searched(task, entrant, lambda: tips, 0.1, {})]
    count = len(entrant.runs)
    known = {row.key: row for row in first}
    assert [row for row, _ in benchmark.searched(task, entrant, lambda: tips, 0.1, known)] == first
    assert len(entrant.runs) == count > 0


@pytest.mark.parametrize(
    ("name", "task", "setting", "within_um"),
    [
        ("MuJoCo", STIFF, RodSetting(20, 6.25e-4, "Euler"), 40.0),
        ("MuJoCo", "10 cm, air drag", RodSetting(20, 6.25e-4, "Euler"), 100.0),
        ("PyElastica", "10 cm, air drag", RodSetting(16, 6.25e-5, "radius 4 mm"), 1000.0),
    ],
)
def test_a_peer_simulates_the_same_cable(
    name: str, task: str, setting: RodSetting, within_um: float
) -> None:
    there, absent = entrants()
    if name in absent:
        pytest.skip(absent[name])
    peer = there[name]
    part = replace(rod_tasks()[task].part(20), times_s=np.arange(0.0, 0.8, 0.005))
    exact = EngineEntrant().runner(part, RodSetting(80, 2.5e-4, "damping 0.8"))()
    assert 1e6 * tip_error(peer.runner(part, setting)(), exact) < within_um
    assert np.ptp(exact[..., 1]) > 0.02


def test_a_run_that_diverges_has_an_infinite_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def diverged(*_: object, **__: object) -> None:
        raise DivergedError([0], 0.1, 5e-3)

    task = rod_tasks()["10 cm, droop 20"].part(20)
    run = EngineEntrant().runner(task, RodSetting(6, 5e-3, "damping 1.0"))
    exact = run()
    monkeypatch.setattr("tools.bench.rod_entrants.simulate", diverged)
    assert tip_error(run(), exact) == inf
    assert isnan(benchmark.energy_ratio(run(), task))


def test_a_gradient_has_a_lane_for_each_parameter() -> None:
    task = rod_tasks()["gradient, 15 parameters"]
    first, *others = task.models
    assert len(others) == 15
    numbers = [
        np.array([*m.rigidity_n_m2, m.viscosity_n_m2_s, *m.effects[0].values]) for m in task.models
    ]
    assert [np.flatnonzero(q != numbers[0]).tolist() for q in numbers[1:]] == [
        [k] for k in range(15)
    ]
    assert len({m.cable for m in task.models}) == 1
    assert first.effects


def test_two_runs_choose_the_same_settings(tmp_path: Path) -> None:
    """By the command, and by its functions, which go on from a row of the first."""
    (tmp_path / "rods.csv").write_text("of a former run\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "tools.bench.benchmark_rods", tmp_path / "a.csv", "--small",
         "--tasks", STIFF, "--budget-s", "0.1", "--table", tmp_path],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert STIFF in done.stdout
    lines = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "b.csv").write_text("".join(lines[:2]), encoding="utf-8")
    there, _ = entrants()
    extent = replace(benchmark.SMALL, budget_s=0.1)
    new = list(benchmark.benchmark(tmp_path / "b.csv", there, [rod_tasks()[STIFF]], extent))
    first, again = (read_rows(tmp_path / f"{x}.csv", benchmark.RodRow) for x in "ab")
    assert [(r.key, r.rms_um) for r in again] == [(r.key, r.rms_um) for r in first]
    assert [r.key for r in new] == [r.key for r in again[1:]]
    swing = [r for r in again if r.task == "undamped swing"]
    assert swing
    assert not isnan(swing[0].energy_percent)
    with (tmp_path / "rods_summary.csv").open(encoding="utf-8") as text:
        (row,) = csv.DictReader(text)
    assert row["engine_setting_50"].startswith("6 segments")
    assert row["command"] == benchmark.COMMAND
    assert "former" not in (tmp_path / "rods.csv").read_text(encoding="utf-8")
