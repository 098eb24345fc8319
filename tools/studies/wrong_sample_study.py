"""How many right samples of markers are taken for wrong, and how many wrong ones are found.

Swings of random cables (6 cm … 2 m, droop 0.5 … 20, strokes with and without jerks, releases) in
30 … 500 frames a second with noise of 0.02 … 0.5 % of the length, AR(1) 0 … 0.7, rounded to steps,
lost, with a clock that jitters.  `python -m tools.studies.wrong_sample_study [SWINGS]`
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.study.wrong_samples import wrong_samples
from tools.worlds.made_studies import coloured

SIZES = (5, 8, 10, 15, 30, 100)
EVERY_S = 0.002


def spread(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two, its logarithm uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def swing(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    """Times, places (T, 11, 2) and free length of a random cable in a random stroke."""
    length_m, density = spread(rng, 0.06, 2.0), spread(rng, 0.005, 0.1)
    slower = np.sqrt(length_m / 0.1)
    rigidity = density * 9.81 * length_m**3 / spread(rng, 0.5, 20.0)
    cable = Cable(length_m, density, 0.016, max(1e-4, density / 0.016 / 8000.0))
    viscosity = rigidity * slower * spread(rng, 5e-4, 1e-2)
    model = CableModel.uniform(cable, rigidity, viscosity_n_m2_s=viscosity)
    seconds = rng.uniform(0.15, 0.4) * slower
    t_s = np.arange(0.0, 0.2 + seconds + 0.9 * slower, EVERY_S)
    u = np.clip((t_s - 0.2) / seconds, 0.0, 1.0)
    kind = rng.choice(["jerk", "there and back", "release"])
    smooth, back = u**3 * (10.0 - 15.0 * u + 6.0 * u**2), np.sin(np.pi * u) ** 2
    done = {"jerk": smooth, "there and back": back, "release": 0.0 * u}[kind]
    way = rng.uniform(-0.8, 0.8, 2) * length_m
    angle = np.full_like(t_s, rng.uniform(-1.0, 0.6))
    times = np.arange(0.001, t_s[-1], EVERY_S)
    more = {"start": "straight", "release_s": 0.15} if kind == "release" else {}
    xy_m = simulate(
        model, Motion(t_s, way[0] * done, way[1] * done, angle), times,
        node_arc_lengths(length_m), solver=Solver(segments=40, step_s=5e-4), **more,
    )[0]  # fmt: skip
    return times, xy_m, length_m


def measured(
    rng: np.random.Generator, times: np.ndarray, xy_m: np.ndarray, length_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Frames, what is seen (T, channels) in them, what is there, and the noise."""
    frames_per_s, noise_m = spread(rng, 30.0, 500.0), spread(rng, 2e-4, 5e-3) * length_m
    count = int((times[-1] - times[0]) * frames_per_s)
    jitter = rng.choice([0.0, 0.1]) * rng.uniform(-0.5, 0.5, count)
    t_s = times[0] + (np.arange(count) + 0.5 + jitter) / frames_per_s
    t_s = t_s[t_s < times[-1]]
    markers = np.sort(rng.choice(10, int(rng.integers(1, 11)), replace=False))
    there = CubicSpline(times, xy_m[:, markers])(t_s).reshape(len(t_s), -1)
    seen = there + noise_m * coloured(rng, there.shape, rng.uniform(0.0, 0.7))
    if rng.random() < 0.3:
        step_m = noise_m * rng.uniform(0.5, 4.0)
        seen = np.round(seen / step_m) * step_m
    seen[rng.random(seen.shape) < rng.choice([0.0, 0.02, 0.1])] = np.nan
    return t_s, seen, there, noise_m


def main(swings: int) -> None:
    """Print both rates, of the measurements alone and of what a right model leaves of them."""
    rng = np.random.default_rng(27)
    right, false = np.zeros(2, int), np.zeros(2, int)
    tried, found = np.zeros((2, len(SIZES)), int), np.zeros((2, len(SIZES)), int)
    for _ in range(swings):
        t_s, seen, there, noise_m = measured(rng, *swing(rng))
        for of_model, series in enumerate((seen, seen - there)):
            right[of_model] += np.isfinite(series).sum()
            false[of_model] += np.isfinite(wrong_samples(t_s, series)).sum()
            for i, size in enumerate(SIZES):
                row, channel = rng.integers(series.shape[0]), rng.integers(series.shape[1])
                if np.isnan(series[row, channel]):
                    continue
                spoilt = series[:, [channel]].copy()
                spoilt[row, 0] += rng.choice([-1, 1]) * size * noise_m
                tried[of_model, i] += 1
                found[of_model, i] += bool(np.isfinite(wrong_samples(t_s, spoilt)[row, 0]))
    for of_model, name in enumerate(("measurements alone", "left of a right model")):
        shares = [f"{s}: {f / t:.1%}" for s, f, t in
                  zip(SIZES, found[of_model], tried[of_model], strict=True)]  # fmt: skip
        print(f"{name}: {false[of_model]} of {right[of_model]} right ones; {', '.join(shares)}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
