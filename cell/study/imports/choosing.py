"""Choice of the cable's points in a file, their order, and the gripping point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import did_you_mean
from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.contents import Contents, Point
from cell.study.imports.shape import (
    chain,
    lost_rows,
    means_lost,
    middle,
    reach_of,
    rest_rows,
)
from cell.study.imports.units import METRES

#: A point stays if it moves by less than this share of what the farthest moves.
STAYS = 1e-3
#: A point that is seen in less than this share of the rows that show a usual one is a false
#: detection.
_RARE = 0.15
#: Values that programs write into all coordinates of what was not seen.
LOST = (0.0, -9999.0, 9999.0, -999.0, 999.0, -1.0)
#: First words of names that programs give to what nobody named.
_UNLABELED = frozenset(("unlabeled", "unlabelled", "unidentified", "unassigned"))
#: Share of the record in which a gripper rests and a cable still swings.
_LATE = 0.3


@dataclass(frozen=True)
class Chosen:
    """Points of a cable from the gripper to the tip.

    gripper    the gripping point, in the same file; None = it is in another one, or in none
    second     another point of the gripper
    """

    markers: tuple[Point, ...]
    gripper: Point | None
    second: Point | None
    lost: tuple[float, ...]


def choose(
    capture: Capture,
    inside: Contents,
    hand_elsewhere: bool,
    findings: ImportFindings,
    others: Sequence[Capture] = (),
    free_length_m: float | None = None,
) -> Chosen:
    """The cable's points in order, and the gripper's.  Raises InputError: there are no points,
    or a single one and no gripper.

    findings  those about it are added
    others    files of the other trials, which may lose markers that this one does not
    """
    points = _same_dimension(capture, inside, findings)
    lost = _lost([capture, *others], points)
    raw = {p.name: detected_places(capture, p.columns, lost, p.on_gripper) for p in points}
    _check_distinct(capture, points, raw)
    for value in lost:
        findings.seen("lost", f"{value:g} in all coordinates means that a marker was not seen")
    named = [p for p in points if p.on_gripper]
    cable = [p for p in points if not p.on_gripper]
    if not cable and len(named) > 1:  # a cable all of whose points are called after the gripper
        named, cable = named[:1], named[1:]
    cable, still = _moving(_labeled(cable, findings), raw, findings)
    if not cable:
        raise capture.error(
            0, "shows no point that moves besides the gripper; give the cable's markers"
        )
    hand, second = None, None
    if named:
        cable = _in_front(named, cable, raw, findings)
    if not hand_elsewhere:
        hand, second = _gripper_points(named, cable, raw, inside)
        if hand is not None:
            findings.guessed("hand", f"{hand.name!r} is the gripping point, by its name")
        elif (hand := still) is not None:
            sentence = f"{hand.name!r} does not move: it is taken as the gripping point, held still"
            findings.guessed("hand", sentence)
    if hand is None and not hand_elsewhere:
        _check_several(capture, cable, others)
        order = from_end(cable, raw)
        behind = _behind_jaws(order, raw, free_length_m)
        second = order[behind - 1] if behind else None
        hand, *order = order[behind:]
        sentence = f"no point is named after a gripper: {hand.name!r}, the end of the chain that "
        if second is None:
            findings.guessed("hand", f"{sentence}rests first, is the gripping point")
        else:
            sentence = f"no point is named after a gripper: {hand.name!r} is the gripping point, "
            sentence += f"for {second.name!r} moves with it as one body, and from it to the tip "
            findings.guessed("hand", f"{sentence}the markers span the free length")
    elif hand is None:
        order = from_end(cable, raw)
        if behind := _on_jaws(order, raw, free_length_m):
            body = ", ".join(repr(p.name) for p in order[:behind])
            sentence = f"{body}: on the gripper, for with them the markers span more than the cable"
            findings.guessed("markers", f"{sentence}, and they move as one body: left out")
            order = order[behind:]
    else:
        order = [cable[i - 1] for i in chain(_typical([hand, *cable], raw), 0)[1:]]
    names = " → ".join(p.name for p in order)
    findings.seen(
        "markers",
        f"from the gripper to the tip the markers are {names}, each nearest to the one before",
    )
    return Chosen(tuple(order), hand, second, lost)


#: Chains of one cable are as long as each other to this share, and its pieces to this one.
_SAME_SCALE, _SAME_PIECE, _FEWEST_STEPS = 0.05, 0.3, 3
#: What is done with files that can be no trials of one mapping.
_APART = "import each alone, with its own scale and the same arc_length_m and arc_length_std_m, "
_APART += "then gather the studies: cell study A B -o both"


def check_scales(captures: Sequence[Capture], chosen: Chosen, findings: ImportFindings) -> None:
    """Add trials whose chain is longer or shorter than the first one's, as of another scale.

    raises  InputError: a file has other columns than the first, which the mapping names
    """
    points = [*([chosen.gripper] if chosen.gripper else []), *chosen.markers]
    first, steps = captures[0], list[FloatArray]()
    for capture in captures:
        lacking = [c for p in points for c in p.columns if c not in capture.names]
        if lacking:
            known = did_you_mean(lacking[0], capture.names)
            message = f"has no column {lacking[0]!r} as {first.path.name} has{known}; if it is of "
            raise capture.error(0, f"{message}another program: {_APART}")
        raw = np.stack([detected_places(capture, p.columns, chosen.lost) for p in points], axis=1)
        steps.append(middle(np.linalg.norm(np.diff(raw, axis=1), axis=2)))
        if len(steps[0]) < _FEWEST_STEPS:
            continue
        length, of_first = float(steps[-1].sum()), float(steps[0].sum())
        piece = float(np.max(np.abs(steps[-1] / steps[0] - 1.0), initial=0.0))
        other = abs(length / of_first - 1.0) > _SAME_SCALE or piece > _SAME_PIECE
        if other:
            sentence = f"{capture.path.name}: its markers span {length:.4g}, those of "
            sentence += f"{first.path.name} {of_first:.4g}; their pieces differ by up to "
            sentence += f"{piece:.0%}: if their scales differ, {_APART}"
            findings.guessed("metres_per_unit", sentence)


def _check_several(capture: Capture, cable: Sequence[Point], others: Sequence[Capture]) -> None:
    """Raise InputError where a file shows one point alone: none is left for the gripper."""
    if len(cable) > 1:
        return
    message = "shows one point and no gripper: give a file of the gripper with --hand, or call "
    message += "the columns of its place gripper_x and gripper_y"
    if others:
        message += ", or, if each file shows a marker of one motion, write the columns of all "
        message += "into one file, such as m1_x, m1_y, m2_x"
    raise capture.error(0, f"{message}. Columns: {', '.join(capture.names[:12])}")


def _labeled(cable: Sequence[Point], findings: ImportFindings) -> list[Point]:
    """Points that somebody named; all, if nobody named any."""
    named = [p for p in cable if p.name.split()[0] not in _UNLABELED]
    for p in cable if named else ():
        if p not in named:
            sentence = f"{p.name!r} is no marker of the cable by its name: it is left out"
            findings.seen("markers", sentence)
    return named or list(cable)


def _check_distinct(capture: Capture, points: Sequence[Point], raw: dict[str, FloatArray]) -> None:
    """Raise InputError where two points have the same places in all rows: they are one."""
    for i, first in enumerate(points):
        for second in points[i + 1 :]:
            if first.on_gripper and second.on_gripper:
                continue  # a body and a marker at its origin
            both = np.isfinite(raw[first.name] + raw[second.name]).all(axis=1)
            count = int(both.sum())
            if count > 1 and np.array_equal(raw[first.name][both], raw[second.name][both]):
                raise capture.error(
                    int(np.argmax(both)),
                    f"{first.name!r} and {second.name!r} have the same places in all {count} rows "
                    "that show both: it is one marker; remove the columns of one",
                )


def detected_places(
    capture: Capture, columns: Sequence[str], lost: Sequence[float], of_hand: bool = False
) -> FloatArray:
    """(rows, 2 or 3) positions of a point in the file's unit and axes; nan where not seen."""
    raw = capture.at(list(columns)).copy()
    raw[lost_rows(raw, lost, of_hand)] = np.nan
    return raw


def _same_dimension(capture: Capture, inside: Contents, findings: ImportFindings) -> list[Point]:
    """Points with as many coordinates as most have.  Raises InputError: there are none.

    Three numbers of a gripper among points of a plane are its place and perhaps its angle, if the
    first two are next to these points.
    """
    if not inside.points:
        message = "names no points: no two columns are the x and y of one; name them as tip_x and "
        raise capture.error(0, f"{message}tip_y. Columns: {', '.join(capture.names[:12])}")
    sizes = [len(p.columns) for p in inside.points]
    usual = max(set(sizes), key=sizes.count)
    points = [p for p in inside.points if len(p.columns) == usual]
    for p in inside.points:
        if not p.on_gripper or len(p.columns) <= usual or len(points) < 2:
            continue
        flat = replace(p, columns=p.columns[:usual])
        places = middle(np.stack([capture.at(q.columns) for q in (flat, *points)], axis=1))
        nearest = np.linalg.norm(places[1:] - places[0], axis=1).min()
        if nearest < np.linalg.norm(np.ptp(places[1:], axis=0)):
            points.append(flat)
            sentence = f"of {p.name!r} {' and '.join(flat.columns)} are taken as its place, "
            findings.guessed("hand", f"{sentence}for the other points have {usual} coordinates")
    return points


def _lost(captures: Sequence[Capture], points: Sequence[Point]) -> tuple[float, ...]:
    """Values that stand in all coordinates of a point in some rows, and are none of its places."""
    places = [
        capture.at(list(point.columns))
        for capture in captures
        for point in points
        if set(point.columns) <= set(capture.names)
    ]
    return tuple(value for value in LOST if any(means_lost(value, raw) for raw in places))


def _moving(
    cable: Sequence[Point], raw: dict[str, FloatArray], findings: ImportFindings
) -> tuple[list[Point], Point | None]:
    """Points that move, and the one that stays if it alone does and may be held."""
    shown = {p.name: int(np.isfinite(raw[p.name]).all(axis=1).sum()) for p in cable}
    usual = float(np.median(list(shown.values()))) if cable else 0.0
    for p in cable:
        if 0 < shown[p.name] < _RARE * usual:
            sentence = f"{p.name!r} is seen in {shown[p.name]} of {len(raw[p.name])} rows, other "
            findings.guessed("markers", f"{sentence}points in {usual:g}: it is left out")
    cable = [p for p in cable if not 0 < shown[p.name] < _RARE * usual]
    reach = {p.name: reach_of(raw[p.name]) for p in cable}
    most = max(reach.values(), default=0.0)
    stay = [p for p in cable if reach[p.name] <= STAYS * most or not np.isfinite(reach[p.name])]
    held = stay[0] if len(stay) == 1 and np.isfinite(reach[stay[0].name]) else None
    for p in stay if held is None else ():
        findings.seen("markers", f"{p.name!r} never moves or is never seen: it is left out")
    return [p for p in cable if p not in stay], held


def _gripper_points(
    named: Sequence[Point],
    cable: Sequence[Point],
    raw: dict[str, FloatArray],
    inside: Contents,
) -> tuple[Point | None, Point | None]:
    """The gripper's point nearest to the cable, and another one if its angle is not told
    otherwise."""
    if not named:
        return None, None
    groups = {group for group, _ in inside.quaternions} | {m.group for _, m in inside.angles}
    with_angle = [p for p in named if p.name in groups]

    def apart(p: Point) -> float:
        away = middle(
            np.stack([np.linalg.norm(raw[p.name] - raw[c.name], axis=1) for c in cable], 1)
        )
        return float(np.min(away, initial=np.inf, where=np.isfinite(away)))

    hand = min(with_angle or named, key=apart)
    others = [p for p in named if p is not hand]
    return hand, others[0] if others and not with_angle else None


def from_end(cable: Sequence[Point], raw: dict[str, FloatArray]) -> list[Point]:
    """Points in the order in which a cable passes through them at rest, from the end that rests
    first: there the gripper is."""
    places = _typical(cable, raw)
    orders = [chain(places, start) for start in range(len(cable))]
    order = min(
        orders, key=lambda o: float(np.linalg.norm(np.diff(places[o], axis=0), axis=1).sum())
    )
    late = slice(int((1.0 - _LATE) * len(raw[cable[0].name])), None)
    first, last = (reach_of(raw[cable[i].name][late]) for i in (order[0], order[-1]))
    return [cable[i] for i in (order if not first > last else order[::-1])]


#: Points of one body keep their distance to this share of the length that they are part of.
_ONE_BODY = 0.01
#: … and to this share of what the distance of a cable's point changes.
_OF_CABLE = 0.4
#: A chain is as long as the cable to this share of its length.
_AS_LONG = 0.03


def _changes(first: FloatArray, second: FloatArray) -> float:
    """By how much the distance of two points (rows, d) changes, but for a few rows."""
    away = np.linalg.norm(first - second, axis=1)
    away = away[np.isfinite(away)]
    return float(np.subtract(*np.percentile(away, (98, 2)))) if len(away) > 1 else np.inf


def _in_front(
    named: Sequence[Point],
    cable: Sequence[Point],
    raw: dict[str, FloatArray],
    findings: ImportFindings,
) -> list[Point]:
    """Points but those that move with the gripper as one body, behind it.

    The cable's next marker keeps its distance too, but is where the others are.
    """
    places = _typical([*named, *cable], raw)
    size = float(np.ptp(places, axis=0).max())
    change = {p.name: max(_changes(raw[h.name], raw[p.name]) for h in named) for p in cable}
    most = min(_ONE_BODY * size, _OF_CABLE * max(c for c in [0.0, *change.values()] if c < np.inf))
    rigid = [p for p in cable if change[p.name] < most]
    loose = [i for i, p in enumerate(cable, len(named)) if p not in rigid]
    if not rigid or len(loose) < 2 or not np.isfinite(places).all():
        return list(cable)
    hand = places[: len(named)].mean(axis=0)
    towards = places[loose].mean(axis=0) - hand
    body = [p for i, p in enumerate(cable, len(named))
            if p in rigid and float((places[i] - hand) @ towards) < 0.0]  # fmt: skip
    for p in body:
        sentence = f"{p.name!r} moves with the gripper as one body, away from the cable: it is left"
        findings.seen("markers", f"{sentence} out")
    return [p for p in cable if p not in body]


def _behind_jaws(
    order: Sequence[Point], raw: dict[str, FloatArray], free_length_m: float | None
) -> int:
    """How many points of a chain are on the gripper, behind the point that holds the cable.

    From this one to the tip the chain is as long as the cable, where with them it is not.
    """
    steps = np.linalg.norm(np.diff(_typical(order, raw), axis=0), axis=1)
    left = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    if free_length_m is None or not np.isfinite(left).all():
        return 0
    units = [METRES[p.unit] for p in order if p.unit in METRES][:1] or list(METRES.values())
    for behind in range(len(order) - 2):
        if any(abs(left[behind] * u - free_length_m) < _AS_LONG * free_length_m for u in units):
            body = order[: behind + 1]
            whole = left[behind]
            change = [_changes(raw[p.name], raw[body[-1].name]) for p in body[:-1]]
            return behind if max(change, default=0.0) < _ONE_BODY * whole else 0
    return 0


def _on_jaws(
    order: Sequence[Point], raw: dict[str, FloatArray], free_length_m: float | None
) -> int:
    """How many points of a chain are on a gripper that has a file of its own.

    With them the chain is longer than the cable, without them it is not, and they are one body.
    """
    unit = METRES.get(order[0].unit)
    if free_length_m is None or unit is None:
        return 0
    steps = np.linalg.norm(np.diff(_typical(order, raw), axis=0), axis=1)
    left = np.append(np.cumsum(steps[::-1])[::-1], 0.0) * unit
    most_m = (1.0 + _AS_LONG) * free_length_m
    count = int(np.argmax(left <= most_m))
    body = order[:count]
    change = [_changes(raw[p.name], raw[body[-1].name]) * unit for p in body[:-1]]
    return count if max(change, default=0.0) < _ONE_BODY * free_length_m else 0


def _typical(points: Sequence[Point], raw: dict[str, FloatArray]) -> FloatArray:
    """(points, d) at rest, else a row in the middle that shows them all."""
    places = np.stack([raw[p.name] for p in points], axis=1)
    rest = places[rest_rows(places)]
    if len(rest) and np.isfinite(rest).all(axis=2).any(axis=0).all():
        return middle(rest)
    whole = places[np.isfinite(places).all(axis=(1, 2))]
    return whole[len(whole) // 2] if len(whole) else middle(places)
