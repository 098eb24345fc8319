"""Recorded cycles of many cables, read for learning what all of them have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.cable.geometry import Cable
from cell.files.input_error import InputError, Problem
from cell.records.folder import is_cycle, read_record
from cell.records.result import Outcome
from cell.study.data import Study, Trial
from cell.study.folder import read_study

#: Data sheets of the same cable agree to this.
SAME = 1e-6
#: Why a cycle is left out that ended, or was killed, before its study was written.
UNMEASURED = "nothing was measured"
NONE_MEASURED = "no cycle here has measurements"
#: Why a cycle is left out that has the name of another one.
_TWICE = "the same as {}, or called so; if it is another cable, rename its folder"


@dataclass(frozen=True, eq=False)
class RecordedCycle:
    """The recorded measurements of one cable.

    held      the hold that it was identified from; None = only measured, with motions of its own
    executed  the execution; None = there was none
    product   that was made; None = its settings have no products
    """

    name: str
    folder: Path
    study: Study
    held: Trial | None
    executed: Trial | None
    outcome: Outcome | None
    product: str | None = None


def read_cycles(
    runs: Sequence[Path], cable: Cable, product: str | None = None
) -> tuple[list[RecordedCycle], list[str]]:
    """Cycles of folders or their subfolders, oldest first; and the cycles left out, with reasons.

    Each counts once, however often it is given: a copy is no other cable.
    product  cycles that say another one, or none, are left out; None = those that say one are
    raises  InputError: a folder that holds no cycle, one of another data sheet, or none of use
    """
    found: list[RecordedCycle] = []
    left_out: list[str] = []
    taken: dict[str, Path] = {}
    for folder in _folders(runs):
        if there := taken.get(folder.resolve().name):
            left_out.append(f"{folder}: {_TWICE.format(there)}")
            continue
        cycle = _read(folder)
        if cycle is None:
            left_out.append(f"{folder}: {UNMEASURED}")
            continue
        if cycle.product != product:
            left_out.append(f"{folder}: of {_of(cycle.product)}, not of {_of(product)}")
            continue
        for name, value in cable.numbers.items():
            theirs = cycle.study.cable.numbers[name]
            if not np.isclose(theirs, value, rtol=SAME, atol=0.0):
                message = f"is {theirs:g}, but {value:g} in the settings; learn from one kind only"
                place = folder / "study" / "study.yaml"
                raise InputError([Problem(place, 1, None, f"cable.{name}", message)])
        found.append(cycle)
        taken[cycle.name] = folder
    if not found:
        why = NONE_MEASURED if product is None else f"{NONE_MEASURED} of product {product}"
        raise InputError([Problem(Path(runs[0]), 1, None, "", why)])
    return sorted(found, key=lambda c: c.name), left_out


def measured(runs: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """The folders without cycles that recorded no study; and a note on each omitted one.

    raises  InputError: none is left
    """
    empty = [
        run
        for run in runs
        if is_cycle(run) and not any((at / "study.yaml").exists() for at in (run, run / "study"))
    ]
    if runs and len(empty) == len(runs):
        raise InputError([Problem(Path(runs[0]), 1, None, "", NONE_MEASURED)])
    return [run for run in runs if run not in empty], [f"{run}: {UNMEASURED}" for run in empty]


def _folders(runs: Sequence[Path]) -> Iterator[Path]:
    for run in runs:
        if is_cycle(run) or (run / "study.yaml").exists():
            yield run
            continue
        inside = sorted(p.parent for p in run.glob("*/state.json")) if run.is_dir() else []
        if not inside:
            message = "holds no recorded cycle (state.json) and no study (study.yaml)"
            raise InputError([Problem(run, 1, None, "", message)])
        yield from inside


def _of(product: str | None) -> str:
    return "no product" if product is None else f"product {product}"


def _read(folder: Path) -> RecordedCycle | None:
    product = None
    if (folder / "state.json").exists():
        record = read_record(folder)
        study, outcome = record.study, record.result.outcome if record.result else None
        product = record.state.get("product")
    elif is_cycle(folder):
        study, outcome = None, None
    else:
        study, outcome = read_study(folder), None
    if study is None:
        return None
    trials = {t.name: t for t in study.trials}
    held, executed = trials.get("identify"), trials.get("execute")
    return RecordedCycle(folder.resolve().name, folder, study, held, executed, outcome, product)
