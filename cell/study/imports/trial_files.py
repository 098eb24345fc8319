"""The trials in files: each is a file, a part of a file, or rows of a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.contents import contents, with_names
from cell.study.imports.groups import with_part
from cell.study.imports.joined_files import joined, motions, tells_only_turns
from cell.study.imports.read import parts_in_file, read_capture
from cell.study.imports.row_trials import label_text, rows_of, trial_column, trial_labels
from cell.study.imports.transforms import only_constant
from cell.study.imports.trials import Files, unique_names

_Read = Callable[[Path], Capture]


def read_trials(
    files: Sequence[Path], hands: Sequence[Path | None], named: Callable[[Path], str]
) -> list[Files]:
    """Every trial of some files, in their order.

    hands   gripper's file of each trial, or of each motion if there is a file per point;
            None = it has none, or it is a part of the same file
    named   function that returns a file's name in the mapping
    raises  InputError: one cannot be read.  ValueError: hands and trials differ in number
    """
    read, parts_in = cache(read_capture), cache(parts_in_file)
    files = [file for file in files if not only_constant(file)] or list(files)
    gripper_files = [hand for hand in hands if hand is not None]
    if not gripper_files or len(gripper_files) < len(files):
        single_parts = not any(parts_in(file) for file in files)
        if single_parts and (of_motions := _of_motions(files, gripper_files, read, named)):
            return of_motions
    of_parts = bool(gripper_files) and len(hands) != len(files)  # grippers of trials in a file
    hand_of = hands if hands and not of_parts else [None] * len(files)
    entries: list[tuple[str, Path, Path | None]] = []
    for file, hand in zip(files, hand_of, strict=True):
        parts = parts_in(file) if hand is None else []
        if not parts:
            entries.append((file.stem, file, hand))
        for part in parts:
            gripper = with_part(file, part.gripper) if part.gripper else None
            entries.append((part.name or file.stem, with_part(file, part.markers), gripper))
    if of_parts:
        for _, file, _ in entries:
            read(file)  # of a kind that is not read, the number of trials is unknown
        if len(hands) != len(entries):
            raise ValueError(
                f"--hand names {len(hands)} files for {len(entries)} trials; give one for each, "
                "in their order"
            )
        entries = [(name, file, hand) for (name, file, _), hand in zip(entries, hands, strict=True)]
    names = unique_names([label for label, _, _ in entries])
    return [
        _trial(name, file, hand, read, named)
        for name, (_, file, hand) in zip(names, entries, strict=True)
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
        merged = joined([capture, gripper])
        return Files(name, named(file), merged, joined_files=(named(hand),))
    return Files(name, named(file), capture, named(hand), gripper)


def _of_motions(
    files: Sequence[Path], hands: Sequence[Path], read: _Read, named: Callable[[Path], str]
) -> list[Files]:
    """Trials that have a file for each point; empty = the files are not such.

    hands  gripper's file of each trial; empty = a point is the gripper's
    """
    captures = [read(file) for file in files]
    groups = motions(captures, bool(hands))
    if hands and len(groups) != len(hands):
        return []
    merged = [joined([captures[i] for i in group]) for group in groups]
    folders = [files[group[0]].parent for group in groups]
    by_folder = len(set(folders)) == len(groups) > 1
    labels = [files[group[0]].stem for group in groups]
    names = unique_names([f.name for f in folders] if by_folder else labels)
    trials = []
    hand_of: Sequence[Path | None] = hands or [None] * len(groups)
    for name, group, capture, hand in zip(names, groups, merged, hand_of, strict=True):
        first, *others = (named(files[i]) for i in group)
        files_of = Files(name, first, capture, joined_files=tuple(others))
        if hand is not None:
            files_of = replace(files_of, gripper_file=named(hand), gripper=read(hand))
        trials.append(files_of)
    return trials


def by_rows(trials: Sequence[Files], findings: ImportFindings) -> list[Files]:
    """Split files that hold several trials in their rows into single trials.

    The gripper's file has a column with the same labels, or serves all trials.
    """
    result: list[Files] = []
    for files in _with_rows_of_gripper(trials, findings):
        column = trial_column(files.capture)
        if column is None:
            result.append(files)
            continue
        labels = trial_labels(files.capture, column)
        gripper_column = None if files.gripper is None else trial_column(files.gripper)
        for label in labels:
            only = {column: label} | ({gripper_column: label} if gripper_column is not None else {})
            gripper = None if files.gripper is None else rows_of(files.gripper, only)
            suffix = label if isinstance(label, str) else f"{column}{label:g}"
            part = replace(
                files,
                name=unique_names([f"{files.name}_{suffix}"])[0],
                capture=rows_of(files.capture, only),
                gripper=gripper,
                only=only,
            )
            result.append(part)
        sentence = f"{files.capture.path.name}: column {column!r} tells {len(labels)} trials apart"
        findings.stated("trials.only", sentence)
    return result


def _with_rows_of_gripper(trials: Sequence[Files], findings: ImportFindings) -> list[Files]:
    """The trials, each with its rows of a gripper's file that holds several trials.

    The rows are assigned by names of files if these match labels, else in order.
    raises  InputError: the file holds more or fewer trials
    """
    result = list(trials)
    for name in dict.fromkeys(t.gripper_file for t in trials if t.gripper_file):
        users = [i for i, t in enumerate(trials) if t.gripper_file == name]
        gripper = trials[users[0]].gripper
        column = None if gripper is None else trial_column(gripper)
        if gripper is None or column is None or trial_column(trials[users[0]].capture) is not None:
            continue
        labels = trial_labels(gripper, column)
        hits = [[w for w in labels if _ends_with(label_text(w), trials[i].name)] for i in users]
        unique = all(len(w) == 1 for w in hits) and len({w[0] for w in hits}) == len(users)
        if not unique and len(labels) != len(users):
            message = f"column {column!r} tells {len(labels)} trials apart, for {len(users)} files "
            message += "with --hand it; name the files after them, or save each in one of its own"
            raise gripper.error(0, message)
        by_name = "names" if unique else "order"
        for position, i in enumerate(users):
            label = hits[position][0] if unique else labels[position]
            only = {column: label}
            result[i] = replace(trials[i], gripper=rows_of(gripper, only), only=only)
            sentence = f"{trials[i].name}: rows of {gripper.path.name} with {column} "
            findings.guessed(
                "trials.only", f"{sentence}{label_text(label)!r} are its gripper's, by {by_name}"
            )
    return result


def _ends_with(title: str, name: str) -> bool:
    """Whether a file's name ends with a word of a title."""
    words = re.findall(r"\w+", title.lower())
    return any(re.search(rf"(?:^|[\W_]){re.escape(word)}$", name.lower()) for word in words)


def named_alike(trials: Sequence[Files], findings: ImportFindings) -> list[Files]:
    """The trials with the first one's column names, where another program uses other names."""
    first = trials[0].capture
    result = [trials[0]]
    for files in trials[1:]:
        capture, renamed = with_names(files.capture, first.names, contents(first).time)
        result.append(replace(files, capture=capture))
        name = files.capture.path.name
        if renamed:
            each = ", ".join(f"{own!r} as {of_first!r}" for of_first, own in renamed.items())
            sentence = f"{name}: columns are called otherwise than in {first.path.name}: "
            findings.guessed("trials", f"{sentence}{each}")
    return result
