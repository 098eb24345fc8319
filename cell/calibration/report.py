"""Reports of calibrations: one self-contained HTML page each, with pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

import cv2
import numpy as np

from calib.board import BoardView
from calib.camera import CameraFit, picture_grid
from calib.cell import CellFit
from calib.grip import GripFit, GripView
from calib.plane import PlaneView
from calib.store import StoredCalibration
from calib.timing import Delay
from cell.cable.arrays import FloatArray
from cell.calibration.conclude import Times
from cell.calibration.raw import DetectedMove, NamedImage, ShownCell
from cell.settings import Settings
from cell.settings.calibrated import CIRCLE_95
from drivers.interfaces import Image

#: Length of the longest arrow in a picture of residuals.
_ARROW_PX = 60.0
#: Width and height of the part of a picture that is shown enlarged.
_PART_PX = (240, 130)

_STYLE = """
body{font:16px/1.45 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222}
h1{font-size:1.5em;margin-bottom:.2em}h2{font-size:1.15em;margin-top:2em}.note{color:#555}
.says{font-size:1.2em;padding:.7em 1em;background:#eef4f5;border-left:6px solid #00798c}
table{border-collapse:collapse;margin:.8em 0}td,th{padding:.25em .9em;text-align:left;
border-bottom:1px solid #ddd}td.n{text-align:right;font-variant-numeric:tabular-nums}
img{max-width:100%;border:1px solid #ccc}svg{max-width:100%}
"""


def camera_report(
    stored: StoredCalibration,
    fit: CameraFit,
    views: Sequence[BoardView],
    pictures: Sequence[NamedImage],
    troubles: Sequence[str],
) -> str:
    """Page about a lens: coverage, errors per picture, disagreement of halves, uncertainty."""
    e = stored.error
    corners = np.concatenate([view.pixels for view in views])
    numbers = zip(stored.result["lens"], np.sqrt(np.diag(fit.covariance)), strict=True)
    names = ("fx, px", "fy, px", "cx, px", "cy, px", "k1", "k2", "p1", "p2", "k3")
    rows = [(n, f"{v:.6g}", f"{s:.2g}") for n, (v, s) in zip(names, numbers, strict=True)]
    for name, value, spread in zip(
        ("board bowed across, mm", "board bowed upright, mm"),
        fit.warp_m,
        fit.warp_std_m,
        strict=True,
    ):
        rows.append((name, f"{value * 1e3:.3f}", f"{spread * 1e3:.3f}"))
    across, deviation = fit.stretch
    rows.append(("board stretched across, %", f"{1e2 * across:.4f}", f"{1e2 * deviation:.4f}"))
    per_view = [(v.name, f"{v.corners}", f"{v.outliers}", f"{v.rms_px:.3f}") for v in fit.views]
    return _page(
        "Lens of the camera",
        f"On a plane the lens puts points right to ±{e['spread_95_px']:.3f} px (95 %, worst of the "
        f"picture); two lenses, each from half of the pictures, differ by "
        f"{e['halves_rms_px']:.3f} px rms.",
        [
            (
                "Where corners were seen",
                _image(_dots(pictures[0].image, corners))
                + _note("Those of all pictures, over the first; none may be lacking in a corner."),
            ),
            (
                "Uncertainty, 95 %, px",
                _heat(CIRCLE_95 * fit.spread_px)
                + _note("From the corners' noise, through the whole fit, board poses and bow "
                        "included; what a plane's pose takes up anyway is left off."),
            ),
            (
                "Disagreement of two halves, px",
                _heat(fit.halves_px)
                + _note("Far above the uncertainty: the model is wrong, which no covariance can "
                        "show. Look for a loose lens, a soft board, another focus."),
            ),
            ("Numbers", _table(("", "value", "standard deviation"), rows)),
            (
                "Pictures",
                _table(("picture", "corners", "set aside", "rms, px"), per_view)
                + _note("A small rms alone proves nothing: fewer pictures have a smaller one.")
                + "".join(f"<p class=note>{html.escape(t)}</p>" for t in troubles),
            ),
        ],
        stored,
    )  # fmt: skip


def cell_report(
    stored: StoredCalibration,
    fit: CellFit,
    shown: ShownCell,
    classic_m: FloatArray,
    settings: Settings,
) -> str:
    """Page about a cell: error at held-out poses, uncertainty of the map, residuals, plane.

    classic_m  (R, C) disagreement with the classic method, see `conclude.disagreement_m`
    """
    e, size = stored.error, (settings.camera.width_px, settings.camera.height_px)
    spread_mm = 1e3 * CIRCLE_95 * fit.spread_m(picture_grid(size))
    roll_rad, _ = fit.roll()
    tilt = np.degrees(np.arccos(np.clip(abs((fit.X_CB @ fit.X_BP)[2, 2]), -1.0, 1.0)))
    offset = fit.X_TM[:3, 3] * 1e3
    rows = [
        ("map, 95 %, worst of the picture", f"{e['map_95_m'] * 1e3:.3f} mm"),
        ("held-out poses, rms", f"{e['held_out_rms_m'] * 1e3:.3f} mm"),
        ("held-out poses, worst mark", f"{e['held_out_max_m'] * 1e3:.3f} mm"),
        (
            "classic hand–eye for comparison, rms and worst",
            f"{e['classic_rms_m'] * 1e3:.3f}, {e['classic_max_m'] * 1e3:.3f} mm",
        ),
        ("plate bent: a mark off the plane of all", f"{e['bend_m'] * 1e3:.3f} mm"),
        ("marks' noise", f"{e['noise_px']:.3f} px"),
        ("arm's noise, as the camera sees it", f"{e['arm_noise_px']:.3f} px"),
        ("marks seen / stated", f"{fit.scale[0]:.5f} ± {1.96 * fit.scale[1]:.5f}"),
        ("camera against the plane", f"{tilt:.2f}°"),
        (
            "roll against gravity",
            f"{np.degrees(roll_rad):.3f}° ± {np.degrees(e['roll_95_rad']):.3f}°",
        ),
        (
            "gripping point relative to the tool, x and y",
            f"{offset[0]:+z.3f}, {offset[1]:+z.3f} mm",
        ),
    ]
    last = shown.poses[-1].picture.image
    overlay = _grid_over(last, fit)
    return _page(
        "Where pixels lie in the cell's plane",
        f"Marks at poses that had no part in the fit are {e['held_out_rms_m'] * 1e3:.3f} mm rms "
        f"from where the map has them, {e['held_out_max_m'] * 1e3:.3f} mm at most.",
        [
            (
                "The plane as the map has it",
                _image(overlay) + _note("Lines every 10 mm; the axes are red, y against gravity."),
            ),
            ("Uncertainty of the map, 95 %, mm", _heat(spread_mm)),
            (
                "Disagreement with the classic way, mm",
                _heat(1e3 * classic_m)
                + _note(
                    "Hand–eye as it is usually done: the plate's pose in each picture by itself, "
                    "then robot and camera brought together; Park's and Daniilidis' own solutions "
                    "need turns about two axes, which this gripper cannot make. It shares nothing "
                    "with the fit above but pictures and lens, and is itself wrong by tenths "
                    "of a millimetre. A millimetre or more where the gripper was shown means that "
                    "one of the two misunderstands the cell: check the marks' places in "
                    "vision.jaw.discs_m, the lens, and that nothing was moved between them."
                ),
            ),
            (
                "What the fit leaves, pose by pose",
                _image(_arrows(last, fit, shown))
                + _note(
                    f"The longest arrow is {_longest_px(fit):.3f} px; they must not point all "
                    "one way in one region."
                ),
            ),
            ("Numbers", _table(("", ""), rows)),
        ],
        stored,
    )


def time_report(stored: StoredCalibration, times: Times, move: DetectedMove) -> str:
    """Page about delays."""

    def words(delay: Delay) -> str:
        return f"{delay.value_s * 1e3:.3f} ± {delay.half_width_s * 1e3:.3f} ms"

    rows = [
        ("camera timestamps late by", words(times.latency), f"{times.latency.rms_m * 1e3:.3f} mm"),
        ("arm behind its commands", words(times.lag), f"{times.lag.rms_m * 1e3:.3f} mm"),
    ]
    stamps = move.stamps_s - times.latency.value_s
    start = move.gripper_log.t_s[0]
    series = [
        ("told", move.commanded.t_s - start, move.commanded.y_m),
        ("measured by the arm", move.gripper_log.t_s - start, move.gripper_log.y_m),
        ("seen, latency taken off", stamps - start, move.detected_m[:, 1]),
    ]
    return _page(
        "Latency and lag",
        f"The camera's stamps are {words(times.latency)} late, the arm follows "
        f"{words(times.lag)} late (95 %).",
        [
            ("Height of the gripping point, mm, against time, s", _curves(series)),
            ("Delays", _table(("", "95 %", "left, rms"), rows)),
        ],
        stored,
    )


def grip_report(
    stored: StoredCalibration,
    fit: GripFit,
    views: Sequence[GripView],
    shown: ShownCell,
    view: PlaneView,
) -> str:
    """Page about a grip: measurements pose by pose, over pictures."""
    e = stored.error
    half, between = fit.half_95, fit.repeatability
    units = (("mm", 1e3), ("mm", 1e3), ("°", 180.0 / np.pi), ("mm", 1e3))
    names = ("gripping point, x", "gripping point, y", "clamp angle", "free length")
    rows = [
        tuple(f"{k * v:.3f} {unit}" for v in (fit.mean[n], half[n], between[n]))
        for n, (unit, k) in enumerate(units)
    ]
    views = [one for one, good in zip(views, fit.used, strict=True) if good]
    poses = [
        (one.name, *(f"{k * v:.3f}" for v, (_, k) in zip(values, units, strict=True)),
         f"{1e3 * residual:.3f}")
        for one, values, residual in zip(views, fit.by_pose, fit.residual_m, strict=True)
    ]  # fmt: skip
    images = {p.picture.name: p.picture.image for p in shown.poses}
    first, last = views[0], views[-1]
    return _page(
        "How the jaws hold a cable",
        f"The cable leaves the jaws {np.degrees(fit.mean[2]):+z.2f}° ± "
        f"{np.degrees(e['angle_95_rad']):.2f}° from the direction of the marks, its free length "
        f"is {1e3 * fit.mean[3]:.2f} ± {1e3 * e['length_95_m']:.2f} mm (95 %).",
        [
            ("Numbers", _table(("", "value", "± 95 %", "between poses"),
                               [(n, *r) for n, r in zip(names, rows, strict=True)])
             + _note("In the frame of the marks: x away from the cable, y up, angle positive where "
                     "the cable points further down. The cycle uses them in place of "
                     "vision.jaw.discs_m about 0, 0 and cable.free_length_m.")),
            ("The line as measured, and where it begins and ends",
             "".join(_image(_held(images[one.name], one, view)) for one in (first, last))),
            ("The jaw, enlarged", _image(_enlarged(_held(images[first.name], first, view),
                                                   view.to_pixels(first.line.edge_m)))),
            ("Poses", _table(("picture", "x, mm", "y, mm", "angle, °", "length, mm",
                              "left, rms, mm"), poses)
             + _note("What goes from pose to pose must not go one way: then the cable slides.")),
        ],
        stored,
    )  # fmt: skip


# --- parts of a page --------------------------------------------------------------------------


def _page(
    title: str, sentence: str, parts: Sequence[tuple[str, str]], stored: StoredCalibration
) -> str:
    stated = [*stored.how.items(), *stored.devices.items()]
    facts = "; ".join(_plainly(k, v) for k, v in stated if v is not None)
    body = "".join(f"<h2>{html.escape(head)}</h2>{content}" for head, content in parts)
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>"
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1>"
        f"<p class=note>{stored.made:%Y-%m-%d %H:%M} UTC; {html.escape(facts)}</p>"
        f"<p class=says>{html.escape(sentence)}</p>{body}</html>"
    )


def _plainly(key: str, value: object) -> str:
    """A fact as words, the unit behind its number."""
    name, _, unit = key.rpartition("_")
    if unit not in ("px", "s"):
        name, unit = key, ""
    return f"{name.replace('_', ' ')}: {value} {unit}".rstrip()


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    lines = "".join(
        "<tr>" + "".join(f"<td{'' if k == 0 else ' class=n'}>{html.escape(c)}</td>"
                         for k, c in enumerate(row)) + "</tr>"
        for row in rows
    )  # fmt: skip
    return f"<table><tr>{top}</tr>{lines}</table>"


def _note(words: str) -> str:
    return f"<p class=note>{html.escape(words)}</p>"


def _image(image: Image) -> str:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return f'<img alt="" src="data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}">'


def _heat(values: FloatArray) -> str:
    """(R, C) values over the picture as coloured cells with their numbers."""
    rows, columns = values.shape
    top = float(np.nanmax(values)) or 1.0
    wide, high = 64, 34
    cells = []
    for r in range(rows):
        for c in range(columns):
            share = float(values[r, c]) / top
            ink = "#fff" if share > 0.6 else "#222"
            cells.append(
                f'<rect x="{c * wide}" y="{r * high}" width="{wide}" height="{high}" '
                f'fill="hsl(195 60% {95 - 65 * share:.0f}%)"/>'
                f'<text x="{(c + 0.5) * wide}" y="{(r + 0.65) * high}" fill="{ink}" '
                f'text-anchor="middle" font-size="12">{values[r, c]:.3f}</text>'
            )
    return f'<svg viewBox="0 0 {columns * wide} {rows * high}">{"".join(cells)}</svg>'


def _curves(series: Sequence[tuple[str, FloatArray, FloatArray]]) -> str:
    """Curves of metres against seconds, drawn in mm."""
    wide, high, edge = 900.0, 320.0, 40.0
    t = np.concatenate([s[1] for s in series])
    y = np.concatenate([s[2] for s in series])
    low, span = np.nanmin(y), max(float(np.nanmax(y) - np.nanmin(y)), 1e-6)
    begin, lasts = t.min(), max(float(np.ptp(t)), 1e-6)
    parts = []
    for k, (name, t_s, values) in enumerate(series):
        good = np.isfinite(values)
        u = edge + (wide - 2 * edge) * (t_s[good] - begin) / lasts
        v = high - edge - (high - 2 * edge) * (values[good] - low) / span
        colour = ("#888", "#00798c", "#d1495b")[k % 3]
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(u, v, strict=True))
        if k == len(series) - 1:
            dots = "".join(
                f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.6" fill="{colour}"/>'
                for a, b in zip(u, v, strict=True)
            )
            parts.append(dots)
        else:
            parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}"/>')
        place = f'x="{edge + 220 * k}" y="16" fill="{colour}" font-size="14"'
        parts.append(f"<text {place}>{html.escape(name)}</text>")
    for share in (0.0, 0.5, 1.0):
        label = f"{(low + share * span) * 1e3:.1f}"
        at = high - edge - (high - 2 * edge) * share
        parts.append(f'<text x="0" y="{at:.0f}" font-size="12" fill="#555">{label}</text>')
        across = edge + (wide - 2 * edge) * share
        place = f'x="{across:.0f}" y="{high - 8}" font-size="12" fill="#555"'
        parts.append(f"<text {place}>{abs(begin + share * lasts):.2f}</text>")
    return f'<svg viewBox="0 0 {wide:.0f} {high:.0f}">{"".join(parts)}</svg>'


def _dots(image: Image, pixels: FloatArray) -> Image:
    picture = _coloured(image)
    for u, v in np.rint(pixels).astype(int).tolist():
        cv2.circle(picture, (u, v), 2, (60, 60, 230), -1, cv2.LINE_AA)
    return picture


def _longest_px(fit: CellFit) -> float:
    return max(float(np.linalg.norm(fit.residuals_px, axis=-1).max()), 1e-6)


def _arrows(image: Image, fit: CellFit, shown: ShownCell) -> Image:
    """Residual of every mark, drawn at its pose."""
    picture = _coloured(image)
    places = [p.pose for p in shown.poses if p.role == "fit"][: len(fit.residuals_px)]
    for pose, residuals in zip(places, fit.residuals_px, strict=False):
        at = fit.view.to_pixels(np.array([pose.x_m, pose.y_m]))
        for residual in residuals:
            end = at + _ARROW_PX / _longest_px(fit) * residual
            a, b = (tuple(np.rint(p).astype(int).tolist()) for p in (at, end))
            cv2.arrowedLine(picture, a, b, (60, 60, 230), 1, cv2.LINE_AA, tipLength=0.3)
    return picture


def _grid_over(image: Image, fit: CellFit) -> Image:
    picture = _coloured(image)
    height, width = image.shape
    corners = fit.view.to_plane(np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
    low = np.floor(corners.min(axis=0) * 100.0).astype(int)
    high = np.ceil(corners.max(axis=0) * 100.0).astype(int)
    along = np.linspace(0.0, 1.0, 60)[:, None]
    for axis in (0, 1):
        for k in range(low[axis], high[axis] + 1):
            begin, end = np.array(low, float) / 100, np.array(high, float) / 100
            begin[axis] = end[axis] = k / 100
            line = fit.view.to_pixels(begin + along * (end - begin))
            ok = np.all(np.isfinite(line), axis=1) & np.all(np.abs(line) < 1e4, axis=1)
            colour, thick = ((60, 60, 230), 2) if k == 0 else ((150, 190, 90), 1)
            cv2.polylines(
                picture, [np.rint(line[ok]).astype(np.int32)], False, colour, thick, cv2.LINE_AA
            )
    return picture


def _held(image: Image, one: GripView, view: PlaneView) -> Image:
    """The cable's line, its ends, and the directions of marks and cable."""
    picture = _coloured(image)
    line = np.rint(view.to_pixels(one.line.smooth_m)).astype(np.int32)
    cv2.polylines(picture, [line], False, (60, 60, 230), 1, cv2.LINE_AA)
    for end in (one.line.edge_m, one.line.tip_m):
        u, v = np.rint(view.to_pixels(end)).astype(int).tolist()
        cv2.circle(picture, (u, v), 5, (30, 200, 250), 1, cv2.LINE_AA)
    angle = float(one.marks[2])
    way = 0.03 * np.array([[np.cos(angle), np.sin(angle)], [-np.cos(angle), -np.sin(angle)]])
    a, b = np.rint(view.to_pixels(way + one.marks[:2])).astype(int).tolist()
    cv2.line(picture, tuple(a), tuple(b), (150, 190, 90), 1, cv2.LINE_AA)
    return picture


def _enlarged(image: Image, at_px: FloatArray) -> Image:
    """A part of a picture, four times as large."""
    high, wide = image.shape[:2]
    u = int(np.clip(at_px[0] - _PART_PX[0] // 2, 0, max(wide - _PART_PX[0], 0)))
    v = int(np.clip(at_px[1] - _PART_PX[1] // 2, 0, max(high - _PART_PX[1], 0)))
    part = image[v : v + _PART_PX[1], u : u + _PART_PX[0]]
    return np.asarray(cv2.resize(part, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC))


def _coloured(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
