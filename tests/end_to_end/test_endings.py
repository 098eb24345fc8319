"""Every way in which a cable may end, in the simulated cell, and that the next one is taken.

What is inserted, measured, rehearsed, held and resumed, and faults, have tests of their own beside.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.solver import DivergedError
from cell.lab.data.cycles import read_cycles
from cell.lab.line.learn import learn
from cell.plan.choose import Forecast
from cell.records.folder import read_record
from cell.records.result import Outcome, Result
from cell.run.machine import CellState
from cell.settings import Settings, load_settings
from cell.settings.model import ModelSettings
from cell.settings.translate import cable_of, identification_of
from drivers.sim.camera import CameraFaults

from .conftest import WINDY, changed, said

Live = Callable[..., SimpleNamespace]


@dataclass(frozen=True)
class Run:
    """A run of three cables in that world: its settings, records and what it printed."""

    config: Path
    runs: Path
    code: int
    results: list[dict[str, Any]]
    err: str


@pytest.fixture(scope="module")
def windy(quick_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("windy")
    config = changed(quick_config, folder / "windy.yaml", WINDY)
    code, out, err = said("run", "-c", config, "--cycles", 3, "--json", "--runs", folder / "runs")
    results = [json.loads(line) for line in out.splitlines()]
    return Run(config, folder / "runs", code, results, err)


def test_after_a_missed_and_a_rejected_cable_the_next_one_is_taken(windy: Run) -> None:
    assert [r["outcome"] for r in windy.results] == ["rejected", "missed", "inserted"]
    assert windy.code == 1
    rejected, missed, _ = windy.results
    assert rejected["reason"].startswith("no offset passes with probability")
    assert missed["reason"].startswith("the tip missed the destination by")
    assert missed["margin_m"] < 0.0 and missed["fault"] is None
    assert "cable 2 missed" in windy.err and "failed" not in windy.err


def test_a_missed_cable_is_recorded_and_put_aside(windy: Run) -> None:
    record = read_record(Path(windy.results[1]["folder"]))
    assert record.closed and record.state["state"] == "complete"
    assert record.study is not None
    assert [t.name for t in record.study.trials] == ["identify", "execute"]
    times = record.result.seconds if record.result else {}
    inserted = windy.results[2]["seconds"]
    # the way aside takes its time, and an inserted cable is let go where it is
    assert times["release"] > inserted["release"] + 0.3


def test_learn_uses_missed_cycles(windy: Run) -> None:
    settings = load_settings(windy.config)
    cable = cable_of(settings)
    cycles, left_out = read_cycles([windy.runs], cable)
    assert left_out == []
    assert [c.outcome for c in cycles] == [Outcome.REJECTED, Outcome.MISSED, Outcome.INSERTED]
    assert [c.executed is not None for c in cycles] == [False, True, True]
    tried = {"draught": library()["draught"]}
    result = learn(cycles[1:], cable, identification_of(settings), tried, lambda text: None)
    assert [c.outcome for c in result.cycles] == [Outcome.MISSED, Outcome.INSERTED]
    assert result.best is not None and result.best.name == "draught"
    missed, _ = result.cycle_evidence
    assert missed.cycle == cycles[1].name and missed.fall > 100.0, "and it speaks for the effect"


# --- rejected, for each reason -------------------------------------------------------------------


def with_(settings: Settings, section: str, **update: object) -> Settings:
    changed = getattr(settings, section).model_copy(update=update)
    return settings.model_copy(update={section: changed})


def few_still_frames(settings: Settings) -> Settings:
    return with_(settings, "motion", still_s=0.02)


def bent_up_at_rest(settings: Settings) -> Settings:
    """Weight and shape disagree: the paper's method cannot tell a rigidity."""
    settings = with_(settings, "identification", method="paper")
    return with_(
        settings,
        "world",
        rigidity_n_m2=(5.0e-5, 5.001e-5),
        rigidity_variation=0.0,
        exponent=(1.0, 1.001),
        effects={"natural_curvature": {"curvature_1_per_m": -8.5}},
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (few_still_frames, "no still frames: the noise cannot be estimated"),
        (bent_up_at_rest, "no fit: the cable hardly bends at rest"),
    ],
)
def test_a_cable_that_cannot_be_identified_is_put_aside_and_the_next_is_taken(
    live: Live, quick: Settings, change: Callable[[Settings], Settings], reason: str
) -> None:
    it = live(settings=change(quick))
    check_put_aside(it, it.cell.run_cycle(1), quick, reason)


def check_put_aside(it: SimpleNamespace, result: Result, settings: Settings, reason: str) -> None:
    assert (result.outcome, result.fault) == (Outcome.REJECTED, None)
    assert result.reason is not None and result.reason.startswith(reason)
    assert it.cell.machine.state is CellState.COMPLETE, "the next cable can be taken"
    assert not it.twins.world.holds
    x_m = it.twins.arm.log(0.0, it.twins.world.clock.now_s()).x_m
    assert np.max(x_m) == pytest.approx(settings.motion.aside.x_m, abs=2e-4)


def test_a_cable_that_goes_out_of_sight_is_put_aside_and_the_next_one_inserted(
    live: Live, quick: Settings
) -> None:
    def cover(it: SimpleNamespace) -> None:
        it.twins.camera.faults = CameraFaults(black_frames=frozenset(range(30, 75)))

    def uncover(it: SimpleNamespace) -> None:
        it.twins.camera.faults = CameraFaults()

    it = live({"lower": cover, "release": uncover}, cycles=2)
    result = it.cell.run_cycle(1)
    check_put_aside(it, result, quick, "unseen frames: the cable is seen in")
    assert result.reason is not None
    counted = re.search(r"in (\d+) of (\d+) .*; empty in (\d+)$", result.reason)
    assert counted is not None, result.reason
    seen, frames, empty = map(int, counted.groups())
    assert 0 < empty == frames - seen
    assert it.cell.run_cycle(2).outcome is Outcome.INSERTED


def test_a_cable_whose_swing_cannot_be_simulated_is_put_aside(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It used to end the run as a mistake of the program, with a cable in the jaws."""

    def diverging(*args: object, **kwargs: object) -> Forecast:
        raise DivergedError([0], 0.1, 0.003)

    monkeypatch.setattr("cell.run.candidates.forecast", diverging)
    it = live()
    check_put_aside(it, it.cell.run_cycle(1), quick, "no forecast: lane 0 diverged")


# --- what used to end as failed ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "change"), [("motion", {"hold_s": 0.12}), ("arm", {"lag_s": 0.2})]
)
def test_an_arm_that_still_settles_when_the_film_is_over_is_waited_for(
    live: Live, quick: Settings, section: str, change: dict[str, float]
) -> None:
    result = live(settings=with_(quick, section, **change)).cell.run_cycle(1)
    assert result.fault is None
    assert result.outcome is Outcome.INSERTED


def test_a_model_that_cannot_be_simulated_is_named_with_what_to_correct(
    live: Live, quick: Settings
) -> None:
    heavy = {"effect": "tip_mass", "parameters": {"mass_kg": {"fixed": 0.02}}}
    model = ModelSettings.model_validate({"effects": [heavy]})
    result = live(settings=quick.model_copy(update={"model": model})).cell.run_cycle(1)
    fault = result.fault
    assert fault is not None and (fault.step, fault.device) == ("warm_up", "model")
    assert "cannot be simulated" in fault.cause
    assert "model.effects" in fault.remedy and "cell promote --undo" in fault.remedy
    state = read_record(Path(result.folder)).state
    assert state["traceback"] is None, "it is no mistake of the program"
