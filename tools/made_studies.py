"""Studies with a known answer for the lab's long trials: random cables, motions, noise, effects.

The world is finer than the model (60 segments, half its step) and the cable's EI(s) is drawn from
another family than the model's spline, so that the model is not compared with itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.cable.dynamics import Solver, simulate
from cell.cable.effects import ActiveEffect, Effect
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.study.data import Markers, Study, Trial

CABLE = Cable(0.1, 0.0074, 0.016, 0.0001)
WORLD = Solver(segments=60, step_s=5e-4)
FRAME_S = 0.005
#: name, role, clamp angle, way (x, y), seconds
STROKES = (
    ("identify", "fit", 0.0, (0.0, -0.05), 0.30),
    ("probe_up", "fit", -0.9, (0.0, -0.05), 0.30),
    ("probe_left", "fit", 0.0, (-0.06, 0.0), 0.28),
    ("deep", "validate", 0.0, (0.0, -0.08), 0.35),
    ("aslant", "validate", 0.3, (-0.05, -0.03), 0.30),
    ("raised", "validate", -0.5, (-0.05, 0.0), 0.25),
)


def make_study(
    seed: int,
    effects: Sequence[ActiveEffect] = (),
    *,
    noise_m: float | None = None,
    colour: float | None = None,
    noise_seed: int | None = None,
) -> Study:
    """A study of a random cable.

    noise_m     0.05 … 0.3 mm and colour 0 … 0.9 are drawn if not given
    noise_seed  of other noise on the same cable
    """
    rng = np.random.default_rng(seed)
    noise = float(np.exp(rng.uniform(np.log(5e-5), np.log(3e-4)))) if noise_m is None else noise_m
    rho = float(rng.uniform(0.0, 0.9)) if colour is None else colour
    s = np.linspace(0.0, 1.0, 9)
    wave = 0.2 * np.sin(2.0 * np.pi * (rng.uniform(0.4, 1.2) * s + rng.uniform()))
    rigidity = rng.uniform(1.8e-5, 4e-5) * (1.0 + wave + rng.uniform(-0.2, 0.2) * (s - 0.5))
    model = CableModel(
        CABLE, rigidity, rng.uniform(0.9, 1.15), rng.uniform(4e-8, 2e-7), effects=tuple(effects)
    )
    if noise_seed is not None:
        rng = np.random.default_rng(noise_seed)
    arcs = node_arc_lengths(CABLE.free_length_m)
    trials = []
    for name, role, angle, way, seconds in STROKES:
        t = np.arange(0.0, 0.22 + seconds + 0.9, 0.002)
        u = np.clip((t - 0.2) / seconds, 0.0, 1.0)
        done = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        hand = (way[0] * done, way[1] * done, np.full_like(t, angle))
        t_s = np.arange(rng.uniform(0.0, FRAME_S), t[-1], FRAME_S)
        clean = simulate(model, Motion(t, *hand), t_s, arcs, solver=WORLD)[0]
        seen = clean + noise * _coloured(rng, clean.shape, rho)
        x, y = (v + 1e-5 * rng.normal(size=len(t)) for v in hand[:2])
        motion = Motion(t, x, y, hand[2])
        trials.append(Trial(name, "fit" if role == "fit" else "validate", "equilibrium", motion,
                            Markers(t_s, seen)))  # fmt: skip
    return Study(f"made_{seed}", CABLE, arcs, tuple(trials))


def hidden(effect: type[Effect], size: float) -> ActiveEffect:
    """An effect at `size` times its typical strength, its other parameters typical."""
    values = {
        p.name: p.default + size * (p.starts[0] - p.default) if p.amplitude else p.starts[0]
        for p in effect.parameters
    }
    return effect.active(**values)


def _coloured(rng: np.random.Generator, shape: tuple[int, ...], rho: float) -> np.ndarray:
    noise = rng.normal(size=shape)
    for i in range(1, len(noise)):
        noise[i] = rho * noise[i - 1] + np.sqrt(1.0 - rho**2) * noise[i]
    return noise
