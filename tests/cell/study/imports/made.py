"""A made trial in forms that people write; those of programs are in `corpus`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from typer.testing import CliRunner

from cell.cli import app
from cell.study.data import Study
from cell.study.folder import read_study
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.swing import Swing, stroke, swing, times_s
from tests.cell.study.imports.corpus.text import cells as digits
from tests.cell.study.imports.corpus.text import lines as text
from tests.cell.study.imports.corpus.text import saved

#: What a file of places cannot say.
CABLE = ("--free-length", "0.1", "--line-density", "0.0074", "--width", "0.016")
CABLE = (*CABLE, "--thickness", "0.0001")


#: Noise of `made`, less than that of the corpus: tests compare what is derived of it.
NOISE_M = 5e-5
#: Of numbers with 7 decimals of a millimetre: places, m, and clamp angles, rad; of times, s.
PLACE_M, ANGLE_RAD, TIME_S = 1e-7, 1e-5, 2e-5


def made(seed: int = 1, noise_m: float = NOISE_M) -> Swing:
    """A gripper that goes down and turns, from the gripper to the tip."""
    t_s = times_s(lasts_s=1.8)
    way = stroke(t_s)
    hand_m = np.column_stack([0.01 * way, -0.05 * way])
    return swing("made", hand_m, 0.2 + 0.15 * way, seed, t_s, noise_m)


def check_same(
    study: Study,
    *truth: Swing,
    place_m: float = PLACE_M,
    angle_rad: float = ANGLE_RAD,
    time_s: float = TIME_S,
) -> None:
    """Places of markers and gripper from its first one on, clamp angles and times are the truth."""
    assert len(study.trials) == len(truth)
    for trial, s in zip(study.trials, truth, strict=True):
        grip, markers = trial.grip, trial.markers
        origin_m = np.array([grip.x_m[0], grip.y_m[0]]) - s.gripper_m[0]
        assert trial.start == "equilibrium"
        np.testing.assert_allclose(markers.t_s - markers.t_s[0], s.t_s, atol=time_s)
        np.testing.assert_allclose(
            markers.xy_m - origin_m, s.markers_m[:, ::-1], rtol=0.0, atol=place_m
        )
        at_s = grip.t_s - markers.t_s[0]
        path = np.column_stack([grip.x_m, grip.y_m, grip.angle_rad])
        if len(at_s) == len(s.t_s):
            np.testing.assert_allclose(at_s, s.t_s, atol=time_s)
        else:
            path = np.column_stack([np.interp(s.t_s, at_s, v) for v in path.T])
        np.testing.assert_allclose(path[:, :2] - origin_m, s.gripper_m, rtol=0.0, atol=place_m)
        np.testing.assert_allclose(path[:, 2], s.angle_rad, rtol=0.0, atol=angle_rad)


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


def filled(mapping: Path, entries: Mapping[str, Any]) -> None:
    """Write entries of a mapping, by their dotted keys."""
    content = yaml.safe_load(mapping.read_text())
    for key, value in entries.items():
        *sections, name = key.split(".")
        place = content
        for section in sections:
            place = place[int(section) if section.isdecimal() else section]
        place[name] = value
    mapping.write_text(yaml.safe_dump(content))


def _wide(m: Swing) -> np.ndarray:
    """(T, 4 + 10): time, gripper, angle, markers from the tip to the gripper."""
    markers = m.markers_m[:, ::-1].reshape(len(m.t_s), -1)
    return np.column_stack([m.t_s, m.gripper_m, m.angle_rad, markers])


def wide_metres(m: Swing, folder: Path) -> list[str]:
    """As this program would write it."""
    names = ["t_s", "hand_x_m", "hand_y_m", "hand_angle_rad"]
    names += [f"{n}_{a}_m" for n in NAMES[::-1] for a in "xy"]
    return [str(saved(folder / "trial.csv", text([names, *digits(_wide(m), 9)])))]


def german(m: Swing, folder: Path) -> list[str]:
    """Semicolons, decimal commas, ms, mm, degrees; y down and the angle positive upwards."""
    scale = [1e3, 1e3, -1e3, -180.0 / np.pi, *[1e3, -1e3] * 5]
    names = ["Zeit [ms]", "Greifer X [mm]", "Greifer Y [mm]", "Greifer Winkel [deg]"]
    names += [f"Spitze{i} {a} [mm]" for i in range(5) for a in "XY"]
    rows = [[c.replace(".", ",") for c in row] for row in digits(_wide(m) * scale, 7)]
    file = folder / "versuch.csv"
    file.write_text("Messung vom Montag\n\n" + text([names, *rows], ";"), encoding="utf-8-sig")
    return [str(file)]


def long_table(m: Swing, folder: Path) -> list[str]:
    """A row per time and marker; the angle only in the gripper's rows."""
    rows: list[list[object]] = [["time (s)", "label", "X (mm)", "Y (mm)", "angle (deg)"]]
    for k, t in enumerate(m.t_s):
        x, y = m.gripper_m[k] * 1e3
        rows.append(
            [f"{t:.6f}", "gripper", f"{x:.7f}", f"{y:.7f}", f"{np.degrees(m.angle_rad[k]):.9f}"]
        )
        for name, (x, y) in zip(NAMES, m.markers_m[k] * 1e3, strict=True):
            rows.append([f"{t:.6f}", name, f"{x:.7f}", f"{y:.7f}", ""])
    return [str(saved(folder / "long.csv", text(rows)))]


def melted(m: Swing, folder: Path) -> list[str]:
    """A row per time and coordinate."""
    rows: list[list[object]] = [["time", "variable", "value"]]
    names = ["clamp_x_mm", "clamp_y_mm", "clamp_angle_deg"]
    names += [f"{n}_{a}_mm" for n in NAMES[::-1] for a in "xy"]
    scale = np.array([1e3, 1e3, 180.0 / np.pi, *[1e3] * 10])
    for t, values in zip(m.t_s, _wide(m)[:, 1:] * scale, strict=True):
        rows += [[f"{t:.6f}", n, f"{v:.7f}"] for n, v in zip(names, values, strict=True)]
    return [str(saved(folder / "melted.tsv", text(rows, "\t")))]


def two_files(m: Swing, folder: Path) -> list[str]:
    """Markers by numbers of frames in mm; the gripper in its own file, in seconds, m and
    degrees."""
    seen = digits(m.markers_m.reshape(len(m.t_s), -1) * 1e3, 7)
    names = ["frame", *(f"{a}{i}" for i in range(5) for a in "xy")]
    markers, hand = folder / "markers.csv", folder / "robot.csv"
    markers.write_text("# units: mm\n" + text([names, *([k, *row] for k, row in enumerate(seen))]))
    poses = np.column_stack([m.t_s, m.gripper_m, np.degrees(m.angle_rad)])
    hand.write_text(
        text([["t [s]", "TCP x [m]", "TCP y [m]", "TCP angle [deg]"], *digits(poses, 10)])
    )
    return [str(markers), "--hand", str(hand), "--rate", "200"]


FORMS: tuple[Callable[[Swing, Path], list[str]], ...] = (
    wide_metres, german, long_table, melted, two_files,
)  # fmt: skip
