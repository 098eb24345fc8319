"""A known swing as texts of programs that write what others do not: own endings and encodings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from .swing import MARKERS, RATE_HZ, Swing
from .text import POINTS, Floats, cells, framed, lines, plane, saved, space, trc


def own_ending(s: Swing, folder: Path) -> Path:
    """A tracker's text under an ending of its own, `.emt`, with a header of keys and y up."""
    at = space(s, up=1, right=0, unit_m=1.0)
    names = ["apex", *MARKERS[:-1], "hand_dist", "hand_prox"]
    shown = np.hstack([at[n] for n in (MARKERS[-1], *MARKERS[:-1], "gripper", "gripper_back")])
    head = [
        "BTS ASCII format",
        "",
        "Type:\tPoint 3D tracks",
        "Measure unit:\tm",
        "",
        f"Tracks:\t{len(names)}",
        f"Frequency:\t{RATE_HZ:g} Hz",
        "Start time:\t0.000",
        "",
    ]
    titles = ["Frame", "Time", *(f"{n}.{a}" for n in names for a in "XYZ")]
    rows = framed(s, cells(shown, 9), 1)
    return saved(folder / f"{s.name}.emt", "\n".join(head) + "\n" + lines([titles, *rows], "\t"))


def chinese(s: Swing, folder: Path) -> Path:
    """A TRC file whose header names a folder in GBK."""
    file = trc(s, folder)
    text = file.read_text().replace(f"\t{s.name}.trc", f"\tD:\\动作捕捉\\线缆实验\\{s.name}.trc")
    file.write_bytes(text.encode("gbk"))
    return file


def line_protocol(s: Swing, folder: Path, *, runs: tuple[Swing, ...] = ()) -> Path:
    """InfluxDB's line protocol, mm and ns: a line per point and time, in no order."""
    found: list[str] = []
    for k, run in enumerate(runs or (s,)):
        start_ns = 1_719_403_200_417_000_000 + k * 60_000_000_000
        for i, t in enumerate(run.t_s):
            time, turn = start_ns + round(t * 1e9), run.angle_rad[i]
            for name, at in zip(MARKERS, run.markers_m[i] * 1e3, strict=True):
                point = f"cable,marker={name},run={run.name}"
                found.append(f"{point} x_mm={at[0]:.6f},y_mm={at[1]:.6f} {time}")
            x, y = run.gripper_m[i] * 1e3
            place = f"x_mm={x:.6f},y_mm={y:.6f},angle_rad={turn:.7f}"
            found.append(f"gripper,run={run.name} {place} {time}")
    found += [f"climate,room=lab3 t_c=21.{k} {1_719_403_200_417_000_000 + k}" for k in range(5)]
    order = np.random.default_rng(1).permutation(len(found))
    head = "# DDL\nCREATE DATABASE cable WITH NAME autogen\n# DML\n"
    return saved(folder / f"{s.name}.lp", head + "\n".join(found[i] for i in order) + "\n")


def legend(s: Swing, folder: Path) -> Path:
    """Adams' tabular export: columns are letters, which a list above them explains."""
    at = plane(s)
    said = [f"{n}_D{a} ({'mm'})" for n in ("gripper", *MARKERS) for a in "XY"]
    named = ["Time (sec)", *(f".CABLE.{n}" for n in said), ".CABLE.gripper_PSI (deg)"]
    letters = [chr(ord("A") + i) for i in range(len(named))]
    values = np.hstack([s.t_s[:, None], *(at[n] for n in ("gripper", *MARKERS)),
                        np.degrees(s.angle_rad)[:, None]])  # fmt: skip
    head = ["  ", "  Adams/View  2022.1", "  "]
    head += [f"  {c}. {n}" for c, n in zip(letters, named, strict=True)] + ["  "]
    rows = lines([letters, *cells(values, 8)], "\t")
    return saved(folder / f"{s.name}.tab", "\n".join(head) + "\n" + rows, newline="\r\n")


def vectors(s: Swing, folder: Path) -> Path:
    """OpenSim's storage with the three coordinates of a marker in one cell."""
    at = space(s, up=1, right=0)
    rows = [[f"{t:.5f}", *(",".join(cells(at[n][i : i + 1], 7)[0]) for n in POINTS)]
            for i, t in enumerate(s.t_s)]  # fmt: skip
    head = f"{s.name}\nDataRate={RATE_HZ:.6f}\nDataType=Vec3\nUnits=mm\nversion=3\nendheader\n"
    return saved(folder / f"{s.name}.sto", head + lines([["time", *POINTS], *rows], "\t"))


def stamped_json(s: Swing, folder: Path) -> Path:
    """Messages of two topics as JSON: each with its stamp, and when it was received; one twice."""
    found = []
    for i, t in enumerate(s.t_s):
        sent_ns = 1_712_045_533_000_000_000 + round(t * 1e9)

        def of(topic: str, content: dict[str, object], sent_ns: int = sent_ns) -> dict[str, object]:
            late_ns = sent_ns + 1_117_946
            times = [{"sec": ns // 10**9, "nsec": ns % 10**9} for ns in (late_ns, sent_ns)]
            header = {"stamp": times[1], "frame_id": "base"}
            return {"topic": topic, "receiveTime": times[0], "schemaName": "a/B",
                    "message": {"header": header, **content}}  # fmt: skip

        x, y = map(float, s.gripper_m[i])
        turn = float(s.angle_rad[i]) / 2
        place = {"x": x, "y": 0.0, "z": y}
        turned = {"x": 0.0, "y": -np.sin(turn), "z": 0.0, "w": np.cos(turn)}
        found.append(of("/ee_pose", {"pose": {"position": place, "orientation": turned}}))
        points = [{"x": p[0], "y": 0.0, "z": p[1]} for p in s.markers_m[i].tolist()]
        found.append(of("/cable/points", {"points": points}))
        found += found[-1:] * (i == 20)
    return saved(folder / f"{s.name}.json", json.dumps(found))


def received_twice(s: Swing, folder: Path) -> Path:
    """A row per message and point, with two times; some messages were received twice."""
    rows: list[list[object]] = []
    for i, t in enumerate(s.t_s):
        sent_ns = 1_718_700_412_118_340_021 + round(t * 1e9)
        places = [s.gripper_m[i], *s.markers_m[i], s.back_m[i]]
        for late_ns in (12_000_000, 12_100_000)[: 1 + (i % 40 == 7)]:
            for k, at in enumerate(places):
                name = {0: "gripper", len(places) - 1: "gripper_back"}.get(k, f"m{k}")
                rows.append([sent_ns + late_ns, sent_ns, "base", name, *cells(at[None], 8)[0]])
    head = ["bag_time_ns", "header_stamp_ns", "frame_id", "name", "x", "y"]
    return saved(folder / f"{s.name}.csv", lines([head, *rows]))


def labview(s: Swing, folder: Path) -> Path:
    """LabVIEW's text with decimal commas and a comment in its first row only."""
    at = plane(s)
    names = [f"{n} {a} [mm]" for n in POINTS for a in "xy"]
    count = len(names)
    head = ["LabVIEW Measurement\t", "Separator\tTab", "Decimal_Separator\t,",
            "X_Columns\tOne", "***End_of_Header***\t", "\t"]  # fmt: skip
    properties = [["Channels", str(count)], ["Samples", *["150"] * count],
                  ["Y_Unit_Label", *["mm"] * count], ["X0", *["0,0000000000000000E+0"] * count],
                  ["Delta_X", *["0,005"] * count], ["***End_of_Header***"]]  # fmt: skip
    head += ["\t".join(words).ljust(0) + "\t" for words in properties]
    values = np.hstack([s.t_s[:, None], *(at[n] for n in POINTS)])
    rows = cells(values, 7, mark=",")
    rows[0].append("Trigger")
    table = lines([["X_Value", *names, "Comment"], *rows], "\t")
    return saved(folder / f"{s.name}.lvm", "\n".join(head) + "\n" + table, newline="\r\n")


def octave(s: Swing, folder: Path, *, ending: str = "txt") -> Path:
    """Octave's text of variables: a range, a structure and matrices with gaps."""

    def matrix(name: str, values: Floats) -> str:
        rows = "\n".join(" " + " ".join(row) for row in cells(values, 9, lost="NaN"))
        size = f"# rows: {len(values)}\n# columns: {values.shape[1]}"
        return f"# name: {name}\n# type: matrix\n{size}\n{rows}\n\n\n"

    steps = f"0 {s.t_s[-1]:.15g} {1 / RATE_HZ:g}"
    head = "# Created by Octave 8.4.0, Mon Jun 03 10:11:12 2024 UTC <lab@pc>\n# name: time_s\n"
    head += f"# type: double_range\n# base, limit, increment\n{steps}\n\n\n# name: gripper\n"
    head += "# type: scalar struct\n# ndims: 2\n 1 1\n# length: 2\n"
    variables = [matrix("at_m", s.gripper_m), matrix("angle_rad", s.angle_rad[:, None]), "\n",
                 *(matrix(f"{n}_m", at) for n, at in zip(MARKERS, s.markers_m.swapaxes(0, 1),
                                                        strict=True))]  # fmt: skip
    return saved(folder / f"{s.name}.{ending}", head + "".join(variables))


def aruco(s: Swing, folder: Path) -> Path:
    """Corners of square tags in pixels, a frame in each line, as OpenCV detects them."""
    found = []
    square = 20.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    for i, t in enumerate(s.t_s):
        tags = [{"id": 40 + k, "name": name, "corners": (at[i] + square).round(6).tolist()}
                for k, (name, at) in enumerate(plane(s, up=-1.0, unit_m=0.0005).items())
                if np.isfinite(at[i]).all()]  # fmt: skip
        found.append(json.dumps({"time_s": t, "tags": tags}))
    return saved(folder / f"{s.name}.jsonl", "\n".join(found))


def blocks(s: Swing, folder: Path, *, gap: str = "\n\n") -> Path:
    """gnuplot's blocks of a frame each below a comment with its time; `gap` is between them."""
    found = "# cable, plot with index\n# columns: point x[mm] y[mm]; in the picture\n"
    for i, t in enumerate(s.t_s):
        rows = [[n, *cells(at[i : i + 1], 6)[0]] for n, at in plane(s).items()]
        found += f"# t = {t:.5f} s\n" + lines([r for r in rows if r[1]], " ") + gap
    return saved(folder / f"{s.name}.dat", found)
