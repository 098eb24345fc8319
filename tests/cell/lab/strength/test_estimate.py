"""Parameters from all trials: trials of one cable agree, of two cables they do not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from cell.cable.effects import library
from cell.identify.gauss_newton import Options, UnsimulatedError
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit import systematic_error
from cell.lab.fit.fitting import fit_model
from cell.lab.search.extension import cold_start
from cell.lab.strength.estimate import disagreement, estimate, identified


def fitted(study):
    prepared = PreparedStudy.of(study)
    space = ParameterSpace.of(study.cable, effects=[library()["tip_mass"]])
    baseline = ParameterSpace.of(study.cable)
    start = space.mean.copy()
    start[: len(baseline.names)] = cold_start(prepared, baseline)
    return prepared, fit_model(prepared, space, start)


def test_all_trials_know_more_and_agree(make_study):
    prepared, fit = fitted(make_study([library()["tip_mass"].active(mass_kg=2e-5)], seed=3))
    found = estimate(prepared, fit)
    assert found.disagreement < 1.5
    assert np.all(np.diag(found.fit.covariance) <= 1.01 * np.diag(fit.covariance))
    mass = found.intervals(library()["tip_mass"])["mass_kg"]
    assert mass.low < 2e-5 < mass.high
    assert mass.high - mass.low < 0.1 * 2e-5
    # beside a parameter that is hardly known rounding errors leave a variance below 0
    solution = found.fit.solution
    values, vectors = np.linalg.eigh(solution.covariance)
    values[0] = -1e-12 * values[-1]
    rounded = replace(solution, covariance=(vectors * values) @ vectors.T)
    again = disagreement(prepared, replace(found.fit, solution=rounded))
    assert np.isclose(again, found.disagreement, rtol=0.3)


def test_trials_of_different_cables_disagree_and_widen_the_interval(make_study):
    mass = library()["tip_mass"]
    one, other = (make_study([mass.active(mass_kg=m)], seed=3) for m in (2e-5, 3e-5))
    mixed = replace(one, trials=(*one.trials[:2], *other.trials[2:]))
    prepared, fit = fitted(mixed)
    found = estimate(prepared, fit)
    assert found.disagreement > 3.0
    interval = found.intervals(mass)["mass_kg"]
    alone = estimate(*fitted(one)).intervals(mass)["mass_kg"]
    assert interval.high - interval.low > 1.5 * (alone.high - alone.low)


def test_a_fit_left_before_its_minimum_allows_for_the_way_that_is_left(make_study, monkeypatch):
    """A compliance of the grip whose fit ended 10 standard deviations away was said to 1 %."""
    prepared, fit = fitted(make_study([library()["tip_mass"].active(mass_kg=2e-5)], seed=3))
    at = fit.space.names.index("tip_mass.mass_kg")
    q = fit.q.copy()
    q[at] *= 1.5
    left = fit_model(prepared, fit.space, q, options=Options(max_iterations=1))
    assert not left.arrived
    assert fit.arrived
    monkeypatch.setattr(systematic_error, "CONVERGED", Options(max_iterations=1))
    mass = estimate(prepared, left).intervals(library()["tip_mass"])["mass_kg"]
    assert mass.low < 2e-5 < mass.high
    assert abs(mass.value - 2e-5) > 10.0 * np.sqrt(left.covariance[at, at])
    kept = identified(prepared, left)
    low, high = kept.interval()
    assert low[at] < 2e-5 < high[at]
    assert not kept.converged
    assert identified(prepared, fit).converged


def test_a_fit_whose_last_place_cannot_be_simulated_is_its_own_estimate(monkeypatch):
    """A diagnosis ended there with "the model cannot be simulated at the start of the fit"."""

    def impossible(*args, **options):
        raise UnsimulatedError

    class Stub(SimpleNamespace):
        __hash__ = object.__hash__

    monkeypatch.setattr(systematic_error, "fit_model", impossible)
    fit = Stub(space=None, q=None, initial_states={})
    found = estimate(Stub(study=Stub(trials=()), memo={}), fit)
    assert (found.fit, found.disagreement) == (fit, 1.0)
