"""How a trial begins, and by how much the clock of its hand's log is off, from what moves first."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.clock_shift import clock_shift_s
from cell.study.imports.convert import times_s
from cell.study.imports.finding import Finding, Sure
from cell.study.imports.mapping import Mapping
from cell.study.imports.places import places_m
from cell.study.imports.shape import FEWEST_REST, rest_rows

#: A clock is proposed to be off if it is so by more than this many rows.
ROWS_OFF = 1.5
#: The first marker follows the hand closely if it is within this share of the cable.
NEAR_HAND = 0.35
#: A hand moves if it leaves its place by this share of the cable's length.
_MOVES = 0.01


def start_of(
    name: str, capture: Capture, hand: Capture | None, mapping: Mapping
) -> tuple[dict[str, Any], list[Finding]]:
    """Entries `start`, `release_s` and `clock_offset_s` of a trial, and why.

    raises  InputError: times are in disorder, or a column is missing
    """
    scale = mapping.metres_per_unit or 1.0
    t_s = times_s(capture, mapping.time)
    zero_s = float(t_s[0]) if mapping.time.starts_at_zero else 0.0
    t_s = t_s - zero_s
    xy_m = np.stack(
        [places_m(capture, m.columns, mapping.axes, scale, mapping.lost) for m in mapping.markers],
        axis=1,
    )
    begun: dict[str, Any] = {}
    findings: list[Finding] = []
    hand_s, hand_m = t_s, np.zeros((len(t_s), 2))
    known = mapping.hand.turns is None and mapping.hand.acceleration is None
    if known:
        hand_s, hand_m = _hand(capture, hand, mapping, zero_s)
    elif hand is not None:
        sentence = f"{name}: whether both clocks agree is not known before the hand's path is"
        findings.append(Finding("clock_offset_s", sentence, Sure.GUESSED))
    if known and hand is not None:
        begun, findings = _clock(name, (hand_s, hand_m), (t_s, xy_m), mapping)
        hand_s = hand_s + begun.get("clock_offset_s", 0.0)
    seen = np.isfinite(xy_m).any(axis=(1, 2))
    length_m = mapping.cable.free_length_m or 1.0
    of_hand = (hand_s, hand_m) if known else None
    more, told = _start(name, (t_s[seen], xy_m[seen]), of_hand, length_m)
    return begun | more, [*findings, *told]


def _hand(
    capture: Capture, hand: Capture | None, mapping: Mapping, zero_s: float
) -> tuple[FloatArray, FloatArray]:
    """Times and places of the gripping point."""
    section, of = mapping.hand, hand or capture
    t_s = times_s(of, section.time or mapping.time) - zero_s
    if section.columns is None:
        return t_s, np.broadcast_to(np.array(section.fixed_m, dtype=np.float64), (len(t_s), 2))
    scale = section.metres_per_unit or mapping.metres_per_unit or 1.0
    axes = section.axes or mapping.axes
    at_m = places_m(of, section.columns, axes, scale, mapping.lost, unseen=0.0, of_hand=True)
    known = np.isfinite(at_m).all(axis=1)
    return t_s[known], at_m[known]


def _clock(
    name: str,
    hand: tuple[FloatArray, FloatArray],
    seen: tuple[FloatArray, FloatArray],
    mapping: Mapping,
) -> tuple[dict[str, Any], list[Finding]]:
    """The offset of the hand's clock, where a marker near it tells one."""
    first, length_m = mapping.markers[0].arc_length_m, mapping.cable.free_length_m
    if first is None or length_m is None or first > NEAR_HAND * length_m:
        sentence = f"{name}: no marker is near the hand: whether both clocks agree is not known"
        return {}, [Finding("clock_offset_s", sentence, Sure.GUESSED)]
    shift_s = clock_shift_s(*hand, seen[0], seen[1][:, 0])
    if shift_s is None:
        sentence = f"{name}: the hand hardly moves: whether both clocks agree is not known"
        return {}, [Finding("clock_offset_s", sentence, Sure.GUESSED)]
    limit_s = ROWS_OFF * float(max(np.median(np.diff(hand[0])), np.median(np.diff(seen[0]))))
    if abs(shift_s) <= limit_s:
        sentence = f"{name}: both clocks agree within {limit_s * 1e3:.3g} ms"
        return {}, [Finding("clock_offset_s", sentence, Sure.SEEN)]
    shift_s = round(shift_s, 4)
    sentence = f"{name}: {shift_s:+g} s are added to the hand's clock, so that both move at once"
    return {"clock_offset_s": shift_s}, [Finding("clock_offset_s", sentence, Sure.GUESSED)]


def _start(
    name: str,
    seen: tuple[FloatArray, FloatArray],
    hand: tuple[FloatArray, FloatArray] | None,
    length_m: float,
) -> tuple[dict[str, Any], list[Finding]]:
    """At rest until the hand moves, let go, or in motion from the first row on.

    hand  None = its path is not known yet
    """
    t_s, xy_m = seen
    rest = rest_rows(xy_m)
    if rest.stop < FEWEST_REST:
        sentence = f"{name}: the cable moves from the first row on: start moving"
        return {"start": "moving"}, [Finding("trials.start", sentence, Sure.SEEN)]
    if hand is None:
        sentence = f"{name}: the cable is at rest at first: start equilibrium"
        return {"start": "equilibrium"}, [Finding("trials.start", sentence, Sure.GUESSED)]
    away = np.linalg.norm(hand[1] - hand[1][:1], axis=1) > _MOVES * length_m
    moves_s = float(hand[0][np.argmax(away)]) if away.any() else np.inf
    begins_s = float(t_s[rest.stop]) if rest.stop < len(t_s) else np.inf
    late_s = 0.15 + float(np.sqrt(length_m / 9.81))  # as `cell.study.clocks` allows it
    if begins_s == np.inf or moves_s <= begins_s + late_s:
        sentence = f"{name}: the cable is at rest until the hand moves: start equilibrium"
        return {"start": "equilibrium"}, [Finding("trials.start", sentence, Sure.SEEN)]
    release_s = round(float(t_s[rest.stop - 1]), 4)
    sentence = (
        f"{name}: the cable moves at {begins_s:.3g} s, the hand does not: let go (start held)"
    )
    return {"start": "held", "release_s": release_s}, [
        Finding("trials.start", sentence, Sure.GUESSED)
    ]
