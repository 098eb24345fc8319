"""Choice of the cable's points in a file, their order, and the gripping point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import did_you_mean
from cell.study.imports.cable_points import (
    at_rest,
    detected_often,
    distance_range,
    from_end,
    is_clamped,
    labeled,
    least_noisy,
    moving,
    of_one_cable,
    on_the_gripper,
    swing_share,
    without_corners,
)
from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.contents import Contents, Point
from cell.study.imports.shape import (
    chain,
    lost_rows,
    means_lost,
    middle,
    reach_of,
)
from cell.study.imports.units import METRES
from cell.study.tracks import identical

#: A point is on a moving gripper if it moves by more than this share of the largest motion.
MOVES = 0.1
#: Values that programs write into all coordinates of a point that was not detected.
LOST = (0.0, -9999.0, 9999.0, -999.0, 999.0, -1.0)


@dataclass(frozen=True)
class Chosen:
    """Points of a cable from the gripper to the tip.

    gripper    the gripping point, in the same file; None = in another file, or not measured
    second     a second point of the gripper
    clamp      a point named after the gripper, whose path is in another file
    """

    markers: tuple[Point, ...]
    gripper: Point | None
    second: Point | None
    lost: tuple[float, ...]
    clamp: Point | None = None


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

    findings  extended by those about the points
    others    files of the other trials, in which other markers may be missing
    """
    points = _same_dimension(capture, inside, findings)
    lost = _missing_codes([capture, *others], points)
    raw = {p.name: detected_places(capture, p.columns, lost, p.on_gripper) for p in points}
    points = _distinct(capture, points, raw, findings)
    for value in lost:
        findings.shown("lost", f"{value:g} in all coordinates means that a marker was not seen")
    points = without_corners(points, raw, findings)
    named = [p for p in points if p.on_gripper]
    cable = [p for p in points if not p.on_gripper]
    if not cable and len(named) > 1:  # a cable all of whose points are called after the gripper
        named, cable = named[:1], named[1:]
    cable = detected_often(labeled(cable, findings), raw, findings)
    cable, fixed = moving(named, cable, raw, hand_elsewhere, findings)
    named, cable = on_the_gripper(named, cable, raw, findings)
    cable = of_one_cable(named, cable, raw, free_length_m, findings)
    if not cable:
        raise capture.error(
            0, "shows no point that moves besides the gripper; give the cable's markers"
        )
    hand, second, clamp = None, None, None
    body = _body(named, cable, raw)
    cable = [p for p in cable if p not in body]
    if named and hand_elsewhere:
        most = max(reach_of(raw[p.name]) for p in cable)
        clamp, _ = _gripper_points(named, cable, raw, inside)
        clamp = clamp if clamp and reach_of(raw[clamp.name]) > MOVES * most else None
    if not hand_elsewhere:
        if not _with_angle(named, inside):
            named = least_noisy(named, cable, raw, findings)
        hand, second = _gripper_points([*named, *body], cable, raw, inside)
        if hand is not None:
            findings.guessed("hand", f"{hand.name!r} is the gripping point, by its name")
        elif (hand := fixed) is not None:
            sentence = f"{hand.name!r} does not move: it is taken as the gripping point, held still"
            findings.guessed("hand", sentence)
    for p in body:
        if p is not second:
            sentence = f"{p.name!r} moves with the gripper as one body, away from the cable"
            findings.shown("markers", f"{sentence}: it is left out")
    if hand is None and not hand_elsewhere:
        _check_not_single(capture, cable, others)
        order, hand, second = _of_chain(from_end(cable, raw), raw, free_length_m, findings)
    elif hand is None and clamp is None:
        order = from_end(cable, raw)
        if behind := _count_on_gripper(order, raw, free_length_m):
            listed = ", ".join(repr(p.name) for p in order[:behind])
            sentence = f"{listed}: on the gripper, for with them the markers span more than the "
            findings.guessed("markers", f"{sentence}cable, and they move as one body: left out")
            order = from_end(order[behind:], raw)
        if _begins_at_clamp(order, raw, free_length_m):
            clamp, *order = order
            sentence = f"{clamp.name!r} rests while the tip swings: it is at the gripping point"
            findings.shown("markers", f"{sentence}, and no marker is at the tip")
    else:
        first = hand or clamp
        assert first is not None
        order = [cable[i - 1] for i in chain(at_rest([first, *cable], raw), 0)[1:]]
    names = " → ".join(p.name for p in order)
    findings.shown(
        "markers",
        f"from the gripper to the tip the markers are {names}, each nearest to the one before",
    )
    return Chosen(tuple(order), hand, second, lost, clamp)


def _begins_at_clamp(
    order: Sequence[Point], raw: dict[str, FloatArray], free_length_m: float | None
) -> bool:
    """Whether the first marker is on a gripper with its own file: it rests while the tip swings.

    Else the last marker would be taken as the tip, and the first one would be away from the clamp.
    """
    unit = METRES.get(order[0].unit)
    if free_length_m is None or unit is None or len(order) < _FEWEST_STEPS:
        return False
    away = 1.0 - unit * float(_spans(order, raw)[0]) / free_length_m
    return away > _LENGTH_TOL and is_clamped(raw[order[0].name], raw[order[-1].name], away)


def _of_chain(
    order: list[Point],
    raw: dict[str, FloatArray],
    free_length_m: float | None,
    findings: ImportFindings,
) -> tuple[list[Point], Point | None, Point | None]:
    """The cable's points of a chain, the gripping point at its end, and a second one behind that.

    None = there is none: the chain's end swings with the tip.
    """
    behind = _count_behind(order, raw, free_length_m)
    second = order[behind - 1] if behind else None
    hand, *cable = order[behind:]
    sentence = f"no point is named after a gripper: {hand.name!r}"
    if second is not None:
        sentence += f" is the gripping point, for {second.name!r} moves with it as one body, "
        sentence += "and from it to the tip the markers span the free length"
        findings.guessed("hand", sentence)
    elif share := swing_share(raw[hand.name], raw[cable[-1].name]):
        sentence += f", the end of the chain that moves least, swings by {share:.1%} of the "
        sentence += "tip's motion at the end of the record: it is a point of the cable. Name "
        sentence += "the gripping point's columns gripper_x and gripper_y, or give its file "
        sentence += "with --hand; if it is this point, name its columns in hand.columns"
        findings.missing("hand", sentence)
        return order, None, None
    else:
        sentence += ", the end of the chain that rests first, is the gripping point"
        findings.guessed("hand", sentence)
    return cable, hand, second


#: Tolerances of one cable's chain length and of its pieces between trials, and fewest pieces.
_LENGTH_RATIO, _PIECE_RATIO, _FEWEST_STEPS = 0.05, 0.3, 3
#: Remedy for files that cannot be trials of one mapping.
_SEPARATE = "import each alone, with its own scale and the same arc_length_m and arc_length_std_m, "
_SEPARATE += "then gather the studies: cell study A B -o both"


def check_scales(captures: Sequence[Capture], chosen: Chosen, findings: ImportFindings) -> None:
    """Add a finding for each trial whose chain differs in length from the first: another scale.

    raises  InputError: a file has other columns than the first, which the mapping names
    """
    points = [*([chosen.gripper] if chosen.gripper else []), *chosen.markers]
    first, steps = captures[0], list[FloatArray]()
    for capture in captures:
        missing = [c for p in points for c in p.columns if c not in capture.names]
        if missing:
            hint = did_you_mean(missing[0], capture.names)
            message = f"has no column {missing[0]!r} as {first.path.name} has{hint}; if it is of "
            raise capture.error(0, f"{message}another program: {_SEPARATE}")
        raw = np.stack([detected_places(capture, p.columns, chosen.lost) for p in points], axis=1)
        steps.append(middle(np.linalg.norm(np.diff(raw, axis=1), axis=2)))
        if len(steps[0]) < _FEWEST_STEPS:
            continue
        length, of_first = float(steps[-1].sum()), float(steps[0].sum())
        piece = float(np.max(np.abs(steps[-1] / steps[0] - 1.0), initial=0.0))
        scale_differs = abs(length / of_first - 1.0) > _LENGTH_RATIO or piece > _PIECE_RATIO
        if scale_differs:
            sentence = f"{capture.path.name}: its markers span {length:.4g}, those of "
            sentence += f"{first.path.name} {of_first:.4g}; their pieces differ by up to "
            sentence += f"{piece:.0%}: if their scales differ, {_SEPARATE}"
            findings.guessed("metres_per_unit", sentence)


def _check_not_single(capture: Capture, cable: Sequence[Point], others: Sequence[Capture]) -> None:
    if len(cable) > 1:
        return
    message = "shows one point and no gripper: give a file of the gripper with --hand, or call "
    message += "the columns of its place gripper_x and gripper_y"
    if others:
        message += ", or, if each file shows a marker of one motion, write the columns of all "
        message += "into one file, such as m1_x, m1_y, m2_x"
    raise capture.error(0, f"{message}. Columns: {', '.join(capture.names[:12])}")


def _distinct(
    capture: Capture,
    points: Sequence[Point],
    raw: dict[str, FloatArray],
    findings: ImportFindings,
) -> list[Point]:
    """Points without those on the gripper that have the places of another in all rows with both.

    One of the gripper's is kept; both are if both are called so, as a body and a marker at its
    origin.

    raises  InputError: two points away from the gripper are one marker: where it is, is unknown
    """
    hands = [raw[p.name] for p in points if p.on_gripper]
    names = set[str]()
    for i, k, both in identical(np.stack([raw[p.name] for p in points], axis=1)):
        pair = points[i], points[k]
        if all(p.on_gripper for p in pair) or names & {p.name for p in pair}:
            continue
        kept, spare = pair[::-1] if pair[1].on_gripper else pair
        most = _RIGID * reach_of(raw[spare.name])
        if not any(distance_range(hand, raw[spare.name]) < most for hand in hands):
            raise capture.error(
                int(np.argmax(both)),
                f"{kept.name!r} and {spare.name!r} have the same places in all {both.sum()} rows "
                "that show both: it is one marker; remove the columns of one",
            )
        names.add(spare.name)
        sentence = f"{spare.name!r} has the places of {kept.name!r} in all rows that show both"
        findings.shown("markers", f"{sentence}: it is left out")
    return [p for p in points if p.name not in names]


def detected_places(
    capture: Capture, columns: Sequence[str], lost: Sequence[float], of_hand: bool = False
) -> FloatArray:
    """(rows, 2 or 3) positions of a point in the file's unit and axes; nan where not detected."""
    raw = capture.at(list(columns)).copy()
    raw[lost_rows(raw, lost, of_hand)] = np.nan
    return raw


def _same_dimension(capture: Capture, inside: Contents, findings: ImportFindings) -> list[Point]:
    """Points with the most frequent number of coordinates.  Raises InputError: there are none.

    Three columns of a gripper among planar points are its position and perhaps its angle, if the
    first two are close to these points.
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


def _missing_codes(captures: Sequence[Capture], points: Sequence[Point]) -> tuple[float, ...]:
    """Codes of a missing point: in some rows all its coordinates have this value."""
    places = [
        capture.at(list(point.columns))
        for capture in captures
        for point in points
        if set(point.columns) <= set(capture.names)
    ]
    return tuple(value for value in LOST if any(means_lost(value, raw) for raw in places))


def _gripper_points(
    named: Sequence[Point],
    cable: Sequence[Point],
    raw: dict[str, FloatArray],
    inside: Contents,
) -> tuple[Point | None, Point | None]:
    """The gripper's point nearest to the cable, and a second one if no angle is measured."""
    if not named:
        return None, None
    with_angle = _with_angle(named, inside)

    def distance(p: Point) -> float:
        distances = middle(
            np.stack([np.linalg.norm(raw[p.name] - raw[c.name], axis=1) for c in cable], 1)
        )
        return float(np.min(distances, initial=np.inf, where=np.isfinite(distances)))

    hand = min(with_angle or named, key=distance)
    others = [p for p in named if p is not hand]
    return hand, others[0] if others and not with_angle else None


def _with_angle(named: Sequence[Point], inside: Contents) -> list[Point]:
    """The points whose body has an angle or a quaternion."""
    groups = {group for group, _ in inside.quaternions} | {m.group for _, m in inside.angles}
    return [p for p in named if p.name in groups]


#: Distances within a rigid body change by less than this share of the complete length.
_RIGID = 0.01
#: … and by less than this share of the largest change of distance of a cable's point.
_RIGID_SHARE = 0.4
#: Tolerance of a chain's length, relative to the cable's free length.
_LENGTH_TOL = 0.03


def _body(
    named: Sequence[Point], cable: Sequence[Point], raw: dict[str, FloatArray]
) -> list[Point]:
    """Points that move with the gripper as one rigid body, behind it.

    The cable's first marker keeps its distance too, but lies on the side of the others.
    """
    if not named:
        return []
    places = at_rest([*named, *cable], raw)
    size = float(np.ptp(places, axis=0).max())
    change = {p.name: max(distance_range(raw[h.name], raw[p.name]) for h in named) for p in cable}
    most = min(_RIGID * size, _RIGID_SHARE * max(c for c in [0.0, *change.values()] if c < np.inf))
    rigid = [p for p in cable if change[p.name] < most]
    loose = [i for i, p in enumerate(cable, len(named)) if p not in rigid]
    if not rigid or len(loose) < 2 or not np.isfinite(places).all():
        return []
    hand = places[: len(named)].mean(axis=0)
    towards = places[loose].mean(axis=0) - hand
    return [p for i, p in enumerate(cable, len(named))
            if p in rigid and float((places[i] - hand) @ towards) < 0.0]  # fmt: skip


def _spans(order: Sequence[Point], raw: dict[str, FloatArray]) -> FloatArray:
    """(points,) length of the chain at rest from each point to the last, in the file's unit."""
    steps = np.linalg.norm(np.diff(at_rest(order, raw), axis=0), axis=1)
    return np.append(np.cumsum(steps[::-1])[::-1], 0.0)


def _is_rigid(body: Sequence[Point], raw: dict[str, FloatArray], length: float) -> bool:
    """Whether points keep their distances to the last of them; `length` of chain or cable."""
    change = [distance_range(raw[p.name], raw[body[-1].name]) for p in body[:-1]]
    return max(change, default=0.0) < _RIGID * length


def _count_behind(
    order: Sequence[Point], raw: dict[str, FloatArray], free_length_m: float | None
) -> int:
    """Number of points of a chain that are on the gripper, behind the gripping point.

    From the gripping point to the tip the chain is as long as the cable; with them it is longer.
    """
    spans = _spans(order, raw)
    if free_length_m is None or not np.isfinite(spans).all():
        return 0
    units = [METRES[p.unit] for p in order if p.unit in METRES][:1] or list(METRES.values())
    for behind in range(len(order) - 2):
        if any(abs(spans[behind] * u - free_length_m) < _LENGTH_TOL * free_length_m for u in units):
            return behind if _is_rigid(order[: behind + 1], raw, spans[behind]) else 0
    return 0


def _count_on_gripper(
    order: Sequence[Point], raw: dict[str, FloatArray], free_length_m: float | None
) -> int:
    """Number of points of a chain that are on a gripper with its own file.

    With them the chain is longer than the cable, without them it is not; they are one rigid body.
    """
    unit = METRES.get(order[0].unit)
    if free_length_m is None or unit is None:
        return 0
    length = free_length_m / unit
    count = int(np.argmax(_spans(order, raw) <= (1.0 + _LENGTH_TOL) * length))
    return count if _is_rigid(order[:count], raw, length) else 0
