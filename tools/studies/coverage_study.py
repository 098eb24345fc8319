"""Do the 95 % intervals of `map` cover the truth in 95 of 100 cables?

Cables with random EI(s), N and viscosity, in a world of finer mesh and half the time step, each
identified as in the cell: from rendered pictures (`--pictures`, 3 s a cable), or from nodes with
autocorrelated noise, constant errors, and a noisy log (0.1 s a cable).
`python -m tools.studies.coverage_study [--cables 100] [--seed 0] [--pictures]`
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import binomtest

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.identify.identified import Identified
from cell.identify.individual import IdentifyOptions, hold_trial, identify
from cell.study.data import Trial
from cell.vision.detect import VisionOptions, detect_all
from drivers.interfaces import Image
from drivers.sim.render import Rates, RenderOptions, render
from tools.worlds.fast_truth import Bias, Errors, observed_gripper, pictured
from tools.worlds.made_studies import CABLE, FRAME_S, WORLD, logged
from tools.worlds.paper_world import NODES_M, hold

VIEW = PlaneView.from_scale(2e-4, 800.0, 300.0)
#: EI(s) is evaluated at every fifth of a segment where the still cable bends by more than this
#: share of its largest curvature.
BENDS = 0.2
PLACES_M = np.linspace(0.0, 0.1, 51)


@dataclass(frozen=True)
class CableCoverage:
    """Relative errors and whether the 95 % intervals cover, of one cable."""

    rigidity_error: FloatArray
    rigidity_covered: NDArray[np.bool_]
    exponent_error: float
    exponent_covered: bool
    viscosity_error: float
    viscosity_covered: bool
    residual_to_noise: float
    inflation: float


def random_cable(rng: np.random.Generator) -> CableModel:
    """EI 1.5e-5 … 5e-5 N·m², changing along the cable by some 10 % over a few centimetres."""
    level = np.log(1.5e-5) + rng.random() * np.log(5.0 / 1.5)
    s = np.linspace(0.0, 0.1, 11)
    smooth = np.exp(-0.5 * ((s[:, None] - s) / 0.03) ** 2) + 1e-9 * np.eye(len(s))
    shape = 0.12 * np.linalg.cholesky(smooth) @ rng.normal(size=len(s))
    rigidity = np.exp(level + shape)
    viscosity = np.exp(level) * rng.uniform(2.5e-3, 6e-3)
    return CableModel(CABLE, rigidity, rng.uniform(0.88, 1.12), float(viscosity))


def measured(model: CableModel, motion: Motion, errors: Errors, rng: np.random.Generator) -> Trial:
    """Trial of a cable's hold as measured by the cell: nodes with noise, and a noisy log."""
    t_s = np.arange(0.001, motion.t_s[-1], FRAME_S)
    nodes = simulate(model, motion, t_s, NODES_M, solver=WORLD)[0]
    # the end is detected too far or too short, which shifts all nodes of equal arc length
    observed_m = pictured(nodes, Bias.drawn(rng, errors, len(NODES_M)), errors, rng)
    log = logged(rng, motion, errors.log_m)
    return hold_trial(log, t_s, observed_m, *observed_gripper(motion, t_s, errors, rng))


def photographed(
    model: CableModel, motion: Motion, errors: Errors, rng: np.random.Generator
) -> Trial:
    """Trial of a cable's hold as the cell would measure it in rendered pictures."""
    t_s = np.arange(0.001, motion.t_s[-1], FRAME_S)
    instants = (t_s[:, None] + [-2e-4, 0.0, 2e-4]).ravel()
    lines = simulate(model, motion, instants, node_arc_lengths(0.1, 61), solver=WORLD)[0]
    lines = lines.reshape(len(t_s), 3, 61, 2)
    poses = (motion.x_m, motion.y_m, motion.angle_rad)
    scene = RenderOptions(scene_seed=int(rng.integers(1000)))

    def frames() -> Iterator[tuple[float, Image]]:
        for t, (before, line, after) in zip(t_s, lines, strict=True):
            grip, earlier, later = (
                np.array([np.interp(at, motion.t_s, v) for v in poses])
                for at in (t, t - 1e-4, t + 1e-4)
            )
            image = render(
                line,
                tuple(grip),
                VIEW.homography,
                scene,
                rng,
                rates=Rates((after - before) / 4e-4, tuple((later - earlier) / 2e-4)),
            )
            yield t, image

    sightings = list(detect_all(frames(), VIEW, VisionOptions(free_length_m=0.1)))
    return hold_trial(
        logged(rng, motion, errors.log_m),
        t_s,
        np.array([s.nodes_m for s in sightings]),
        np.array([s.grip_m for s in sightings]),
        np.array([s.clamp_angle_rad for s in sightings]),
    )


def judge(model: CableModel, estimate: Identified, motion: Motion) -> CableCoverage:
    """Errors of an identified cable, and whether its intervals cover the truth."""
    still = simulate(model, motion, motion.t_s[:2], PLACES_M, solver=WORLD)[0, 0]
    heading = np.unwrap(np.arctan2(*np.diff(still, axis=0).T[::-1]))
    curvature = np.append(np.abs(np.diff(heading)), [0.0, 0.0])
    bends = curvature > BENDS * curvature.max()
    places = PLACES_M[bends]
    error = np.log(estimate.model.rigidity_at(places) / model.rigidity_at(places))
    low, high = estimate.interval()
    exponent, viscosity = model.exponent, model.viscosity_n_m2_s
    return CableCoverage(
        error,
        np.abs(error) <= 1.96 * estimate.rigidity_log_std(places),
        estimate.values[-2] - exponent,
        bool(low[-2] <= exponent <= high[-2]),
        float(np.log(estimate.values[-1] / viscosity)),
        bool(low[-1] <= viscosity <= high[-1]),
        estimate.residual_rms_m / estimate.noise.std_m,
        estimate.inflation,
    )


def study(
    cables: int,
    seed: int,
    errors: Errors,
    options: IdentifyOptions,
    look: Callable[[CableModel, Motion, Errors, np.random.Generator], Trial] = measured,
) -> list[CableCoverage]:
    """Identify `cables` random cables."""
    motion = hold()
    outcomes = []
    for i in track(range(cables), description="cables", transient=True):
        rng = np.random.default_rng([seed, i])
        model = random_cable(rng)
        trial = look(model, motion, errors, rng)
        estimate = identify(trial, NODES_M, CABLE, options=options)
        outcomes.append(judge(model, estimate, motion))
    return outcomes


def report(outcomes: list[CableCoverage]) -> Table:
    """Coverage with its own 95 % interval, and the size of errors."""
    table = Table(title=f"95 % intervals of `map`, {len(outcomes)} cables")
    for column in ("", "covered", "of 100 %, 95 % sure", "rms error", "worst error"):
        table.add_column(column, justify="right")
    titles = {"rigidity": "EI(s) where it bends", "exponent": "N", "viscosity": "viscosity"}
    for of, name in titles.items():
        errors = np.hstack([getattr(o, f"{of}_error") for o in outcomes])
        share = float(np.mean(np.hstack([getattr(o, f"{of}_covered") for o in outcomes])))
        sure = binomtest(round(share * len(outcomes)), len(outcomes)).proportion_ci()
        table.add_row(
            name,
            f"{share:.1%}",
            f"{sure.low:.0%} … {sure.high:.0%}",
            f"{np.sqrt(np.mean(errors**2)):.2%}",
            f"{np.abs(errors).max():.2%}",
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cables", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pictures", action="store_true")
    arguments = parser.parse_args()
    look = photographed if arguments.pictures else measured
    outcomes = study(arguments.cables, arguments.seed, Errors(), IdentifyOptions(), look)
    console = Console()
    console.print(report(outcomes))
    residual = np.array([o.residual_to_noise for o in outcomes])
    inflation = np.array([o.inflation for o in outcomes])
    console.print(
        f"residual / noise {residual.mean():.3f} ({residual.max():.3f}), "
        f"inflation {inflation.mean():.2f} ({inflation.max():.2f})"
    )


if __name__ == "__main__":
    main()
