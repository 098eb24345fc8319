"""A made trial in forms that people write; those of programs are in `corpus`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from cell.cli import app
from cell.study.data import Study
from cell.study.folder import read_study

LENGTH_M, RATE_HZ = 0.1, 200.0
ARCS_M = np.array([0.02, 0.04, 0.06, 0.08, 0.1])
NAMES = ("m1", "m2", "m3", "m4", "tip")
#: What a file of places cannot say.
CABLE = ("--free-length", "0.1", "--line-density", "0.0074", "--width", "0.016")
CABLE = (*CABLE, "--thickness", "0.0001")


@dataclass(frozen=True)
class Made:
    """A gripper that goes down and turns, and a cable that swings: metres, radians, seconds.

    t_s (T,), hand_m (T, 2), angle_rad (T,), markers_m (T, 5, 2) from the gripper to the tip
    """

    t_s: np.ndarray
    hand_m: np.ndarray
    angle_rad: np.ndarray
    markers_m: np.ndarray


def made(seed: int = 1, noise_m: float = 5e-5) -> Made:
    """The trial; its cable keeps its length, is bent downwards at rest, and rings for a second."""
    t = np.arange(0.0, 1.8, 1.0 / RATE_HZ)
    s = np.clip((t - 0.4) / 0.3, 0.0, 1.0)
    stroke = s**3 * (10 - 15 * s + 6 * s**2)
    hand = np.column_stack([0.01 * stroke, -0.05 * stroke])
    return swinging(t, hand, 0.2 + 0.15 * stroke, seed, noise_m)


def swinging(
    t: np.ndarray, hand: np.ndarray, angle: np.ndarray, seed: int = 1, noise_m: float = 5e-5
) -> Made:
    """The cable on any gripper that moves from 0.4 to 0.7 s."""
    after = np.clip(t - 0.45, 0.0, None)
    curl = 9.0 - 4.0 * np.exp(-2.0 * after) * np.sin(2 * np.pi * 4.0 * after)
    fine = np.linspace(0.0, LENGTH_M, 501)
    turn = angle[:, None] + curl[:, None] * (fine - fine**2 / (2 * LENGTH_M))
    steps = np.stack([-np.cos(turn), -np.sin(turn)], axis=2)
    middle = 0.5 * (steps[:, 1:] + steps[:, :-1]) * (fine[1] - fine[0])
    along = np.concatenate([np.zeros((len(t), 1, 2)), np.cumsum(middle, axis=1)], axis=1)
    at = np.searchsorted(fine, ARCS_M - 1e-9)
    noise = np.random.default_rng(seed).normal(0.0, noise_m, (len(t), len(ARCS_M), 2))
    return Made(t, hand, angle, np.round(hand[:, None] + along[:, at] + noise, 8))


def text(rows: Sequence[Sequence[object]], separator: str = ",") -> str:
    """Rows as lines."""
    return "\n".join(separator.join(str(c) for c in row) for row in rows) + "\n"


def run(*arguments: str | Path, code: int = 0) -> str:
    """What `cell import` says, in one line."""
    done = CliRunner().invoke(app, ["import", *map(str, arguments)])
    assert done.exit_code == code, done.output
    return " ".join(done.output.split())


def imported(arguments: list[str], folder: Path) -> Study:
    """The study of the two commands."""
    run(*arguments, "-o", folder, *CABLE)
    assert not (folder / "study.yaml").exists()
    assert (folder / "preview.html").exists()
    run(folder / "import.yaml")
    return read_study(folder)


def digits(values: np.ndarray, count: int = 6) -> list[list[str]]:
    """Numbers with so many decimals; empty where there is none."""
    return [["" if v != v else f"{v:.{count}f}" for v in row] for row in values]


def _wide(m: Made) -> np.ndarray:
    """(T, 4 + 10): time, gripper, angle, markers from the tip to the gripper."""
    markers = m.markers_m[:, ::-1].reshape(len(m.t_s), -1)
    return np.column_stack([m.t_s, m.hand_m, m.angle_rad, markers])


def wide_metres(m: Made, folder: Path) -> list[str]:
    """As this program would write it."""
    names = ["t_s", "hand_x_m", "hand_y_m", "hand_angle_rad"]
    names += [f"{n}_{a}_m" for n in NAMES[::-1] for a in "xy"]
    file = folder / "trial.csv"
    file.write_text(text([names, *digits(_wide(m), 9)]))
    return [str(file)]


def german(m: Made, folder: Path) -> list[str]:
    """Semicolons, decimal commas, ms, mm, degrees; y down and the angle positive upwards."""
    scale = [1e3, 1e3, -1e3, -180.0 / np.pi, *[1e3, -1e3] * 5]
    names = ["Zeit [ms]", "Greifer X [mm]", "Greifer Y [mm]", "Greifer Winkel [deg]"]
    names += [f"Spitze{i} {a} [mm]" for i in range(5) for a in "XY"]
    rows = [[c.replace(".", ",") for c in row] for row in digits(_wide(m) * scale, 7)]
    file = folder / "versuch.csv"
    file.write_text("Messung vom Montag\n\n" + text([names, *rows], ";"), encoding="utf-8-sig")
    return [str(file)]


def long_table(m: Made, folder: Path) -> list[str]:
    """A row per time and marker; the angle only in the gripper's rows."""
    rows: list[list[object]] = [["time (s)", "label", "X (mm)", "Y (mm)", "angle (deg)"]]
    for k, t in enumerate(m.t_s):
        x, y = m.hand_m[k] * 1e3
        rows.append(
            [f"{t:.6f}", "gripper", f"{x:.7f}", f"{y:.7f}", f"{np.degrees(m.angle_rad[k]):.9f}"]
        )
        for name, (x, y) in zip(NAMES, m.markers_m[k] * 1e3, strict=True):
            rows.append([f"{t:.6f}", name, f"{x:.7f}", f"{y:.7f}", ""])
    file = folder / "long.csv"
    file.write_text(text(rows))
    return [str(file)]


def melted(m: Made, folder: Path) -> list[str]:
    """A row per time and coordinate."""
    rows: list[list[object]] = [["time", "variable", "value"]]
    names = ["clamp_x_mm", "clamp_y_mm", "clamp_angle_deg"]
    names += [f"{n}_{a}_mm" for n in NAMES[::-1] for a in "xy"]
    scale = np.array([1e3, 1e3, 180.0 / np.pi, *[1e3] * 10])
    for t, values in zip(m.t_s, _wide(m)[:, 1:] * scale, strict=True):
        rows += [[f"{t:.6f}", n, f"{v:.7f}"] for n, v in zip(names, values, strict=True)]
    file = folder / "melted.tsv"
    file.write_text(text(rows, "\t"))
    return [str(file)]


def _spatial(m: Made) -> np.ndarray:
    """(T, 7, 3) mm, z up: gripping point, a point of the gripper behind it, markers."""
    back = m.hand_m + 0.03 * np.column_stack([np.cos(m.angle_rad), np.sin(m.angle_rad)])
    plane = np.concatenate([m.hand_m[:, None], back[:, None], m.markers_m], axis=1) * 1e3
    across = 12.0 + np.random.default_rng(2).normal(0.0, 0.05, plane.shape[:2])
    return np.stack([plane[..., 0], across, plane[..., 1] + 900.0], axis=2)


_POINTS = ("clamp", "clamp_back", *NAMES)


def vicon(m: Made, folder: Path) -> list[str]:
    """Vicon's trajectories: rate alone in a line, names over three columns, units; z up."""
    places = _spatial(m).reshape(len(m.t_s), -1)
    head = ["Trajectories", f"{RATE_HZ:.0f}", ",," + ",,,".join(f"rig:{n}" for n in _POINTS) + ",,"]
    head.append("Frame,Sub Frame" + ",X,Y,Z" * len(_POINTS))
    head.append("," + ",mm" * 3 * len(_POINTS))
    rows = [[k + 1, 0, *row] for k, row in enumerate(digits(places, 7))]
    file = folder / "vicon.csv"
    file.write_text("\n".join(head) + "\n" + text(rows))
    return [str(file)]


def two_files(m: Made, folder: Path) -> list[str]:
    """Markers by numbers of frames in mm; the gripper in its own file, in seconds, m and
    degrees."""
    seen = digits(m.markers_m.reshape(len(m.t_s), -1) * 1e3, 7)
    names = ["frame", *(f"{a}{i}" for i in range(5) for a in "xy")]
    markers, hand = folder / "markers.csv", folder / "robot.csv"
    markers.write_text("# units: mm\n" + text([names, *([k, *row] for k, row in enumerate(seen))]))
    poses = np.column_stack([m.t_s, m.hand_m, np.degrees(m.angle_rad)])
    hand.write_text(
        text([["t [s]", "TCP x [m]", "TCP y [m]", "TCP angle [deg]"], *digits(poses, 10)])
    )
    return [str(markers), "--hand", str(hand), "--rate", "200"]


FORMS: tuple[Callable[[Made, Path], list[str]], ...] = (
    wide_metres, german, long_table, melted, two_files
)  # fmt: skip
