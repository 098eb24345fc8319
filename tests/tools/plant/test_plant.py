"""A plant around a cell begins, and kills are shared out among cycles."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from cell.plant.client import Client
from tools.plant.adapter_kills import STEPS, MadeCycle, assigned
from tools.plant.around import ADAPTERS, Plant, published
from tools.plant.pages_soak import MIB, report_growth
from tools.plant.viewer import Viewer
from tools.processes import wait_until
from tools.shipped_settings import FAKE


def made(*steps: str, **result: object) -> MadeCycle:
    return MadeCycle({"cycle": 1, "outcome": "inserted", **result}, steps)


def test_every_kill_gets_a_cycle_that_has_its_step_and_rare_steps_come_first() -> None:
    planned = [("mqtt", "grasp"), ("mqtt", "execute")]
    cycles = [made("grasp"), made("grasp", "execute"), made("grasp", "execute")]
    assert assigned(planned, cycles) == [("mqtt", "grasp"), ("mqtt", "execute"), None]


def test_adapters_are_killed_in_each_step_after_the_reset() -> None:
    assert {"grasp", "execute", "go_home"} <= set(STEPS)
    assert not {"warm_up", "connect", "reset"} & set(STEPS)


def test_cycles_differ_by_outcome_numbers_and_steps() -> None:
    assert made("grasp").differs(made("grasp")) == ""
    assert made("grasp").differs(made("grasp", "lower", outcome="missed")) == "outcome, steps"


def test_all_adapters_follow_a_cell_that_only_publishes(tmp_path: Path) -> None:
    if shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin") is None:
        pytest.skip("mosquitto is not installed")
    runs = tmp_path / "runs"
    with published(runs), Plant(tmp_path / "plant", FAKE, runs, clients=1) as plant:
        assert set(plant.running) == {"broker", *ADAPTERS, "clients"}
        assert all(program.process.poll() is None for program in plant.running.values())
        assert set(plant.cpu_s()) == set(plant.running)
        assert Client(runs).status().state.value == "execute"
        with Viewer(plant.ports["serve"]) as viewer:
            wait_until(lambda: viewer.updates > 0)
    assert all(program.process.poll() is not None for program in plant.running.values())


@pytest.mark.parametrize("grown_mib, little", [(0, True), (19, True), (25, False)])
def test_growth_counts_after_the_first_tenth(grown_mib: int, little: bool) -> None:
    seen = [100 * MIB] * 10 + [200 * MIB] * 40 + [(200 + grown_mib) * MIB] * 50
    assert report_growth(seen) == little


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_growth_of_a_run_that_was_soon_over(samples: int) -> None:
    """On a busy computer a small run is seen only a few times."""
    assert report_growth([100 * MIB] * samples)
