"""Which points of a file are on the cable, which on its gripper, and which are on neither."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse.csgraph import connected_components

from cell.cable.arrays import FloatArray
from cell.files.words import first_of
from cell.study.imports.capture import ImportFindings
from cell.study.imports.contents import HAND, Point
from cell.study.imports.shape import FINAL_SHARE, OF_NOISE, chain, middle, reach_of, rest_rows
from cell.study.imports.units import METRES
from cell.study.series import noise_m

#: Detected positions (rows, d) of points by their names, in the file's unit and axes.
Places = dict[str, FloatArray]

#: A point is stationary if it moves by less than this share of the largest motion.
STAYS = 1e-3
#: … or by no more than its noise and this share; while a gripper moves, by this share of that.
_AT_REST = 0.1
#: Share of the smallest and of the largest values that do not count, for single outliers.
_CUT = 0.02
#: A point detected in less than this share of the median count of rows is a false detection.
_RARE = 0.15
#: First words of the names that programs give to unlabelled points.
_UNLABELED = frozenset(("unlabeled", "unlabelled", "unidentified", "unassigned"))
#: Words for a gripper that may also name the cable's end at it.
_OF_CABLE_TOO = frozenset(("root", "base"))
#: A chain's end swings if its motion with the tip exceeds this share of the tip's and this multiple
#: of its standard error, in more than so many rows.
_SWINGS, _SIGNIFICANT, _FEWEST_LATE = 0.01, 5.0, 20
#: Corners of a tag: nearer to each other than to other points by this factor; their extents in
#: their plane have at least this ratio; their distances change by less than this share of their
#: size; the centre is in their middle within this share of their distances to it.
_CLUMP_RATIO, _FLAT, _RIGID_TAG, _IN_MIDDLE, _FEWEST_CORNERS = 1.5, 0.3, 0.25, 0.2, 4
#: Points are at one place if their distance is less than this share of the points' extent; one is
#: noisier from this ratio on.
_ONE_PLACE, _NOISIER = 0.01, 2.0
#: The distance of neighbours on a cable changes by less than this share of their motion.
_NEIGHBOURS = 0.5
#: Tolerance of the free length.
_LONGER = 0.1


def without_corners(points: Sequence[Point], raw: Places, findings: ImportFindings) -> list[Point]:
    """Points; of those that are one rigid tag, only the one in the middle of the others."""
    corners: list[Point] = []
    for clump in _clumps(points, raw):
        places = at_rest(clump, raw)
        centred = places - places.mean(axis=0)
        extents = np.linalg.svd(centred, compute_uv=False)
        distances = np.linalg.norm(centred, axis=1)
        pairs = combinations(clump, 2)
        change = max(distance_range(raw[p.name], raw[q.name]) for p, q in pairs)
        centre = clump[int(np.argmin(distances))]
        if (
            extents[1] > _FLAT * extents[0]  # else along the cable
            and change < _RIGID_TAG * 2.0 * distances.max()
            and distances.min() < _IN_MIDDLE * np.median(distances)
            and (centre.on_gripper or not any(p.on_gripper for p in clump))
        ):
            corners += [p for p in clump if p is not centre]
    if corners:
        names = first_of([repr(p.name) for p in corners], 8)
        sentence = f"{names} turn with a point in their middle, as corners of a tag do: of each "
        findings.shown("markers", f"{sentence}tag only this point, its centre, is a marker")
    return [p for p in points if p not in corners]


def _clumps(points: Sequence[Point], raw: Places) -> list[list[Point]]:
    """Groups of points that are much nearer to each other than to the points of other groups."""
    places = at_rest(points, raw) if len(points) > _FEWEST_CORNERS else np.full((1, 2), np.nan)
    if not np.isfinite(places).all():
        return []
    tree = linkage(places, "single")
    heights = np.maximum(tree[:, 2], 1e-9 * tree[-1, 2])
    jumps = np.flatnonzero(heights[1:] > _CLUMP_RATIO * heights[:-1])
    for jump in jumps:
        numbers = fcluster(tree, tree[jump, 2], "distance")
        groups = [[p for p, n in zip(points, numbers, strict=True) if n == k]
                  for k in np.unique(numbers)]  # fmt: skip
        if clumps := [g for g in groups if len(g) >= _FEWEST_CORNERS]:
            return clumps
    return []


def on_the_gripper(
    named: Sequence[Point], cable: Sequence[Point], raw: Places, findings: ImportFindings
) -> tuple[list[Point], list[Point]]:
    """Points of the gripper and of the cable, by their motion; where it does not tell, by name.

    named  points with a word for a gripper in their names
    cable  the others, all moving
    """
    named, cable = list(named), list(cable)
    most = max((reach_of(raw[p.name], _CUT) for p in named), default=0.0)
    still = [p for p in named if len(named) > 1 and _rests(raw[p.name], most)]
    if still and len(still) < len(named):
        _report_omitted(still, "does not move, but the gripper does", findings)
        named = [p for p in named if p not in still]
    if not named or not cable:
        return named, cable
    tip = max(cable, key=lambda p: np.nan_to_num(reach_of(_late(raw[p.name]), _CUT)))
    swinging = [p for p in named if swing_share(raw[p.name], raw[tip.name])]
    weak = [p for p in named if _is_weak(p)]
    if len(swinging) == len(named):
        end = from_end([*named, *cable], raw)[0]
        unnamed = len(weak) == len(named) and end not in named
        swinging = swinging if unnamed and not swing_share(raw[end.name], raw[tip.name]) else []
    for p in swinging:
        sentence = f"{p.name!r} swings with {tip.name!r} while the gripper rests: it is a marker of"
        findings.shown("markers", f"{sentence} the cable, not of the gripper")
    unsure = [p for p in weak if p not in swinging] if len(weak) < len(named) else []
    for p in unsure:
        sentence = f"{p.name!r} is taken as a marker of the cable, for another point is named after"
        findings.guessed("markers", f"{sentence} the gripper; its motion does not tell")
    of_cable = [*swinging, *unsure]
    return [p for p in named if p not in of_cable], [*cable, *of_cable]


def least_noisy(
    named: Sequence[Point], cable: Sequence[Point], raw: Places, findings: ImportFindings
) -> list[Point]:
    """Points of the gripper; of those that show one place, only the one with clearly less noise.

    As a robot's tool point and a camera's dot on the clamp, in the same frame.
    """
    if len(named) < 2 or not cable:
        return list(named)
    size = float(np.ptp(at_rest([*named, *cable], raw), axis=0).max())
    noise = {p.name: _noise(raw[p.name]) for p in named}
    kept = list(named)
    for best, other in permutations(sorted(named, key=lambda p: noise[p.name]), 2):
        apart = _on_all_rows(raw[best.name]) - _on_all_rows(raw[other.name])
        offset = float(np.linalg.norm(middle(apart)))
        within = max(_ONE_PLACE * size, OF_NOISE * noise[other.name])
        one_place = offset < _ONE_PLACE * size and reach_of(apart, _CUT) < within
        if best in kept and other in kept and one_place and (
            noise[other.name] > _NOISIER * noise[best.name]
        ):  # fmt: skip
            kept.remove(other)
            sentence = f"{best.name!r} and {other.name!r} show one place, with noise of "
            sentence += f"{noise[best.name]:.2g} and {noise[other.name]:.2g} {best.unit}: the first"
            sentence += f" is taken; for the other write hand.columns: [{', '.join(other.columns)}]"
            findings.guessed("hand", sentence)
    return kept


def _noise(places: FloatArray) -> float:
    """Noise of positions (rows, d) in the rows that show a point; nan = there are too few."""
    shown = places[np.isfinite(places).all(axis=1)]
    return float(np.linalg.norm([noise_m(values) for values in shown.T]))


def _on_all_rows(places: FloatArray) -> FloatArray:
    """Positions (rows, d), interpolated in the rows that do not show the point."""
    rows, shown = np.arange(len(places)), np.isfinite(places).all(axis=1)
    if not shown.any():
        return places
    return np.column_stack([np.interp(rows, rows[shown], v[shown]) for v in places.T])


def _is_weak(point: Point) -> bool:
    words = {w.rstrip("0123456789") for w in set(point.name.split()) - point.common}
    return not (words & HAND) - _OF_CABLE_TOO


def _report_omitted(points: Sequence[Point], why: str, findings: ImportFindings) -> None:
    for p in points:
        findings.shown("markers", f"{p.name!r} {why}: it is left out")


def labeled(cable: Sequence[Point], findings: ImportFindings) -> list[Point]:
    """Labelled points; all points if none is labelled."""
    named = [p for p in cable if p.name.split()[0] not in _UNLABELED]
    if named:
        unlabeled = [p for p in cable if p not in named]
        _report_omitted(unlabeled, "is no marker of the cable by its name", findings)
    return named or list(cable)


def detected_often(cable: Sequence[Point], raw: Places, findings: ImportFindings) -> list[Point]:
    """Points that are detected about as often as the others."""
    counts = {p.name: int(np.isfinite(raw[p.name]).all(axis=1).sum()) for p in cable}
    median_count = float(np.median(list(counts.values()))) if cable else 0.0
    never = [p for p in cable if not counts[p.name]]
    _report_omitted(never, "is never seen", findings)
    rare = [p for p in cable if 0 < counts[p.name] < _RARE * median_count]
    for p in rare:
        sentence = f"{p.name!r} is seen in {counts[p.name]} of {len(raw[p.name])} rows, other "
        findings.guessed("markers", f"{sentence}points in {median_count:g}: it is left out")
    return [p for p in cable if p not in never and p not in rare]


def moving(
    named: Sequence[Point],
    cable: Sequence[Point],
    raw: Places,
    elsewhere: bool,
    findings: ImportFindings,
) -> tuple[list[Point], Point | None]:
    """Moving points of a cable, and the stationary one that holds it; None = none does.

    named      points on the gripper, which hold it if there are any
    elsewhere  the gripper's path is in another file
    """
    largest = max((reach_of(raw[p.name]) for p in [*named, *cable]), default=0.0)
    of_hand = max((reach_of(raw[p.name], _CUT) for p in named), default=0.0)
    if of_hand > _AT_REST * largest:
        resting = [p for p in cable if reach_of(raw[p.name], _CUT) < _AT_REST * of_hand]
        _report_omitted(resting, "rests while the gripper moves: it is not on the cable", findings)
        return [p for p in cable if p not in resting], None
    exact = [p for p in cable if reach_of(raw[p.name]) <= STAYS * largest]
    resting = [p for p in cable if p in exact or (not named and _rests(raw[p.name], largest))]
    loose = [p for p in cable if p not in resting]
    holding = [p for p in resting if _holds(p, loose, raw)]  # or a first marker, which hardly moves
    resting = [p for p in resting if p in exact or p not in holding]
    clamps = [p for p in exact if p in holding]
    clamp = clamps[0] if len(clamps) == 1 and not named and not elsewhere else None
    strangers = [p for p in resting if p is not clamp]
    _report_omitted(strangers, "never moves: it is not on the cable", findings)
    return [p for p in cable if p not in resting], clamp


def _rests(places: FloatArray, largest: float) -> bool:
    """Whether a point moves by less than a share of the largest motion, and than its noise."""
    reach = reach_of(places, _CUT)
    if reach <= STAYS * largest:
        return True
    noise = float(np.linalg.norm([noise_m(values) for values in places.T]))
    return reach < min(_AT_REST * largest, OF_NOISE * noise)


def _holds(point: Point, cable: Sequence[Point], raw: Places) -> bool:
    """Whether a stationary point may hold a cable: at its end that moves least, which keeps its
    distance to it."""
    places = at_rest([point, *cable], raw)
    if not cable or not np.isfinite(places).all():
        return True
    order = from_end(cable, raw)
    nearest = cable[int(np.argmin(np.linalg.norm(places[1:] - places[0], axis=1)))]
    reach = reach_of(raw[nearest.name], _CUT)
    least = min(reach_of(raw[p.name], _CUT) for p in (order[0], order[-1]))
    change = distance_range(raw[point.name], raw[nearest.name])
    return reach <= least and change < _NEIGHBOURS * reach


def of_one_cable(
    named: Sequence[Point],
    cable: Sequence[Point],
    raw: Places,
    free_length_m: float | None,
    findings: ImportFindings,
) -> list[Point]:
    """Points of a cable without those that cannot be on the same one as the gripper or most others.

    Neighbours on a cable are no farther apart than it is long, and nearly keep their distance.
    """
    points = [*named, *cable]
    if not points:
        return []
    units = {METRES[p.unit] for p in points if p.unit in METRES}
    longest = np.inf
    if free_length_m is not None and len(units) == 1:
        longest = (1.0 + _LONGER) * free_length_m / units.pop()
    reach = [reach_of(raw[p.name], _CUT) for p in points]
    near, coherent = (np.ones((len(points), len(points)), bool) for _ in range(2))
    for (i, p), (k, q) in combinations(enumerate(points), 2):
        distance = np.linalg.norm(raw[p.name] - raw[q.name], axis=1)
        if np.isfinite(distance).sum() <= _FEWEST_LATE:
            continue
        motion = min(max(reach[i], reach[k]), float(np.nanmedian(reach)))
        change = distance_range(raw[p.name], raw[q.name])
        near[i, k] = near[k, i] = np.nanmedian(distance) < longest
        coherent[i, k] = coherent[k, i] = change < _NEIGHBOURS * motion
    of_length, of_motion = (_with_most(links, len(named)) for links in (near, coherent & near))
    kept = list(cable)
    for i, p in enumerate(points):
        if i < len(named) or len(of_motion) < 2 + bool(named) or i in of_motion:
            continue
        if i not in of_length:
            _report_omitted([p], "is farther from the others than the cable is long", findings)
        else:
            sentence = f"{p.name!r} keeps no distance to another point, as neighbours on a cable do"
            findings.guessed("markers", f"{sentence}: it is left out")
        kept.remove(p)
    return kept


def _with_most(links: np.ndarray, named: int) -> set[int]:
    """Indices of the group of linked points with most points, among those with a named one."""
    _, labels = connected_components(links, directed=False)
    wanted = labels[:named] if named else labels
    counts = np.bincount(labels)
    most = max(set(wanted.tolist()), key=lambda k: counts[k])
    return set(np.flatnonzero(labels == most).tolist())


def from_end(cable: Sequence[Point], raw: Places) -> list[Point]:
    """Points in their order along the cable at rest, from the end that comes to rest first: the
    gripper's."""
    places = at_rest(cable, raw)
    orders = [chain(places, start) for start in range(len(cable))]
    order = min(
        orders, key=lambda o: float(np.linalg.norm(np.diff(places[o], axis=0), axis=1).sum())
    )
    first, last = (reach_of(_late(raw[cable[i].name])) for i in (order[0], order[-1]))
    return [cable[i] for i in (order if not first > last else order[::-1])]


def _late(places: FloatArray) -> FloatArray:
    """The last rows of positions (rows, d)."""
    return places[int((1.0 - FINAL_SHARE) * len(places)) :]


def swing_share(end: FloatArray, tip: FloatArray) -> float:
    """Motion of a chain's end (rows, d) with the tip's in the last rows, as a share of that; 0 =
    it rests, or no more than noise moves it.

    A gripping point rests while the cable still swings; a point of the cable swings with it.
    """
    share, std = late_swing(end, tip)
    return share if share > max(_SWINGS, _SIGNIFICANT * std) else 0.0


def late_swing(end: FloatArray, tip: FloatArray) -> tuple[float, float]:
    """Motion of a point (rows, d) with the tip's in the last rows, as a share of that, and its
    standard deviation; 0 and infinite = too few rows show both."""
    end, tip = _late(end), _late(tip)
    both = np.isfinite(end + tip).all(axis=1)
    if np.count_nonzero(both) <= _FEWEST_LATE:
        return 0.0, np.inf
    own, of_tip = (p[both] - p[both].mean(axis=0) for p in (end, tip))
    by_tip, *_ = np.linalg.lstsq(of_tip, own, rcond=1e-6)
    moved = of_tip @ by_tip
    size = max(float(np.linalg.norm(of_tip)), 1e-300)
    residual = float(np.sqrt(np.mean((own - moved) ** 2)))
    return float(np.linalg.norm(moved)) / size, residual * np.sqrt(own.shape[1]) / size


#: Of a beam that is clamped at its root, in its slowest swing: wave number, and ratio of its parts.
_BEAM, _BEAM_RATIO = 1.875104, 0.734096
#: A point that swings by more than the beam's over this may be on the cable between both.
_BETWEEN = 4.0


def is_clamped(first: FloatArray, tip: FloatArray, away: float) -> bool:
    """Whether the first of a chain's points (rows, d) rests with the clamp, by 5 standard
    deviations, rather than swings as the point of a beam at a share `away` of its length.

    source  Rao, Mechanical Vibrations, "Lateral vibration of beams": fixed-free, first mode
    """
    x = _BEAM * max(away, 0.0)
    swings = 0.5 * (np.cosh(x) - np.cos(x) - _BEAM_RATIO * (np.sinh(x) - np.sin(x)))
    share, std = late_swing(first, tip)
    rests = share < swings / _BETWEEN and swing_share(first, tip) == 0.0
    return bool(rests and swings - share > _SIGNIFICANT * std)


def distance_range(first: FloatArray, second: FloatArray) -> float:
    """Range of the distance of two points (rows, d), without 2 % of the rows at either end."""
    distances = np.linalg.norm(first - second, axis=1)
    distances = distances[np.isfinite(distances)]
    return float(np.subtract(*np.percentile(distances, (98, 2)))) if len(distances) > 1 else np.inf


def at_rest(points: Sequence[Point], raw: Places) -> FloatArray:
    """(points, d) positions at rest, else in the middle row of those with all points."""
    places = np.stack([raw[p.name] for p in points], axis=1)
    rest = places[rest_rows(places)]
    if len(rest) and np.isfinite(rest).all(axis=2).any(axis=0).all():
        return middle(rest)
    complete = places[np.isfinite(places).all(axis=(1, 2))]
    return complete[len(complete) // 2] if len(complete) else middle(places)
