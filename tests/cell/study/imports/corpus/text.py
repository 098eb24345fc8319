"""A known swing as text files, in the layouts that programs document: motion capture and video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .swing import MARKERS, RATE_HZ, Swing

Floats = NDArray[np.float64]
#: Points of a file that shows no angle: the gripping point, one behind it, and the markers.
POINTS = ("gripper", "gripper_back", *MARKERS)
#: Where a laboratory's origin is, m from that of the study: right, up, across.
ORIGIN_M = (0.412, 0.9, 0.22)


def cells(values: Floats, decimals: int = 5, lost: str = "", mark: str = ".") -> list[list[str]]:
    """Rows of numbers as text; `lost` where there is none."""
    rows = [[lost if v != v else f"{v:.{decimals}f}" for v in row] for row in values.tolist()]
    return rows if mark == "." else [[c.replace(".", mark) for c in row] for row in rows]


def lines(rows: Sequence[Sequence[object]], separator: str = ",") -> str:
    """Rows as lines."""
    return "\n".join(separator.join(map(str, row)) for row in rows) + "\n"


def framed(
    s: Swing, values: Sequence[Sequence[str]], first: int = 0, step: int = 1, decimals: int = 6
) -> list[list[str]]:
    """Rows behind the number of their frame and its time."""
    each = zip(s.t_s, values, strict=True)
    return [[str(first + k * step), f"{t:.{decimals}f}", *v] for k, (t, v) in enumerate(each)]


def saved(file: Path, text: str, newline: str | None = None) -> Path:
    """The file, written."""
    file.write_text(text, newline=newline)
    return file


def plane(s: Swing, *, up: float = 1.0, unit_m: float = 1e-3) -> dict[str, Floats]:
    """(T, 2) of all points in a picture; up = -1: y counts downwards."""
    places = dict(
        zip(POINTS, (s.gripper_m, s.back_m, *s.markers_m.transpose(1, 0, 2)), strict=True)
    )
    return {name: at / unit_m * (1.0, up) for name, at in places.items()}


def space(
    s: Swing, *, up: int = 2, right: int = 0, unit_m: float = 1e-3, turned_rad: float = 0.0
) -> dict[str, Floats]:
    """(T, 3) of all points in a laboratory; markers have noise across the plane, too.

    up, right   which axis is up, and which to the right before the plane is turned about up
    """
    across = 3 - up - right
    draw = np.random.default_rng(7)
    found = {}
    for name, at in plane(s, unit_m=1.0).items():
        noise = draw.normal(0.0, 1e-4, len(at)) * (name in MARKERS)
        level, deep = at[:, 0], np.where(np.isnan(at[:, 0]), np.nan, noise)
        place = np.zeros((len(at), 3))
        place[:, up] = at[:, 1] + ORIGIN_M[1]
        place[:, right] = level * np.cos(turned_rad) - deep * np.sin(turned_rad) + ORIGIN_M[0]
        place[:, across] = level * np.sin(turned_rad) + deep * np.cos(turned_rad) + ORIGIN_M[2]
        found[name] = place / unit_m
    return found


def turns(s: Swing, normal: Sequence[float] = (0.0, 0.0, 1.0)) -> Rotation:
    """Of a body along whose −x the cable leaves it, about the plane's normal."""
    return Rotation.from_rotvec(s.angle_rad[:, None] * np.asarray(normal, dtype=np.float64))


@dataclass(frozen=True)
class MotiveExport:
    """Options of Motive's export.

    body          columns of the rigid body; without it two markers of the gripper are there
    body_markers  those of the rigid body, as it says and as they are measured
    quality       columns of errors and of markers' quality
    """

    rotation: str = "Quaternion"
    unit: str = "Meters"
    body: bool = True
    body_markers: bool = False
    unlabeled: bool = False
    quality: bool = False
    header: bool = True
    capture_hz: float = RATE_HZ
    version: str = "1.23"

    @property
    def unit_m(self) -> float:
        """Metres that one of its unit is."""
        return {"Meters": 1.0, "Centimeters": 0.01, "Millimeters": 1e-3}[self.unit]


#: Type, name, ID, quantity, axis and values of a column.
_Column = tuple[str, str, str, str, str, Floats]


def _three(kind: str, name: str, key: str, at: Floats, what: str = "Position") -> list[_Column]:
    axes = "XYZW"[: at.shape[1]]
    return [(kind, name, key, what, a, v) for a, v in zip(axes, at.T, strict=True)]


def _motive_body(s: Swing, places: dict[str, Floats], export: MotiveExport) -> list[_Column]:
    """Columns of the rigid body and of its markers."""
    turned = turns(s)
    quaternion = export.rotation == "Quaternion"
    rotation = turned.as_quat() if quaternion else turned.as_euler("XYZ", degrees=True)
    columns = _three("Rigid Body", "Gripper", "8A41", rotation, "Rotation")
    columns += _three("Rigid Body", "Gripper", "8A41", places["gripper"])
    if export.quality:
        error = np.full(len(s.t_s), 1.2e-4)
        columns.append(("Rigid Body", "Gripper", "8A41", "Mean Marker Error", "", error))
    for kind in ("Rigid Body Marker", "Marker") if export.body_markers else ():
        for k, away in enumerate(np.eye(3)):
            name, key = f"Gripper:Marker {k + 1}", f"8A41{k}"
            at = places["gripper_back"] + away * 0.02 / export.unit_m
            columns += _three(kind, name, key, at)
            if export.quality and kind != "Marker":
                columns.append((kind, name, key, "Marker Quality", "", np.ones(len(s.t_s))))
    return columns


def _motive_columns(s: Swing, export: MotiveExport) -> list[_Column]:
    places = space(s, up=1, right=0, unit_m=export.unit_m)
    columns = _motive_body(s, places, export) if export.body else []
    for name in () if export.body else POINTS[:2]:
        columns += _three("Marker", f"Rig:{name}", "77", places[name])
    for k, name in enumerate(MARKERS):
        columns += _three("Marker", f"Cable:{name}", f"80{k}", places[name])
    if export.unlabeled:
        stray = np.full((len(s.t_s), 3), np.nan)
        stray[20:60] = [0.1, 1.4, -0.6]
        stray[20:60] += np.random.default_rng(9).normal(0.0, 1e-4, (40, 3))
        columns += _three("Marker", "Unlabeled 1077", "1077", stray / export.unit_m)
    return columns


def motive(s: Swing, folder: Path, **options: Any) -> Path:
    """OptiTrack Motive, "Data Export: CSV"; y is up.  options: of `MotiveExport`."""
    export = MotiveExport(**options)
    columns = _motive_columns(s, export)
    values = cells(np.column_stack([c[5] for c in columns]), 8)
    step = round(export.capture_hz / RATE_HZ)
    rows = framed(s, values, 0, step)
    said = f"Format Version,{export.version},Take Name,{s.name},Take Notes,,Capture Frame Rate,"
    said += f"{export.capture_hz:.6f},Export Frame Rate,{RATE_HZ:.6f},Capture Start Time,"
    said += "2026-05-04 02.11.10.123 PM,Capture Start Frame,0,Total Frames in Take,"
    said += f"{len(rows)},Total Exported Frames,{len(rows)},Rotation Type,{export.rotation},"
    said += f"Length Units,{export.unit},Coordinate Space,Global\n\n"
    head = [["", "Type", *(c[0] for c in columns)], ["", "Name", *(c[1] for c in columns)]]
    head += [["", "ID", *(c[2] for c in columns)], ["", "", *(c[3] for c in columns)]]
    head += [["Frame", "Time (Seconds)", *(c[4] for c in columns)]]
    return saved(
        folder / f"{s.name}.csv", said + lines([*head, *rows]) if export.header else lines(rows)
    )


def _section(name: str, names: Sequence[str], axes: str, units: str, values: Floats,
             first: int, parts: int = 1) -> str:  # fmt: skip
    """A section of Vicon's: title, rate, names over their columns, axes, units, rows."""
    width = len(axes.split())
    head = ["", "", *(cell for n in names for cell in (n, *[""] * (width - 1)))]
    rows = [
        [str(first + k // parts), str(k % parts), *row] for k, row in enumerate(cells(values, 6))
    ]
    titles = ["Frame", "Sub Frame", *axes.split() * len(names)]
    below = ["", "", *units.split() * len(names)]
    return lines([[name], [f"{RATE_HZ * parts:.0f}"], head, titles, below, *rows]) + "\n"


def nexus(
    s: Swing, folder: Path, *, sections: Sequence[str] = ("Trajectories",), subject: str = "rig:",
    first: int = 1, semicolons: bool = False,
) -> Path:  # fmt: skip
    """Vicon Nexus, "Export data to ASCII"; z is up."""
    places = space(s, up=2, right=0)
    made = {
        "Trajectories": lambda: _section(
            "Trajectories", [f"{subject}{n}" for n in POINTS], "X Y Z", "mm mm mm",
            np.hstack([places[n] for n in POINTS]), first),
        "Devices": lambda: _section(
            "Devices", ["Force Plate 1 - Force", "Force Plate 1 - Moment"], "Fx Fy Fz",
            "N N N", np.random.default_rng(3).normal(0.0, 0.3, (5 * len(s.t_s), 6)), first, 5),
        "Model Outputs": lambda: _section(
            "Model Outputs", [f"{subject}ElbowAngles"], "X Y Z", "deg deg deg",
            np.random.default_rng(4).normal(20.0, 1.0, (len(s.t_s), 3)), first),
    }  # fmt: skip
    text = "".join(made[name]() for name in sections)
    return saved(folder / f"{s.name}.csv", text.replace(",", ";") if semicolons else text)


def vicon_tracker(s: Swing, folder: Path) -> Path:
    """Vicon Tracker: the section Objects, a rotation vector in degrees and millimetres each."""
    places = space(s, up=2, right=0)
    still = np.zeros((len(s.t_s), 3))
    turned = np.degrees(turns(s, (0.0, -1.0, 0.0)).as_rotvec())
    values = np.hstack([turned, places["gripper"], *(
        v for n in MARKERS for v in (still, places[n])
    )])  # fmt: skip
    names = ["Gripper:Gripper", *(f"{n}:{n}" for n in MARKERS)]
    text = _section("Objects", names, "RX RY RZ TX TY TZ", "deg deg deg mm mm mm", values, 1)
    return saved(folder / f"{s.name}.csv", text)


@dataclass(frozen=True)
class QtmExport:
    """Options of Qualisys Track Manager's export.

    counted  columns of frame and time; names: a row of names; types: a row of types
    lost     what is written where a marker is not seen
    """

    counted: bool = True
    names: bool = True
    types: bool = True
    lost: str = "0.000"
    version: bool = False
    turned_rad: float = 0.0


def _qtm_head(s: Swing, markers: int) -> list[str]:
    head = [f"NO_OF_FRAMES\t{len(s.t_s)}", "NO_OF_CAMERAS\t8", f"NO_OF_MARKERS\t{markers}"]
    head += [f"FREQUENCY\t{RATE_HZ:.0f}", "NO_OF_ANALOG\t0", "ANALOG_FREQUENCY\t0"]
    return [*head, "DESCRIPTION\t--", "TIME_STAMP\t2026-05-04, 14:11:10.201\t3581.02313870"]


def qtm(s: Swing, folder: Path, shown: Sequence[str] = POINTS, **options: Any) -> Path:
    """Qualisys Track Manager, "Motion data (.tsv)"; z is up.  options: of `QtmExport`."""
    export = QtmExport(**options)
    places = space(s, up=2, right=1, turned_rad=export.turned_rad)
    head = ["FILE_VERSION\t2.0.0"] if export.version else []
    head += [*_qtm_head(s, len(shown)), "DATA_INCLUDED\t3D", "MARKER_NAMES\t" + "\t".join(shown)]
    if export.types:
        head.append("TRAJECTORY_TYPES\t" + "\t".join(["Measured"] * len(shown)))
    titles = ["Frame", "Time"] if export.counted else []
    titles += [f"{n} {a}" for n in shown for a in "XYZ"]
    head += ["\t".join(titles)] if export.names else []
    values = cells(np.hstack([places[n] for n in shown]), 5, export.lost)
    text = lines(framed(s, values, 1, decimals=5) if export.counted else values, "\t")
    return saved(folder / f"{s.name}.tsv", "\n".join(head) + "\n" + text, newline="\r\n")


def qtm_bodies(s: Swing, folder: Path) -> tuple[Path, Path]:
    """The same of the markers, and "6DOF data (.tsv)" of the gripper."""
    # The plane is that of y and z: a positive turn about x is the angle's.
    rotation = turns(s, (1.0, 0.0, 0.0))
    matrices = rotation.as_matrix().transpose(0, 2, 1).reshape(len(s.t_s), 9)
    at = space(s, up=2, right=1)["gripper"]
    error = np.full(len(s.t_s), 0.2)
    values = np.column_stack([at, rotation.as_euler("xyz", degrees=True), error, matrices])
    names = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{i}]" for i in range(9))]
    head = [*_qtm_head(s, len(MARKERS)), "DATA_INCLUDED\t6D", "BODY_NAMES\tgripper"]
    head += ["\t".join(["Frame", "Time", *(f"gripper {n}" for n in names)])]
    rows = framed(s, cells(values, 7), 1, decimals=5)
    return qtm(s, folder, MARKERS), saved(
        folder / f"{s.name}_6D.tsv", "\n".join(head) + "\n" + lines(rows, "\t"), newline="\r\n"
    )


def trc(
    s: Swing, folder: Path, *, unit: str = "mm", original_hz: float = RATE_HZ, first: int = 1,
    cut: bool = False, keys: bool = True,
) -> Path:  # fmt: skip
    """OpenSim, "Marker (.trc) files"; y is up.  cut: nothing is written behind the last marker."""
    places = space(s, up=1, right=0, unit_m={"mm": 1e-3, "m": 1.0, "cm": 0.01}[unit])
    names = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate"]
    said = [f"{RATE_HZ:.2f}", f"{original_hz:.2f}", len(s.t_s), len(POINTS), unit, original_hz]
    if keys:
        names += ["OrigDataStartFrame", "OrigNumFrames"]
        said += [first, len(s.t_s)]
    head = f"PathFileType\t4\t(X/Y/Z)\t{s.name}.trc\n" + lines([names, said], "\t")
    head += "Frame#\tTime\t" + "\t\t\t".join(POINTS) + "\t\t\n"
    head += "\t\t" + "\t".join(f"{a}{i + 1}" for i in range(len(POINTS)) for a in "XYZ") + "\n\n"
    values = cells(np.hstack([places[n] for n in POINTS]), 8)
    rows = ["\t".join(row) for row in framed(s, values, first)]
    return saved(
        folder / f"{s.name}.trc",
        head + "\n".join(row.rstrip("\t") if cut else row for row in rows) + "\n",
    )


def storage(s: Swing, folder: Path) -> Path:
    """OpenSim, a storage file: its header ends with `endheader`; metres and degrees."""
    at = plane(s, unit_m=1.0)
    names = [f"{n}_t{a}" for n in ("gripper", *MARKERS) for a in "xy"]
    values = np.hstack([s.t_s[:, None], *(at[n] for n in ("gripper", *MARKERS)),
                        np.degrees(s.angle_rad)[:, None]])  # fmt: skip
    head = f"{s.name}\nversion=1\nnRows={len(values)}\nnColumns={values.shape[1]}\ninDegrees=yes\n"
    head += "endheader\n" + "\t".join(["time", *names, "gripper_angle"]) + "\n"
    return saved(folder / f"{s.name}.sto", head + lines(cells(values, 8), "\t"))


def kinovea(s: Swing, folder: Path, *, form: str) -> Path:
    """Kinovea's tables of trajectories: `csv` in cm, `ms` with millisecond times, `pixels`."""
    at = plane(s, up=1.0, unit_m=0.01) if form != "pixels" else plane(s, up=-1.0, unit_m=0.0005)
    mark, separator = (",", ";") if form == "csv" else (".", ",")
    time = s.t_s * 1e3 if form == "ms" else s.t_s
    titles = [f"Time ({'ms' if form == 'ms' else 's'})"]
    titles += [f"{n}/{a}" for n in POINTS for a in "XY"]
    if form == "csv":
        titles = ["Time", *(f"{n} {a} (cm)" for n in POINTS for a in "XY")]
    values = np.hstack([time[:, None], *(at[n] for n in POINTS)])
    return saved(folder / f"{s.name}.csv", lines([titles, *cells(values, 7, mark=mark)], separator))


def kinovea_text(s: Swing, folder: Path) -> Path:
    """Kinovea's text of trajectories: a block for each point, times as h:mm:ss.fff, cm."""
    blocks = ["#Kinovea Trajectory data export\n#T X Y\n"]
    for name, at in plane(s, unit_m=0.01).items():
        stamps = [f"0:00:{t:06.3f}" for t in s.t_s]
        rows = [[t, *row] for t, row in zip(stamps, cells(at, 6), strict=True)]
        blocks.append(f"# {name}\n" + lines(rows, " ") + "\n")
    return saved(folder / f"{s.name}.txt", "\n".join(blocks))


def tracker(s: Swing, folder: Path, *, mark: str = ".", separator: str = "\t") -> Path:
    """Tracker (Open Source Physics): tracks above their columns, powers of ten, metres."""
    at = plane(s, unit_m=1.0)
    values = np.hstack([s.t_s[:, None], *(at[n] for n in POINTS)])
    rows = [["" if v != v else f"{v:.9E}".replace(".", mark) for v in row] for row in values]
    head = [["", *(c for n in POINTS for c in (n, ""))], ["t", *["x", "y"] * len(POINTS)]]
    return saved(folder / f"{s.name}.txt", lines([*head, *rows], separator))


def likelihood(s: Swing) -> tuple[Floats, Floats]:
    """Pixels (T, points, 2) with a wrong place where a point is not seen, and (T, points)."""
    pixels = np.stack(list(plane(s, up=-1.0, unit_m=0.0005).values()), axis=1)
    pixels += np.array([900.0, 300.0])
    unseen = np.isnan(pixels).any(axis=2)
    pixels[unseen] = (17.25, 1011.5)
    return pixels, np.where(unseen, 0.013, 0.9987)


def deeplabcut(s: Swing, folder: Path) -> Path:
    """DeepLabCut: rows scorer, bodyparts and coords above numbers of frames; y counts downwards."""
    pixels, found = likelihood(s)
    scorer = ["DLC_resnet50_cableMay4shuffle1_100000"] * (3 * len(POINTS))
    head = [["scorer", *scorer], ["bodyparts", *(n for n in POINTS for _ in range(3))]]
    head += [["coords", *["x", "y", "likelihood"] * len(POINTS)]]
    values = np.concatenate([pixels, found[:, :, None]], axis=2).reshape(len(s.t_s), -1)
    rows = [[str(k), *row] for k, row in enumerate(cells(values, 7))]
    return saved(folder / f"{s.name}DLC.csv", lines([*head, *rows]))


def sleap(s: Swing, folder: Path, *, track: str = "") -> Path:
    """SLEAP, analysis CSV: node.x, node.y, node.score; nothing where a node is not seen."""
    pixels, score = likelihood(s)
    unseen = score < 0.5
    values = np.concatenate([pixels, score[:, :, None]], axis=2)
    values[unseen] = np.nan
    head = ["track", "frame_idx", "instance.score"]
    head += [f"{n}.{a}" for n in POINTS for a in ("x", "y", "score")]
    rows = [
        [track, str(k), "0.98", *row]
        for k, row in enumerate(cells(values.reshape(len(s.t_s), -1), 7))
    ]
    return saved(folder / f"{s.name}.csv", lines([head, *rows]))


def phasespace(s: Swing, folder: Path) -> Path:
    """PhaseSpace: id, condition and place of every marker; a condition of −1 means not seen."""
    places = space(s, up=1, right=0)
    titles = ["frame", "time"]
    titles += [f"{n} {what}" for n in POINTS for what in ("cond", "x", "y", "z")]
    blocks = []
    for name in POINTS:
        condition = np.where(np.isnan(places[name][:, :1]), -1.0, 4.2)
        blocks += [condition, np.nan_to_num(places[name])]
    values = np.hstack(blocks)
    rows = framed(s, cells(values, 6))
    return saved(folder / f"{s.name}.csv", lines([titles, *rows]))


def first_principles(s: Swing, folder: Path) -> Path:
    """NDI First Principles: remarks in pairs of cells, numbers of frames, millimetres."""
    places = space(s, up=1, right=0)
    head = [["Number of frames:", str(len(s.t_s))], ["Frequency:", f"{RATE_HZ:.0f}"]]
    head += [["Units:", "mm"], [""], ["Frame", *(f"{n} {a}" for n in POINTS for a in "xyz")]]
    values = cells(np.hstack([places[n] for n in POINTS]), 6, "MISSING")
    return saved(
        folder / f"{s.name}.csv", lines([*head, *([str(k + 1), *v] for k, v in enumerate(values))])
    )


def plotjuggler(s: Swing, folder: Path) -> Path:
    """PlotJuggler: a column for each field of each topic, the time since 1970 in the first."""
    places = space(s, up=2, right=0, unit_m=1.0)
    x, y, z, w = turns(s, (0.0, -1.0, 0.0)).as_quat().T
    columns = {"__time": s.t_s + 1.75e9}
    for name in ("gripper", *MARKERS):
        for k, axis in enumerate("xyz"):
            columns[f"/{name}/pose/position/{axis}"] = places[name][:, k]
    for axis, values in zip("xyzw", (x, y, z, w), strict=True):
        columns[f"/gripper/pose/orientation/{axis}"] = values
    return saved(
        folder / f"{s.name}.csv",
        lines([list(columns), *cells(np.column_stack(list(columns.values())), 9)]),
    )
