"""What the gripper's log may be wrong by, and how much less an effect that it imitates is worth."""

from types import SimpleNamespace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.opened_study import open_study
from cell.lab.diagnosis import diagnose
from cell.lab.fit.systematic_error import MOTIONS, GripperLogError, gripper_log_error
from cell.lab.search.setup import fit_cache_of
from cell.study.folder import write_study
from tests.cell.lab.conftest import fits_of
from tools.worlds.breadth_world import World, hypercube

RNG = np.random.default_rng(3)


@pytest.fixture
def error():
    """Of two trials: rows along one direction each, of standard deviation 3 and 0."""
    along = np.zeros((MOTIONS, 50))
    along[:, 0] = 3.0 * np.sqrt(MOTIONS) * np.eye(MOTIONS)[0]
    return GripperLogError({"a": along, "b": np.zeros((MOTIONS, 20))})


def test_along_what_the_hand_does_a_change_is_worth_less(error):
    along, across = np.zeros(50), np.zeros(50)
    along[0], across[1] = 2.0, 2.0
    nothing = np.zeros(20)
    assert error.inflation({"a": along, "b": nothing}) == pytest.approx(10.0)
    assert error.inflation({"a": across, "b": nothing}) == 1.0
    half = np.append(np.zeros(19), 2.0)  # half of the change is of a trial whose log is exact
    assert error.inflation({"a": along, "b": half}) == pytest.approx(5.5)


def test_no_change_at_all_is_no_division_by_zero(error):
    assert error.inflation({"a": np.zeros(50), "b": np.zeros(20)}) == 1.0
    assert error.inflation({"a": np.full(50, np.inf), "b": np.zeros(20)}) == 1.0


def test_what_the_parameters_imitate_is_not_left(error):
    trials = [SimpleNamespace(name="a"), SimpleNamespace(name="b")]
    slopes = np.zeros((70, 2))
    slopes[0, 0], slopes[1, 1] = 1.0, 1.0
    solution = SimpleNamespace(jacobian=slopes, free=np.array([True, True]))
    assert error.square(trials) == pytest.approx(9.0)
    assert error.residual_square(trials, SimpleNamespace(solution=solution)) == pytest.approx(0.0)
    solution.free[0] = False
    assert error.residual_square(trials, SimpleNamespace(solution=solution)) == pytest.approx(9.0)


def test_an_exact_log_changes_nothing(make_study):
    study = make_study(seed=2)
    fits = fits_of(study)
    found = gripper_log_error(fits.prepared, fits.base.fit)
    assert found.square(study.trials) < 1e-3


def test_a_log_as_noisy_as_the_markers_is_no_effect(tmp_path):
    """Held to the markers' noise alone, this complete study had air drag and a slipping grip."""
    conditions = next(c for c in hypercube(200, 200) if c.number == 46)
    assert conditions.log_m > 0.9 * conditions.noise_m
    world = World.of(conditions, 2)
    write_study(world.study(world.clean(), 2), tmp_path)
    names = ("air_drag", "grip_slip", "tip_mass", "grip_angle")
    selection = EffectSelection((), {n: library()[n] for n in names})
    found = diagnose(fit_cache_of(open_study(tmp_path), selection)).diagnosis
    assert (found.verdict, found.missing) == ("complete", ())
