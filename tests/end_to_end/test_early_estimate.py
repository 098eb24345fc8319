"""The robot does not wait for the computer, and what the computer finds does not depend on when."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.identify import fit
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, Reason
from cell.plan import choose
from cell.records import folder
from cell.records.folder import read_record
from cell.records.result import Outcome, Result
from cell.run import early_estimate, steps, waiting
from cell.run.findings import Filming
from cell.settings import Settings
from cell.settings.model import Hold, StartSettings
from tests.command import run_cell

Live = Callable[..., SimpleNamespace]


@pytest.fixture
def quick(quick: Settings) -> Settings:
    """Every insertion begins at once: what is found is compared number by number."""
    motion = quick.motion.model_copy(update={"start": StartSettings()})
    return quick.model_copy(update={"motion": motion})


def test_frames_are_looked_at_while_the_hand_still_moves(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Filming] = []
    capture = steps.capture

    def noting(station: Any, filming: Filming, *rest: Any) -> Any:
        begun.append(filming)
        return capture(station, filming, *rest)

    monkeypatch.setattr(steps, "capture", noting)
    it = live()
    assert it.cell.run_cycle(1).outcome is Outcome.INSERTED
    filming = begun[0]  # the hold; the execution comes after it
    rate_hz = it.twins.camera.frame_rate_hz
    assert filming.rest_s - filming.sightings[-1].t_s < 2.0 / rate_hz
    assert len(filming.sightings) > 0.9 * (filming.rest_s - filming.begin_s) * rate_hz


def test_after_the_last_frame_nothing_is_simulated(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: list[str] = []

    def told(simulate: Callable[..., Any]) -> Callable[..., Any]:
        def simulated(*args: Any, **kwargs: Any) -> Any:
            threads.append(threading.current_thread().name)
            return simulate(*args, **kwargs)

        return simulated

    deciding: list[str] = []
    it = live(
        {
            "lower": lambda it: threads.clear(),
            "execute": lambda it: deciding.extend(threads),
        }
    )
    monkeypatch.setattr(fit, "simulate", told(fit.simulate))
    monkeypatch.setattr(choose, "simulate_branches", told(choose.simulate_branches))
    assert it.cell.run_cycle(1).outcome is Outcome.INSERTED
    assert deciding
    assert all(name.startswith("ahead") for name in deciding)


def test_a_waiting_gripper_waits_for_no_write(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk takes milliseconds for each, and seconds where another program keeps it busy."""
    written: list[str] = []

    def counted(path: Path, content: str | bytes) -> None:
        if threading.current_thread() is threading.main_thread():
            written.append(path.name)
        write_atomic(path, content)

    write_atomic = folder.write_atomic
    monkeypatch.setattr(folder, "write_atomic", counted)
    deciding: list[int] = []
    it = live(
        {
            "lower": lambda it: written.clear(),
            "execute": lambda it: deciding.append(len(written)),
        }
    )
    result = it.cell.run_cycle(1)
    assert deciding == [0] < [len(written)]
    state = read_record(Path(result.folder)).state
    assert set(state["seconds"]) == set(result.seconds)


def test_a_slow_computer_finds_the_same(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def found() -> tuple[object, ...]:
        r = live(seed=4).cell.run_cycle(1)
        return r.outcome, r.offset_m, r.parameters, r.predicted_margin_m, r.probability

    quick = found()

    def slowed(act: Callable[..., Any]) -> Callable[..., Any]:
        def slow(*args: Any, **kwargs: Any) -> Any:
            time.sleep(0.5)
            return act(*args, **kwargs)

        return slow

    monkeypatch.setattr(early_estimate, "identify", slowed(early_estimate.identify))
    monkeypatch.setattr(early_estimate, "predict_frames", slowed(early_estimate.predict_frames))
    assert found() == quick


def recorded(result: Result) -> Identified:
    """The cable as it was identified."""
    model = read_record(Path(result.folder)).model
    assert model is not None
    return Identified.from_dict(model)


def test_the_record_tells_the_same_cable(live: Live) -> None:
    """Identified from the record, from scratch: the same within the errors that are stated."""
    it = live(seed=6)
    result = it.cell.run_cycle(1)
    then = recorded(result)
    done = run_cell("identify", result.folder, "--json")
    again = Identified.from_dict(json.loads(done.stdout))
    std = np.sqrt(np.diag(again.covariance))
    assert np.abs((then.mean - again.mean) / std).max() < 1.0
    assert np.abs(then.values - again.values)[0] / again.values[0] < 0.01


def as_needed(quick: Settings, **changes: Any) -> Settings:
    hold = Hold(least_s=0.4, most_s=1.0)
    motion = quick.motion.model_copy(update={"hold": hold})
    return quick.model_copy(update={"motion": motion, **changes})


def test_a_hold_lasts_as_long_as_needed(live: Live, quick: Settings) -> None:
    it = live(settings=as_needed(quick), cycles=2)
    for number in (1, 2):
        result = it.cell.run_cycle(number)
        assert result.outcome is Outcome.INSERTED
        assert result.hold_saved_s == pytest.approx(0.6, abs=0.02)
        assert result.seconds["hold_and_capture"] == pytest.approx(0.4, abs=0.02)
        assert result.probability is not None and result.probability > 0.95
        assert result.prediction_error_m is not None and result.prediction_error_m < 5e-4


def test_a_cable_that_is_rejected_was_held_longest(live: Live, quick: Settings) -> None:
    high = quick.destination.model_copy(update={"y_m": (-0.065, -0.055)})
    it = live(settings=as_needed(quick, destination=high))
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.REJECTED
    assert result.hold_saved_s == 0.0
    assert result.seconds["hold_and_capture"] == pytest.approx(1.0, abs=0.02)


def test_where_frames_matter_they_are_filmed(
    live: Live, quick: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the first moment and the last there are others; the forecast is that of the end."""
    answers = iter([False, True])
    monkeypatch.setattr(early_estimate, "enough_frames", lambda *asked: next(answers))
    it = live(settings=as_needed(quick))
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.INSERTED
    assert result.hold_saved_s == pytest.approx(0.3, abs=0.02)
    assert next(answers, None) is None


def test_frames_that_are_not_enough_at_first_only_cost_time(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise CableRejectedError(Reason.UNSEEN_FRAMES, "not yet")

    monkeypatch.setattr(early_estimate, "identify", refuse)
    assert live().cell.run_cycle(1).outcome is Outcome.INSERTED


def test_a_second_process_finds_the_same_and_may_die_or_hang(
    quick: Settings, live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In real time, or nearly, somebody else computes; without it, it only takes longer."""
    hurried = quick.model_copy(
        update={"world": quick.world.model_copy(update={"real_time_factor": 5.0})}
    )

    def give(what: signal.Signals) -> Callable[[SimpleNamespace], None]:
        return lambda it: os.kill(it.cell._station.computer.submit(os.getpid).result(), what)

    alone = live().cell.run_cycle(1)
    kill, freeze = give(signal.SIGKILL), give(signal.SIGSTOP)
    # a clock that runs counts otherwise in the last place; who finds it all at the end takes no
    # last step linearly
    for at, longest_s, within_std in (
        ({}, 30.0, 1e-3),
        ({"hold_and_capture": kill}, 30.0, 0.5),
        ({"hold_and_capture": freeze}, 1.0, 0.5),
    ):
        monkeypatch.setattr(waiting, "LONGEST_S", longest_s)
        it = live(at, settings=hurried)
        found = it.cell.run_cycle(1)
        it.cell.close()
        assert found.outcome is Outcome.INSERTED
        assert found.offset_m == alone.offset_m
        here, there = recorded(found), recorded(alone)
        std = np.sqrt(np.diag(there.covariance))
        assert np.abs((here.mean - there.mean) / std).max() < within_std
