"""A known swing as tables of spreadsheets, logs of robots, encoders and accelerometers."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .swing import BEGINS_S, ENDS_S, MARKERS, Swing
from .text import cells, lines, saved, space, turns

Floats = NDArray[np.float64]
#: When the measurement began; of a spreadsheet, days since the end of 1899.
_BEGAN = datetime(2026, 5, 4, 14, 11, 10)
SERIAL_DAYS = 46146.0 + (14 * 3600 + 11 * 60 + 10) / 86400.0
#: Where a robot's base is, m from the origin of the markers: right, up.
BASE_M = (-0.45, -0.2)
_WORDS = {
    "de": ("Zeit", "Greifer", "Winkel Greifer", "#NV"),
    "fr": ("Temps", "Pince gripper", "Angle gripper", "#N/A"),
    "en": ("Time", "Gripper", "Gripper angle", "#N/A"),
}


def sheet(s: Swing, *, language: str = "en", shift_mm: float = 0.0) -> tuple[list[str], Floats]:
    """Names and (rows, columns) of a table in s, mm and degrees."""
    time, gripper, angle, _ = _WORDS[language]
    names = [f"{time} [s]", f"{gripper} X [mm]", f"{gripper} Y [mm]"]
    names += [f"{n} {a} [mm]" for n in MARKERS for a in "XY"] + [f"{angle} [°]"]
    places = np.hstack([s.gripper_m, s.markers_m.reshape(len(s.t_s), -1)]) * 1e3 + shift_mm
    return names, np.column_stack([s.t_s, places, np.degrees(s.angle_rad)])


def moments(s: Swing, form: str) -> list[str]:
    """Times of rows as a spreadsheet shows them: a date with a time, or its number of days."""
    if form == "serial":
        return [f"{SERIAL_DAYS + t / 86400.0:.10f}" for t in s.t_s]
    at = [_BEGAN + timedelta(seconds=round(t, 6)) for t in s.t_s]
    if form == "en":
        return [f"{a.month}/{a.day}/{a.year} {a:%I:%M:%S}.{a.microsecond // 1000:03d} {a:%p}"
                for a in at]  # fmt: skip
    if form == "clock":
        return [f"{a:%H:%M:%S}.{a.microsecond // 1000:03d}" for a in at]
    if form == "coarse":
        return [f"{a:%d.%m.%Y %H:%M:%S}" for a in at]
    return [f"{a:%d.%m.%Y %H:%M:%S},{a.microsecond // 1000:03d}" for a in at]


def excel(
    s: Swing, folder: Path, *, language: str, thousands: str = "", times: str = "seconds",
    encoding: str = "utf-8-sig", codes: bool = False,
) -> Path:  # fmt: skip
    """A spreadsheet saved as CSV under one language's settings.

    thousands  separator of thousands; the places are then 5 m from their origin
    times      seconds, serial (days), or a date and time as a language writes it
    codes      what is not seen is the spreadsheet's code of an error, not an empty cell
    """
    separator, mark = (",", ".") if language == "en" else (";", ",")
    names, values = sheet(s, language=language, shift_mm=5000.0 if thousands else 0.0)
    rows = cells(values, 7 if thousands == "" else 6, _WORDS[language][3] if codes else "", mark)
    if thousands:
        rows = [[_grouped(c, thousands, mark) for c in row] for row in rows]
    if times != "seconds":
        names[0] = names[0].split()[0]
        stamps = moments(s, times)
        stamps = [m.replace(".", mark) for m in stamps] if times == "serial" else stamps
        rows = [[m, *row[1:]] for m, row in zip(stamps, rows, strict=True)]
    if language == "en":
        rows = [[f'"{c}"' if "," in c else c for c in row] for row in rows]
    file = folder / f"{s.name}.csv"
    file.write_bytes(lines([names, *rows], separator).encode(encoding))
    return file


def _grouped(cell: str, thousands: str, mark: str) -> str:
    whole, _, part = cell.partition(mark)
    return f"{int(whole):,}".replace(",", thousands) + mark + part if part else cell


def workbook(s: Swing, folder: Path, *, dates: bool = False, title: bool = False) -> Path:
    """A spreadsheet's own file; `title`: its first sheet holds notes, the second the table."""
    from openpyxl import Workbook

    names, values = sheet(s)
    book = Workbook()
    page = book.active
    if title:
        page.append(["Measured on Monday", "by hand"])
        page = book.create_sheet("Data")
        page.append(["swing of a cable"])
        page.append([])
    if dates:
        names[0] = "Time"
    page.append(names)
    for row in values:
        first = [_BEGAN + timedelta(seconds=float(row[0]))] if dates else [float(row[0])]
        page.append([*first, *(None if v != v else float(v) for v in row[1:])])
    file = folder / f"{s.name}.xlsx"
    book.save(file)
    return file


def plain(s: Swing, folder: Path, *, style: str) -> Path:
    """A table of a script: `pandas`, `r`, `labview`, `arduino`, `gnuplot` or `matlab`."""
    names, values = sheet(s)
    names = [n.replace("[", "(").replace("]", ")").replace("°", "deg") for n in names]
    rows = cells(values, 7, "NA" if style == "r" else "NaN" if style == "matlab" else "")
    file = folder / f"{s.name}.{ {'labview': 'lvm', 'gnuplot': 'dat'}.get(style, 'csv') }"
    if style == "pandas":
        rows = [[str(k), *row] for k, row in enumerate(rows)]
        text = lines([["", *names], *rows])
    elif style == "r":
        head = [f'"{n}"' for n in ["", *names]]
        text = lines([head, *([f'"{k + 1}"', *row] for k, row in enumerate(rows))])
    elif style == "labview":
        said = "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\n"
        said += "Decimal_Separator\t.\nX_Columns\tOne\nTime_Pref\tRelative\nDate\t2026/05/04\n"
        said += "Time\t14:11:10.2\n***End_of_Header***\t\n\n"
        said += "\t".join(["Channels", str(len(names) - 1)]) + "\n***End_of_Header***\t\n"
        names[0] = "X_Value"
        text = said + lines([[*names, "Comment"], *([*row, ""] for row in rows)], "\t")
    elif style == "arduino":
        names[0] = "millis"
        milliseconds = [[f"{1e3 * s.t_s[k]:.0f}", *row[1:]] for k, row in enumerate(rows)]
        text = "Ready.\n" + lines([names, *milliseconds])
    elif style == "matlab":
        text = lines(
            [[n.replace(" ", "_").replace("(", "").replace(")", "") for n in names], *rows]
        )
    else:
        text = "# " + lines([[n.replace(" ", "_") for n in names]], " ") + lines(rows, " ")
    file.write_text(text)
    return file


def markers_file(s: Swing, folder: Path) -> Path:
    """Markers only, of a camera, in mm."""
    titles = [f"{n}_{a}_mm" for n in MARKERS for a in "xy"]
    values = np.column_stack([s.t_s, s.markers_m.reshape(len(s.t_s), -1) * 1e3])
    return saved(folder / f"{s.name}.csv", lines([["t_s", *titles], *cells(values, 6)]))


#: Tool of an arm that points down: its x is against the base's.
_DOWN = Rotation.from_rotvec([0.0, np.pi, 0.0])


def _poses(s: Swing, in_base: bool = True) -> tuple[Floats, Rotation]:
    """(T, 3) TCP of an arm whose z is up, m, and its turn; else in the markers' frame."""
    offset = BASE_M if in_base else (0.0, 0.0)
    place = np.column_stack(
        [s.gripper_m[:, 0] - offset[0], np.full(len(s.t_s), -0.3), s.gripper_m[:, 1] - offset[1]]
    )
    return place, turns(s, (0.0, -1.0, 0.0))


def ur(s: Swing, folder: Path, *, separator: str = " ", in_base: bool = True) -> tuple[Path, Path]:
    """Universal Robots' record of RTDE: metres and a rotation vector of a tool that points down."""
    place, turn = _poses(s, in_base)
    vectors = (turn * _DOWN).as_rotvec()
    titles = ["timestamp", *[f"actual_q_{i}" for i in range(6)]]
    titles += [f"actual_TCP_pose_{i}" for i in range(6)]
    angles = np.tile([0.1, -1.2, 1.4, -1.7, -1.5, 0.2], (len(s.t_s), 1))
    values = np.column_stack([s.t_s, angles, place, vectors])
    return markers_file(s, folder), saved(
        folder / f"{s.name}_record.csv", lines([titles, *cells(values, 9)], separator)
    )


def _robot(s: Swing, folder: Path, titles: Sequence[str], values: Floats, separator: str,
           mark: str = ".") -> tuple[Path, Path]:  # fmt: skip
    return markers_file(s, folder), saved(
        folder / f"{s.name}_robot.csv", lines([titles, *cells(values, 8, mark=mark)], separator)
    )


def kuka(s: Swing, folder: Path, *, german: bool = False) -> tuple[Path, Path]:
    """KUKA's trace of $POS_ACT: mm, and degrees about z, y and x."""
    place, turn = _poses(s)
    angles = turn.as_euler("ZYX", degrees=True)
    titles = ["Zeit [s]" if german else "Time [s]"]
    titles += [f"$POS_ACT.{a} [mm]" for a in "XYZ"] + [f"$POS_ACT.{a} [°]" for a in "ABC"]
    values = np.column_stack([s.t_s, place * 1e3, angles])
    return _robot(s, folder, titles, values, ";", "," if german else ".")


def abb(s: Swing, folder: Path) -> tuple[Path, Path]:
    """ABB's robtarget: mm, and a quaternion q1 … q4 that begins with its real part."""
    place, turn = _poses(s)
    x, y, z, w = turn.as_quat().T
    titles = ["time_s", "tcp_x_mm", "tcp_y_mm", "tcp_z_mm", "q1", "q2", "q3", "q4"]
    values = np.column_stack([s.t_s, place * 1e3, w, x, y, z])
    return _robot(s, folder, titles, values, ",")


def fanuc(s: Swing, folder: Path) -> tuple[Path, Path]:
    """Fanuc's position registers: mm, and degrees W, P, R about x, y and z."""
    place, turn = _poses(s)
    angles = turn.as_euler("xyz", degrees=True)
    titles = ["Time(ms)", "X", "Y", "Z", "W", "P", "R"]
    values = np.column_stack([s.t_s * 1e3, place * 1e3, angles])
    return _robot(s, folder, titles, values, ",")


def franka(s: Swing, folder: Path) -> tuple[Path, Path]:
    """Franka's O_T_EE: 16 numbers of a pose, columns one after the other, metres."""
    place, turn = _poses(s)
    pose = np.tile(np.eye(4), (len(s.t_s), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = turn.as_matrix(), place
    titles = ["time", *(f"O_T_EE[{i}]" for i in range(16))]
    values = np.column_stack([s.t_s, pose.transpose(0, 2, 1).reshape(len(s.t_s), 16)])
    return _robot(s, folder, titles, values, ",")


def planar_log(s: Swing, folder: Path, *, unit: str = "", unit_m: float = 1.0) -> tuple[Path, Path]:
    """A script's log of an arm in the markers' plane and frame, radians, beside camera's mm."""
    titles = ["timestamp", f"tcp_x{unit}", f"tcp_y{unit}", "tcp_rz"]
    return _robot(
        s, folder, titles, np.column_stack([s.t_s, s.gripper_m / unit_m, s.angle_rad]), ","
    )


def laboratory_log(s: Swing, folder: Path, *, begins_s: float) -> Path:
    """A gripper's places in the laboratory's frame, z up, mm, and its angle in degrees."""
    values = np.column_stack([s.t_s + begins_s, space(s)["gripper"], np.degrees(s.angle_rad)])
    file = folder / f"{s.name}_robot.csv"
    titles = ["t_s", "tcp_x_mm", "tcp_y_mm", "tcp_z_mm", "tcp_angle_deg"]
    file.write_text(lines([titles, *cells(values, 7)]))
    return file


def encoder_on_axle(s: Swing, folder: Path, *, counts: int = 0) -> tuple[Path, Path]:
    """An encoder of the arm's axle: degrees, or counts of a turn."""
    if counts:
        titles, values = ["time_s", "encoder"], np.round(s.angle_rad / (2 * np.pi) * counts)
        shown = [[f"{t:.6f}", f"{v:.0f}"] for t, v in zip(s.t_s, values, strict=True)]
    else:
        titles = ["time_s", "encoder [deg]"]
        shown = cells(np.column_stack([s.t_s, np.degrees(s.angle_rad)]), 8)
    return markers_file(s, folder), saved(folder / f"{s.name}_encoder.csv", lines([titles, *shown]))


def encoder_of_rail(s: Swing, folder: Path) -> tuple[Path, Path]:
    """A linear encoder of a vertical axis, mm from where it began."""
    file = folder / f"{s.name}_encoder.csv"
    rows = cells(np.column_stack([s.t_s, s.gripper_m[:, 1] * 1e3]), 8)
    file.write_text(lines([["time_s", "encoder_y_mm"], *rows]))
    return markers_file(s, folder), file


#: Rows a second of an accelerometer.
ACCELEROMETER_HZ = 2000.0


def accelerometer(
    s: Swing, folder: Path, *, way_m: float, names: Sequence[str], unit: float = 1.0
) -> tuple[Path, Path]:
    """A quiet sensor on a clamp that does not turn: its x is along the clamp, its y across.

    way_m  by which the gripper goes down
    unit   m/s² that one of the file's is
    """
    t = np.arange(round(s.t_s[-1] * ACCELEROMETER_HZ) + 1) / ACCELEROMETER_HZ
    lasts_s = ENDS_S - BEGINS_S
    u = np.clip((t - BEGINS_S) / lasts_s, 0.0, 1.0)
    up = -way_m * (60.0 * u - 180.0 * u**2 + 120.0 * u**3) / lasts_s**2 + 9.81
    angle = s.angle_rad[0]
    values = np.column_stack([t, -np.sin(-angle) * up, np.cos(angle) * up])
    values[:, 1:] += np.random.default_rng(5).normal(0.0, 1e-3, (len(t), 2))
    values[:, 1:] /= unit
    return markers_file(s, folder), saved(
        folder / f"{s.name}_sensor.csv", lines([names, *cells(values, 9)])
    )
