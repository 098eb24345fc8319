"""Plots of `docs/validation.md`, each from a CSV file in `docs/measured`.

    python -m tools.figures.measured_plots [FOLDER]        (default: docs/images/measured)

The same files give the same pictures with the same version of matplotlib.  Intervals of shares:
95 %, Wilson; of wrong claims: binomial, exact.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
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
Rows = list[dict[str, str]]
Marks = tuple[str, str]


def read(name: str) -> Rows:
    """Rows of a file of measured results."""
    with (DOCS / "measured" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def numbers(rows: Rows, column: str) -> np.ndarray:
    """Numbers of a column; nan where it is empty."""
    return np.array([float(r[column] or "nan") for r in rows])


def share(axes: Axes, y: ArrayLike, of: Rows, count: str, colour: str, label: str) -> None:
    """Percent of n, with Wilson intervals."""
    tests = [binomtest(int(row[count]), int(row["n"])) for row in of]
    ends = np.array([test.proportion_ci(method="wilson") for test in tests])
    axes.hlines(y, *(100 * ends.T), color=colour, lw=1.5)
    percent = 100 * numbers(of, count) / numbers(of, "n")
    axes.plot(percent, y, "o", ms=4.5, color=colour, label=label)


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


def ranges(axes: Axes, rows: Rows, low: str, high: str, unit: str, marks: Marks) -> None:
    """Two values of each row, joined, on a logarithmic axis."""
    a, b = numbers(rows, low), numbers(rows, high)
    axes.hlines(range(len(a)), a, np.where(np.isnan(b), a, b), color="#bbbbbb", lw=1.5)
    axes.plot(a, range(len(a)), "o", ms=4.5, color=BLUE, label=marks[0])
    axes.plot(b, range(len(b)), "D", ms=4, mfc="white", color=ORANGE, label=marks[1])
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    named(axes, [r["condition"] for r in rows], unit)
    for value in {r["goal"] for r in rows if r.get("goal")}:
        goal(axes, float(value))


def pairs(
    name: str, low: str = "median", high: str = "largest", marks: Marks = MARKS, unit: str = ""
) -> Figure:
    """Two values of each row of a file, a panel for each unit."""
    groups: dict[str, Rows] = {}
    for row in read(name):
        of = unit or row["unit"]
        if row[low] and of not in ("ratio", "MiB", "% of a core"):
            groups.setdefault(of, []).append(row)
    figure, axes = panels([len(rows) for rows in groups.values()])
    for ax, (of, rows) in zip(axes, groups.items(), strict=True):
        ranges(ax, rows, low, high, of, marks)
    legend(figure, axes[0])
    return figure


def lab() -> Figure:
    """Right verdicts by kind of study; numbers of studies and of wrong verdicts."""
    rows = [r for r in read("lab") if r["n"] != "1"]
    figure, (axes,) = panels([len(rows)])
    for kind, colour in zip(dict.fromkeys(r["hidden"] for r in rows), COLOURS, strict=False):
        y = [i for i, r in enumerate(rows) if r["hidden"] == kind]
        share(axes, y, [rows[i] for i in y], "right", colour, kind)
    for place, row in enumerate(rows):
        most = binomtest(int(row["wrong"]), int(row["n"])).proportion_ci().high
        axes.text(102, place, f"{row['wrong']} of {row['n']}, < {100 * most:.0f} %", va="center")
    goal(axes, 90.0)
    axes.set_xlim(20, 101)
    named(axes, [r["condition"] for r in rows], "right verdicts, % (95 % interval)")
    axes.text(102, -1, "wrong (95 % bound)", va="center")
    legend(figure, axes, 4)
    return figure


def several(name: str, group: str, rows_of: str, count: str, unit: str) -> Figure:
    """Plot shares of several groups for each condition."""
    rows = [r for r in read(name) if r[group]]
    names = list(dict.fromkeys(r[rows_of] for r in rows))
    groups = list(dict.fromkeys(r[group] for r in rows))
    figure, (axes,) = panels([2 * len(names)])
    for i, (row, colour) in enumerate(zip(groups, COLOURS, strict=False)):
        of = [r for r in rows if r[group] == row]
        y = [names.index(r[rows_of]) + 0.22 * (i - (len(groups) - 1) / 2) for r in of]
        share(axes, y, of, count, colour, row)
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
    named(axes, [r["condition"] for r in rows], "95 % intervals that contain the truth, %")
    ranges(below, errors, "median", "largest", "error of position, mm", MARKS)
    legend(figure, axes)
    return figure


def correction() -> Figure:
    rows = [r for r in read("correction") if r["half_mm"] == "2" and "× 2" not in r["condition"]]
    figure, (axes,) = panels([len(rows)])
    for dy, way, colour in ((-0.15, "planned", GREY), (0.15, "corrected", ORANGE)):
        share(axes, np.arange(len(rows)) + dy, rows, f"inserted_{way}", colour, way)
    named(axes, [r["condition"].removesuffix(", ± 2 mm") for r in rows],
          "of 20 cables inserted, % (95 % interval); opening ± 2 mm")  # fmt: skip
    legend(figure, axes)
    return figure


def benchmark_effects() -> Figure:
    """Right against wrong claims of each entrant, as the threshold of abstaining rises."""
    rows = [r for r in read("benchmark_effects") if r["hidden"] == "all"]
    figure = Figure((7.2, 4.6), layout="constrained")
    axes, names = figure.subplots(), list(dict.fromkeys(r["condition"] for r in rows))
    for i, name in enumerate(names):
        of = [r for r in rows if r["condition"] == name]
        wrong, right = (100 * numbers(of, c) / numbers(of, "n") for c in ("wrong", "right"))
        style = {"color": COLOURS[i % len(COLOURS)], "ls": ("-", "--", ":")[i // len(COLOURS)]}
        usual = [r["threshold"] for r in of].index("0.5")
        label = f"{name}, n = {of[0]['n']}"
        axes.plot(wrong, right, lw=1.2, marker=MARKERS[i], markevery=[usual], label=label, **style)
        for x, y, count in ((wrong, right, "right"), (wrong, right, "wrong")):
            low, high = (100 * numbers(of, f"{count}_{end}")[usual] for end in ("low", "high"))
            line = (axes.vlines, x) if count == "right" else (axes.hlines, y)
            line[0](line[1][usual], low, high, color=style["color"], lw=0.5, alpha=0.5)
    axes.set(xlim=(-2, 102), ylim=(-2, 102), xlabel="wrong claims, %", ylabel="right claims, %")
    figure.legend(loc="outside right upper")
    return figure


def rods() -> Figure:
    """Error of the tip against CPU time by task, of settings that halve the error."""
    rows = [r for r in read("rods") if r["reference_um"] != "nan"]
    tasks, names = (list(dict.fromkeys(r[c] for r in rows)) for c in ("task", "entrant"))
    figure = Figure((7.2, 4.8), layout="constrained")
    grid = figure.subplots(2, -(-len(tasks) // 2), sharex=True, sharey=True)
    for axes, task in zip(grid.flat, tasks, strict=False):
        for name, colour, marker in zip(names, COLOURS, MARKERS, strict=False):
            of = list[dict[str, str]]()
            for row in (r for r in rows if (r["task"], r["entrant"]) == (task, name)):
                if not of or float(row["rms_um"]) < 0.5 * float(of[-1]["rms_um"]):
                    of.append(row)
            cost, error = numbers(of, "cpu_ms"), numbers(of, "rms_um")
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
