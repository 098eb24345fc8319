"""Fits on trials and their weight on those held out."""

from dataclasses import replace

import numpy as np

from cell.cable.geometry import Motion
from cell.identify.parameters import ParameterSpace
from cell.lab.bench import Bench
from cell.lab.explore import cold_start
from cell.lab.fitting import fit_model, heldout


def test_a_held_out_trial_that_the_model_cannot_follow_is_impossible_not_nan(make_study):
    study = make_study(seed=2)
    bench = Bench.of(study)
    space = ParameterSpace.of(study.cable)
    fit = fit_model(bench, space, cold_start(bench, space))
    last = study.trials[-1]
    t_s = last.grip.t_s
    thrown = Motion(t_s, 40.0 * np.sin(60.0 * t_s), last.grip.y_m, 30.0 * np.sin(40.0 * t_s))
    wild = replace(study, trials=(*study.trials[:-1], replace(last, grip=thrown)))
    weighed = heldout(replace(bench, study=wild), fit)
    assert weighed is not None
    assert weighed.log_likelihood == -np.inf
    assert weighed.rms_m == np.inf
    assert heldout(bench, fit).rms_m < 1.1e-4
