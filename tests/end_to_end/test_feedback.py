"""An insertion is corrected while it is made, by the simulated cell as `cell run` makes it."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.plan import correction
from cell.plan.correction import Tail
from cell.records.folder import read_record
from cell.records.result import Outcome, Result
from cell.run import corrector
from cell.run.machine import MachineEvent
from cell.settings import Settings, load_settings
from cell.wiring.build import build_cell
from drivers.interfaces import Trajectory, revised_too_late
from drivers.sim.arm import SimArm

from .conftest import run

Live = Callable[..., SimpleNamespace]
Hopeless = Callable[[int], None]


def seeing(quick: Settings, **changes: Any) -> Settings:
    return quick.model_copy(update={"feedback": "on", **changes})


#: A change that no arm's limits allow.
FAR = Tail(0.0, 0.5, 0.0, 0.2, 1.0, 0.0, 0.2, np.zeros((1, 2)))


def one_change(rise_m: float) -> Callable[..., Tail | None]:
    """At the first decision the gripper is led up by so much, at no other."""
    made: list[Tail] = []

    def tail(answers: Any, beside: Any, destination: Any, from_s: float, *rest: Any) -> Tail | None:
        if made:
            return None
        before_m = answers.nodes_m[:, 0] + beside.tip_m
        tail = Tail(from_s, rise_m, 0.0, 0.2, 1.0, 0.0, 0.5, before_m)
        moved = correction.moved_by(answers, tail, 0.03).nodes_m[:, 0] + beside.tip_m
        made.append(replace(tail, tip_m=moved))
        return made[0]

    return tail


def test_what_goes_well_goes_no_worse(live: Live, quick: Settings) -> None:
    result = live(settings=seeing(quick)).cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED
    assert result.corrections is not None
    assert result.margin_m is not None and result.predicted_margin_m is not None
    assert result.margin_m > result.predicted_margin_m - 3e-4
    assert result.prediction_error_m is not None and result.prediction_error_m < 5e-4


def without_feedback(settings: Settings, runs: Path) -> Result:
    cell = build_cell(settings, runs, seed=1, cycles=1)
    try:
        return cell.run_cycle(1)
    finally:
        cell.close()


@pytest.fixture(scope="module")
def plain(quick: Settings, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return without_feedback(quick, tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def plain_dense(dense_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return without_feedback(load_settings(dense_config), tmp_path_factory.mktemp("dense"))


def test_without_feedback_nothing_is_said_of_it(plain: Result) -> None:
    assert plain.corrections is None


@pytest.mark.parametrize("rise_m", [0.002, -0.002])
def test_a_change_in_flight_moves_the_tip_as_foretold(
    live: Live,
    dense_config: Path,
    plain_dense: Result,
    monkeypatch: pytest.MonkeyPatch,
    rise_m: float,
) -> None:
    dense, plain = load_settings(dense_config), plain_dense
    monkeypatch.setattr(correction, "best_tail", one_change(rise_m))
    result = live(settings=seeing(dense)).cell.run_cycle(1)
    assert result.corrections is not None and len(result.corrections) == 1
    assert result.corrections[0].rise_m == rise_m
    assert result.measured_miss_m is not None and plain.measured_miss_m is not None
    assert np.sign(result.measured_miss_m - plain.measured_miss_m) == np.sign(rise_m)
    assert abs(result.measured_miss_m - plain.measured_miss_m) > 1e-3
    assert result.prediction_error_m is not None and result.prediction_error_m < 5e-4
    study = read_record(Path(result.folder)).study
    assert study is not None
    executed = study.trials[-1].grip  # what the arm did is in the record, not what was chosen first
    assert executed.y_m[-1] == pytest.approx(
        dense.motion.home.y_m - dense.motion.lower_m - (result.offset_m or 0.0) + rise_m, abs=3e-4
    )


def test_what_the_arm_refuses_leaves_the_path_as_it_is(
    live: Live,
    quick: Settings,
    plain: Result,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Too fast for the limits of the settings, or told too late."""
    monkeypatch.setattr(correction, "best_tail", one_change(0.5))
    with caplog.at_level(logging.WARNING):
        result = live(settings=seeing(quick)).cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED and result.corrections == ()
    assert result.measured_miss_m == pytest.approx(plain.measured_miss_m, abs=1e-4)
    assert "path not changed" in caplog.text and "followed as it was" in caplog.text


def test_what_needs_a_change_that_the_arm_refuses_stops_in_front_of_the_opening(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the last decision; a rest within the limits is taken."""
    monkeypatch.setattr(correction, "best_tail", lambda *asked: replace(FAR, from_s=asked[3]))
    monkeypatch.setattr(correction, "probability_of_passing", lambda *asked: 0.2)
    result = live(settings=seeing(quick)).cell.run_cycle(1)
    assert result.outcome is Outcome.REJECTED and result.corrections == ()
    assert result.reason is not None and result.reason.startswith("stopped in front of the opening")


def test_what_cannot_be_explained_is_not_corrected(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(correction, "MOST_MISFIT", 0.0)
    monkeypatch.setattr(correction, "best_tail", one_change(0.002))
    result = live(settings=seeing(quick)).cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED and result.corrections == ()


def test_without_the_second_process_it_goes_on_as_it_was(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corrector, "result_of", lambda job, commands: None)
    result = live(settings=seeing(quick)).cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED and result.corrections == ()


def test_a_stop_wins_over_a_change(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    it = live(settings=seeing(quick))
    find = one_change(0.002)

    def stopped(*asked: Any) -> Tail | None:
        it.cell.command(MachineEvent.STOP, "a person")
        return find(*asked)

    monkeypatch.setattr(correction, "best_tail", stopped)
    result: Result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.FAILED and result.fault is not None
    assert result.fault.step == "execute" and result.fault.cause == "a person"
    assert not it.cell._station.devices.arm.state().moving


def test_what_nothing_brings_through_stops_in_front_of_the_opening(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cable is put aside, and the next one is inserted."""
    monkeypatch.setattr(correction, "best_tail", lambda *asked: None)
    monkeypatch.setattr(correction, "probability_of_passing", lambda *asked: 0.03)
    it = live(settings=seeing(quick), cycles=2)
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.REJECTED
    assert result.reason is not None
    assert result.reason.startswith(
        "stopped in front of the opening: the tip would have passed with"
    )
    study = read_record(Path(result.folder)).study
    assert study is not None
    executed = study.trials[-1]
    assert np.nanmin(executed.markers.xy_m[:, 0, 0]) > quick.destination.x_m[1]
    assert it.steps[-2:] == ["release", "go_home"]
    monkeypatch.undo()
    assert it.cell.run_cycle(2).outcome is Outcome.INSERTED


def recorded(tmp_path: Path, recorded_config: Path, entries: str) -> dict[str, Any]:
    """Result of a recorded cycle with these settings in addition."""
    config = tmp_path / "seeing.yaml"
    config.write_text(f"{recorded_config.read_text('utf-8')}\n{entries}", encoding="utf-8")
    done = run("run", "--config", config, "--json", "--runs", tmp_path / "runs")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def test_a_corrected_insertion_is_recorded_and_replayed(
    tmp_path: Path, recorded_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(correction, "best_tail", one_change(0.002))
    result = recorded(tmp_path, recorded_config, "feedback: on\n")
    assert len(result["corrections"]) == 1
    monkeypatch.setattr(correction, "best_tail", one_change(0.002))
    again = run("replay", result["folder"], "--json")
    assert json.loads(again.stdout)["identical"], again.stdout
    page = tmp_path / "page.html"
    told = run("report", result["folder"], "-o", page)
    assert told.returncode == 0, told.stderr
    assert "Corrections in flight" in page.read_text(encoding="utf-8")


# --- a second try --------------------------------------------------------------------------------


def test_a_stopped_cable_is_brought_back_measured_and_inserted(
    live: Live, quick: Settings, hopeless: Hopeless
) -> None:
    hopeless(1)
    it = live(settings=seeing(quick, retry=1))
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED and result.reason is None
    assert len(result.stops) == 1 and result.stops[0].startswith("stopped in front of the opening")
    assert it.steps.count("lower") == 2 and it.steps.count("bring_back") == 1
    assert it.steps.count("grasp") == 1, "the cable stays in the jaws"
    record = read_record(Path(result.folder))
    assert record.study is not None and record.result == result
    names = [t.name for t in record.study.trials]
    assert names == ["identify", "execute", "identify_try_1", "execute_try_1"]
    first, second = (record.study.trials[i].markers for i in (2, 0))
    still = first.t_s < quick.motion.still_s  # the second film begins at rest as the first one did
    scatter = [np.nanstd(m.xy_m[still, 0, 1]) for m in (first, second)]
    assert scatter[1] < 2.0 * scatter[0] + 1e-5
    pictures = {p.name for p in Path(result.folder).glob("*.jpg")}
    assert {n for n in pictures if n.startswith("try_1_")}
    assert {n.removeprefix("try_1_") for n in pictures if n.startswith("try_1_")} <= pictures


def test_a_cable_that_is_stopped_again_is_put_aside(
    live: Live, quick: Settings, hopeless: Hopeless, monkeypatch: pytest.MonkeyPatch
) -> None:
    hopeless(9)
    it = live(settings=seeing(quick, retry=2), cycles=2)
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.REJECTED and result.reason is not None
    assert result.reason.startswith("stopped in front of the opening")
    assert len(result.stops) == 2 and it.steps.count("lower") == 3
    assert it.steps[-2:] == ["release", "go_home"]
    monkeypatch.undo()
    assert it.cell.run_cycle(2).outcome is Outcome.INSERTED


def test_a_stop_on_the_way_back_ends_the_cycle(
    live: Live, quick: Settings, hopeless: Hopeless
) -> None:
    hopeless(1)
    it = live(
        {"bring_back": lambda it: it.cell.command(MachineEvent.STOP, "a person")},
        settings=seeing(quick, retry=1),
    )
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.FAILED and result.fault is not None
    assert result.fault.step == "bring_back" and result.fault.cable == "a cable is in the jaws"


def test_a_second_try_is_recorded_and_replayed(
    tmp_path: Path, recorded_config: Path, hopeless: Hopeless
) -> None:
    hopeless(1)
    result = recorded(tmp_path, recorded_config, "feedback: on\nretry: 1\n")
    assert result["outcome"] == "inserted" and len(result["stops"]) == 1
    hopeless(1)
    again = run("replay", result["folder"], "--json")
    replayed = json.loads(again.stdout)
    assert replayed["identical"] and replayed["result"]["stops"] == result["stops"], again.stdout


def test_a_change_that_came_too_late_is_told_again_for_later(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[float] = []

    def tail(answers: Any, beside: Any, destination: Any, from_s: float, *rest: Any) -> Tail | None:
        asked.append(from_s)
        if len(asked) > 2:
            return None
        return Tail(from_s, 0.002, 0.0, 0.2, 1.0, 0.0, 0.5, answers.nodes_m[:, 0] + beside.tip_m)

    it = live(settings=seeing(quick))
    revise, told = SimArm.revise, []

    def late_at_first(arm: SimArm, path: Trajectory, from_s: float) -> None:
        told.append(from_s)
        if len(told) == 1:
            raise revised_too_late("arm", 0.003)
        revise(arm, path, from_s)

    monkeypatch.setattr(correction, "best_tail", tail)
    monkeypatch.setattr(SimArm, "revise", late_at_first)
    with caplog.at_level(logging.WARNING):
        result = it.cell.run_cycle(1)
    assert "told 3.0 ms after" in caplog.text
    assert result.corrections is not None and len(result.corrections) == 1
    early_s, late_s = corrector.DEAD_S
    assert asked[1] - asked[0] == pytest.approx(late_s - early_s)
    assert told[1] - told[0] == pytest.approx(late_s - early_s)
    assert result.corrections[0].from_s == asked[1]
