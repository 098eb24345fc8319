"""Stated probability of passing against what happened, of the cables of a line study.

`python -m tools.studies.line_study --sizes 1 2 --json F`, then
`python -m tools.figures.promise_picture F [-o docs/images/promises.png]`

In the study's mouth nearly every cable is promised nearly everything.  So each cable's forecast is
also held against lower mouths: floor and ceiling nearer by so much, for which the same predicted
margin and standard deviation promise less, and the true margin is less as well.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import beta

FloatArray = NDArray[np.float64]

IMAGE = Path(__file__).parents[2] / "docs" / "images" / "promises.png"
#: How much nearer floor and ceiling come, in standard deviations of the forecast from its middle.
NEARER = np.arange(-2.25, 2.3, 0.5)
SURE = 0.9


def promises(rows: list[dict[str, object]]) -> tuple[FloatArray, FloatArray]:
    """(cables, mouths) stated probability, and 1 where the tip would have passed."""
    known = [
        [float(str(r[k])) for k in ("predicted_margin_m", "margin_std_m", "true_margin_m")]
        for r in rows
        if r["probability"] is not None
    ]
    predicted, std, true = np.array(known).T
    taken_m = predicted[:, None] + NEARER * std[:, None]
    stated = ndtr((predicted[:, None] - taken_m) / std[:, None])
    return stated, (true[:, None] > taken_m).astype(float)


def as_it_was(rows: list[dict[str, object]]) -> tuple[int, int]:
    """Executions promised at least 90 % in the study's own mouth, and those that passed."""
    sure = [r for r in rows if r["probability"] is not None and float(str(r["probability"])) > SURE]
    return len(sure), sum(float(str(r["true_margin_m"])) > 0.0 for r in sure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=IMAGE)
    options = parser.parse_args()
    rows = json.loads(options.rows.read_text(encoding="utf-8"))
    stated, passed = promises(rows)
    sure, of_them = as_it_was(rows)
    print(f"{len(stated)} cables; in their own mouth promised ≥ 90 %: {sure}, passed {of_them}")
    figure, axes = plt.subplots(figsize=(5.2, 4.6), constrained_layout=True)
    axes.plot([0, 1], [0, 1], color="#9e9e9e", linewidth=1, label="honest")
    for column in range(stated.shape[1]):
        # One mouth for each cable: the cables are independent, the mouths of one are not.
        n, k = len(stated), float(passed[:, column].sum())
        low, high = beta.ppf([0.025, 0.975], [k, k + 1.0], [n - k + 1.0, n - k])
        share, place = k / n, float(stated[:, column].mean())
        bars = np.array([[share - np.nan_to_num(low)], [np.nan_to_num(high, nan=1.0) - share]])
        axes.errorbar(place, share, bars, fmt="o", color="#1565c0", capsize=3)
        print(f"stated {place:.2f}: passed {share:.2f} ({np.nan_to_num(low):.2f} … {high:.2f})")
    worlds = len({(r["effect"], r["size"]) for r in rows})
    axes.set(
        xlabel="stated probability of passing",
        ylabel="share that passed, with 95 % interval",
        title=f"{len(stated)} cables of {worlds} worlds, the model without their effects",
        xlim=(0, 1),
        ylim=(0, 1.01),
    )
    axes.title.set_fontsize(10)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(options.out, dpi=110)
    print(f"picture: {options.out}")


if __name__ == "__main__":
    main()
