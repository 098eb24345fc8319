"""What became of the cables of every world, as planned and with feedback, of `make flights`.

python -m tools.figures.flight_picture docs/measured/flights.csv docs/images/flights.png
"""

from __future__ import annotations

import argparse
import csv
from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

#: Colours of outcomes, the same as on the pages; in the order of the bars.
COLOURS = {"inserted": "#0b7285", "rejected": "#ced4da", "stopped": "#f0b429", "missed": "#c92a2a"}


def counts(path: Path) -> dict[str, dict[bool, Counter[str]]]:
    """Outcomes by world and by whether there was feedback."""
    found: dict[str, dict[bool, Counter[str]]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            of_world = found.setdefault(row["world"], {False: Counter(), True: Counter()})
            of_world[row["feedback"] == "True"][row["outcome"]] += 1
    return found


def picture(found: dict[str, dict[bool, Counter[str]]], path: Path) -> None:
    """Two bars a world: the upper one as planned, the lower one with feedback."""
    figure, axes = plt.subplots(figsize=(9.0, 0.29 * len(found) + 0.9), layout="constrained")
    for at, by_feedback in enumerate(found.values()):
        for feedback, y in ((False, at - 0.19), (True, at + 0.19)):
            left = 0
            for outcome, colour in COLOURS.items():
                count = by_feedback[feedback][outcome]
                shade = 1.0 if feedback else 0.55
                axes.barh(y, count, 0.36, left, color=colour, alpha=shade)
                left += count
    axes.set_yticks(range(len(found)), [w.replace("_", " ") for w in found], fontsize=8)
    axes.set_ylim(len(found) - 0.4, -0.6)
    axes.set_xlim(0, 20)
    axes.set_xticks(range(0, 21, 5))
    axes.set_xlabel("cables of 20; upper bar: as planned, lower bar: chosen freely and corrected")
    handles = [plt.Rectangle((0, 0), 1, 1, color=c) for c in COLOURS.values()]
    figure.legend(handles, COLOURS, loc="outside upper right", ncols=4, frameon=False, fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("rows", type=Path)
    parser.add_argument("picture", type=Path)
    given = parser.parse_args()
    picture(counts(given.rows), given.picture)


if __name__ == "__main__":
    main()
