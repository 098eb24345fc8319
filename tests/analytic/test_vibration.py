"""Small vibrations of a clamped beam against the textbook."""

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import curve_fit

from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver

EI, RHO, LENGTH = 3e-5, 0.0074, 0.1
FINE = Solver(60, 1e-4, 1.0)


def two_frequencies(t, signal, guess):
    """Frequencies of two undamped modes in a signal, Hz."""

    def modes(t, f1, f2, a1, a2, mean):
        return mean + a1 * np.cos(2 * np.pi * f1 * t) + a2 * np.cos(2 * np.pi * f2 * t)

    scale = np.ptp(signal)
    start = (*guess, -0.45 * scale, -0.02 * scale, signal.mean())
    sizes = (1, 1, scale, scale, scale)
    found, _ = curve_fit(modes, t, signal, p0=start, method="trf", x_scale=sizes)
    return found[:2]


def released(cable, angle, gravity):
    """Displacements of tip and of the point 0.6 L after letting go a straight beam."""
    model = CableModel.uniform(cable, EI, gravity_m_per_s2=gravity)
    t = np.arange(0.0, 1.5, 1e-3)
    still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.full(2, angle))
    xy = simulate(model, still, t, np.array([LENGTH]), solver=FINE, start="straight", release_s=0.0)
    return t, xy[0, :, 0] - xy[0, 0, 0]


def test_horizontal_beam_has_the_textbook_frequencies(cable):
    theory = np.array([1.8751, 4.6941]) ** 2 / LENGTH**2 * np.sqrt(EI / RHO) / (2 * np.pi)
    t, d = released(cable, 0.0, (0.0, -1e-4))
    assert two_frequencies(t, d[:, 1], theory) == pytest.approx(theory, rel=5e-4)


def test_hanging_beam_has_the_frequencies_of_a_tensioned_beam(cable):
    # Hermite finite elements, 60 of them: bending, and tension ρ g (L − s)
    n, h = 60, LENGTH / 60
    size = 2 * (n + 1)
    stiff, mass = np.zeros((size, size)), np.zeros((size, size))
    x, weights = np.polynomial.legendre.leggauss(5)
    for e in range(n):
        own = slice(2 * e, 2 * e + 4)
        for xi, w in zip((x + 1) / 2, weights / 2 * h, strict=True):
            rise, dip = 3 * xi**2 - 2 * xi**3, 6 * (xi - xi**2) / h
            shape = np.array([1 - rise, h * xi * (1 - xi) ** 2, rise, h * (xi**3 - xi**2)])
            slope = np.array([-dip, 1 - 4 * xi + 3 * xi**2, dip, 3 * xi**2 - 2 * xi])
            bend = np.array([12 * xi - 6, h * (6 * xi - 4), 6 - 12 * xi, h * (6 * xi - 2)]) / h**2
            tension = RHO * 9.81 * (LENGTH - (e + xi) * h)
            stiff[own, own] += w * (EI * np.outer(bend, bend) + tension * np.outer(slope, slope))
            mass[own, own] += w * RHO * np.outer(shape, shape)
    values = eigh(stiff[2:, 2:], mass[2:, 2:], eigvals_only=True, subset_by_index=[0, 1])
    theory = np.sqrt(values) / (2 * np.pi)
    t, d = released(cable, np.pi / 2, (1e-4, -9.81))
    assert two_frequencies(t, d[:, 0], theory) == pytest.approx(theory, rel=5e-4)
