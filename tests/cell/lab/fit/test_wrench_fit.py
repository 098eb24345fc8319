"""What a wrench at the clamp adds to one marker: mass at the tip, whatever the sensor's tare."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.solver import Solver
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.fit.corrections import mesh_error_m, without_mesh_error
from cell.lab.fit.fitting import fit_model
from cell.lab.next.simulated import HiddenEffectWorld
from cell.lab.search.extension import cold_start
from cell.lab.search.fitted_model import POLISH
from tools.worlds.made_studies import hidden
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import rig_study

RIG = KINDS["wrench"](4)
MASS = hidden(library()["tip_mass"], 1.0, RIG.cable)
COARSE = Solver(segments=20, step_s=2e-3, threads=1)


@pytest.fixture(scope="module")
def study():
    made = rig_study(RIG, MASS)
    return replace(made, trials=made.trials[:1])


def fitted(study):
    space = ParameterSpace.of(study.cable, effects=(library()["tip_mass"],))
    prepared = PreparedStudy.of(study, solver=COARSE)
    fit = fit_model(prepared, space, cold_start(prepared, space), options=POLISH)
    prepared = without_mesh_error(prepared, fit, mesh_error_m(prepared, fit))
    return prepared, fit_model(prepared, space, fit.q, options=POLISH)


def mass_of(fit):
    i = fit.space.names.index("tip_mass.mass_kg")
    return fit.space.natural(fit.q)[i], float(np.sqrt(fit.covariance[i, i]))


def test_a_mass_at_the_tip_is_found_better_than_by_the_marker_alone(study):
    bare = replace(study, trials=tuple(replace(t, wrench=None) for t in study.trials))
    (prepared, fit), (_, alone) = fitted(study), fitted(bare)
    (value, std), (_, std_alone) = mass_of(fit), mass_of(alone)
    true_kg = MASS.named["mass_kg"]
    assert value == pytest.approx(true_kg, abs=4.0 * std)
    assert std < 0.7 * std_alone
    assert fit.chi2 / prepared.count(prepared.study.trials) == pytest.approx(1.0, abs=0.2)
    assert fit.markers_rms_m == pytest.approx(alone.rms_m, rel=0.1)


def test_the_tare_of_the_sensor_changes_nothing(study):
    """A constant on every column."""
    first = study.trials[0]
    shown = np.add(first.wrench.values, [3.0, -2.0, 1.0])
    tared = replace(first, wrench=replace(first.wrench, values=shown))
    (_, fit), (_, other) = fitted(study), fitted(replace(study, trials=(tared,)))
    np.testing.assert_allclose(other.q, fit.q, atol=1e-3)


def test_a_copy_of_the_study_has_a_wrench_of_the_same_noise_and_colour(study):
    """Fresh noise on the fitted cable's wrench; it is a study as the one that was measured."""
    prepared, fit = fitted(study)
    world = HiddenEffectWorld.of(prepared, fit, None)
    (copy,), (measured,) = world.copy(1).trials, as_measured(prepared).trials
    assert np.isin(copy.wrench.t_s, measured.wrench.t_s).all()
    np.testing.assert_array_equal(copy.markers.t_s, measured.markers.t_s)
    gauges = world.prepared.gauges
    clean = gauges.of_wrench(world.clean_m["identify"])
    left = (copy.wrench.values - clean[gauges.joined["identify"].rows])[:, :2]
    noise = prepared.gauges.force.noise
    assert left.std() == pytest.approx(noise.std_m, rel=0.15)
    beside = np.mean(left[1:] * left[:-1]) / left.var()
    assert beside == pytest.approx(noise.ar1, abs=0.15)


def test_a_copy_of_a_fast_sensor_has_its_rows_not_their_means():
    """As many as were measured while markers were looked for, of a row's noise."""
    rig = KINDS["wrench"](3)
    made = rig_study(rig, MASS)
    prepared, fit = fitted(replace(made, trials=made.trials[:1]))
    assert prepared.study.trials[0].row_means is not None
    world = HiddenEffectWorld.of(prepared, fit, None)
    (copy,), (measured,) = world.copy(1).trials, as_measured(prepared).trials
    filmed = measured.wrench.t_s >= measured.markers.t_s[0]
    filmed &= measured.wrench.t_s <= measured.markers.t_s[-1]
    np.testing.assert_array_equal(copy.wrench.t_s, measured.wrench.t_s[filmed])
    left = copy.wrench.values - world.prepared.gauges.of_wrench(
        world.clean_m["identify"][world.prepared.gauges.joined["identify"].rows]
    )
    assert left[:, :2].std() == pytest.approx(rig.sensor.force_n, rel=0.2)
    again = PreparedStudy.of(world.copy(1)).study.trials[0]
    np.testing.assert_array_equal(again.markers.t_s, prepared.study.trials[0].markers.t_s)
