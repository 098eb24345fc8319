"""Every figure of the paper, drawn from this code.

    python -m tools.figures.paper_figures [--out figures]

"Measured" is a world with a finer mesh, hidden parameters and noise; "model" is identified from its
hold.  Figures 2, 3, 5–7, 8–12 and 13–15 of "Vision-Guided Individual Modeling of Bendable Cables
for Their Insertion".  Drawings without data (1, 4) are omitted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.plan.destination import Destination
from tools.worlds.made_studies import CABLE, WORLD
from tools.worlds.paper_world import (
    MODEL,
    NODES_M,
    NOISE_M,
    STILL_S,
    TIP_M,
    best_uniform,
    guided,
    hold,
    identified,
    individuals,
    insertion,
    measure,
    same_shape,
    trio,
)

SEEN, PREDICTED, SIMPLER, GRIPPER = "#1f4e9c", "#d1495b", "#2e8b57", "#555555"
THREE = ("#1f4e9c", "#d1495b", "#2e8b57")


#: Arc lengths at which shapes are drawn, m.
DENSE_M = node_arc_lengths(0.1, 101)


def drawing(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    """A figure with a size in inches, and its axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def still_shape(model: CableModel, solver: Solver, arcs_m: FloatArray = DENSE_M) -> FloatArray:
    """(points, 2) of the cable that hangs at rest, m."""
    return simulate(model, hold(), np.zeros(1), arcs_m, solver=solver)[0, 0]


def tip_path(model: CableModel, motion: Motion, t_s: FloatArray) -> FloatArray:
    """(times, 2) of the tip as the model predicts it, m."""
    return simulate(model, motion, t_s, TIP_M, solver=MODEL)[0, :, 0]


def figure_2() -> Figure:
    """Still shapes of eight cables, and the nodes of three of them."""
    figure, (left, right) = drawing(9.0, 2.9, 1, 2, sharex=True, sharey=True)
    shapes = [still_shape(m, WORLD) for m in individuals()]
    for shape in shapes:
        left.plot(*(shape.T * 1e3), color=SEEN, lw=1.2)
    tips = np.array([s[0] for s in shapes])
    spread_m = max(np.linalg.norm(a - b) for a in tips for b in tips)
    left.set_title(f"(a) eight cables, tips up to {spread_m * 1e3:.1f} mm apart")
    for index, colour in zip(trio(), THREE, strict=True):
        nodes = identified(index)[1].xy_m[0]
        right.plot(*(nodes.T * 1e3), "o-", color=colour, ms=4, lw=1, label=f"cable {index + 1}")
    right.set_title("(b) nodes of three of them, as seen")
    right.legend(loc="lower right")
    for axes in (left, right):
        plane(axes)
    return figure


def figure_3() -> Figure:
    """The swing of a tip while the gripper goes 50 mm down."""
    _, markers = identified(4)
    figure, both = drawing(9.0, 3.4, 1, 2)
    for axes, c, name, which in zip(
        both, (0, 1), "xy", ("(a) horizontal", "(b) vertical"), strict=True
    ):
        hand = (hold().x_m, hold().y_m)[c]
        axes.plot(markers.t_s, markers.xy_m[:, 0, c] * 1e3, color=SEEN, label="tip, seen")
        axes.plot(hold().t_s, hand * 1e3, "--", color=GRIPPER, label="gripping point")
        axes.set(title=which, xlabel="time [s]", ylabel=f"{name} [mm]")
        axes.legend()
    return figure


def figure_5() -> Figure:
    """Uniform EI and the identified EI(s): still shape, and its residual."""
    cable, markers = identified(5)
    nodes = markers.xy_m[markers.t_s < STILL_S - 0.01].mean(0)
    uniform = best_uniform(nodes)
    figure, (left, right) = drawing(9.0, 3.0, 1, 2, width_ratios=(5, 4))
    left.plot(*(nodes.T * 1e3), "o", color=SEEN, ms=5, label="seen, mean of the still frames")
    for model, colour, name in (
        (uniform, SIMPLER, "uniform EI, best"),
        (cable.model, PREDICTED, "non-uniform EI(s), identified"),
    ):
        left.plot(*(still_shape(model, MODEL).T * 1e3), color=colour, lw=1, label=name)
        error = np.linalg.norm(nodes - still_shape(model, MODEL, NODES_M), axis=1)
        right.plot(NODES_M * 1e3, error * 1e3, "o-", color=colour, ms=4, label=name)
    left.set_title("still shape")
    plane(left)
    left.legend()
    right.axhline(
        1e3 * NOISE_M / np.sqrt(38), color=GRIPPER, lw=0.8, ls=":", label="noise of a mean"
    )
    right.set(title="distance from the nodes seen", xlabel="arc length [mm]", ylabel="[mm]")
    right.legend()
    return figure


def figure_6() -> Figure:
    """Linear and nonlinear bending: the same still shape, different swings."""
    index = int(np.argmax([abs(m.exponent - 1.0) for m in individuals()]))
    cable, tips = identified(index)
    k = cable.space.knots
    linear = same_shape(cable.model, 1.0)
    figure, (top, bottom) = drawing(9.0, 5.2, 2, 1, sharex=True, height_ratios=(2, 1))
    top.plot(tips.t_s, tips.xy_m[:, 0, 1] * 1e3, color=SEEN, lw=2.5, alpha=0.5, label="tip, seen")
    for model, colour, name in (
        (linear, SIMPLER, "linear, N = 1"),
        (cable.model, PREDICTED, f"nonlinear, N = {cable.values[k]:.3f}"),
    ):
        tip = tip_path(model, hold(), tips.t_s)
        error = np.linalg.norm(tips.xy_m[:, 0] - tip, axis=1)
        top.plot(tips.t_s, tip[:, 1] * 1e3, color=colour, lw=1.2, label=name)
        rms = np.sqrt(np.mean(error**2)) * 1e3
        bottom.plot(tips.t_s, error * 1e3, color=colour, lw=1, label=f"{name}: rms {rms:.2f} mm")
    top.set(
        ylabel="y of the tip [mm]", title=f"same still shape, other exponent (cable {index + 1})"
    )
    bottom.set(xlabel="time [s]", ylabel="error [mm]")
    top.legend()
    bottom.legend()
    return figure


def figure_7() -> Figure:
    """Effect of N and C on the swing; EI is scaled with N so that the still shape stays."""
    cable, _ = identified(4)
    base = cable.model
    t_s = np.arange(0.0, hold().t_s[-1], 0.002)
    figure, (left, right) = drawing(9.0, 3.6, 1, 2, sharey=True)
    for exponent in (0.8, 1.0, 1.2):
        tip = tip_path(same_shape(base, exponent), hold(), t_s)
        left.plot(t_s, tip[:, 1] * 1e3, label=f"N = {exponent}")
    for factor in (0.3, 1.0, 3.0):
        viscosity = base.viscosity_n_m2_s * factor
        model = CableModel(CABLE, base.rigidity_n_m2, base.exponent, viscosity)
        tip = tip_path(model, hold(), t_s)
        right.plot(t_s, tip[:, 1] * 1e3, label=f"C = {viscosity * 1e7:.1f}e-7 N·m²·s")
    left.set(title="(a) the exponent sets the frequency", xlabel="time [s]", ylabel="y [mm]")
    right.set(title="(b) viscosity sets the damping", xlabel="time [s]")
    left.legend()
    right.legend()
    return figure


def figure_8_to_12(offset_m: float) -> Figure:
    """Tip motion for one offset, measured and predicted by the model, and their distance."""
    index = 4
    cable, _ = identified(index)
    motion = insertion(offset_m)
    markers = measure(individuals()[index], motion, 100 + round(offset_m * 1e3), TIP_M)
    tip = tip_path(cable.model, motion, markers.t_s)
    error = np.linalg.norm(markers.xy_m[:, 0] - tip, axis=1)
    figure, (left, right) = drawing(9.0, 3.6, 1, 2)
    for c, name in enumerate("xy"):
        left.plot(markers.t_s, markers.xy_m[:, 0, c] * 1e3, color=SEEN, lw=3, alpha=0.4)
        left.plot(markers.t_s, tip[:, c] * 1e3, color=PREDICTED, lw=1)
        left.annotate(name, (markers.t_s[-1], tip[-1, c] * 1e3), xytext=(4, 0), va="center",
                      textcoords="offset points")  # fmt: skip
    left.plot([], [], color=SEEN, lw=3, alpha=0.4, label="seen")
    left.plot([], [], color=PREDICTED, lw=1, label="model")
    left.set(title=f"(a) tip, down {offset_m * 1e3:.0f} mm then 50 mm left", xlabel="time [s]",
             ylabel="[mm]")  # fmt: skip
    left.legend(loc="lower left")
    right.plot(markers.t_s, error * 1e3, color=GRIPPER, lw=1)
    right.axhline(
        np.sqrt(np.pi / 2) * NOISE_M * 1e3, color=SEEN, ls=":", label="mean of noise alone"
    )
    rms = np.sqrt(np.mean(error**2) / 2.0) * 1e3
    right.set(title=f"(b) distance, rms {rms:.3f} mm per coordinate", xlabel="time [s]",
              ylabel="[mm]", ylim=(0.0, None))  # fmt: skip
    right.legend()
    return figure


def figure_13() -> Figure:
    """The three cables that are guided."""
    figure, axes = drawing(5.0, 3.6)
    for index, colour in zip(trio(), THREE, strict=True):
        axes.plot(*(still_shape(individuals()[index], WORLD).T * 1e3), color=colour, lw=1)
        nodes = identified(index)[1].xy_m[0]
        axes.plot(*(nodes.T * 1e3), "o", color=colour, ms=4, label=f"cable {index + 1}")
    plane(axes)
    axes.set_title("true shapes, and the nodes seen")
    axes.legend()
    return figure


def figure_14() -> Figure:
    """Tips of three cables on their chosen motions, and around the destination."""
    opening, choices = guided()
    figure, both = drawing(9.0, 4.0, 1, 2)
    for axes, near in zip(both, (False, True), strict=True):
        for (index, choice), colour in zip(choices.items(), THREE, strict=True):
            motion = insertion(choice.best.offset_m)
            markers = measure(individuals()[index], motion, 200 + index, TIP_M)
            label = f"cable {index + 1}: offset {choice.best.offset_m * 1e3:.0f} mm"
            axes.plot(*(markers.xy_m[:, 0].T * 1e3), ".-", color=colour, ms=3, lw=0.6, label=label)
            axes.plot(*(choice.tip_m.T * 1e3), color=colour, lw=1.5, alpha=0.5)
        mark(axes, opening)
        plane(axes)
        if near:
            axes.set_xlim(opening.x_min_m * 1e3 - 5, opening.x_max_m * 1e3 + 12)
            axes.set_ylim(opening.y_min_m * 1e3 - 5, opening.y_max_m * 1e3 + 5)
            axes.locator_params(nbins=5)
    figure.axes[0].set_title("(a) tips; dots seen, lines forecast")
    figure.axes[0].legend()
    figure.axes[1].set_title("(b) around the destination")
    return figure


def figure_15() -> Figure:
    """Tip and gripper of each guided cable."""
    opening, choices = guided()
    figure, all_axes = drawing(9.0, 2.6, 1, 3, sharex=True, sharey=True)
    for axes, (index, choice), colour in zip(all_axes, choices.items(), THREE, strict=True):
        motion = insertion(choice.best.offset_m)
        markers = measure(individuals()[index], motion, 200 + index, node_arc_lengths(0.1, 41))
        for k in range(0, len(markers.t_s), 20):
            axes.plot(*(markers.xy_m[k].T * 1e3), color=GRIPPER, lw=0.4)
        axes.plot(*(markers.xy_m[:, 0].T * 1e3), color=colour, label="tip")
        axes.plot(motion.x_m * 1e3, motion.y_m * 1e3, "--", color=GRIPPER, label="gripper")
        mark(axes, opening)
        plane(axes)
        axes.set_title(f"cable {index + 1}: {choice.best.offset_m * 1e3:.0f} mm down")
    figure.axes[0].legend(loc="upper left")
    return figure


# --- shared by the figures ----------------------------------------------------------------------


def mark(axes: Axes, opening: Destination) -> None:
    corner = (opening.x_min_m * 1e3, opening.y_min_m * 1e3)
    width, height = (
        (opening.x_max_m - opening.x_min_m) * 1e3,
        (opening.y_max_m - opening.y_min_m) * 1e3,
    )
    axes.add_patch(Rectangle(corner, width, height, fc="#ffe9a8", ec="#b8860b", zorder=0))


def plane(axes: Axes) -> None:
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.set_aspect("equal", adjustable="box")
    axes.grid(visible=True, lw=0.3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--only", nargs="+", metavar="NAME", help="as 02_still_shapes")
    arguments = parser.parse_args()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    mpl.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    drawn: dict[str, Callable[[], Figure]] = {
        "02_still_shapes": figure_2,
        "03_swing": figure_3,
        "05_uniform_or_not": figure_5,
        "06_linear_or_not": figure_6,
        "07_exponent_and_viscosity": figure_7,
        **{f"{8 + k:02d}_offset_{10 * k}_mm": partial(figure_8_to_12, 0.01 * k) for k in range(5)},
        "13_three_cables": figure_13,
        "14_guided_tips": figure_14,
        "15_guided_motions": figure_15,
    }
    for name, draw in drawn.items():
        if not arguments.only or name in arguments.only:
            draw().savefig(out / f"fig{name}.png", dpi=110)
            print(out / f"fig{name}.png")
    if arguments.only:
        return
    for index, choice in guided()[1].items():
        best = choice.best
        print(
            f"cable {index + 1}: offset {best.offset_m * 1e3:.0f} mm, probability "
            f"{best.probability:.2f}, margin {best.margin_m * 1e3:+.2f} mm"
        )


if __name__ == "__main__":
    main()
