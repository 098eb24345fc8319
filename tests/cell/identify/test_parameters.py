import numpy as np
import pytest

from cell.cable.effects.air import AirDrag
from cell.cable.effects.grip import GripSlip, TipMass
from cell.cable.geometry import Cable
from cell.identify.model_class import with_prior
from cell.identify.parameters import ParameterSpace, Prior


def test_model_and_coordinates_agree(flat_cable: Cable) -> None:
    space = ParameterSpace.of(flat_cable, effects=[AirDrag])
    natural = np.array([2e-5, 3e-5, 4e-5, 3e-5, 2e-5, 1e-5, 1.1, 2e-7, 1.5])
    model = space.model(space.coordinates(natural))
    np.testing.assert_allclose(model.rigidity_n_m2, natural[:6])
    assert model.exponent == pytest.approx(1.1)
    assert model.viscosity_n_m2_s == pytest.approx(2e-7)
    assert model.effects[0].effect is AirDrag
    assert model.effects[0].values == pytest.approx((1.5,))
    assert space.names[-3:] == ("exponent", "viscosity", "air_drag.drag_coefficient")
    np.testing.assert_allclose(space.natural(space.coordinates(natural)), natural)


def test_prior_is_positive_definite_and_prefers_smooth_rigidity(flat_cable: Cable) -> None:
    space = ParameterSpace.of(flat_cable, prior=Prior(knots=8))
    np.linalg.cholesky(space.precision)
    even, rough = np.zeros(10), np.zeros(10)
    even[:8], rough[:8] = 0.3, 0.3 * (-1.0) ** np.arange(8)
    assert rough @ space.precision @ rough > 100.0 * (even @ space.precision @ even)


def test_prior_scales_with_the_cable() -> None:
    """A silicone bar and a flat cable: both start within a factor 4 of their rigidity."""
    bar = ParameterSpace.of(Cable(0.1, 0.963, 0.03, 0.03))
    assert np.exp(bar.mean[0]) == pytest.approx(1e-2, rel=3.0)


def test_start_takes_viscosity_and_effects_along(flat_cable: Cable) -> None:
    space = ParameterSpace.of(flat_cable, effects=[AirDrag])
    soft, stiff = space.start(1e-5), space.start(1e-4)
    np.testing.assert_allclose(stiff[:6] - soft[:6], np.log(10.0))
    assert stiff[7] - soft[7] == pytest.approx(np.log(10.0))
    assert soft[-1] == AirDrag.parameters[0].starts[0]


def test_impossible_priors_are_refused(flat_cable: Cable) -> None:
    with pytest.raises(ValueError, match="knots"):
        Prior(knots=1)
    with pytest.raises(ValueError, match="exponent_std"):
        Prior(exponent_std=0.0)
    with pytest.raises(ValueError, match="gravity"):
        ParameterSpace.of(flat_cable, gravity_m_per_s2=(0.0, 0.0))


def test_more_knots_describe_the_same_cable(flat_cable: Cable) -> None:
    space = ParameterSpace.of(flat_cable, effects=[AirDrag])
    q = space.mean + np.array([0.3, -0.2, 0.4, 0.1, -0.3, 0.2, 0.05, 0.5, 1.5])
    along = np.linspace(0.0, flat_cable.free_length_m, 301)
    for knots in (11, 21):
        finer = space.with_knots(knots)
        assert finer.names[knots:] == space.names[6:]
        assert len(finer.mean) == len(finer.low) == len(finer.step) == knots + 3
        np.linalg.cholesky(finer.precision)
        model = finer.model(space.at_knots(q, knots))
        np.testing.assert_allclose(
            model.rigidity_at(along), space.model(q).rigidity_at(along), rtol=1e-9
        )
        assert model.effects[0].values == pytest.approx((1.5,))


def test_what_is_known_of_a_kinds_rigidity_is_told_from_what_is_not(flat_cable: Cable) -> None:
    space = ParameterSpace.of(flat_cable)
    assert space.rigidity_is_unknown
    assert with_prior(space, ["viscosity"], [1e-7], [[0.01]]).rigidity_is_unknown
    assert not with_prior(space, ["rigidity_2"], [3e-5], [[0.01]]).rigidity_is_unknown


SMALL = ("tip_mass.mass_kg", "grip_slip.length_m")


@pytest.mark.parametrize(
    "covariance",
    [
        ((1e-12, 0.0), (9e-11, 1e-8)),  # its lower half only
        ((1e-12, 2e-10), (2e-10, 1e-8)),
        ((1e-12, 0.0), (0.0, 0.0)),
        ((1e-12, 0.0), (0.0, -1e-8)),
        ((1e-12, float("nan")), (float("nan"), 1e-8)),
    ],
)
def test_a_covariance_of_small_numbers_is_checked_as_any_other(
    flat_cable: Cable, covariance: tuple[tuple[float, ...], ...]
) -> None:
    space = ParameterSpace.of(flat_cable, effects=[TipMass, GripSlip])
    with pytest.raises(ValueError, match="not symmetric and positive definite"):
        with_prior(space, SMALL, (1e-5, 1e-4), covariance)
