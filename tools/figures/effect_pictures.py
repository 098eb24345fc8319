"""Draw the pictures of the catalogue of effects, docs/images/effects/NAME.png, one for each.

    python -m tools.figures.effect_pictures [--only NAME …] [--out FOLDER]

A gripped cable goes 50 mm down in 0.3 s and swings, with the effect and without.  Then EI at four
knots, N and the viscosity of one without it are fitted to the one with it.  Prints sizes in mm.
"""

from __future__ import annotations

import argparse
import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from cell.cable.dynamics import simulate
from cell.cable.effects import ActiveEffect, library, unscreened
from cell.cable.effects.base import after_number
from cell.cable.geometry import Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.files.figure_style import ADDED, BETWEEN, MODEL
from tools.worlds.made_studies import CABLE, moved

FloatArray = NDArray[np.float64]
NODES_M = node_arc_lengths(CABLE.free_length_m, 21)[::-1]
TIMES_S = np.arange(0.0, 2.0, 0.005)
BEGINS_S, LASTS_S, WAY_M, PASSES = 0.1, 0.3, 0.05, 8
#: Values in the pictures that differ from the first start of each amplitude.
SIZES = {
    "air_drag": {"drag_coefficient": 4.0},
    "draught": dict.fromkeys(("wind_x_m_per_s", "wind_y_m_per_s"), 0.2),
    "robot_ringing": {"amplitude_m": 5e-4},
    "camera_roll": {"angle_rad": 0.03},
    "rest_shape": {f"curvature_{i}_1_per_m": 2.0 if i < 3 else -2.0 for i in range(6)},
}


@dataclass(frozen=True, eq=False)
class Signature:
    """Markers (times, markers, 2) of a cable without the effect, with it, and of the refit; m."""

    name: str
    values: str
    without: FloatArray
    with_it: FloatArray
    refit: FloatArray

    @property
    def sizes_text(self) -> str:
        """Sizes of the effect in mm."""
        moved = np.linalg.norm(self.with_it - self.without, axis=-1)[:, -1].max() * 1e3
        residual = np.sqrt(np.mean((self.with_it - self.refit) ** 2)) * 1e3
        return f"tip moved by up to {moved:.2g} mm; after refitting EI, N, C {residual:.2g} mm rms"


def motion() -> Motion:
    """The gripper moves down along a minimum-jerk path, and rests."""
    return moved(np.arange(0.0, TIMES_S[-1] + 0.01, 0.002), (0.0, -WAY_M), LASTS_S, BEGINS_S)


def model(q: FloatArray, effects: tuple[ActiveEffect, ...] = ()) -> CableModel:
    """Cable model of the parameters: log EI at its knots, N, log viscosity."""
    return CableModel(CABLE, np.exp(q[:-2]), float(q[-2]), float(np.exp(q[-1])), effects=effects)


PLAIN = np.array([*np.log([3e-5] * 4), 1.0, np.log(2e-7)])


def signature(name: str) -> Signature:
    """Effect on a cable, and the residual of the best baseline fit to it."""
    effect = (library() | unscreened())[name]
    shown = [p for p in effect.parameters if p.fitted]
    active = effect.active(**SIZES.get(name, {p.name: p.starts[0] for p in shown if p.amplitude}))
    each = (f"{p.name} = {active.named[p.name]:g}{after_number(p.unit)}" for p in shown)

    def runs(models: Sequence[CableModel]) -> FloatArray:
        return simulate(models, motion(), TIMES_S, NODES_M)

    without, with_it = runs([model(PLAIN), model(PLAIN, (active,))])
    q, refit, damping, steps = PLAIN, without, 1e-3, 1e-4 * np.eye(PLAIN.size)
    for _ in range(PASSES):
        jacobian = (runs([model(q + s) for s in steps]) - refit).reshape(q.size, -1).T / 1e-4
        normal = jacobian.T @ jacobian
        normal += damping * np.diag(np.diag(normal))
        step = np.linalg.solve(normal, jacobian.T @ (with_it - refit).ravel())
        (there,) = runs([model(tried := q + np.clip(step, -0.4, 0.4))])
        better = np.sum((with_it - there) ** 2) < np.sum((with_it - refit) ** 2)
        q, refit, damping = (tried, there, damping / 5) if better else (q, refit, damping * 20)
    return Signature(name, ", ".join(each), without, with_it, refit)


@mpl.rc_context({"font.size": 8, "axes.titlesize": 8, "axes.grid": True, "grid.alpha": 0.4})
def draw(sig: Signature) -> Figure:
    """Shape at rest, tip height, residual map and spectrum."""
    figure = Figure(figsize=(8.4, 4.9), layout="constrained", dpi=100)
    values = textwrap.fill(sig.values.replace(" ", "\xa0").replace(",\xa0", ", "), 115)
    figure.suptitle(f"{values}\n{sig.sizes_text}", fontsize=8)
    (rest, height), (field, spectrum) = figure.subplots(2, 2)
    lines = (("without the effect", sig.without, BETWEEN[0], "-", 1.3),
             ("with the effect", sig.with_it, ADDED, "-", 2.2),
             ("refit without the effect", sig.refit, MODEL, "--", 1.1))  # fmt: skip
    for name, xy, colour, dash, width in lines:
        style = {"color": colour, "ls": dash, "lw": width, "label": name}
        tip_mm = xy[:, -1, 1] * 1e3
        rest.plot(*(xy[0].T * 1e3), **style)
        height.plot(TIMES_S, tip_mm, **style)
        swing = tip_mm[TIMES_S > BEGINS_S + LASTS_S]
        swing = (swing - swing.mean()) * np.hanning(swing.size)
        hz = np.fft.rfftfreq(swing.size, TIMES_S[1])
        spectrum.semilogy(hz, np.abs(np.fft.rfft(swing)) * 4 / swing.size, **style)
    rest.set(title="shape at rest", xlabel="x, mm", ylabel="y, mm")
    height.set(title="height of the tip", xlabel="time, s", ylabel="y, mm")
    spectrum.set(title="spectrum of the tip's height, from the stop on", xlabel="frequency, Hz",
                 ylabel="amplitude, mm", xlim=(0, 40), ylim=(1e-4, 30))  # fmt: skip
    rest_mm = (sig.with_it - sig.refit)[..., 1].T * 1e3
    most = max(float(np.abs(rest_mm).max()), 1e-3)
    field.grid(visible=False)
    image = field.pcolormesh(TIMES_S, NODES_M * 1e3, rest_mm, cmap="RdBu", vmin=-most, vmax=most)
    field.set(title="with effect minus refit, vertical", xlabel="time, s", ylabel="mm from clamp")
    figure.colorbar(image, ax=field, label="mm")
    rest.legend(fontsize=7)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=list(library() | unscreened()))
    parser.add_argument("--out", type=Path, default=Path("docs/images/effects"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only or library() | unscreened():
        sig, drawn = signature(name), io.BytesIO()
        draw(sig).savefig(drawn, format="png")
        picture = Image.open(drawn).convert("RGB").quantize(160)
        picture.save(options.out / f"{name}.png", optimize=True)
        print(f"{name}: {sig.values}: {sig.sizes_text}")


if __name__ == "__main__":
    main()
