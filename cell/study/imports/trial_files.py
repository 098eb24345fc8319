"""The trials that some files hold: each a file, a part of one, or rows of one."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.containers import parts_of
from cell.study.imports.contents import contents, with_names
from cell.study.imports.groups import with_part
from cell.study.imports.joined_files import joined, motions, tells_only_turns
from cell.study.imports.read import read_capture
from cell.study.imports.row_trials import label_text, rows_of, trial_column, trial_labels
from cell.study.imports.trials import Files, unique_names

_Read = Callable[[Path], Capture]


def read_trials(
    files: Sequence[Path], hands: Sequence[Path | None], named: Callable[[Path], str]
) -> list[Files]:
    """Every trial of some files, in their order.

    hands   file of the gripper of each, or of each motion where points have files of their own;
            None = it has none, or it is a part of the same file
    named   name of a file as the mapping says it
    raises  InputError: one cannot be read.  ValueError: hands are not as many as trials
    """
    read = cache(read_capture)
    given = [hand for hand in hands if hand is not None]
    if not given or len(given) < len(files):
        apart = not any(parts_of(file) for file in files)
        if apart and (of_motions := _of_motions(files, given, read, named)):
            return of_motions
    if given and len(hands) != len(files):
        raise ValueError(
            f"--hand names {len(hands)} files for {len(files)} trials; give one for each, "
            "in their order"
        )
    found: list[tuple[str, Path, Path | None]] = []
    for file, hand in zip(files, hands or [None] * len(files), strict=True):
        parts = parts_of(file) if hand is None else []
        if not parts:
            found.append((file.stem, file, hand))
        for part in parts:
            gripper = with_part(file, part.gripper) if part.gripper else None
            found.append((part.name or file.stem, with_part(file, part.markers), gripper))
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


def _of_motions(
    files: Sequence[Path], hands: Sequence[Path], read: _Read, named: Callable[[Path], str]
) -> list[Files]:
    """Trials whose points have a file each; empty = that is not so.

    hands  of the gripper in each; none = a point is the gripper's
    """
    captures = [read(file) for file in files]
    groups = motions(captures, bool(hands))
    if hands and len(groups) != len(hands):
        return []
    each = [joined([captures[i] for i in group]) for group in groups]
    folders = [files[group[0]].parent for group in groups]
    apart = len(set(folders)) == len(groups) > 1
    labels = [files[group[0]].stem for group in groups]
    names = unique_names([f.name for f in folders] if apart else labels)
    made = []
    for number, (group, capture) in enumerate(zip(groups, each, strict=True)):
        first, *others = (named(files[i]) for i in group)
        gripper = hands[number] if hands else None
        made.append(
            Files(
                names[number],
                first,
                capture,
                None if gripper is None else named(gripper),
                None if gripper is None else read(gripper),
                tuple(others),
            )
        )
    return made


def by_rows(trials: Sequence[Files], findings: ImportFindings) -> list[Files]:
    """The trials, with those in the rows of one file as trials of their own.

    The gripper's file has the same numbers in a column of its own, or is of all of them.
    """
    found: list[Files] = []
    for files in _with_rows_of_gripper(trials, findings):
        column = trial_column(files.capture)
        if column is None:
            found.append(files)
            continue
        labels = trial_labels(files.capture, column)
        own = None if files.gripper is None else trial_column(files.gripper)
        for label in labels:
            only = {column: label} | ({own: label} if own is not None else {})
            gripper = None if files.gripper is None else rows_of(files.gripper, only)
            of_file = label if isinstance(label, str) else f"{column}{label:g}"
            part = replace(
                files,
                name=unique_names([f"{files.name}_{of_file}"])[0],
                capture=rows_of(files.capture, only),
                gripper=gripper,
                only=only,
            )
            found.append(part)
        sentence = f"{files.capture.path.name}: column {column!r} tells {len(labels)} trials apart"
        findings.said("trials.only", sentence)
    return found


def _with_rows_of_gripper(trials: Sequence[Files], findings: ImportFindings) -> list[Files]:
    """The trials, each with its rows of a gripper's file that holds those of several.

    Its trials are those of the files that it belongs to by their names, else in their order.
    raises  InputError: it holds more or fewer
    """
    found = list(trials)
    for name in dict.fromkeys(t.gripper_file for t in trials if t.gripper_file):
        own = [i for i, t in enumerate(trials) if t.gripper_file == name]
        gripper = trials[own[0]].gripper
        column = None if gripper is None else trial_column(gripper)
        if gripper is None or column is None or trial_column(trials[own[0]].capture) is not None:
            continue
        labels = trial_labels(gripper, column)
        each = [[w for w in labels if _ends_alike(label_text(w), trials[i].name)] for i in own]
        named = all(len(w) == 1 for w in each) and len({w[0] for w in each}) == len(own)
        if not named and len(labels) != len(own):
            message = f"column {column!r} tells {len(labels)} trials apart, for {len(own)} files "
            message += "with --hand it; name the files after them, or save each in one of its own"
            raise gripper.error(0, message)
        by_name = "names" if named else "order"
        for place, i in enumerate(own):
            label = each[place][0] if named else labels[place]
            only = {column: label}
            found[i] = replace(trials[i], gripper=rows_of(gripper, only), only=only)
            sentence = f"{trials[i].name}: rows of {gripper.path.name} with {column} "
            findings.guessed(
                "trials.only", f"{sentence}{label_text(label)!r} are its gripper's, by {by_name}"
            )
    return found


def _ends_alike(title: str, name: str) -> bool:
    """Whether a title has a word that a file's name ends with."""
    words = re.findall(r"\w+", title.lower())
    return any(re.search(rf"(?:^|[\W_]){re.escape(word)}$", name.lower()) for word in words)


def named_alike(trials: Sequence[Files], findings: ImportFindings) -> list[Files]:
    """The trials with the first one's names for columns that another program calls otherwise."""
    first = trials[0].capture
    found = [trials[0]]
    for files in trials[1:]:
        capture, others = with_names(files.capture, first.names, contents(first).time)
        found.append(replace(files, capture=capture))
        name = files.capture.path.name
        if others:
            each = ", ".join(f"{own!r} as {of_first!r}" for of_first, own in others.items())
            sentence = f"{name}: columns are called otherwise than in {first.path.name}: "
            findings.guessed("trials", f"{sentence}{each}")
    return found
