"""The noise of a residual from which much that is slow was taken out."""

import numpy as np
import pytest

from cell.identify.noise import Noise
from cell.lab.data import noise_likelihood
from cell.lab.data.noise_likelihood import AR1_GRID, WHITE_SHARES, ProjectedResidual
from tests.cell.lab.conftest import coloured

NOISES = [(float(ar1), 0.0) for ar1 in AR1_GRID]


def taken_out(seed, frames=100, channels=6, ar1=0.92, directions=30, lost=0.0):
    """AR(1) noise of variance 1 less what slow oscillations explain of it, over two trials."""
    rng = np.random.default_rng(seed)
    noise, t = coloured(rng, (frames, channels), ar1), np.linspace(0.0, 1.0, frames)
    slow = [
        np.outer(np.cos(rng.uniform(0, 30) * t + rng.uniform(0, 6)), rng.normal(size=channels))
        for _ in range(directions)
    ]
    seen = rng.uniform(size=noise.shape) >= lost
    q, _ = np.linalg.qr(np.stack(slow, axis=-1)[seen])
    explained = np.zeros((*noise.shape, directions))
    explained[seen] = q
    noise[seen] -= q @ (q.T @ noise[seen])
    noise[~seen] = np.nan
    half = frames // 2
    return ProjectedResidual((noise[:half], noise[half:]), (explained[:half], explained[half:]))


def likeliest(projected, noises=NOISES):
    """Noise, and −2 ln of the likelihood of all."""
    square, log_det = projected.sums(noises, np.ones(len(noises), dtype=bool))
    level = square / projected.dof
    cost = projected.dof * np.log(level) + log_det
    best = int(np.argmin(cost))
    ar1, white = noises[best]
    return Noise(float(np.sqrt(level[best])), ar1, white=white), cost


@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_slow_noise_is_not_underestimated_for_what_was_taken_out(lost):
    """A third of what is slow was; without regard to that half of the slow variance is missed."""
    found, naive = [], []
    for seed in range(24):
        projected = taken_out(seed, lost=lost)
        none = tuple(e[..., :0] for e in projected.basis)
        for r, logs in ((projected, found), (ProjectedResidual(projected.errors_m, none), naive)):
            noise, _ = likeliest(r)
            logs.append(np.log(noise.std_m**2 / noise.effective_fraction / 24.0))
    assert abs(np.mean(found)) < 3.0 * np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found)) < 0.3 * abs(np.mean(naive))
    assert np.mean(naive) < -0.5


def test_between_the_correlations_that_are_worked_out_little_is_lost(monkeypatch):
    projected = taken_out(0, frames=60, channels=2, directions=20)
    _, cost = likeliest(projected)
    monkeypatch.setattr(noise_likelihood, "NODES", len(NOISES))
    _, exact = likeliest(projected)
    near = exact < exact.min() + 16.0
    assert near.sum() > 20
    assert np.abs(cost - exact)[near] == pytest.approx(0.0, abs=0.03)


def test_only_what_is_wanted_is_worked_out():
    noises = [(float(ar1), white) for white in WHITE_SHARES for ar1 in AR1_GRID]
    wanted = np.zeros(len(noises), dtype=bool)
    wanted[[3, 4, 5, 130]] = True
    square, log_det = taken_out(1).sums(noises, wanted)
    assert np.array_equal(np.isfinite(square), wanted)
    assert np.array_equal(np.isfinite(log_det), wanted)


def test_where_all_is_taken_out_nothing_is_told():
    projected = taken_out(2, frames=10, channels=2, directions=20)
    assert projected.dof == 0
    square, _ = projected.sums(NOISES, np.ones(len(NOISES), dtype=bool))
    assert square == pytest.approx(0.0, abs=1e-9)
