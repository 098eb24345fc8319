"""The tables of cell/examples: two simulated cables as a motion-capture program exports them.

    python -m tools.worlds.tracker_tables cell/examples

MuJoCo computes the swings, so the tables contain none of the project's own physics.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tools.worlds.made_studies import STROKES, Stroke
from tools.worlds.mujoco_studies import Hidden, Specimen, true_markers

RATE_HZ, LASTS_S = 100.0, 1.4
#: Standard deviations of a marker and of the gripper, which the robot's log gives.
MARKER_NOISE_M, GRIPPER_NOISE_M = 5e-5, 2e-6
#: Markers of the table, from the gripper to the tip, by their number in `mujoco_studies`.
SHOWN = {"m1": 8, "m2": 5, "m3": 2, "tip": 0}
#: Origin of the tables, from the gripping point at rest.
ORIGIN_M = np.array([-0.3, -0.2])
MOTIONS = {"down": "identify", "left": "probe_left"}
CABLES = {
    "cable_a": Specimen(hidden=Hidden(tip_mass=3e-5)),
    "cable_b": Specimen(rigidity_n_m2=3e-5, phase=0.7, hidden=Hidden(magnet=(2e-5, -0.1, -0.15))),
}


def table(cable: Specimen, stroke: Stroke, rng: np.random.Generator) -> str:
    """Rows of time, gripper and markers in mm, separated by semicolons, with decimal commas."""
    t_s = np.arange(round(LASTS_S * RATE_HZ)) / RATE_HZ
    gripper = stroke.place_m(t_s)
    gripper += rng.normal(0.0, GRIPPER_NOISE_M, gripper.shape)
    markers = true_markers(cable, stroke, t_s)[:, list(SHOWN.values())]
    markers += rng.normal(0.0, MARKER_NOISE_M, markers.shape)
    points_mm = 1e3 * (np.concatenate([gripper[:, None], markers], axis=1) - ORIGIN_M)
    rows = [["time_s", *(f"{p}_{a}_mm" for p in ("gripper", *SHOWN) for a in "xy")]]
    for t, row in zip(t_s, points_mm, strict=True):
        rows.append([f"{t:.2f}", *(f"{v:.3f}" for v in row.ravel())])
    return "".join(";".join(row).replace(".", ",") + "\n" for row in rows)


def tables(cable: str, motions: Sequence[str] = tuple(MOTIONS)) -> dict[str, str]:
    """Text of each table of a cable, by its motion; the noise of one follows that of the other."""
    rng = np.random.default_rng(list(CABLES).index(cable))
    strokes = {s.name: s for s in STROKES}
    return {m: table(CABLES[cable], strokes[MOTIONS[m]], rng) for m in motions}


def write(folder: Path) -> None:
    """Write all tables, a folder for each cable."""
    for cable in CABLES:
        (folder / cable).mkdir(parents=True, exist_ok=True)
        for motion, text in tables(cable).items():
            (folder / cable / f"{motion}.csv").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
