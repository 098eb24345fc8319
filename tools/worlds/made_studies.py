"""Studies with a known answer for long trials of the lab: random cables, motions, noise, effects.

The world is finer than the model (60 segments, half its step) and the cable's EI(s) is of a
different family than the model's spline, so that the model is not compared with itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.effects import ActiveEffect, Effect
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.plan.measuring import quintic
from cell.study.data import Markers, Study, Trial

CABLE = Cable(0.1, 0.0074, 0.016, 0.0001)
#: Powers of line density and free length in the scaling of similar cables, by unit of the quantity.
LIKE = {
    "kg": (1.0, 1.0),
    "kg/m": (1.0, 0.0),
    "m": (0.0, 1.0),
    "1/m": (0.0, -1.0),
    "1/m²": (0.0, -2.0),
    "s": (0.0, 0.5),
    "Hz": (0.0, -0.5),
    "m/s": (0.0, 0.5),
    "s/m": (0.0, -0.5),
    "N·m": (1.0, 2.0),
    "N·m²": (1.0, 3.0),
    "N·m²·s": (1.0, 3.5),
    "N·s/m²": (1.0, -0.5),
    "rad/(N·m)": (-1.0, -2.0),
}
WORLD = Solver(segments=60, step_s=5e-4)
FRAME_S = 0.005
#: Rest before a stroke, and after it, s.
STILL_S, HOLD_S = 0.2, 0.9


class Stroke(NamedTuple):
    """Motion from rest by `way_m` in `seconds` at a constant clamp angle, then held."""

    name: str
    role: Literal["fit", "validate"]
    angle_rad: float
    way_m: tuple[float, float]
    seconds: float

    def place_m(self, t_s: np.ndarray) -> np.ndarray:
        """(times, 2) from its start, m; it begins after `STILL_S`."""
        done = quintic(np.clip((t_s - STILL_S) / self.seconds, 0.0, 1.0))
        return np.asarray(done[:, None] * np.array(self.way_m))


STROKES = (
    Stroke("identify", "fit", 0.0, (0.0, -0.05), 0.30),
    Stroke("probe_up", "fit", -0.9, (0.0, -0.05), 0.30),
    Stroke("probe_left", "fit", 0.0, (-0.06, 0.0), 0.28),
    Stroke("deep", "validate", 0.0, (0.0, -0.08), 0.35),
    Stroke("aslant", "validate", 0.3, (-0.05, -0.03), 0.30),
    Stroke("raised", "validate", -0.5, (-0.05, 0.0), 0.25),
)

#: Knots of a cable whose EI has a step, and the width of the step over the free length.
STEP_KNOTS, STEP_WIDTH = 61, 0.01


@dataclass(frozen=True)
class Step:
    """A step of EI: it is `factor` times as large beyond `place`, a share of the free length."""

    factor: float
    place: float

    @staticmethod
    def drawn(seed: int) -> Step:
        """A random step by a factor 1.3 … 2 up or down, away from the ends."""
        rng = np.random.default_rng([seed, 7])
        size = rng.uniform(np.log(1.3), np.log(2.0)) * rng.choice([-1.0, 1.0])
        return Step(float(np.exp(size)), float(rng.uniform(0.1, 0.9)))

    def in_model(self, model: CableModel) -> CableModel:
        """The model with this step in its EI."""
        share = np.linspace(0.0, 1.0, STEP_KNOTS)
        beyond = 0.5 * (1.0 + np.tanh((share - self.place) / STEP_WIDTH))
        smooth = model.rigidity_at(share * model.cable.free_length_m)
        return replace(model, rigidity_n_m2=smooth * self.factor**beyond)


def make_study(
    seed: int,
    effects: Sequence[ActiveEffect] = (),
    *,
    noise_m: float | None = None,
    colour: float | None = None,
    noise_seed: int | None = None,
    step: Step | None = None,
) -> Study:
    """A study of a random cable.

    noise_m     0.05 … 0.3 mm and colour 0 … 0.9 are drawn if not given
    noise_seed  of other noise on the same cable
    step        of EI; None = EI is smooth
    """
    rng = np.random.default_rng(seed)
    noise = float(np.exp(rng.uniform(np.log(5e-5), np.log(3e-4)))) if noise_m is None else noise_m
    rho = float(rng.uniform(0.0, 0.9)) if colour is None else colour
    model = random_model(rng, CABLE, effects)
    if step is not None:
        model = step.in_model(model)
    if noise_seed is not None:
        rng = np.random.default_rng(noise_seed)
    arcs = node_arc_lengths(CABLE.free_length_m)
    trials = []
    for name, role, angle, way, seconds in STROKES:
        hand = stroke(angle, way, seconds)
        t_s = np.arange(rng.uniform(0.0, FRAME_S), hand.t_s[-1], FRAME_S)
        markers = filmed(rng, model, hand, t_s, arcs, noise_m=noise, colour=rho)
        trials.append(Trial(name, role, "equilibrium", logged(rng, hand, 1e-5), markers))
    return Study(f"made_{seed}", CABLE, arcs, tuple(trials))


def random_model(
    rng: np.random.Generator, cable: Cable, effects: Sequence[ActiveEffect]
) -> CableModel:
    """Random cable model; for a cable other than `CABLE` a dynamically similar one."""
    s = np.linspace(0.0, 1.0, 9)
    wave = 0.2 * np.sin(2.0 * np.pi * (rng.uniform(0.4, 1.2) * s + rng.uniform()))
    rigidity = rng.uniform(1.8e-5, 4e-5) * (1.0 + wave + rng.uniform(-0.2, 0.2) * (s - 0.5))
    rigidity *= like(cable, "N·m²")
    exponent, viscosity = rng.uniform(0.9, 1.15), rng.uniform(4e-8, 2e-7)
    viscosity *= like(cable, "N·m²·s")
    return CableModel(cable, rigidity, exponent, viscosity, effects=tuple(effects))


def stroke(
    angle_rad: float,
    way_m: tuple[float, float],
    seconds: float,
    still_s: float = STILL_S,
    after_s: float = HOLD_S,
) -> Motion:
    """Smooth motion of the gripper; begins after `still_s`, and is recorded for `after_s` more."""
    t_s = np.arange(0.0, still_s + 0.02 + seconds + after_s, 0.002)
    return moved(t_s, way_m, seconds, still_s, angle_rad)


def moved(
    t_s: np.ndarray,
    way_m: tuple[float, float],
    seconds: float,
    begin_s: float = STILL_S,
    angle_rad: float = 0.0,
) -> Motion:
    """Smooth motion of the gripper, from rest at `begin_s`, at the times of its log."""
    done = quintic(np.clip((t_s - begin_s) / seconds, 0.0, 1.0))
    return Motion(t_s, way_m[0] * done, way_m[1] * done, np.full_like(t_s, angle_rad))


def filmed(
    rng: np.random.Generator,
    model: CableModel,
    hand: Motion,
    t_s: np.ndarray,
    arc_length_m: np.ndarray,
    *,
    noise_m: float = 1e-4,
    colour: float = 0.0,
    **options: Any,
) -> Markers:
    """Markers of a cable in a camera's pictures: AR(1) noise of `noise_m`, m.

    options  of `simulate`; the mesh is that of `WORLD`, if they name no solver
    """
    clean = simulate(model, hand, t_s, arc_length_m, **{"solver": WORLD, **options})[0]
    return Markers(t_s, clean + noise_m * coloured(rng, clean.shape, colour))


def logged(rng: np.random.Generator, hand: Motion, noise_m: float) -> Motion:
    """The gripper's motion with noise added, as in a log."""
    x, y = (v + noise_m * rng.normal(size=len(v)) for v in (hand.x_m, hand.y_m))
    return Motion(hand.t_s, x, y, hand.angle_rad)


def like(cable: Cable, unit: str) -> float:
    """Ratio of a quantity with this unit between a dynamically similar cable and `CABLE`."""
    of_density, of_length = LIKE.get(unit, (0.0, 0.0))
    heavier = cable.line_density_kg_per_m / CABLE.line_density_kg_per_m
    return float(heavier**of_density * (cable.free_length_m / CABLE.free_length_m) ** of_length)


def hidden(effect: type[Effect], size: float, cable: Cable = CABLE) -> ActiveEffect:
    """An effect at `size` times its strength typical of a cable, its other parameters typical.

    Within the parameters' bounds.  Constants of the set-up stay as they are.
    """
    values = {}
    for p in effect.parameters:
        typical = (p.starts[0] - p.default) * like(cable, p.unit)
        value = p.default + size * typical if p.amplitude else p.starts[0] * like(cable, p.unit)
        values[p.name] = float(np.clip(value, p.low, p.high)) if p.fitted else p.default
    return effect.active(**values)


def coloured(rng: np.random.Generator, shape: tuple[int, ...], rho: float) -> np.ndarray:
    """AR(1) noise of variance 1 along the first axis, with correlation `rho`."""
    noise = rng.normal(size=shape)
    for i in range(1, len(noise)):
        noise[i] = rho * noise[i - 1] + np.sqrt(1.0 - rho**2) * noise[i]
    return noise
