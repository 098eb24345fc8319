"""Insertion rate against the mouth's height, from counts of mouth and flight studies.

`python -m tools.figures.mouth_picture docs/measured/mouths.csv [-o docs/images/mouths.png]`
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import matplotlib.pyplot as plt
from scipy.stats import beta

IMAGE = Path(__file__).parents[2] / "docs" / "images" / "mouths.png"
NAMES = {
    "offsets": ("21 offsets, at once", "#9e9e9e", "o"),
    "and moment": ("any offset and moment", "#1565c0", "s"),
    "and pace": ("and pace", "#2e7d32", "^"),
    "and feedback": ("and corrected in flight", "#c62828", "D"),
}


def rates(rows: list[dict[str, str]]) -> dict[tuple[str, float], tuple[int, int]]:
    """Inserted and all, by what may be chosen and half the mouth's height, mm."""
    return {
        (row["freely"], float(row["half_mm"])): (int(row["inserted"]), int(row["cables"]))
        for row in rows
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=IMAGE)
    options = parser.parse_args()
    with options.rows.open(newline="") as file:
        found = rates(list(csv.DictReader(file)))
    figure, axes = plt.subplots(figsize=(6.4, 3.8), constrained_layout=True)
    heights = sorted({half_mm for _, half_mm in found}, reverse=True)
    for index, (name, (label, colour, marker)) in enumerate(NAMES.items()):
        known = [(place, found[name, h]) for place, h in enumerate(heights) if (name, h) in found]
        places = [place + 0.06 * (index - 1.5) for place, _ in known]
        share = [100.0 * k / n for _, (k, n) in known]
        low = [s - 100.0 * beta.ppf(0.025, k, n - k + 1) if k else 0.0
               for s, (_, (k, n)) in zip(share, known, strict=True)]  # fmt: skip
        high = [100.0 * beta.ppf(0.975, k + 1, n - k) - s if k < n else 0.0
                for s, (_, (k, n)) in zip(share, known, strict=True)]  # fmt: skip
        axes.errorbar(
            places, share, [low, high], color=colour, marker=marker, capsize=3, label=label
        )
    axes.set_xticks(range(len(heights)), [f"± {h:g}" for h in heights])
    axes.set_xlabel("mouth, mm")
    axes.set_ylabel("cables inserted, %")
    axes.set_ylim(-3, 104)
    axes.grid(axis="y", color="#e0e0e0")
    axes.legend(frameon=False, loc="lower left")
    figure.savefig(options.out, dpi=150)
    print(options.out)


if __name__ == "__main__":
    main()
