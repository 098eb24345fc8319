"""Proposed mapping of a gripper with its own file, an encoder or an accelerometer."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.words import first_of
from cell.study.imports.body_orientation import BodyTurn, body_turn
from cell.study.imports.cable_root import Root
from cell.study.imports.capture import Capture, Finding, ImportFindings, Sure
from cell.study.imports.choosing import detected_places
from cell.study.imports.clamp_angle import clamp_angle
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import Contents, Point, contents
from cell.study.imports.gripper_section import (
    AccelerationSection,
    AngleSection,
    AxesSection,
    GripperSection,
    TurnsSection,
    entries_to_fill_in,
)
from cell.study.imports.places import ALIGNED
from cell.study.imports.scales import time_section
from cell.study.imports.shape import AWAY, FEWEST_REST, FINAL_SHARE, arc_lengths, reach_of
from cell.study.imports.units import METRES, RADIANS

#: m/s² per unit; an unstated unit is detected by standard gravity within this share.
ACCELERATIONS = {"m/s^2": 1.0, "mm/s^2": 1e-3, "g": 9.80665}
_GRAVITY_SHARE = 0.1
#: Rows in which a gripper rests at first.
_REST_ROWS = 20
#: Words of a pose that was only commanded.
_COMMANDED = frozenset(
    ("target", "commanded", "command", "cmd", "desired", "setpoint", "reference", "soll", "rsol")
)
#: Maximum number of columns listed for the user to choose from.
_MAX_LISTED = 24


def sensor_section(
    capture: Capture,
    inside: Contents,
    axes: AxesSection,
    root: Root,
    of_file: dict[str, Any],
    findings: ImportFindings,
) -> GripperSection:
    """The gripper's section for an encoder or accelerometer, null where the user must fill it in.

    axes      of the markers
    of_file   entries of the section if the gripper has its own file
    findings  extended by those about the gripper
    """
    if not inside.encoders:
        section = _by_acceleration(capture, inside, axes, root, findings)
    elif all(m.unit in METRES for _, m in inside.encoders):
        section = _linear(capture, inside, root, findings)
    else:
        section = _rotary(capture, inside, axes, root, findings)
    section = section.model_copy(update=of_file)
    for key, remedy in entries_to_fill_in(section):
        findings.missing("hand", f"give {'.'.join(map(str, key))}: {remedy}")
    return section


def _linear(
    capture: Capture, inside: Contents, root: Root, findings: ImportFindings
) -> GripperSection:
    """Section of a gripper on linear axes; null = it does not move along this one."""
    by_axis = {m.axis or "x": name for name, m in reversed(inside.encoders)}
    columns: list[str | None] = [by_axis.get("x"), by_axis.get("y") or by_axis.get("z")]
    names = " and ".join(repr(c) for c in columns if c is not None)
    sentence = f"{names} tells the gripper's place; along null it stays at hand.origin_m"
    findings.guessed("hand", f"{sentence}: does it move right, or up?")
    plane = AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])
    angle = clamp_angle(capture, inside, plane, root, findings)
    unit = METRES[inside.encoders[0][1].unit]
    return GripperSection(columns=columns, axes=plane, metres_per_unit=unit, angle=angle)


def _rotary(
    capture: Capture, inside: Contents, axes: AxesSection, root: Root, findings: ImportFindings
) -> GripperSection:
    name, encoder = next((n, m) for n, m in inside.encoders if m.unit not in METRES)
    unit = RADIANS.get(encoder.unit)
    turns = TurnsSection(column=name, radians_per_unit=unit, axle_m=None, radius_m=None)
    sentence = f"no place of the gripper is in {capture.path.name}: {name!r} tells how its arm "
    findings.guessed("hand", f"{sentence}turns")
    if inside.angles:
        angle = clamp_angle(capture, inside, axes, root, findings)
    else:
        angle = AngleSection(follows=True)
        sentence = "the clamp turns with the arm, and the cable leaves along it; else give "
        findings.guessed("hand.angle", f"{sentence}offset_rad")
    return GripperSection(turns=turns, angle=angle)


def _by_acceleration(
    capture: Capture, inside: Contents, axes: AxesSection, root: Root, findings: ImportFindings
) -> GripperSection:
    """Section of an accelerometer; up and the unit are estimated by gravity at rest."""
    channels = inside.accelerations[:3]
    names = [n for n, _ in channels]
    columns: list[str | None] = [*names, *[None] * (2 - len(names))]
    rest = np.nanmedian(capture.at(names)[:_REST_ROWS], axis=0)
    size = float(np.linalg.norm(rest))
    unit, sure, why = _unit(channels[0][1].unit, size)
    shows_gravity = unit is None or size * unit > 0.5 * ACCELERATIONS["g"]
    own, shown = _axes(capture, names, rest, shows_gravity)
    sentence = f"no place of the gripper is in {capture.path.name}: it is integrated from "
    findings.guessed("hand", f"{sentence}acceleration, columns {', '.join(names)}; {shown}")
    findings.append(Finding("hand.acceleration", f"acceleration is {why}", sure))
    sensor = AccelerationSection(
        columns=columns, m_per_s2_per_unit=unit, along="clamp", starts_at_m=None
    )
    angle = clamp_angle(capture, inside, axes, root, findings)
    return GripperSection(acceleration=sensor, axes=own, angle=angle)


def _unit(stated: str, size: float) -> tuple[float | None, Sure, str]:
    """m/s² per unit, its certainty and the reason; size: magnitude at rest in the file's unit."""
    if stated in ACCELERATIONS:
        return ACCELERATIONS[stated], Sure.STATED, f"in {stated}, as the file says"
    for name, unit in ACCELERATIONS.items():
        if abs(size * unit / ACCELERATIONS["g"] - 1.0) < _GRAVITY_SHARE:
            return unit, Sure.GUESSED, f"in {name}: it is {size:.4g} at rest"
    return None, Sure.MISSING, f"in a unit that is not known: it is {size:.4g} at rest"


def _axes(
    capture: Capture, names: list[str], rest: np.ndarray, shows_gravity: bool
) -> tuple[AxesSection, str]:
    """Axes of the sensor: up shows gravity at rest, right moves most of the others."""
    count = max(2, len(names))
    right, up = np.zeros(count), np.zeros(count)
    k = int(np.argmax(np.abs(rest))) if shows_gravity else 1
    up[k] = np.sign(rest[k]) if shows_gravity else 1.0
    spreads = np.full(count, -1.0)
    spreads[: len(names)] = np.nanstd(capture.at(names), axis=0)
    spreads[k] = -2.0
    right[int(np.argmax(spreads))] = 1.0
    shown = names[k] if k < len(names) else "none of these"
    why = "it shows gravity at rest" if shows_gravity else "none shows gravity at rest"
    return AxesSection(right=right.tolist(), up=up.tolist()), f"up is {shown}: {why}"


#: A gripper moves along one axis if it moves less than this share of that across the axis.
_ONE_AXIS = 0.02
#: A chain from the gripper is the cable's if it is longer than the free length by at most the first
#: share and, if no unit is stated, shorter by at most the second.
TIP, _SHORTER = 0.02, 0.3
#: Quantile of a gripper's distances from its initial position; rows beyond it are outliers.
_OUTLIER_QUANTILE = 0.95


@dataclass(frozen=True, eq=False)
class GripperFile:
    """A file of the gripper.

    point    the gripping point; None = the file has none
    initial  (d,) its initial position at rest, in the file's unit and axes; None = it never rests
    """

    capture: Capture
    inside: Contents
    point: Point | None
    initial: FloatArray | None


def gripper_file(capture: Capture) -> GripperFile:
    """The content of a file of the gripper."""
    inside = contents(capture)
    named = [p for p in inside.points if p.on_gripper] or list(inside.points)
    if not named and (only := _only_coordinate(capture, inside)) is not None:
        named = [only]
    if not named:
        return GripperFile(capture, inside, None, None)
    point = min(
        named, key=lambda p: (not _COMMANDED.isdisjoint(p.name.split()), "actual" not in p.name)
    )
    initial = initial_place(detected_places(capture, point.columns, ()))
    return GripperFile(capture, inside, point, initial)


def _only_coordinate(capture: Capture, inside: Contents) -> Point | None:
    """The only length in a file without points, as of a distance sensor; None = not exactly one."""
    unused = [(c.name, meaning(c)) for c in capture.columns if c.name in inside.unused]
    lengths = [(n, m) for n, m in unused if m.unit in METRES or m.kind is ColumnKind.COORDINATE]
    return Point(lengths[0][0], (lengths[0][0],), lengths[0][1].unit) if len(lengths) == 1 else None


def initial_place(places: FloatArray) -> FloatArray | None:
    """(d,) position of a point (rows, d) before it moves; None = it moves from the first row on."""
    known = places[np.isfinite(places).all(axis=1)]
    if len(known) < FEWEST_REST:
        return None
    distances = np.linalg.norm(known - np.median(known[:FEWEST_REST], axis=0), axis=1)
    is_moving = distances > AWAY * np.quantile(distances, _OUTLIER_QUANTILE)
    rest_rows = int(np.argmax(is_moving)) if is_moving.any() else len(known)
    return np.asarray(np.median(known[:rest_rows], axis=0)) if rest_rows >= FEWEST_REST else None


#: Units of length of robots' logs.
_OWN_UNITS = ("m", "mm")


def first_point(
    hand: GripperFile, shape: FloatArray, units: Set[str], free_length_m: float | None
) -> FloatArray | None:
    """(d,) gripper at rest, in the markers' unit; None = it is not in the markers' frame.

    It is if the chain from the gripper to the tip is no longer than the cable.

    shape   (points, d) of the markers at rest, from the gripper to the tip, in the file's unit
    units   that the markers' file states
    """
    point, rest = hand.point, hand.initial
    if free_length_m is None or point is None or rest is None or len(rest) != shape.shape[1]:
        return None
    stated = next((u for u in sorted(units) if u in METRES), "")
    tried = [stated] if stated else list(METRES)
    pairs = [(unit, point.unit if point.unit in METRES else unit) for unit in tried]
    if point.unit not in METRES:  # it may be in another one than the markers
        pairs += [(unit, own) for unit in tried for own in _OWN_UNITS if own != unit]
    for unit, own in pairs:
        place = rest * METRES[own] / METRES[unit]
        chain_m = METRES[unit] * float(arc_lengths(np.vstack([place, shape])[None])[-1])
        known = bool(stated) and (own == unit or own == point.unit)
        least_m = 0.0 if known else free_length_m / (1.0 + _SHORTER)
        if least_m <= chain_m <= free_length_m * (1.0 + TIP):
            return np.asarray(place)
    return None


#: A gripper has its own axes if it leaves the markers' plane by more than this share of its span.
_OUT_OF_PLANE = 0.2
#: Tolerance of the directions of the gripper and the nearest marker, relative to their spans.
_DIRECTION_TOL = 0.25
#: The nearest marker moves about as far as the gripper; a ratio above this is another unit.
_MAX_RATIO = 5.0
#: Units whose ratios differ by less, in logarithms, are equally likely.
_EQUALLY = 0.4


@dataclass(frozen=True, eq=False)
class NearestMarker:
    """Motion of the marker next to the gripper, in the trial whose gripper moves most; empty where
    the markers' unit or the gripper's position is unknown.

    hand   (rows, d) of that trial's gripper, in the unit and axes of its file
    xy_m   (frames, 2) of the marker in the study's plane
    moves  displacements of both, (d,) and (2,), from the beginning to the end of every trial
    """

    hand: FloatArray
    xy_m: FloatArray
    moves: tuple[tuple[FloatArray, FloatArray], ...]


def displacement(places: FloatArray) -> FloatArray:
    """(d,) from the initial to the final position of a point (rows, d); 0 if never detected."""
    known = places[np.isfinite(places).all(axis=1)]
    if not len(known):
        return np.zeros(places.shape[1])
    late = known[int((1.0 - FINAL_SHARE) * len(known)) :]
    return np.asarray(np.median(late, axis=0) - np.median(known[:FEWEST_REST], axis=0))


def section_of_file(
    hand: GripperFile,
    axes: AxesSection,
    root: Root,
    scale: float | None,
    nearest: NearestMarker,
    lasts_s: float | None,
    findings: ImportFindings,
) -> GripperSection:
    """The section of a gripper with its own file; without a position if the file has none.

    lasts_s   duration of the first trial by its markers; None = unknown
    findings  extended by those about the gripper
    """
    capture, inside, point, file = hand.capture, hand.inside, hand.point, hand.capture.path.name
    time, time_finding = time_section(capture, inside, None, lasts_s, "hand.time")
    of_file: dict[str, Any] = {"text": capture.form, "time": time}
    if point is None:
        findings.append(time_finding)
        if inside.has_gripper_sensor:
            return sensor_section(capture, inside, axes, root, of_file, findings)
        findings.missing(
            "hand",
            f"no place of the gripper is known in {file}: name two columns of it as hand.columns, "
            "that of its axle's encoder in hand.turns, or those of an accelerometer on it in "
            "hand.acceleration",
        )
        listed = first_of(capture.names, _MAX_LISTED)
        findings.shown("hand", f"columns of {file}: {listed}")
        return GripperSection(angle=AngleSection(), **of_file)
    findings.guessed("hand", f"{point.name!r} of {file} is the gripping point")
    own, columns = None, list[str | None](point.columns)
    turn = body_turn(capture, inside, point.name, root)
    if len(columns) == 1:
        columns, own, sentence = _one_axis(point.name, nearest)
        findings.guessed("hand.axes", sentence)
    elif len(point.columns) != len(axes.up) or _leaves_plane(axes, nearest, turn):
        places = detected_places(capture, point.columns, ())
        own, sentence = _own_axes(places, nearest, turn)
        findings.guessed("hand.axes", sentence)
    elif (own := _reversed_axes(axes, nearest)) is not None:
        sentence = "the gripper's file has its own axes: they are turned round, so that it and the "
        findings.guessed("hand.axes", f"{sentence}marker next to it move the same way")
    elif _way_off(axes, nearest) > 2.0 * _DIRECTION_TOL:
        other, sentence = _own_axes(detected_places(capture, point.columns, ()), nearest, turn)
        if _way_off(other, nearest) < _DIRECTION_TOL:
            own = other
            findings.guessed("hand.axes", sentence)
    unit, unit_finding = _unit_of_place(point, scale, nearest)
    findings += [replace(f, sentence=f"{file}: {f.sentence}") for f in (time_finding, unit_finding)]
    angle = clamp_angle(capture, inside, own or axes, root, findings, point.name)
    return GripperSection(columns=columns, angle=angle, metres_per_unit=unit, axes=own, **of_file)


def _unit_of_place(
    point: Point, scale: float | None, nearest: NearestMarker
) -> tuple[float | None, Finding]:
    """Metres per unit of the gripper's position: it moves about as far as the nearest marker.

    scale  of the markers
    """
    marker_m, span = reach(nearest.xy_m), reach(nearest.hand)
    stated = METRES.get(point.unit)
    as_stated = Finding("hand", f"lengths are in {point.unit}, as it says", Sure.STATED)
    names = {METRES[n]: n for n in ("m", "mm", "cm", "in")}
    tried = [u for u in (scale, *names) if u is not None and span > 0.0 and marker_m > 0.0]
    off = {u: abs(float(np.log(u * span / marker_m))) for u in tried}
    fitting = [u for u in tried if off[u] < min(np.log(_MAX_RATIO), min(off.values()) + _EQUALLY)]
    if not fitting:
        if stated is not None:
            return stated, as_stated
        sentence = "its unit of length is taken as that of the markers"
        return scale, Finding("hand", sentence, Sure.GUESSED)
    unit = fitting[0]
    spans = f"in {names.get(unit, f'{unit:g} m')} it moves by {unit * span:.3g} m, the marker next "
    spans += f"to it by {marker_m:.3g} m"
    if stated is None:
        return unit, Finding("hand.metres_per_unit", f"{spans}: so that is its unit", Sure.SHOWN)
    if 1 / _MAX_RATIO < stated * span / marker_m < _MAX_RATIO:
        return stated, as_stated
    sentence = f"it says {point.unit}, and would move by {stated * span:.3g} m, yet {spans}; give "
    sentence += f"hand.metres_per_unit: {unit:g}"
    return stated, Finding("hand.metres_per_unit", sentence, Sure.MISSING)


def _leaves_plane(axes: AxesSection, nearest: NearestMarker, turn: BodyTurn | None) -> bool:
    """Whether the gripper moves across the markers' plane, or turns about another axis than its
    normal: then its file has other axes."""
    if len(axes.up) < 3:
        return False
    normal = np.cross(axes.right, axes.up)
    if turn is not None and turn.across(normal) > _OUT_OF_PLANE:
        return True
    across = nearest.hand @ normal
    return reach(across[:, None]) > _OUT_OF_PLANE * reach(nearest.hand)


def _reversed_axes(axes: AxesSection, nearest: NearestMarker) -> AxesSection | None:
    """The markers' axes, reversed where the gripper moves opposite to the nearest marker, as in an
    image whose rows count down; None = both move the same way."""
    plane = np.array([axes.right, axes.up])
    hand, marker = _way(nearest.hand @ plane.T), _way(nearest.xy_m)
    if hand is None or marker is None:
        return None
    opposite = (np.abs(hand) > _DIRECTION_TOL) & (np.abs(hand + marker) < _DIRECTION_TOL)
    alike = np.abs(np.where(opposite, -hand, hand) - marker) < _DIRECTION_TOL
    if not opposite.any() or not alike.all():
        return None
    right, up = np.where(opposite[:, None], -plane, plane) + 0.0
    return AxesSection(right=right.tolist(), up=up.tolist())


def _way_off(axes: AxesSection, nearest: NearestMarker) -> float:
    """Largest difference of the ways of the gripper, in its axes, and the nearest marker; 0 = one
    of them does not move."""
    hand, marker = _way(nearest.hand @ np.array([axes.right, axes.up]).T), _way(nearest.xy_m)
    return 0.0 if hand is None or marker is None else float(np.abs(hand - marker).max())


def _way(path: FloatArray) -> FloatArray | None:
    """(d,) from the first to the last position (rows, d), over their span; None = no motion."""
    known = path[np.isfinite(path).all(axis=1)]
    return (known[-1] - known[0]) / reach(known) if reach(known) > 0.0 else None


def _one_axis(name: str, nearest: NearestMarker) -> tuple[list[str | None], AxesSection, str]:
    """Columns and axes of a sensor of one coordinate: the nearest marker moves along it."""
    towards = sum((hand[0] * marker for hand, marker in nearest.moves), np.zeros(2))
    axis = int(not abs(towards[0]) > abs(towards[1]))
    plane = np.eye(2)
    plane[axis] *= np.sign(towards[axis]) or 1.0
    columns: list[str | None] = [None, None]
    columns[axis] = name
    way = ("right", "up")[axis] + (", reversed" if plane[axis, axis] < 0.0 else "")
    why = "as the marker next to it moves" if nearest.moves else "unless it moves to the side"
    sentence = f"{name!r} is the gripper's place along {way}, {why}; along null it stays at "
    sentence += "hand.origin_m"
    return columns, AxesSection(right=plane[0].tolist(), up=plane[1].tolist()), sentence


def _own_axes(
    places: FloatArray, nearest: NearestMarker, turn: BodyTurn | None
) -> tuple[AxesSection, str]:
    """Right and up along the columns of a gripper whose axes are not the markers' axes.

    Up is the third axis of a robot; in motion capture it may be the second, if the gripper rises
    along it as the nearest marker does.  Right is across the axis about which the gripper
    turns, such that it turns as the cable's root; else the horizontal direction in which the
    gripper moves in any of the trials, towards the same side as that marker.
    """
    if places.shape[1] == 2:
        plane = AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])
        return plane, "the gripper's file has its own axes: right and up are its first and second"
    known = places[np.isfinite(places).all(axis=1)]
    span = np.ptp(known, axis=0) if len(known) else np.zeros(3)
    up = _up_axis(nearest)
    flat = [0, 3 - up]
    sentence = f"the gripper's file has its own axes: up is its {'second' if up == 1 else 'third'}"
    right = np.array([1.0, 0.0, 0.0])
    moves, how = nearest.moves, ", right the level direction in which it moves"
    towards = sum((marker[0] * hand[flat] for hand, marker in moves), np.zeros(2))
    most = sum(abs(float(marker[0])) * float(np.hypot(*hand[flat])) for hand, marker in moves)
    goes = any(np.hypot(*hand[flat]) > _ONE_AXIS * np.linalg.norm(hand) for hand, _ in moves)
    goes = goes and bool(np.hypot(*towards) > 0.5 * most)
    level = None if turn is None else _level_of_turn(turn, up)
    if turn is not None and level is not None and (turn.signed or goes):
        if not turn.signed and towards @ level < 0.0:
            level = -level
        right[flat], how = level, ", right across the axis about which it turns as the cable's root"
    elif goes:
        right[flat] = towards / np.hypot(*towards)
    elif np.hypot(*span[flat]) <= _ONE_AXIS * span[up]:
        how = "; it only moves along that: right is its first"
        if level is not None:
            right[flat], how = level, "; right or left across the axis about which it turns"
    else:
        level = known[:, flat] - known[:, flat].mean(axis=0)
        right[flat] = np.linalg.svd(level, full_matrices=False)[2][0]
    rounded = [round(float(v), 7) + 0.0 for v in right]
    return AxesSection(right=rounded, up=np.eye(3)[up].tolist()), sentence + how


def _level_of_turn(turn: BodyTurn, up: int) -> FloatArray | None:
    """(2,) horizontal direction across the axis of a turn, along an axis of the file if it is near;
    None = that axis is not level."""
    right = np.cross(np.eye(3)[up], turn.normal)
    if abs(turn.normal[up]) > _OUT_OF_PLANE:
        return None
    level = right[[0, 3 - up]] / np.linalg.norm(right)
    nearest = int(np.argmax(np.abs(level)))
    if abs(level[1 - nearest]) < ALIGNED:
        level = np.sign(level[nearest]) * np.eye(2)[nearest]
    return np.asarray(level)


def _up_axis(nearest: NearestMarker) -> int:
    """Index of the up axis: 2, or 1 if only that coordinate rises as much as the nearest marker."""
    hand, marker = _way(nearest.hand), _way(nearest.xy_m)
    if hand is None or marker is None:
        return 2
    off = np.abs(hand - marker[1])
    return 1 if off[1] < _DIRECTION_TOL and off[2] > 2.0 * _DIRECTION_TOL else 2


def reach(places: FloatArray) -> float:
    """Span of the middle 98 % of positions (rows, d); 0 if none is detected."""
    return float(np.nan_to_num(reach_of(places, 0.01)))
