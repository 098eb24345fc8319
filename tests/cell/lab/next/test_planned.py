"""Motions to come are measured with what the study is measured with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.solver import Solver
from cell.lab.next.effect_query import effect_queries
from cell.lab.next.motion_file import Stroke
from cell.lab.next.simulated import with_motions
from cell.lab.next.study_power import power_of
from tests.cell.lab.conftest import fits_of
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import rig_study

MOTION = ("later", Stroke(0.0, 0.0, -0.08, 0.4).motion())
COARSE = Solver(segments=20, step_s=2e-3, threads=1)


@pytest.fixture(scope="module")
def study():
    made = rig_study(KINDS["wrench"](4), None)
    return replace(made, trials=made.trials[:1])


def of(study):
    return with_motions(fits_of(study, ("tip_mass", "air_drag"), solver=COARSE), [MOTION])


def test_the_wrench_of_a_motion_to_come_counts(study):
    fits = of(study)
    (planned,) = (t for t in fits.prepared.unjoined.trials if t.name == "later")
    (first, *_) = fits.prepared.unjoined.trials
    assert np.isfinite(planned.wrench.values).all()
    steps_s = [np.median(np.diff(t.wrench.t_s)) for t in (planned, first)]
    assert steps_s[0] == pytest.approx(steps_s[1], rel=1e-3)
    still = planned.wrench.t_s < 0.19
    noise_n = fits.prepared.gauges.force.noise.std_m
    assert np.std(planned.wrench.values[still, 1]) == pytest.approx(noise_n, rel=0.4)
    asked = effect_queries(["tip_mass=0.001"], [])[0]
    bare = replace(study, trials=tuple(replace(t, wrench=None) for t in study.trials))
    with_it, without = (power_of(f, asked).effects[0] for f in (fits, of(bare)))
    assert with_it.noncentrality > 1.2 * without.noncentrality


def test_the_hand_of_a_motion_to_come_is_logged_as_in_the_study(study):
    bare = replace(study, trials=tuple(replace(t, wrench=None) for t in study.trials))
    (first, planned) = of(bare).prepared.study.trials
    assert np.median(np.diff(planned.grip.t_s)) == pytest.approx(np.median(np.diff(first.grip.t_s)))
    for logged, recorded in zip(planned.grip.splines, first.grip.splines, strict=True):
        assert logged.noise_std == pytest.approx(recorded.noise_std, rel=0.4)
