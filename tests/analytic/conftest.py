"""A cable in the compiled layout, and a chain of links, to be stepped and weighed."""

from __future__ import annotations

import numpy as np
import pytest

from cell.cable import layout as at
from cell.cable.assembly import assemble
from cell.cable.clamp import base_rows
from cell.cable.compiling import compiled
from cell.cable.geometry import Cable
from cell.cable.kernel import bending, kinematics, solve
from cell.cable.model import REFERENCE_CURVATURE_1_PER_M, REGULAR_CURVATURE_1_PER_M, CableModel
from cell.cable.solver import generalised_alpha
from cell.cable.splines import Steps
from cell.cable.stepping import integrate, sample_times


@compiled
def _accelerate(state, scratch, lanes, segments, rows, nonlinear):
    kinematics(state, lanes, segments, rows, 0, False)
    bending(state, lanes, segments, nonlinear, 0.0, 0.0)
    solve(state, scratch, lanes, segments, rows, 0, 0.0, False)


class Chain:
    """One cable in the compiled layout, to be stepped under a still clamp and weighed."""

    def __init__(self, model, segments=12, step=5e-4, damping=1.0, angle=0.0):
        (self.block,) = assemble([model], segments, 0.0)
        self.n, self.model, self.angle, self.step = segments, model, angle, step
        self.coefficients = generalised_alpha(step, damping)
        self.fields = self.block.state.reshape(segments + 1, at.FIELDS, at.LANES)

    def __getitem__(self, field):
        return self.fields[:, field, 0]

    def base(self, steps):
        rows = np.zeros((steps, at.BASE_FIELDS, at.LANES))
        rows[:, at.BASE_ANGLE] = self.angle
        return rows.ravel()

    def run(self, steps):
        b = self.block
        out = np.empty(0)
        bad = integrate(
            b.state, b.width, self.n, self.base(steps), self.coefficients, b.nonlinear,
            b.iterations, b.effects, sample_times([out]), out, np.empty(0),
        )  # fmt: skip
        assert bad == -1

    def acceleration(self):
        """Of the bends, in the present state, by the engine."""
        b, rows = self.block, self.base(1)
        for now, there in ((at.BEND, at.BEND_C), (at.RATE, at.RATE_C)):
            self.fields[:, there] = self.fields[:, now]
        self.fields[:, at.ACCEL_C] = 0.0
        _accelerate(b.state, np.zeros(12 * at.LANES), b.width, self.n, rows, b.nonlinear)
        return self[at.ACCEL_C].copy()

    def kinetic(self, bend, rate):
        """½∫ρ v² over the rods by Gauss' rule, J."""
        model, length = self.model, self[at.LENGTH]
        extra = sum(a.named.get("kg_per_m", 0.0) for a in model.effects)
        tip = sum(a.named.get("mass_kg", 0.0) for a in model.effects)
        angle, spin = self.angle + np.cumsum(bend), np.cumsum(rate)
        t = -np.stack([np.cos(angle), np.sin(angle)], axis=1)
        normal = np.stack([-t[:, 1], t[:, 0]], axis=1)
        velocity, total = np.zeros(2), 0.0
        for i in range(self.n + 1):
            for place, weight in ((0.5 - 12**-0.5, 0.5), (0.5 + 12**-0.5, 0.5)):
                v = velocity + place * length[i] * spin[i] * normal[i]
                density = model.cable.line_density_kg_per_m * v @ v + extra * (v @ normal[i]) ** 2
                total += 0.5 * weight * length[i] * density
            velocity = velocity + length[i] * spin[i] * normal[i]
        return total + 0.5 * tip * velocity @ velocity

    def potential(self, bend):
        """Weight, and ∫M dκ over the hinges by Gauss' rule, J."""
        model, length = self.model, self[at.LENGTH]
        tip = sum(a.named.get("mass_kg", 0.0) for a in model.effects)
        angle = self.angle + np.cumsum(bend)
        t = -np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ends = np.cumsum(length[:, None] * t, axis=0)
        middles = ends - 0.5 * length[:, None] * t
        g = np.array(model.gravity_m_per_s2)
        total = -model.cable.line_density_kg_per_m * np.sum(length * (middles @ g))
        total -= tip * ends[-1] @ g
        x, weights = np.polynomial.legendre.leggauss(40)
        per = self[at.PER_LENGTH][1:]
        k = bend[1:] * per - self[at.REST][1:]
        for xi, w in zip((x + 1) / 2, weights / 2, strict=True):
            scale = ((xi * k) ** 2 + REGULAR_CURVATURE_1_PER_M**2) / REFERENCE_CURVATURE_1_PER_M**2
            moment = self[at.RIGIDITY][1:] * xi * k * scale ** ((model.exponent - 1) / 2)
            total += np.sum(w * k * moment / per)
        return total

    def energy(self):
        return self.kinetic(self[at.BEND], self[at.RATE]) + self.potential(self[at.BEND])


@pytest.fixture
def chain():
    return Chain


def swing_links(length, fields, motion, times, step=1e-4):
    """Node positions (times, n + 1, 2) of a chain of n equal links hinged at the nodes.

    fields  (5, n) from the grip out: stiffness and damping of the hinge before each link, and ∫dm,
            ∫s dm, ∫s² dm of the link
    The chain starts straight and at rest at the first time.
    """
    stiffness, damping, mass, first, second = np.asarray(fields)
    n = len(mass)
    (block,) = assemble([CableModel.uniform(Cable(n * length, 0.01, 0.01, 1e-4), 1.0)], n, 0.0)
    state = block.state.reshape(n + 1, at.FIELDS, at.LANES)
    state[0, [at.LENGTH, at.MASS, at.MASS_1, at.MASS_2, at.WEIGHT, at.WEIGHT_1]] = 0.0
    links = state[1:].swapaxes(0, 1)
    links[at.LENGTH], links[at.PER_LENGTH] = length, 1.0
    for field, value in (
        (at.RIGIDITY, stiffness),
        (at.VISCOSITY, damping),
        (at.MASS, mass),
        (at.MASS_1, first),
        (at.MASS_2, second),
        (at.WEIGHT, mass),
        (at.WEIGHT_1, first),
    ):
        links[field] = value[:, None]
    steps = int(np.ceil((times[-1] - times[0]) / step))
    coefficients = generalised_alpha(step, 1.0)
    rows = base_rows(motion, (), Steps(times[0], step, steps, coefficients[12]))
    base = np.repeat(rows[:, :, None], at.LANES, axis=2).ravel()
    out = np.zeros(len(times) * (n + 1) * at.LANES)
    bad = integrate(
        block.state, block.width, n, base, coefficients, False, 2, block.effects,
        sample_times([(times - times[0]) / step] * at.LANES), out, np.empty(0),
    )  # fmt: skip
    assert bad == -1
    x, y, angle = (s(times) for s in motion.splines)
    angles = angle[:, None] + np.cumsum(out.reshape(len(times), n + 1, at.LANES)[:, :, 0], axis=1)
    links_xy = -length * np.stack([np.cos(angles[:, 1:]), np.sin(angles[:, 1:])], axis=2)
    grip = np.stack([x, y], axis=1)[:, None]
    return np.concatenate([grip, grip + np.cumsum(links_xy, axis=1)], axis=1)


@pytest.fixture
def links():
    return swing_links
