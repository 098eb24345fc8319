"""The simulated cables: drawn from the seed alone, within the settings, finer than the model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.identify.parameters import Prior
from cell.settings import Settings, load_settings
from cell.wiring.twins import FIRST_MODE, build_twins, cable_shape, hidden_cable
from drivers.interfaces import Trajectory

CONFIG = Path(__file__).parents[3] / "config"


@pytest.fixture(scope="module")
def settings() -> Settings:
    return load_settings(CONFIG / "fake.yaml")


def test_individuals_differ_and_the_seed_repeats_them(settings: Settings) -> None:
    a, b, again = (hidden_cable(settings, 3, n) for n in (1, 2, 1))
    np.testing.assert_array_equal(a.rigidity_n_m2, again.rigidity_n_m2)
    assert a.viscosity_n_m2_s == again.viscosity_n_m2_s
    assert abs(np.log(a.rigidity_n_m2.mean() / b.rigidity_n_m2.mean())) > 0.01


def test_individuals_are_as_the_settings_say(settings: Settings) -> None:
    truth = settings.world
    cables = [hidden_cable(settings, seed, 1) for seed in range(200)]
    logs = np.log([c.rigidity_n_m2 for c in cables])
    low, high = np.log(truth.rigidity_n_m2)
    middle = logs.mean(axis=1)
    assert low - 0.3 < middle.min() < low + 0.2
    assert high - 0.2 < middle.max() < high + 0.3
    assert 0.3 < logs.std(axis=1).mean() / truth.rigidity_variation < 1.3, "EI varies along it"
    exponents = np.array([c.exponent for c in cables])
    assert truth.exponent[0] <= exponents.min() < exponents.max() <= truth.exponent[1]


def test_damping_of_the_first_mode_is_what_the_settings_say(settings: Settings) -> None:
    world = settings.world.model_copy(
        update={"damping_ratio": (0.0499, 0.0501), "rigidity_variation": 0.0}
    )
    cable = hidden_cable(settings.model_copy(update={"world": world}), 1, 1)
    rigidity = float(cable.rigidity_n_m2[0])
    inertia = cable.cable.line_density_kg_per_m * cable.cable.free_length_m**4
    rate = FIRST_MODE**2 * np.sqrt(rigidity / inertia)
    assert cable.viscosity_n_m2_s * rate / (2.0 * rigidity) == pytest.approx(0.05, rel=0.01)


def test_the_world_knows_more_of_its_cables_than_the_model_can(settings: Settings) -> None:
    assert hidden_cable(settings, 1, 1).rigidity_n_m2.size > Prior().knots
    rest = Trajectory(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))
    shape = cable_shape(hidden_cable(settings, 1, 1), settings.world.segments)
    points_m = shape(rest, np.array([0.0, 0.5]))
    assert points_m.shape == (2, settings.world.segments + 1, 2)
    np.testing.assert_allclose(points_m[:, -1], 0.0, atol=1e-12)
    assert np.all(points_m[:, 0, 0] < -0.08), "tip first"
    length_m = np.linalg.norm(np.diff(points_m[0], axis=0), axis=1).sum()
    assert length_m == pytest.approx(settings.cable.free_length_m, rel=1e-3)


@pytest.mark.parametrize(
    "effects", [{"tip_mass": {"mass_kg": 5e-5}}, {"plastic_set": {"radius_m": 0.05}}]
)
def test_hidden_effects_change_what_the_world_does(
    settings: Settings, effects: dict[str, dict[str, float]]
) -> None:
    heavy = settings.world.model_copy(update={"effects": effects})
    rest = Trajectory(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))
    tips = [
        cable_shape(hidden_cable(s, 1, 1), 60)(rest, np.array([0.0, 0.5]))[1, 0]
        for s in (settings, settings.model_copy(update={"world": heavy}))
    ]
    assert tips[1][1] < tips[0][1] - 0.002


def test_as_many_cables_are_laid_out_as_there_are_cycles(settings: Settings) -> None:
    assert build_twins(settings, 1, 4).world.waiting == 4
