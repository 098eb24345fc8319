"""A made trial, and the twelve forms in which programs would have written it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import ezc3d
import numpy as np
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

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


def spaces(m: Made, folder: Path) -> list[str]:
    """Columns of blanks, centimetres, seconds since 1970, the cable to the right."""
    scale = [1.0, -1e2, 1e2, 1.0, *[-1e2, 1e2] * 5]
    values = _wide(m) * scale
    values[:, 0] += 1.7e9
    names = "time grip_x_cm grip_y_cm theta " + " ".join(
        f"{n}_{a}_cm" for n in NAMES[::-1] for a in "xy"
    )
    file = folder / "trial.txt"
    np.savetxt(file, values, fmt="%.8f", header=names)
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


def _spatial(m: Made, up: int, right: int, turned_rad: float = 0.0) -> np.ndarray:
    """(T, 7, 3) mm: gripping point, a point of the gripper behind it, markers; in three dimensions.

    up, right   which axis is up, and which is to the right before the plane is turned about up
    """
    back = m.hand_m + 0.03 * np.column_stack([np.cos(m.angle_rad), np.sin(m.angle_rad)])
    plane = np.concatenate([m.hand_m[:, None], back[:, None], m.markers_m], axis=1) * 1e3
    places = np.full((*plane.shape[:2], 3), 12.0)
    across = 3 - up - right
    noise = np.random.default_rng(2).normal(0.0, 0.05, plane.shape[:2])  # out of the plane
    places[..., up] = plane[..., 1] + 900.0
    places[..., right] = plane[..., 0] * np.cos(turned_rad) - noise * np.sin(turned_rad)
    places[..., across] += plane[..., 0] * np.sin(turned_rad) + noise * np.cos(turned_rad)
    return places


_POINTS = ("clamp", "clamp_back", *NAMES)


def vicon(m: Made, folder: Path) -> list[str]:
    """Vicon's trajectories: rate alone in a line, names over three columns, units; z up."""
    places = _spatial(m, up=2, right=0).reshape(len(m.t_s), -1)
    head = ["Trajectories", f"{RATE_HZ:.0f}", ",," + ",,,".join(f"rig:{n}" for n in _POINTS) + ",,"]
    head.append("Frame,Sub Frame" + ",X,Y,Z" * len(_POINTS))
    head.append("," + ",mm" * 3 * len(_POINTS))
    rows = [[k + 1, 0, *row] for k, row in enumerate(digits(places, 7))]
    file = folder / "vicon.csv"
    file.write_text("\n".join(head) + "\n" + text(rows))
    return [str(file)]


def motive(m: Made, folder: Path) -> list[str]:
    """OptiTrack's export: remarks in the first line, four rows of names, a body; y up.

    The cable leaves the body along its −x.
    """
    places = _spatial(m, up=1, right=0) / 1e3
    turns = Rotation.from_rotvec(m.angle_rad[:, None] * [0.0, 0.0, 1.0]).as_quat()
    columns = ["", ""], ["", "Name"], ["", "ID"], ["", ""], ["Frame", "Time (Seconds)"]
    kinds, names, ids, what, axes = columns
    kinds[1] = "Type"
    for name, kind in (("Hand", "Rigid Body"), *((n, "Marker") for n in NAMES)):
        fields = [("Rotation", a) for a in "XYZW"] if kind == "Rigid Body" else []
        for field, axis in [*fields, *(("Position", a) for a in "XYZ")]:
            kinds.append(kind)
            names.append(name)
            ids.append("4FA2")
            what.append(field)
            axes.append(axis)
    values = np.concatenate(
        [m.t_s[:, None], turns, places[:, 0], places[:, 2:].reshape(len(m.t_s), -1)], axis=1
    )
    said = f"Format Version,1.23,Export Frame Rate,{RATE_HZ:.6f},Length Units,Meters"
    rows = [[k, *row] for k, row in enumerate(digits(values, 10))]
    file = folder / "take.csv"
    file.write_text(said + "\n\n" + text([kinds, names, ids, what, axes, *rows]))
    return [str(file)]


def qualisys(m: Made, folder: Path) -> list[str]:
    """Qualisys' table: remarks by lines, names of markers only, no columns named; z up, turned."""
    places = _spatial(m, up=2, right=1, turned_rad=0.6).reshape(len(m.t_s), -1)
    head = [f"NO_OF_FRAMES\t{len(m.t_s)}", f"FREQUENCY\t{RATE_HZ:.0f}", "DATA_INCLUDED\t3D"]
    head.append("MARKER_NAMES\t" + "\t".join(_POINTS))
    values = np.column_stack([m.t_s, places])
    file = folder / "qtm.tsv"
    file.write_text("\n".join(head) + "\n" + text(digits(values, 7), "\t"))
    return [str(file), "--rate", "200"]


def trc(m: Made, folder: Path) -> list[str]:
    """OpenSim's form; y up, the cable to the right."""
    places = _spatial(m, up=1, right=0)
    places[..., 0] *= -1.0
    head = [
        "PathFileType\t4\t(X/Y/Z)\ttrial.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
    ]
    head.append(f"{RATE_HZ}\t{RATE_HZ}\t{len(m.t_s)}\t{len(_POINTS)}\tmm")
    head.append("Frame#\tTime\t" + "\t\t\t".join(_POINTS) + "\t\t")
    head.append("\t\t" + "\t".join(f"{a}{i + 1}" for i in range(len(_POINTS)) for a in "XYZ"))
    values = digits(np.column_stack([m.t_s, places.reshape(len(m.t_s), -1)]), 7)
    file = folder / "trial.trc"
    file.write_text(
        "\n".join(head) + "\n\n" + text([[k + 1, *v] for k, v in enumerate(values)], "\t")
    )
    return [str(file)]


def c3d(m: Made, folder: Path) -> list[str]:
    """C3D, whose numbers have 32 bits; z up."""
    places = _spatial(m, up=2, right=0)
    places[..., 2] -= 900.0
    content = ezc3d.c3d()
    content["parameters"]["POINT"]["RATE"]["value"] = [RATE_HZ]
    content["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    content["parameters"]["POINT"]["LABELS"]["value"] = list(_POINTS)
    points = np.ones((4, len(_POINTS), len(m.t_s)))
    points[:3] = places.transpose(2, 1, 0)
    content["data"]["points"] = points
    file = folder / "trial.c3d"
    content.write(str(file))
    return [str(file)]


def mcap_json(m: Made, folder: Path) -> list[str]:
    """JSON messages, a topic for the gripper and one for each marker, stamped alike."""
    file = folder / "trial.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        topics = ["/hand", *(f"/{n}" for n in NAMES)]
        schema = writer.register_schema("place", "jsonschema", b"{}")
        channels = {t: writer.register_channel(t, "json", schema) for t in topics}
        for k, t in enumerate(m.t_s):
            stamp = {"sec": 1_700_000_000 + int(t), "nanosec": round((t - int(t)) * 1e9)}
            said = {"/hand": (*m.hand_m[k], m.angle_rad[k])}
            said |= {f"/{n}": tuple(p) for n, p in zip(NAMES, m.markers_m[k], strict=True)}
            for topic, values in said.items():
                message = {"header": {"stamp": stamp}}
                message |= dict(zip(("x", "y", "angle"), map(float, values), strict=False))
                data = json.dumps(message).encode()
                nanoseconds = int(1.7e18 + t * 1e9)
                writer.add_message(channels[topic], nanoseconds, data, nanoseconds)
        writer.finish()
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
    wide_metres, german, spaces, long_table, melted, vicon, motive, qualisys, trc, c3d, mcap_json,
    two_files,
)  # fmt: skip
