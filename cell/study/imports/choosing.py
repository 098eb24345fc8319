"""Choice of the cable's points in a file, their order, and the gripping point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, Finding, Sure
from cell.study.imports.contents import Contents, Point
from cell.study.imports.shape import (
    chain,
    lost_rows,
    means_lost,
    middle,
    reach_of,
    rest_rows,
)

#: A point stays if it moves by less than this share of what the farthest moves.
STAYS = 1e-3
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
    of_root    whether the gripping point is the cable's own first marker
    """

    markers: tuple[Point, ...]
    gripper: Point | None
    second: Point | None
    of_root: bool
    lost: tuple[float, ...]


def choose(
    capture: Capture, inside: Contents, hand_elsewhere: bool, others: Sequence[Capture] = ()
) -> tuple[Chosen, list[Finding]]:
    """The cable's points in order, and the gripper's.  Raises InputError: there are no points.

    others  files of the other trials, which may lose markers that this one does not
    """
    points = _same_dimension(capture, inside)
    lost = _lost([capture, *others], points)
    raw = {p.name: detected_places(capture, p.columns, lost, p.on_gripper) for p in points}
    _check_distinct(capture, points, raw)
    findings = [
        Finding("lost", f"{v:g} in all coordinates means that a marker was not seen", Sure.SEEN)
        for v in lost
    ]
    named = [p for p in points if p.on_gripper]
    cable = [p for p in points if not p.on_gripper]
    if not cable and len(named) > 1:  # a cable all of whose points are called after the gripper
        named, cable = named[:1], named[1:]
    cable, told = _labeled(cable)
    findings += told
    cable, still, told = _moving(cable, raw)
    findings += told
    if not cable:
        raise capture.error(
            0, "shows no point that moves besides the gripper; give the cable's markers"
        )
    if hand_elsewhere:
        order = _from_end(cable, raw)
        findings.append(_order_finding(order))
        return Chosen(tuple(order), None, None, False, lost), findings
    hand, second = _gripper_points(named, cable, raw, inside)
    if hand is not None:
        findings.append(
            Finding("hand", f"{hand.name!r} is the gripping point, by its name", Sure.GUESSED)
        )
    elif still is not None:
        hand = still
        sentence = f"{hand.name!r} does not move: it is taken as the gripping point, held still"
        findings.append(Finding("hand", sentence, Sure.GUESSED))
    if hand is not None:
        order = _ordered([hand, *cable], raw, 0)[1:]
        findings.append(_order_finding(order))
        return Chosen(tuple(order), hand, second, False, lost), findings
    if len(cable) < 2:
        sentence = (
            f"{capture.path.name} shows one point and no gripper: name two columns of its place as "
            "hand.columns, or give a file of the gripper with --hand"
        )
        findings += [Finding("hand", sentence, Sure.WANTED), columns_finding(capture)]
        return Chosen(tuple(cable), None, None, False, lost), findings
    order = _from_end(cable, raw)
    sentence = f"no point is named after a gripper: {order[0].name!r}, the end of the chain that "
    findings.append(Finding("hand", f"{sentence}rests first, is the gripping point", Sure.GUESSED))
    findings.append(_order_finding(order[1:]))
    return Chosen(tuple(order[1:]), order[0], None, True, lost), findings


def _labeled(cable: Sequence[Point]) -> tuple[list[Point], list[Finding]]:
    """Points that somebody named; all, if nobody named any."""
    named = [p for p in cable if p.name.split()[0] not in _UNLABELED]
    if not named:
        return list(cable), []
    return named, [
        Finding("markers", f"{p.name!r} is no marker of the cable by its name: it is left out",
                Sure.SEEN)
        for p in cable
        if p not in named
    ]  # fmt: skip


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


def _same_dimension(capture: Capture, inside: Contents) -> list[Point]:
    """Points with as many coordinates as most have.  Raises InputError: there are none."""
    if not inside.points:
        message = "names no points: no two columns are the x and y of one; name them as tip_x and "
        raise capture.error(0, f"{message}tip_y. Columns: {', '.join(capture.names[:12])}")
    sizes = [len(p.columns) for p in inside.points]
    usual = max(set(sizes), key=sizes.count)
    return [p for p in inside.points if len(p.columns) == usual]


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
    cable: Sequence[Point], raw: dict[str, FloatArray]
) -> tuple[list[Point], Point | None, list[Finding]]:
    """Points that move; the one that stays and is an end of the chain; what is left out."""
    reach = {p.name: reach_of(raw[p.name]) for p in cable}
    most = max(reach.values(), default=0.0)
    stay = [p for p in cable if reach[p.name] <= STAYS * most or not np.isfinite(reach[p.name])]
    moving = [p for p in cable if p not in stay]
    held = stay[0] if len(stay) == 1 and np.isfinite(reach[stay[0].name]) else None
    left_out = [] if held is not None else stay
    findings = [
        Finding("markers", f"{p.name!r} never moves or is never seen: it is left out", Sure.SEEN)
        for p in left_out
    ]
    return moving, held, findings


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


def _ordered(points: Sequence[Point], raw: dict[str, FloatArray], start: int) -> list[Point]:
    """Points in the order in which a cable passes through them at rest."""
    places = _typical(points, raw)
    return [points[i] for i in chain(places, start)]


def _from_end(cable: Sequence[Point], raw: dict[str, FloatArray]) -> list[Point]:
    """The same from the end that rests first: there the gripper is."""
    places = _typical(cable, raw)
    orders = [chain(places, start) for start in range(len(cable))]
    order = min(
        orders, key=lambda o: float(np.linalg.norm(np.diff(places[o], axis=0), axis=1).sum())
    )
    late = slice(int((1.0 - _LATE) * len(raw[cable[0].name])), None)
    first, last = (reach_of(raw[cable[i].name][late]) for i in (order[0], order[-1]))
    return [cable[i] for i in (order if not first > last else order[::-1])]


def _typical(points: Sequence[Point], raw: dict[str, FloatArray]) -> FloatArray:
    """(points, d) at rest, else a row in the middle that shows them all."""
    places = np.stack([raw[p.name] for p in points], axis=1)
    rest = places[rest_rows(places)]
    if len(rest) and np.isfinite(rest).all(axis=2).any(axis=0).all():
        return middle(rest)
    whole = places[np.isfinite(places).all(axis=(1, 2))]
    return whole[len(whole) // 2] if len(whole) else middle(places)


def columns_finding(capture: Capture) -> Finding:
    """The file's columns, listed for a person to choose the gripper's, if none was recognised."""
    names, most = capture.names, 24
    more = f" and {len(names) - most} more" if len(names) > most else ""
    sentence = f"columns of {capture.path.name}: {', '.join(names[:most])}{more}"
    return Finding("hand", sentence, Sure.SEEN)


def _order_finding(order: Sequence[Point]) -> Finding:
    names = " → ".join(p.name for p in order)
    sentence = (
        f"from the gripper to the tip the markers are {names}, each nearest to the one before"
    )
    return Finding("markers", sentence, Sure.SEEN)
