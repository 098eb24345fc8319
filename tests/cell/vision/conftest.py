"""Cables of known shape, and the pictures a camera would take of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from calib.plane import PlaneView
from drivers.sim.render import STILL, Rates, RenderOptions, render


@dataclass(frozen=True)
class HeldCable:
    """A cable whose angle and curvature against arc length are known exactly."""

    grip: tuple[float, float, float]
    line_m: np.ndarray  # (401, 2) tip first
    length_m: float

    def nodes(self, count: int = 11) -> np.ndarray:
        share = np.linspace(0.0, 1.0, len(self.line_m))
        at = np.linspace(0.0, 1.0, count)
        return np.stack([np.interp(at, share, self.line_m[:, i]) for i in (0, 1)], axis=1)

    def errors(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors of nodes across and along the cable, m."""
        tangents = np.gradient(self.nodes(401), axis=0)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        t = tangents[:: 400 // (len(nodes) - 1)]
        off = nodes - self.nodes(len(nodes))
        return off[:, 1] * t[:, 0] - off[:, 0] * t[:, 1], np.sum(off * t, axis=1)


def held_cable(
    grip: tuple[float, float, float], curvature: Callable, length_m: float = 0.1
) -> HeldCable:
    """Integrate θ(s) = angle + ∫κ from the grip; `curvature` of s / length, 1/m."""
    s = np.linspace(0.0, length_m, 401)
    kappa = curvature(s / length_m)

    def integral(f):
        return np.concatenate([[0.0], np.cumsum(0.5 * (f[1:] + f[:-1]) * np.diff(s))])

    theta = grip[2] + integral(kappa)
    line = np.stack([-integral(np.cos(theta)), -integral(np.sin(theta))], axis=1)
    return HeldCable(grip, (line + np.array(grip[:2]))[::-1].copy(), length_m)


def random_cable(rng: np.random.Generator) -> HeldCable:
    """Clamp angle ± 60°, droop as of a heavy elastica, and swing with one to three S-bends."""
    a = rng.normal(0.0, [6.0, 6.0, 5.0, 3.0])

    def curvature(u):
        swing = sum(a[k] * np.sin(k * np.pi * u) for k in (1, 2, 3))
        return 2.0 * a[0] * (1.0 - u) ** 2 + swing

    while True:
        grip = (rng.uniform(0.0, 0.06), rng.uniform(-0.04, 0.04), rng.uniform(-1.0472, 1.0472))
        held = held_cable(grip, curvature)
        if np.all(np.abs(held.line_m) < [0.12, 0.095]):
            return held


@pytest.fixture(scope="session")
def view() -> PlaneView:
    """5 px/mm, square to the plane, its origin in the middle of the picture."""
    return PlaneView.from_scale(2e-4, 640.0, 512.0)


@pytest.fixture(scope="session")
def make_cable():
    return held_cable


@pytest.fixture(scope="session")
def make_random_cable():
    return random_cable


@pytest.fixture(scope="session")
def photograph_of(view):
    """Picture of a held cable; `swing` adds motion blur, metres per second at the tip."""

    def take(held: HeldCable, options=None, seed=0, swing=0.0, **faults):
        options = options or RenderOptions()
        share = np.linspace(1.0, 0.0, len(held.line_m))
        moving = np.stack([0.1 + 0.0 * share, 0.1 + swing * share**2], axis=1) * (swing != 0.0)
        return render(
            faults.pop("cable_m", held.line_m),
            faults.pop("grip", held.grip),
            faults.pop("sight", view.homography),
            options,
            np.random.default_rng(seed),
            rates=Rates(moving, (*moving[-1], 0.0)) if swing else STILL,
            **faults,
        )

    return take
