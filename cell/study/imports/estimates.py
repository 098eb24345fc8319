"""The gripper's origin and clock that a completed mapping leaves to the data, or that they deny."""

from __future__ import annotations

from collections.abc import Mapping as Dictionary
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.files.yaml_document import Key
from cell.study.imports.cable_root import MIN_CURVE, start_of
from cell.study.imports.capture import Capture
from cell.study.imports.choosing import MOVES
from cell.study.imports.contents import Point, contents, with_names
from cell.study.imports.gripper_proposal import TIP, initial_place
from cell.study.imports.mapping import Mapping, ReadMapping, TrialEntry
from cell.study.imports.places import places_m
from cell.study.imports.row_trials import rows_of
from cell.study.imports.shape import arc_lengths, middle, reach_of, resting
from cell.study.imports.trials import (
    Files,
    aligned_gripper,
    clock_limit_s,
    gripper_path_of,
    markers_m,
    origin_by_clamp,
)
from cell.study.series import noise_m


@dataclass(frozen=True)
class _TrialFiles:
    """A trial's files, its mapping with the markers from the gripper on, and its point of the
    gripper in the markers' file; None = it has none."""

    files: Files
    mapping: Mapping
    clamp: Point | None


def with_estimates(
    read: ReadMapping, captures: Dictionary[str, Capture]
) -> tuple[ReadMapping, list[str]]:
    """The mapping with the origin and the clocks that are null, as a proposal estimates them.

    Notes tell them, and the clocks that the data contradict.
    raises  InputError: what is null is not shown
    """
    notes: list[str] = []
    if read.mapping.hand.columns is None:
        return read, notes
    entries: list[TrialEntry] = []
    for number, entry in enumerate(read.mapping.trials):
        if entry.clock_offset_s is None:
            offset_s, note = _clock(read, entry, captures, ("trials", number, "clock_offset_s"))
            entry = entry.model_copy(update={"clock_offset_s": offset_s})
            notes.append(note)
        else:
            with suppress(InputError):  # the study's own check of the file tells it
                notes += _contradiction(read, entry, captures)
        entries.append(entry)
    mapping = read.mapping.model_copy(update={"trials": entries})
    read = ReadMapping(mapping, read.document)
    if mapping.hand.origin_m is not None:
        return read, notes
    (x_m, y_m), where = _origin_m(read, captures)
    hand = mapping.hand.model_copy(update={"origin_m": (x_m, y_m)})
    note = f"{read.document.path}: hand.origin_m is estimated as [{x_m:g}, {y_m:g}], so that "
    mapping = mapping.model_copy(update={"hand": hand})
    return ReadMapping(mapping, read.document), [*notes, note + where]


def _trial_files(
    read: ReadMapping, entry: TrialEntry, captures: Dictionary[str, Capture]
) -> _TrialFiles:
    of_trial = read.mapping.of_trial(entry)
    markers = sorted(of_trial.markers, key=lambda m: m.arc_length_m or 0.0)
    mapping = of_trial.model_copy(update={"markers": markers})
    columns = [name for m in markers for name in m.columns if name is not None]
    capture, _ = with_names(rows_of(captures[entry.file], entry.only), columns, mapping.time.column)
    gripper = None
    if entry.hand_file is not None:
        named = [name for name in mapping.hand.columns or () if name is not None]
        time = mapping.hand.time or mapping.time
        gripper, _ = with_names(rows_of(captures[entry.hand_file], entry.only), named, time.column)
    files = Files(entry.name, entry.file, capture, entry.hand_file, gripper, entry.joined_files)
    return _TrialFiles(files, mapping, _clamp(capture, mapping, columns))


def _clamp(capture: Capture, mapping: Mapping, of_markers: Sequence[str]) -> Point | None:
    """The point named after the gripper that moves, next to the first marker; None = none does."""
    frame = mapping.axes, mapping.metres_per_unit or 1.0, mapping.lost
    first_m = markers_m(capture, mapping)[:, 0]
    least_m = MOVES * reach_of(markers_m(capture, mapping)[:, -1])
    found: list[tuple[float, Point]] = []
    for point in contents(capture).points:
        same = len(point.columns) == len(mapping.axes.up) and not {*point.columns} & {*of_markers}
        if point.on_gripper and same:
            xy_m = places_m(capture, point.columns, *frame, of_hand=True)
            if reach_of(xy_m) > least_m:
                away_m = float(middle(np.linalg.norm(xy_m - first_m, axis=1)))
                found.append((away_m, point))
    return min(found, key=lambda each: each[0])[1] if found else None


def _clock(
    read: ReadMapping, entry: TrialEntry, captures: Dictionary[str, Capture], key: Key
) -> tuple[float, str]:
    """Offset of the gripper's clock, s, and a note.  Raises InputError: the motions show none."""
    if entry.hand_file is None:
        return 0.0, f"{entry.name}: gripper and markers are in one file, and so on one clock"
    of = _trial_files(read, entry, captures)
    aligned = aligned_gripper(of.files, of.mapping, of.clamp)
    if aligned is None:
        message = f"is null, and no marker near the gripper of {entry.name} moves as it does: "
        raise read.error(key, f"{message}correct axes and markers, or give the offset")
    offset_s = round(aligned.shift_s, 4)
    note = f"{entry.name}: clock_offset_s is estimated as {offset_s:.4f} ± {aligned.std_s:.1g} s"
    return offset_s, note + _turned_clause(aligned.is_turned)


def _turned_clause(is_turned: bool) -> str:
    clause = ", though the gripper's path is turned or mirrored against the marker next to it: "
    return f"{clause}correct axes or hand.axes" if is_turned else ""


def _contradiction(
    read: ReadMapping, entry: TrialEntry, captures: Dictionary[str, Capture]
) -> list[str]:
    """A note if both motions contradict the stated clock beyond their uncertainty; else empty."""
    if entry.hand_file is None:
        return []
    of, stated_s = _trial_files(read, entry, captures), entry.clock_offset_s or 0.0
    aligned = aligned_gripper(of.files, of.mapping, of.clamp)
    if aligned is None or of.files.in_one:
        return []
    if abs(aligned.shift_s - stated_s) <= clock_limit_s(of.files, of.mapping, aligned):
        return []
    return [
        f"{entry.name}: clock_offset_s is {stated_s:.4f} s, yet gripper and cable move at once "
        f"with {aligned.shift_s:.4f} ± {aligned.std_s:.1g} s; null has it estimated"
        f"{_turned_clause(aligned.is_turned)}"
    ]


def _origin_m(
    read: ReadMapping, captures: Dictionary[str, Capture]
) -> tuple[tuple[float, float], str]:
    """Origin of the gripper's places that the first trial shows, and what lies where.

    raises  InputError: it shows none
    """
    entry = read.mapping.trials[0]
    of = _trial_files(read, entry, captures)
    free_m = of.mapping.cable.free_length_m or np.inf
    places = markers_m(of.files.capture, of.mapping)
    if of.clamp is not None:
        frame = of.mapping.axes, of.mapping.metres_per_unit or 1.0, of.mapping.lost
        clamp_m = places_m(of.files.capture, of.clamp.columns, *frame, of_hand=True)
        chain = resting(np.concatenate([clamp_m[:, None], places], axis=1))
        on_cable = chain is not None and arc_lengths(middle(chain)[None])[-1] <= (1 + TIP) * free_m
        if on_cable and (by_clamp := origin_by_clamp(of.files, of.mapping, of.clamp)) is not None:
            return _rounded(by_clamp), f"the gripper is {of.clamp.name!r}"
    arcs, rest = np.array([m.arc_length_m for m in of.mapping.markers], float), resting(places)
    at_m = initial_place(gripper_path_of(of.files, of.mapping).xy_m)
    is_curve = len(arcs) >= MIN_CURVE and bool(np.all(np.diff(arcs) > 0.0))
    if not is_curve or rest is None or at_m is None or entry.start in ("held", "moving"):
        message = f"is null, and {entry.name} shows no 3 markers at rest to estimate it by; measure"
        message += " where the origin of the gripper's places is, as [x, y]"
        raise read.error(("hand", "origin_m"), message)
    start_m, error_m = start_of(CubicSpline(arcs, middle(rest)))
    error_m = float(np.hypot(error_m, np.nan_to_num(noise_m(rest))))
    where = f"the markers' curve begins at the gripper, ± {error_m * 1e3:.1g} mm"
    return _rounded(start_m - at_m), where


def _rounded(xy_m: FloatArray) -> tuple[float, float]:
    return round(float(xy_m[0]), 5), round(float(xy_m[1]), 5)
