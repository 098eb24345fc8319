"""Between the offsets, later and slower there are insertions where none of the offsets passes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.plan import refinement
from cell.plan.choose import Freedom
from cell.plan.paths import insertion_path
from cell.plan.refinement import ALIKE_S, MOST
from cell.settings import load_settings
from cell.wiring.build import cell_task
from drivers.interfaces import Pose
from tools.worlds.fast_cell import fast_cycle

ROOT = Path(__file__).parents[3]
SETTINGS = load_settings(ROOT / "config" / "fake.yaml")
FREELY = Freedom(0.25, (1.3,))


def free(task):
    return replace(task, choice=replace(task.choice, freely=FREELY))


def narrow(half_mm: float):
    """The settings with an opening of so many mm on either side of its middle."""
    destination = SETTINGS.destination
    middle_m = float(np.mean(destination.y_m))
    height = (middle_m - half_mm * 1e-3, middle_m + half_mm * 1e-3)
    changed = destination.model_copy(update={"y_m": height})
    return SETTINGS.model_copy(update={"destination": changed})


@pytest.mark.parametrize("number", [4, 5, 7])
def test_a_narrow_mouth_that_no_offset_passes(number):
    """Cables that were rejected with 21 offsets 2 mm apart, although no forecast erred."""
    settings = narrow(1.0)
    task = cell_task(settings)
    at_once = replace(task, choice=replace(task.choice, freely=Freedom()))
    before = fast_cycle(settings, 7, number, task=at_once, only_chosen=True)
    assert before.outcome == "rejected"
    now = fast_cycle(settings, 7, number, task=free(task), only_chosen=True)
    assert now.outcome == "inserted"
    best = now.choice.best
    assert best.delay_s > 0.0 or best.pace > 1.0
    assert now.true_margin_m == pytest.approx(best.margin_m, abs=1e-4)


def test_where_an_offset_passes_surely_it_is_done_at_once_and_refined():
    task = free(cell_task(SETTINGS))
    cycle = fast_cycle(SETTINGS, 7, 1, task=task, only_chosen=True)
    assert cycle.outcome == "inserted"
    best, (*others, refined) = cycle.choice.best, cycle.choice.table
    assert best is refined and len(others) == len(task.offsets_m)
    assert (best.delay_s, best.pace, best.further_m) == (0.0, 1.0, 0.0)
    nearest = max(others, key=lambda o: o.margin_m)
    assert abs(best.offset_m - nearest.offset_m) < 0.002 and best.margin_m > nearest.margin_m
    assert cycle.true_margin_m == pytest.approx(best.margin_m, abs=1e-4)


def test_a_cable_that_hangs_too_low_is_led_further():
    """Half as stiff as usual: its tip does not come as far left as the opening is deep."""
    low, high = SETTINGS.world.rigidity_n_m2
    world = SETTINGS.world.model_copy(update={"rigidity_n_m2": (0.5 * low, 0.5 * high)})
    settings = SETTINGS.model_copy(update={"world": world})
    task = free(cell_task(settings))
    assert fast_cycle(settings, 7, 4, task=task, only_chosen=True).outcome == "rejected"
    further = replace(task.choice, freely=replace(FREELY, further_m=0.01))
    now = fast_cycle(settings, 7, 4, task=replace(task, choice=further), only_chosen=True)
    assert now.outcome == "inserted" and now.choice.best.further_m == 0.01
    assert now.true_margin_m == pytest.approx(now.choice.best.margin_m, abs=1e-4)


def test_the_coarse_look_promises_what_the_close_one_finds(monkeypatch):
    promised = []
    widest = refinement._widest

    def spy(margins_m, *places):
        promised.append(margins_m)
        return widest(margins_m, *places)

    monkeypatch.setattr(refinement, "_widest", spy)
    settings = narrow(1.0)
    task = free(cell_task(settings))
    cycle = fast_cycle(settings, 7, 5, task=task, only_chosen=True)
    coming = cycle.candidates.forecast
    count = len(task.offsets_m)
    assert 1 <= len(coming.offsets_m) - count <= MOST
    close = task.destination.margin_m(coming.tip_m[count:])
    (margins,) = promised
    assert close.max() == pytest.approx(margins.max(), abs=2.5e-4)
    for pace in (1.0, 1.3):
        at_s = np.sort(coming.delays_s[count:][coming.paces[count:] == pace])
        assert np.all(np.diff(at_s) >= ALIKE_S - 1e-9)


def test_places_between_are_exact_for_a_cubic():
    known = np.linspace(0.0, 0.01, 6)
    fine, weights = refinement._between(known, np.linspace(0.0, 0.01, 11))
    assert weights @ known**3 == pytest.approx(fine**3, abs=1e-15)
    assert fine[-1] == pytest.approx(known[-1])
    one, alone = refinement._between(known[:1], known)
    assert (one.tolist(), alone.tolist()) == ([0.0], [[1.0]])


def test_a_delayed_path_rests_first():
    limits = cell_task(SETTINGS).insertion
    at_once = insertion_path(Pose(0.0, -0.05, 0.0), 0.02, 0.05, limits, 500.0)
    later = insertion_path(Pose(0.0, -0.05, 0.0), 0.02, 0.05, limits, 500.0, delay_s=0.1)
    assert later.t_s[-1] == pytest.approx(at_once.t_s[-1] + 0.1)
    assert np.all(later.y_m[:51] == -0.05)
    assert later.y_m[50:].tolist() == at_once.y_m.tolist()
    with pytest.raises(ValueError, match="delay"):
        insertion_path(Pose(0.0, 0.0, 0.0), 0.02, 0.05, limits, 500.0, delay_s=-0.1)
