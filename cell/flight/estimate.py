"""What moves a cable beside the expected, found from the frames so far: a linear Gaussian model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from cell.cable.arrays import FloatArray
from cell.flight.answers import EVERY_NODE, INTERVAL_S, KNOTS_S, MODES, Answers

#: By so much at once, m: of the tip that a force bends, and of the hand.  Which of these fit best
#: the frames tell.  The smallest add up to 0.01 mm at the tip in a flight: the engine's own error.
FORCES_M = (1e-6, 3e-5, 2e-4, 1e-3)
HAND_M = (1e-6, 3e-4)
#: Frames one after the other err alike: of so many one is used, and as many of these tell as much
#: as one alone.
EVERY, ALIKE = 2, 2.0


@dataclass(frozen=True, eq=False)
class Deviation:
    """How a cable's tip moves beside the expected, m.

    tip_m       (T, 2) the tip's, at the times of the answers, those to come included
    tips_m      (samples, T, 2) of tips that are as probable
    misfit      of the frames, root mean square in standard deviations; about 1 = explained
    """

    tip_m: FloatArray
    tips_m: FloatArray
    misfit: float


def deviation(
    answers: Answers,
    t_s: FloatArray,
    nodes_m: FloatArray,
    std_m: float,
    samples: int = 32,
) -> Deviation:
    """What the frames so far tell of the cable's motion until its end.

    t_s      (frames,) from when the hand was told to move
    nodes_m  (frames, nodes, 2) measured, nan = not seen
    std_m    of their noise
    source   Kalman & Bucy; batch form, as in Bar-Shalom, Li & Kirubarajan 2001, section 3.4
    """
    knots = 1 + int(t_s[-1] / KNOTS_S)  # of what is to come nothing is known
    unknowns = answers.lasting + knots * (MODES + 2)
    tip = answers.tip[..., :unknowns]
    t_s, nodes_m = t_s[::-EVERY], nodes_m[::-EVERY, ::EVERY_NODE]
    expected = _at(answers.nodes_m[:, ::EVERY_NODE], t_s)
    seen_by = _at(answers.basis[..., :unknowns], t_s)
    rows, known = (nodes_m - expected).ravel(), np.isfinite(nodes_m).ravel()
    weight = 1.0 / (std_m * np.sqrt(ALIKE))
    values = weight * rows[known]
    slopes = weight * seen_by.reshape(len(rows), -1)[known]
    normal, right = slopes.T @ slopes, slopes.T @ values
    best: tuple[float, FloatArray, FloatArray, FloatArray] | None = None
    for prior in _priors(answers.lasting, knots):
        scaled = prior[:, None] * normal * prior
        factor = cho_factor(np.eye(len(prior)) + scaled, lower=True)
        z = cho_solve(factor, prior * right)
        log_evidence = 0.5 * float((prior * right) @ z) - float(np.log(np.diag(factor[0])).sum())
        if best is None or log_evidence > best[0]:
            best = log_evidence, prior, z, np.tril(factor[0])
    assert best is not None
    _, prior, z, root = best
    left = values - slopes @ (prior * z)
    drawn = np.random.default_rng(20260102).standard_normal((len(prior), samples))
    drawn = z[:, None] + solve_triangular(root.T, drawn, lower=False)
    return Deviation(
        tip @ (prior * z),
        np.moveaxis(tip @ (prior[:, None] * drawn), -1, 0),
        float(np.sqrt(np.mean(left**2))) if len(left) else 1.0,
    )


def _priors(lasting: int, knots: int) -> Iterator[FloatArray]:
    """(unknowns,) standard deviations that may be true."""
    for force_m, hand_m in product(FORCES_M, HAND_M):
        knot = [force_m / (mode + 1.0) ** 2 for mode in range(MODES)] + [hand_m] * 2
        yield np.array([1.0] * lasting + knot * knots)


def _at(values: FloatArray, t_s: FloatArray) -> FloatArray:
    """(frames, …) of (T, …) values that are known every `INTERVAL_S`."""
    place = np.clip(t_s / INTERVAL_S, 0.0, len(values) - 1.001)
    before = place.astype(int)
    share = (place - before).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - share) * values[before] + share * values[before + 1])
