"""Draw the plate with the jaw's marks, to scale, with dimensions: print it at 100 %.

python -m tools.figures.jaw_plate -o docs/images/jaw_plate.pdf --png docs/images/jaw_plate.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from cell.vision.marks import JawMarks

#: The plate around the discs, mm: x from the jaw's edge, y from the lower edge.
PLATE_MM = (0.0, -13.0, 38.0, 13.0)
#: The sheet and its range of the jaw's plane, mm.
SHEET_MM, CORNER_MM = (150.0, 110.0), (-40.0, -58.0)
MM_PER_INCH = 25.4


def draw(marks: JawMarks) -> plt.Figure:
    """Figure whose millimetres are those of the plate."""
    figure = plt.figure(figsize=tuple(side / MM_PER_INCH for side in SHEET_MM))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    x0, y0 = CORNER_MM
    axes.set(xlim=(x0, x0 + SHEET_MM[0]), ylim=(y0, y0 + SHEET_MM[1]), aspect="equal")
    axes.axis("off")
    left, low, right, high = PLATE_MM
    axes.add_patch(Rectangle((left, low), right - left, high - low, color="0.1"))
    radius_mm = marks.radius_m * 1e3
    centres = [(1e3 * x, 1e3 * y) for x, y in marks.centres_m]
    for centre in centres:
        axes.add_patch(Circle(centre, radius_mm, color="white"))
    axes.plot([-30.0, 0.0], [0.0, 0.0], color="tab:blue", lw=1.5)
    axes.text(-30.0, 1.5, "cable", fontsize=8, color="tab:blue")
    axes.plot([-3.0, 3.0], [0.0, 0.0], color="tab:red", lw=0.8)
    axes.plot([0.0, 0.0], [-3.0, 3.0], color="tab:red", lw=0.8)
    axes.annotate(
        "gripping point (0, 0)", (0.0, 0.0), (-36.0, -12.0), fontsize=8, color="tab:red",
        arrowprops={"arrowstyle": "-", "color": "tab:red", "lw": 0.6},
    )  # fmt: skip
    for i, at_mm in enumerate(sorted({x for x, _ in centres} | {right})):
        _dimension(axes, (0.0, at_mm), high + 7.0 + 6.0 * i, high, level=True)
    for i, at_mm in enumerate(sorted({y for _, y in centres} | {low, high})):
        _dimension(axes, (0.0, at_mm), right + 8.0 + 9.0 * i, right, level=False)
    axes.text(left, low - 9.0, f"4 light discs, diameter {2 * radius_mm:g}, on a dull dark plate; "
              "dimensions in mm", fontsize=8)  # fmt: skip
    axes.plot([left, left + 50.0], [low - 16.0] * 2, color="black", lw=1.0)
    for at_mm in (0.0, 50.0):
        axes.plot([left + at_mm] * 2, [low - 17.5, low - 14.5], color="black", lw=1.0)
    axes.text(
        left, low - 21.5, "this line is 50 mm: measure it after printing at 100 %", fontsize=8
    )
    _arrows(axes, (-36.0, -38.0))
    return figure


def _dimension(
    axes: Axes, ends: tuple[float, float], line_at: float, from_edge: float, *, level: bool
) -> None:
    """A dimension line from the gripping point's axis to `ends[1]`, with its extension line."""
    start, end = ends
    a, b = ((start, line_at), (end, line_at)) if level else ((line_at, start), (line_at, end))
    axes.annotate("", b, a, arrowprops={"arrowstyle": "<->", "lw": 0.5, "shrinkA": 0, "shrinkB": 0})
    for value in ends:
        edge = ((value, value), (from_edge + 1.0, line_at + 1.0))
        axes.plot(*(edge if level else edge[::-1]), color="0.5", lw=0.3)
    words = f"{end:g}"
    if level:
        axes.text(end + 0.8, line_at, words, fontsize=7, va="center")
    else:
        axes.text(line_at, end + (1.0 if end > 0 else -1.0), words, fontsize=7, ha="center",
                  va="bottom" if end > 0 else "top")  # fmt: skip


def _arrows(axes: Axes, at: tuple[float, float]) -> None:
    """The jaw's frame."""
    for end, name in (((10.0, 0.0), "x, away from the cable"), ((0.0, 10.0), "y, up")):
        tip = (at[0] + end[0], at[1] + end[1])
        axes.annotate("", tip, at, arrowprops={"arrowstyle": "->", "lw": 0.8})
        axes.text(tip[0] + 1.0, tip[1], name, fontsize=7, va="center")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/images/jaw_plate.pdf"))
    parser.add_argument("--png", type=Path, help="a picture of it as well")
    options = parser.parse_args()
    figure = draw(JawMarks())
    figure.savefig(options.out, metadata={"CreationDate": None})
    if options.png:
        figure.savefig(options.png, dpi=150)


if __name__ == "__main__":
    main()
