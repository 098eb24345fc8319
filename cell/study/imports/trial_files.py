"""The trials that some files hold: each a file, a part of one, or rows of one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.containers import parts_of
from cell.study.imports.groups import with_part
from cell.study.imports.joined_files import joined, motions, tells_only_turns
from cell.study.imports.read import read_capture
from cell.study.imports.row_trials import rows_of, trial_column
from cell.study.imports.trials import Files, unique_names

_Read = Callable[[Path], Capture]


def read_trials(
    files: Sequence[Path], hands: Sequence[Path | None], named: Callable[[Path], str]
) -> list[Files]:
    """Every trial of some files, in their order.

    hands   file of the gripper of each; None = it has none, or it is a part of the same file
    named   name of a file as the mapping says it
    raises  InputError: one cannot be read
    """
    read = cache(read_capture)
    found: list[tuple[str, Path, Path | None]] = []
    for file, hand in zip(files, hands, strict=True):
        parts = parts_of(file) if hand is None else []
        if not parts:
            found.append((file.stem, file, hand))
        for part in parts:
            gripper = with_part(file, part.gripper) if part.gripper else None
            found.append((part.name or file.stem, with_part(file, part.markers), gripper))
    apart = [(file, hand) for _, file, hand in found] == [(file, None) for file in files]
    if apart and (of_motions := _of_motions(files, read, named)):
        return of_motions
    names = unique_names([label for label, _, _ in found])
    return [
        _trial(name, file, hand, read, named)
        for name, (_, file, hand) in zip(names, found, strict=True)
    ]


def _trial(
    name: str, file: Path, hand: Path | None, read: _Read, named: Callable[[Path], str]
) -> Files:
    """A trial with its gripper; a file of orientations alone is joined to the markers'."""
    capture = read(file)
    if hand is None:
        return Files(name, named(file), capture)
    gripper = read(hand)
    if tells_only_turns(gripper, capture):
        both = joined([capture, gripper])
        return Files(name, named(file), both, joined_files=(named(hand),))
    return Files(name, named(file), capture, named(hand), gripper)


def _of_motions(files: Sequence[Path], read: _Read, named: Callable[[Path], str]) -> list[Files]:
    """Trials whose points have a file each; empty = that is not so."""
    captures = [read(file) for file in files]
    groups = motions(captures)
    each = [joined([captures[i] for i in group]) for group in groups]
    names = unique_names([files[group[0]].stem for group in groups])
    made = []
    for name, group, capture in zip(names, groups, each, strict=True):
        first, *others = (named(files[i]) for i in group)
        made.append(Files(name, first, capture, joined_files=tuple(others)))
    return made


def by_rows(trials: Sequence[Files], findings: ImportFindings) -> list[Files]:
    """The trials, with those in the rows of one file as trials of their own.

    The gripper's file has the same numbers in a column of its own, or is of all of them.
    """
    found: list[Files] = []
    for files in trials:
        column = trial_column(files.capture)
        if column is None:
            found.append(files)
            continue
        values = np.unique(files.capture.column(column))
        own = None if files.gripper is None else trial_column(files.gripper)
        for value in values.tolist():
            only = {column: value} | ({own: value} if own is not None else {})
            gripper = None if files.gripper is None else rows_of(files.gripper, only)
            part = replace(
                files,
                name=f"{files.name}_{column}{value:g}",
                capture=rows_of(files.capture, only),
                gripper=gripper,
                only=only,
            )
            found.append(part)
        sentence = f"{files.capture.path.name}: column {column!r} tells {len(values)} trials apart"
        findings.said("trials.only", sentence)
    return found
