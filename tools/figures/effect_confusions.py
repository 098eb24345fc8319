"""Correlations between the signatures of effects, motion by motion, as CSV.

    python -m tools.figures.effect_confusions [-o docs/measured/effect_confusions.csv]

A signature is the change of all markers by a small effect, projected off the sensitivities of EI at
four knots, N and the viscosity.  For effects with several amplitudes the largest correlation of
their subspaces counts.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.dynamics import simulate
from cell.cable.effects import library, unscreened
from cell.cable.geometry import Motion, node_arc_lengths
from cell.cable.model import CableModel
from tools.figures.effect_pictures import PLAIN, SIZES, model
from tools.worlds.made_studies import moved

FloatArray = NDArray[np.float64]

TIMES_S = np.arange(0.0, 1.5, 0.01)
NODES_M = node_arc_lengths(0.1, 11)[::-1]
#: Of a picture's size; R of `plastic_set` acts by its square, so it is given in m.
SMALL, SMALL_RADIUS_M = 0.05, 0.01
#: Signatures below this rms, m, are rounding; correlations below the second are left out.
NOTHING_M, LEAST = 5e-9, 0.3


def motions() -> dict[str, list[Motion]]:
    """Motions by name; the pairs `down and …` are fitted jointly."""
    t_s = np.arange(0.0, TIMES_S[-1] + 0.02, 0.002)
    begin_s = 0.1
    down, rest = moved(t_s, (0.0, -0.05), 0.3, begin_s), moved(t_s, (0.0, 0.0), 0.3)
    up_m = moved(t_s, (0.0, 0.03), 0.2, 0.8).y_m
    others = {
        "left": moved(t_s, (-0.06, 0.0), 0.28, begin_s),
        "tilted": moved(t_s, (0.0, -0.05), 0.3, begin_s, angle_rad=-0.9),
        "turn": replace(rest, angle_rad=moved(t_s, (0.4, 0.0), 0.3, begin_s).x_m),
        "fast": moved(t_s, (0.0, -0.03), 0.12, begin_s),
        "down_up": replace(down, y_m=down.y_m + up_m),
    }
    pairs = {f"down and {name}": [down, motion] for name, motion in others.items()}
    alone = {name: [motion] for name, motion in others.items()}
    return {"rest": [rest], "down": [down]} | alone | pairs


def signatures(motions_shown: list[Motion]) -> dict[str, FloatArray]:
    """Orthonormal signatures (values, amplitudes) of the effects that these motions show."""

    def run(cable: CableModel) -> FloatArray:
        return np.concatenate([simulate(cable, m, TIMES_S, NODES_M).ravel() for m in motions_shown])

    plain = run(model(PLAIN))
    slopes = np.array([run(model(PLAIN + step)) - plain for step in 1e-4 * np.eye(PLAIN.size)])
    imitated = np.linalg.qr((slopes[np.any(slopes != 0.0, axis=1)] / 1e-4).T)[0]
    by_effect = {}
    for name, effect in (library() | unscreened()).items():
        changes = []
        for p in effect.parameters:
            if p.amplitude and p.fitted:
                full = SIZES.get(name, {}).get(p.name, p.starts[0]) - p.default
                value = SMALL_RADIUS_M if name == "plastic_set" else p.default + SMALL * full
                changes.append(run(model(PLAIN, (effect.active(**{p.name: value}),))) - plain)
        projected = np.array(changes).T
        projected -= imitated @ (imitated.T @ projected)
        axes, sizes, _ = np.linalg.svd(projected, full_matrices=False)
        if np.sqrt(np.mean(projected**2)) > NOTHING_M:
            by_effect[name] = axes[:, sizes > 1e-6 * sizes[0]]
    return by_effect


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default="docs/measured/effect_confusions.csv")
    options = parser.parse_args(arguments)
    with Path(options.out).open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["motion", "effect", "other", "correlation"])
        for motion, motion_list in motions().items():
            by_effect = signatures(motion_list)
            for effect, own in by_effect.items():
                for second, theirs in by_effect.items():
                    r = float(np.linalg.svd(own.T @ theirs, compute_uv=False)[0])
                    if second != effect and r >= LEAST:
                        table.writerow([motion, effect, second, f"{r:.2f}"])


if __name__ == "__main__":
    main()
