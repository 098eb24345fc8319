"""Derivatives of node positions, at zero amplitude too."""

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.model import CableModel
from cell.cable.sensitivity import (
    parameter_names,
    parameter_values,
    sensitivities,
    with_values,
)

EFFECTS = library()
TIMES = np.arange(0.0, 1.0, 0.02)
ALL = tuple(e.active() for e in EFFECTS.values())


def test_values_and_names_go_there_and_back(cable):
    model = CableModel(cable, np.array([3e-5, 2e-5]), 1.1, 1e-7, effects=ALL)
    names, values = parameter_names(model), parameter_values(model)
    assert len(names) == len(values)
    assert names[:4] == (
        "rigidity_n_m2[0]", "rigidity_n_m2[1]", "exponent", "viscosity_n_m2_s",
    )  # fmt: skip
    values[names.index("air_drag.drag_coefficient")] = 1.5
    assert np.array_equal(parameter_values(with_values(model, values)), values)


def test_they_predict_a_small_change(cable, arc, jerk):
    drag = EFFECTS["air_drag"].active(drag_coefficient=1.0)
    model = CableModel(cable, np.array([3e-5, 2.5e-5]), 1.1, 1e-7, effects=(drag,))
    found = sensitivities(model, jerk, TIMES, arc)
    assert found.jacobian.shape == (5, TIMES.size, arc.size, 2)
    step = np.array([2e-8, -1e-8, 1e-3, 1e-10, 0.01])
    changed = simulate(with_values(model, parameter_values(model) + step), jerk, TIMES, arc)[0]
    predicted = np.tensordot(step, found.jacobian, 1)
    actual = changed - found.positions
    assert np.abs(predicted - actual).max() < 0.01 * np.abs(actual).max()


def test_forward_differences_share_the_lane_in_the_middle(cable, arc, jerk):
    model = CableModel(cable, 3e-5, 1.0, 1e-7)
    central = sensitivities(model, jerk, TIMES, arc)
    forward = sensitivities(model, jerk, TIMES, arc, differences="forward")
    scale = np.abs(central.jacobian).max(axis=(1, 2, 3))
    error = np.abs(forward.jacobian - central.jacobian).max(axis=(1, 2, 3))
    assert np.all(error < 0.01 * scale)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_no_parameter_has_a_zero_derivative_at_zero_amplitude(cable, arc, jerk, name):
    effect = EFFECTS[name]
    model = CableModel(cable, 3e-5, 1.0, 1e-7, effects=(effect.active(),))
    names = [f"{name}.{p.name}" for p in effect.parameters]
    found = sensitivities(model, jerk, TIMES, arc, names=names)
    for p, column in zip(effect.parameters, found.jacobian, strict=True):
        assert np.abs(column).max() * abs(p.starts[0] or 1.0) > 1e-8, p.name


def test_an_amplitude_without_gradient_is_nudged(cable, arc, jerk):
    class Even(EFFECTS["tip_mass"]):
        name = "even"

        @staticmethod
        def tip_mass(cable, p):
            return (p.mass_kg / 1e-5) ** 4 * 1e-5

    model = CableModel(cable, 3e-5, 1.0, 1e-7, effects=(Even.active(),))
    found = sensitivities(model, jerk, TIMES, arc, names=["even.mass_kg"])
    assert np.abs(found.jacobian).max() * 2.5e-5 > 1e-6


def test_an_unknown_parameter_is_named(cable, arc, jerk):
    with pytest.raises(ValueError, match=r"no parameter 'stiffness'.*rigidity_n_m2\[0\]"):
        sensitivities(CableModel(cable, 3e-5), jerk, TIMES, arc, names=["stiffness"])
