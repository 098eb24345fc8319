"""Studies over the range of users' conditions: cables, motions, noise, sampling.

The conditions are a Latin hypercube: each is spread evenly over its range, independent of the
others.  The world is simulated on two meshes and extrapolated, so that its own error stays far
below what a fit could detect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.stats import qmc

from cell.cable.dynamics import simulate
from cell.cable.effects import ActiveEffect, Effect
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.study.data import Markers, Study, Trial
from tools.worlds.made_studies import STROKES, Stroke, coloured, hidden, like, stroke

#: Meshes of the world; the error falls with the square of both segments and step.
COARSE, FINE = Solver(96, 4e-4), Solver(192, 2e-4)
MORE_STROKES = (
    Stroke("slow_down", "fit", 0.2, (0.0, -0.06), 0.45),
    Stroke("left_up", "validate", -0.3, (-0.04, 0.03), 0.3),
)
#: Strokes in the order of a study: fitted and held out alternately.
ORDER = (0, 3, 1, 4, 2, 5, 6, 7)
#: Largest number of frames of a trial, to save time for more studies.
MOST_FRAMES = 400
#: Periods of the first mode that are filmed after the gripper has stopped.
LEAST_PERIODS, MOST_PERIODS = 1.2, 4.0
GRAVITY = 9.81
#: Largest size of an effect over its typical one, and number of attempts.
STRONGEST, ATTEMPTS = 20.0, 4


@dataclass(frozen=True)
class Conditions:
    """Conditions of a study: its cable, and how it was measured.

    droop       ρ g L³ / EI
    noise       standard deviation over the free length
    colour      AR(1) correlation of neighbouring frames
    pixel       step to which values are rounded over the noise; 0 = not rounded
    lost        share of the markers' values that is missing
    jitter      of the frames' times, which are known, over the time between frames
    log_hz, log_m   rate and noise of the gripper's log
    held_out    whether trials are held out (never of one trial)
    shift       of a hidden effect: rms displacement of the markers over the noise
    uneven      each marker of each trial has exp(−uneven … uneven) times the noise of another
    """

    number: int
    markers: int
    rate_hz: float
    rest_frames: int
    trials: int
    held_out: bool
    length_m: float
    droop: float
    noise: float
    colour: float
    pixel: float
    lost: float
    jitter: float
    log_hz: float
    log_m: float
    shift: float
    uneven: float = 0.0

    @property
    def noise_m(self) -> float:
        """Standard deviation of the noise before rounding, m."""
        return self.noise * self.length_m


def hypercube(count: int, seed: int) -> list[Conditions]:
    """`count` conditions of a Latin hypercube."""
    places = qmc.LatinHypercube(d=15, seed=seed).random(count)
    return [_conditions(number, u) for number, u in enumerate(places)]


def _conditions(number: int, u: np.ndarray) -> Conditions:
    def between(i: int, low: float, high: float) -> float:
        return float(low * (high / low) ** u[i])

    trials = 1 + int(8 * u[3])
    return Conditions(
        number=number,
        markers=1 + int(11 * u[0]),
        rate_hz=between(1, 30.0, 500.0),
        rest_frames=round(between(2, 6.0, 200.0)),
        trials=trials,
        held_out=bool(u[4] < 0.6 and trials > 1),
        length_m=between(5, 0.06, 2.0),
        droop=between(6, 0.5, 20.0),
        noise=between(7, 2e-4, 5e-3),
        colour=float(0.7 * u[8]),
        pixel=between(9, 0.25, 4.0) if u[9] > 0.5 else 0.0,  # so 1 … 4, or not at all
        lost=float(max(0.0, 0.08 * u[10] - 0.04)),
        jitter=float(max(0.0, 0.4 * u[11] - 0.2)),
        log_hz=between(12, 30.0, 500.0),
        log_m=between(13, 2e-6, 5e-5),
        shift=between(14, 5.0, 50.0),
    )


@dataclass(frozen=True, eq=False)
class World:
    """A cable and its gripper, without noise: the same for studies with and without an effect."""

    conditions: Conditions
    model: CableModel
    arc_length_m: np.ndarray
    roles: tuple[str, ...]
    hands: tuple[Motion, ...]
    times_s: tuple[np.ndarray, ...]

    @staticmethod
    def of(conditions: Conditions, seed: int) -> World:
        """A random world with the conditions."""
        rng = np.random.default_rng([seed, conditions.number, 1])
        model = _random_cable(rng, conditions)
        cable, count = model.cable, conditions.markers
        clamp_visible = count > 2 and rng.uniform() < 0.5
        arcs = cable.free_length_m * (1.0 - np.arange(count) / (count - clamp_visible))
        strokes = [(*STROKES, *MORE_STROKES)[i] for i in ORDER[: conditions.trials]]
        roles, hands, times = [], [], []
        frame_s, slower, longer = 1.0 / conditions.rate_hz, like(cable, "s"), like(cable, "m")
        still_s = conditions.rest_frames * frame_s + 0.01
        for number, (_, _, angle, way, seconds) in enumerate(strokes):
            after_s = _after_s(rng, conditions, _period_s(model), still_s + seconds * slower)
            hand = stroke(angle, (longer * way[0], longer * way[1]), seconds * slower, still_s,
                          after_s)  # fmt: skip
            t_s = np.arange(rng.uniform(0.0, frame_s), hand.t_s[-1], frame_s)
            t_s = t_s + conditions.jitter * frame_s * rng.uniform(-0.5, 0.5, len(t_s))
            roles.append("validate" if conditions.held_out and number % 2 else "fit")
            hands.append(hand)
            times.append(np.clip(t_s, 0.0, None))
        return World(conditions, model, arcs, tuple(roles), tuple(hands), tuple(times))

    def clean(self, effects: Sequence[ActiveEffect] = ()) -> list[np.ndarray]:
        """Per trial (times, markers, 2) without noise, m."""
        out = []
        for hand, t_s in zip(self.hands, self.times_s, strict=True):
            coarse, fine = (self._simulated(effects, hand, t_s, s, 1e-3) for s in (COARSE, FINE))
            out.append(fine + (fine - coarse) / 3.0)
        return out

    def mesh_error_m(self, effects: Sequence[ActiveEffect] = ()) -> float:
        """Error after extrapolation: rms change by half the segments and twice the step, over 15.

        An upper bound: the remaining error falls with the fourth power.
        """
        hand, t_s, halves = self.hands[0], self.times_s[0], (Solver(48, 8e-4), COARSE, FINE)
        a, b, c = (self._simulated(effects, hand, t_s, s, 2e-3) for s in halves)
        return float(np.sqrt(np.mean(((c + (c - b) / 3.0) - (b + (b - a) / 3.0)) ** 2)) / 15.0)

    def _simulated(
        self,
        effects: Sequence[ActiveEffect],
        hand: Motion,
        t_s: np.ndarray,
        solver: Solver,
        longest_s: float,
    ) -> np.ndarray:
        """(times, markers, 2) on a mesh; its step is that for `CABLE`, up to the longest."""
        model = replace(self.model, effects=tuple(effects))
        solver = replace(solver, step_s=min(solver.step_s * like(model.cable, "s"), longest_s))
        return simulate(model, hand, t_s, self.arc_length_m, solver=solver)[0]

    def study(self, clean: Sequence[np.ndarray], seed: int, *, quiet: bool = False) -> Study:
        """The study with noise; `quiet`: without errors of measurement."""
        conditions, trials = self.conditions, []
        rng = np.random.default_rng([seed, conditions.number, 2])
        for number, (points, hand) in enumerate(zip(clean, self.hands, strict=True)):
            noise = self._levels(seed, number) * coloured(rng, points.shape, conditions.colour)
            markers_m = points + conditions.noise_m * noise
            if conditions.pixel > 0.0:
                step_m = conditions.pixel * conditions.noise_m
                markers_m = step_m * np.round(markers_m / step_m)
            markers_m = points.copy() if quiet else markers_m
            gone = rng.uniform(size=markers_m.shape[:2]) < conditions.lost
            gone[[0, -1]] = False
            markers_m[gone] = np.nan
            trials.append(
                Trial(
                    f"trial_{number}",
                    self.roles[number],  # type: ignore[arg-type]
                    "equilibrium",
                    _as_log(rng, hand, conditions, quiet),
                    Markers(self.times_s[number], markers_m),
                )
            )
        return Study(f"breadth_{conditions.number}", self.model.cable, self.arc_length_m,
                     tuple(trials), noise_std_m=conditions.noise_m if quiet else None)  # fmt: skip

    def _levels(self, seed: int, trial: int) -> np.ndarray:
        """(markers, 1) noise of a trial's markers over that of all, whose mean square is 1."""
        conditions, shape = self.conditions, (len(self.hands), len(self.arc_length_m))
        rng = np.random.default_rng([seed, conditions.number, 3])
        levels = np.exp(rng.uniform(-conditions.uneven, conditions.uneven, shape))
        return (levels / np.sqrt(np.mean(levels**2)))[trial, :, None]

    def showing(self, effect: type[Effect]) -> tuple[ActiveEffect, list[np.ndarray], float]:
        """Effect with the shift `conditions.shift`, its markers, and its shift over the noise."""
        base, wanted = self.clean(), self.conditions.shift * self.conditions.noise_m
        size = 1.0
        for attempt in range(ATTEMPTS):
            active = hidden(effect, size, self.model.cable)
            there = self.clean([active])
            square = [np.mean((a - b) ** 2) for a, b in zip(there, base, strict=True)]
            shift_m = float(np.sqrt(np.mean(square)))
            near = 0.8 < shift_m / wanted < 1.25
            if near or attempt == ATTEMPTS - 1 or (size == STRONGEST and shift_m < wanted):
                break
            size = float(np.clip(size * wanted / max(shift_m, 1e-12), 1e-3, STRONGEST))
        return active, there, shift_m / self.conditions.noise_m


def _random_cable(rng: np.random.Generator, conditions: Conditions) -> CableModel:
    length = conditions.length_m
    density = float(np.exp(rng.uniform(np.log(0.004), np.log(0.06))))
    width = float(rng.uniform(0.006, 0.02))
    cable = Cable(length, density, width, density / (width * rng.uniform(1000.0, 3000.0)))
    s = np.linspace(0.0, 1.0, 9)
    wave = 0.2 * np.sin(2.0 * np.pi * (rng.uniform(0.4, 1.2) * s + rng.uniform()))
    rigidity = density * GRAVITY * length**3 / conditions.droop
    rigidity = rigidity * (1.0 + wave + rng.uniform(-0.2, 0.2) * (s - 0.5))
    plain = CableModel(cable, rigidity, 1.0, 1e-12)
    damping = float(np.exp(rng.uniform(np.log(0.01), np.log(0.08))))
    viscosity = damping * _period_s(plain) / np.pi * float(np.mean(rigidity))
    return replace(plain, exponent=rng.uniform(0.9, 1.15), viscosity_n_m2_s=viscosity)


def _period_s(model: CableModel) -> float:
    """Period of the first mode, of the beam and a hanging rope combined, s."""
    cable, mean = model.cable, float(np.mean(model.rigidity_n_m2))
    length = cable.free_length_m
    square = 12.36 * mean / (cable.line_density_kg_per_m * length**4) + 1.45 * GRAVITY / length
    return float(2.0 * np.pi / np.sqrt(square))


def _after_s(
    rng: np.random.Generator, conditions: Conditions, period_s: float, before_s: float
) -> float:
    wanted = period_s * rng.uniform(LEAST_PERIODS, MOST_PERIODS)
    most = MOST_FRAMES / conditions.rate_hz - before_s
    return float(max(LEAST_PERIODS * period_s, min(wanted, most)))


def _as_log(rng: np.random.Generator, hand: Motion, conditions: Conditions, quiet: bool) -> Motion:
    """The gripper's log at its own rate, noisy; if `quiet`, the gripper's motion itself."""
    if quiet:
        return hand
    t_s = np.arange(0.0, hand.t_s[-1] + 1.0 / conditions.log_hz, 1.0 / conditions.log_hz)
    inside_s = np.clip(t_s, hand.t_s[0], hand.t_s[-1])
    x, y = (
        CubicSpline(hand.t_s, v)(inside_s) + conditions.log_m * rng.normal(size=len(t_s))
        for v in (hand.x_m, hand.y_m)
    )
    return Motion(t_s, x, y, np.full_like(t_s, hand.angle_rad[0]))
