"""Models as identification returns them, of cables that differ."""

from __future__ import annotations

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.geometry import Cable
from cell.exchange.chain import chain_of, resting_bends
from cell.exchange.mjcf import mjcf
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace

FLAT_CABLE = Cable(0.1, 0.0074, 0.016, 0.0001)


@pytest.fixture
def flat_model():
    """Model of the paper's cable: seed, N, and effects by name with values of their parameters."""

    def make(seed: int = 0, exponent: float = 1.0, **effects: dict[str, float]) -> Identified:
        rng = np.random.default_rng(seed)
        classes = [library()[name] for name in effects]
        space = ParameterSpace.of(FLAT_CABLE, effects=classes)
        natural = space.natural(space.mean)
        wave = rng.uniform(-0.15, 0.15, space.knots)
        natural[: space.knots] = rng.uniform(1.8e-5, 5e-5) * np.exp(wave)
        natural[space.knots] = exponent
        natural[space.knots + 1] = rng.uniform(6e-8, 2e-7)
        for name, values in effects.items():
            for parameter, value in values.items():
                natural[space.names.index(f"{name}.{parameter}")] = value
        covariance = 1e-4 * np.eye(len(natural))
        return Identified(
            space, space.coordinates(natural), covariance, Noise(1e-4), 1e-4, 1.0, 100, 100, 3,
            "map", 0.0 * covariance,
        )  # fmt: skip

    return make


@pytest.fixture
def chain_xml(tmp_path):
    """The file of a model as a chain of so many links, without a comparison."""

    def write(identified: Identified, links: int, name: str = "cable.xml"):
        chain = chain_of(identified.model, links)
        rest = resting_bends(identified.model, links, 0.0)
        path = tmp_path / name
        path.write_text(mjcf(chain, 1e-3, rest, ["A cable"]), encoding="utf-8")
        return path

    return write
