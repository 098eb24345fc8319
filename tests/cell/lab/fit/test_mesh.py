"""The error of a mesh is taken out of a study, so that no effect is found in its place."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.geometry import Cable
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.lab.data.prepared import PreparedStudy
from cell.lab.diagnosis import diagnose
from cell.lab.fit.corrections import mesh_error_m, moves_parameters, without_mesh_error
from cell.lab.fit.fitting import fit_trials
from cell.lab.fit.systematic_error import systematic_error
from cell.lab.verdict.check_statistics import score_tests
from cell.study.data import Markers, Study, Trial
from tests.cell.lab.conftest import fits_of
from tools.worlds.made_studies import moved
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import rig_study

pytestmark = pytest.mark.usefixtures("own_mesh")

#: Soft and long, so that 32 segments err by a third of what the camera does.
CABLE = Cable(1.0, 0.02, 0.012, 0.001)


def study(noise_m, frames_hz=60.0):
    model = CableModel(CABLE, np.full(4, 0.02 * 9.81 / 9.0), 1.0, 4e-4)
    arcs = 1.0 - np.arange(6) / 6.0
    rng, trials = np.random.default_rng(0), []
    for name, role, way in (
        ("down", "fit", (0.0, -0.5)),
        ("left", "fit", (-0.5, 0.0)),
        ("aslant", "validate", (-0.4, -0.3)),
    ):
        t = np.arange(0.0, 4.3, 0.005)
        hand = moved(t, way, 0.95, begin_s=1.0)
        seen_s = np.arange(0.0, 4.3, 1.0 / frames_hz)
        coarse, fine = (
            simulate(model, hand, seen_s, arcs, solver=Solver(n, 0.1 / n))[0] for n in (80, 160)
        )
        seen = fine + (fine - coarse) / 3.0 + noise_m * rng.normal(size=fine.shape)
        trials.append(Trial(name, role, "equilibrium", hand, Markers(seen_s, seen)))
    return Study("soft", CABLE, arcs, tuple(trials))


def test_once_taken_out_little_of_it_is_left():
    made = replace(study(1e-7), noise_std_m=1e-4)
    fits = fits_of(made)
    raw, fit = PreparedStudy.of(made), fits.base.fit
    clean = fits.prepared
    trials = fit_trials(raw)

    def size(prepared):
        return float(np.linalg.norm(systematic_error(prepared, fit, trials).mesh))

    assert size(clean) < 0.1 * size(raw)
    trial, moved = raw.study.trials[0].markers, clean.study.trials[0].markers
    shift_m = float(np.sqrt(np.mean((trial.xy_m - moved.xy_m) ** 2)))
    assert 3e-5 < shift_m < 3e-3
    rest_m = mesh_error_m(clean, fit)
    again = without_mesh_error(clean, fit, rest_m).study.trials[0].markers
    assert np.sqrt(np.mean((again.xy_m - moved.xy_m) ** 2)) < 0.1 * shift_m
    assert moves_parameters(raw, mesh_error_m(raw, fit))
    assert not moves_parameters(clean, {name: 1e-3 * error for name, error in rest_m.items()})


def test_a_complete_model_of_a_soft_cable_lacks_nothing():
    """The mesh's error looks like a longer cable, a softer grip: 0.2 mm of noise showed it."""
    names = ("grip_slip", "grip_compliance", "air_drag", "tip_mass")
    found = diagnose(fits_of(study(2e-4), names)).diagnosis
    assert found.verdict == "complete"
    assert found.missing == ()


def test_markers_of_uncertain_arc_length_move_along_the_line_of_the_model():
    """Along the measured line, which errs as the markers do, a complete study had a grip_slip."""
    made = rig_study(KINDS["arcs"](102), None)
    fits = fits_of(made, ("grip_slip",))
    fit, prepared = fits.base.fit, fits.prepared
    for slopes in prepared.lines.values():  # of a cable that does not stretch
        np.testing.assert_allclose(np.linalg.norm(slopes, axis=2), 1.0, atol=2e-3)
    ((asked, _),) = score_tests(prepared, fit, [library()["grip_slip"]]).values()
    assert asked.chi2 < 6.0
