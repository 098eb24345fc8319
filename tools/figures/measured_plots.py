"""Plots of `docs/validation.md`, each from a CSV file in `docs/measured`.

    python -m tools.figures.measured_plots [FOLDER]        (default: docs/images/measured)

The same files give the same pictures with the same version of matplotlib.  Intervals of shares:
95 %, Wilson; of wrong claims: binomial, exact.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import ArrayLike
from scipy.stats import binomtest

DOCS = Path(__file__).parents[2] / "docs"
FOLDER = DOCS / "images" / "measured"
COLOURS = BLUE, GREEN, ORANGE, GREY = "#1f5fa8", "#2b7a3f", "#c8590a", "#5a5a5a"
STYLE = {
    **{"svg.hashsalt": "measured", "svg.fonttype": "none", "font.size": 9},
    **{"axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True},
    **{"axes.grid": True, "grid.color": "#dddddd", "legend.frameon": False},
}
#: A number in a tag, not in a text: it is rounded to two decimals.
DECIMALS = re.compile(r"(?<=\d\.\d\d)\d+(?=[^<>]*>)")
MARKS = ("median", "largest")
MARKERS = "osD^vP*Xh"
Marks = tuple[str, str]


def read(name: str) -> pd.DataFrame:
    """Rows of a file of measured results."""
    return pd.read_csv(DOCS / "measured" / f"{name}.csv")


def share(axes: Axes, y: ArrayLike, of: pd.DataFrame, count: str, colour: str, label: str) -> None:
    """Percent of n, with Wilson intervals."""
    tests = [binomtest(int(k), int(n)) for k, n in zip(of[count], of["n"], strict=True)]
    ends = np.array([test.proportion_ci(method="wilson") for test in tests])
    axes.hlines(y, *(100 * ends.T), color=colour, lw=1.5)
    axes.plot(100 * of[count] / of["n"], y, "o", ms=4.5, color=colour, label=label)


def named(axes: Axes, names: Sequence[str], unit: str) -> None:
    """Label the rows at the left, the first at the top, and the horizontal axis."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.tick_params(length=0)
    axes.minorticks_off()
    axes.set_xlabel(unit)


def goal(axes: Axes, x: float) -> None:
    axes.axvline(x, color=GREY, ls="--", lw=1.2, label="goal")


def legend(figure: Figure, axes: Axes, columns: int = 3) -> None:
    entries = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(entries.values(), entries.keys(), loc="outside upper left", ncols=columns)


def panels(heights: Sequence[int]) -> tuple[Figure, list[Axes]]:
    """A figure with panels below each other; `heights` in rows."""
    figure = Figure((7.2, 0.21 * sum(heights) + 0.75 * len(heights) + 0.4), layout="constrained")
    grid = figure.subplots(len(heights), 1, height_ratios=[h + 1 for h in heights], squeeze=False)
    return figure, list(grid[:, 0])


def ranges(axes: Axes, rows: pd.DataFrame, low: str, high: str, unit: str, marks: Marks) -> None:
    """Two values of each row, joined, on a logarithmic axis."""
    places, a, b = range(len(rows)), rows[low], rows[high]
    axes.hlines(places, a, b.fillna(a), color="#bbbbbb", lw=1.5)
    axes.plot(a, places, "o", ms=4.5, color=BLUE, label=marks[0])
    axes.plot(b, places, "D", ms=4, mfc="white", color=ORANGE, label=marks[1])
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    named(axes, list(rows["condition"]), unit)
    for value in rows["goal"].dropna().unique() if "goal" in rows else ():
        goal(axes, value)


def pairs(
    name: str, low: str = "median", high: str = "largest", marks: Marks = MARKS, unit: str = ""
) -> Figure:
    """Two values of each row of a file, a panel for each unit."""
    rows = read(name).dropna(subset=low)
    rows = rows.assign(unit=unit) if unit else rows
    rows = rows[~rows["unit"].isin(["ratio", "MiB", "% of a core"])]
    figure, axes = panels(list(rows.groupby("unit", sort=False).size()))
    for ax, (of, some) in zip(axes, rows.groupby("unit", sort=False), strict=True):
        ranges(ax, some, low, high, str(of), marks)
    legend(figure, axes[0])
    return figure


def lab() -> Figure:
    """Right verdicts by kind of study; numbers of studies and of wrong verdicts."""
    rows = read("lab").query("n != 1").reset_index()
    figure, (axes,) = panels([len(rows)])
    for (kind, of), colour in zip(rows.groupby("hidden", sort=False), COLOURS, strict=False):
        share(axes, of.index, of, "right", colour, str(kind))
    for place, wrong, n in zip(rows.index, rows["wrong"], rows["n"], strict=True):
        most = binomtest(wrong, n).proportion_ci().high
        axes.text(102, place, f"{wrong} of {n}, < {100 * most:.0f} %", va="center")
    goal(axes, 90.0)
    axes.set_xlim(20, 101)
    named(axes, list(rows["condition"]), "right verdicts, % (95 % interval)")
    axes.text(102, -1, "wrong (95 % bound)", va="center")
    legend(figure, axes, 4)
    return figure


def several(name: str, group: str, rows_of: str, count: str, unit: str) -> Figure:
    """Plot shares of several groups for each condition."""
    rows = read(name).dropna(subset=group)
    names = list(rows[rows_of].unique())
    groups = rows.groupby(group, sort=False)
    figure, (axes,) = panels([2 * len(names)])
    for i, ((label, of), colour) in enumerate(zip(groups, COLOURS, strict=False)):
        y = [names.index(r) + 0.22 * (i - (len(groups) - 1) / 2) for r in of[rows_of]]
        share(axes, y, of, count, colour, str(label))
    named(axes, names, f"{unit}, % (95 % interval)")
    if count == "right":
        goal(axes, 90.0)
    legend(figure, axes, 4)
    return figure


def intervals() -> Figure:
    rows, errors = read("intervals"), read("prediction")
    figure, (axes, below) = panels([len(rows), len(errors)])
    share(axes, range(len(rows)), rows, "inside", BLUE, "inside, 95 % interval")
    goal(axes, 95.0)
    named(axes, list(rows["condition"]), "95 % intervals that contain the truth, %")
    ranges(below, errors, "median", "largest", "error of position, mm", MARKS)
    legend(figure, axes)
    return figure


def correction() -> Figure:
    rows = read("correction").query("half_mm == 2 and not condition.str.contains('× 2')")
    figure, (axes,) = panels([len(rows)])
    for dy, way, colour in ((-0.15, "planned", GREY), (0.15, "corrected", ORANGE)):
        share(axes, np.arange(len(rows)) + dy, rows, f"inserted_{way}", colour, way)
    named(axes, list(rows["condition"].str.removesuffix(", ± 2 mm")),
          "of 20 cables inserted, % (95 % interval); opening ± 2 mm")  # fmt: skip
    legend(figure, axes)
    return figure


def benchmark_effects() -> Figure:
    """Right against wrong claims of each entrant, as the threshold of abstaining rises."""
    rows = read("benchmark_effects").query("hidden == 'all'")
    figure = Figure((7.2, 4.6), layout="constrained")
    axes = figure.subplots()
    for i, (name, of) in enumerate(rows.groupby("condition", sort=False)):
        wrong, right = (100 * of[c] / of["n"] for c in ("wrong", "right"))
        style = {"color": COLOURS[i % len(COLOURS)], "ls": ("-", "--", ":")[i // len(COLOURS)]}
        place = list(of["threshold"]).index(0.5)
        usual, x, y = of.iloc[place], wrong.iloc[place], right.iloc[place]
        label = f"{name}, n = {usual['n']}"
        axes.plot(wrong, right, lw=1.2, marker=MARKERS[i], markevery=[place], label=label, **style)
        for line, at, count in ((axes.vlines, x, "right"), (axes.hlines, y, "wrong")):
            low, high = (100 * usual[f"{count}_{end}"] for end in ("low", "high"))
            line(at, low, high, color=style["color"], lw=0.5, alpha=0.5)
    axes.set(xlim=(-2, 102), ylim=(-2, 102), xlabel="wrong claims, %", ylabel="right claims, %")
    figure.legend(loc="outside right upper")
    return figure


def rods() -> Figure:
    """Error of the tip against CPU time by task, of settings that halve the error."""
    rows = read("rods").dropna(subset="reference_um")
    by_task, names = rows.groupby("task", sort=False), rows["entrant"].unique()
    figure = Figure((7.2, 4.8), layout="constrained")
    grid = figure.subplots(2, -(-len(by_task) // 2), sharex=True, sharey=True)
    for axes, (task, of_task) in zip(grid.flat, by_task, strict=False):
        for name, colour, marker in zip(names, COLOURS, MARKERS, strict=False):
            cost, error = list[float](), list[float]()
            of = of_task[of_task["entrant"] == name]
            for cpu_ms, rms_um in zip(of["cpu_ms"], of["rms_um"], strict=True):
                if not error or rms_um < 0.5 * error[-1]:
                    cost, error = [*cost, cpu_ms], [*error, rms_um]
            axes.loglog(cost, error, marker=marker, ms=3, lw=1, color=colour, label=name)
        axes.set_title(task, fontsize=9)
        axes.set_ylim(0.5, 3e3)
        axes.minorticks_off()
        axes.grid(visible=False)
        axes.label_outer(remove_inner_ticks=True)
        for limit in (50, 10):
            axes.axhline(limit, color=GREY, ls=":", lw=0.8)
    figure.supxlabel("CPU time per simulated second of one cable, ms", fontsize=9)
    figure.supylabel("rms error of the tip, µm", fontsize=9)
    legend(figure, grid.flat[0])
    return figure


PLOTS: dict[str, Callable[[], Figure]] = {
    "intervals": intervals,
    "insertion": lambda: several("insertion", "choice", "opening", "inserted", "cables inserted"),
    "correction": correction,
    "lab": lab,
    "lab_breadth": lambda: several("lab_breadth", "hidden", "condition", "right", "right verdicts"),
    "benchmark_effects": benchmark_effects,
    "rods": rods,
    "learning": lambda: pairs("learning", "before_mm", "after_mm",
                              ("before learning", "after"), "largest error, mm"),
    "export": lambda: pairs("export", "stroke_mm", "most_mm",
                            ("rms over the stroke", "largest"), "difference of the tips, mm"),
    "fault_trials": lambda: pairs("fault_trials", "stop_median_ms", "stop_largest_ms",
                                  unit="fault to stop, ms"),
    **{name: partial(pairs, name) for name in ("calibration", "plant", "waits")},
}  # fmt: skip


def draw(folder: Path) -> None:
    """All plots, as SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, plot in PLOTS.items():
            path = folder / f"{name}.svg"
            plot().savefig(path, metadata={"Date": None}, facecolor="white")
            path.write_text(DECIMALS.sub("", path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    draw(parser.parse_args().folder)
