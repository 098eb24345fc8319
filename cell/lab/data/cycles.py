"""Recorded cycles of many cables, read for learning a common model."""

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

#: Relative tolerance of datasheets of the same cable.
SAME = 1e-6
#: Reason to omit a cycle that ended, or was killed, before its study was written.
UNMEASURED = "nothing was measured"
NONE_MEASURED = "no cycle here has measurements"
#: Reason to omit a cycle with the name of another one.
_TWICE = "the same as {}, or called so; if it is another cable, rename its folder"


@dataclass(frozen=True, eq=False)
class RecordedCycle:
    """The recorded measurements of one cable.

    held      the hold for identification; None = a measurement with its own motions
    executed  the execution; None = there was none
    product   of the cycle; None = its settings have no products
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

    Each counts once, also if a folder occurs repeatedly: a copy is not another cable.
    product  cycles of another product, or of none, are omitted; None = cycles with a product are
    raises  InputError: a folder without a cycle, one of another datasheet, or none usable
    """
    cycles: list[RecordedCycle] = []
    left_out: list[str] = []
    folders: dict[str, Path] = {}
    for folder in _folders(runs):
        if first := folders.get(folder.resolve().name):
            left_out.append(f"{folder}: {_TWICE.format(first)}")
            continue
        cycle = _read(folder)
        if cycle is None:
            left_out.append(f"{folder}: {UNMEASURED}")
            continue
        if cycle.product != product:
            left_out.append(f"{folder}: of {_of(cycle.product)}, not of {_of(product)}")
            continue
        for name, value in cable.numbers.items():
            stated = cycle.study.cable.numbers[name]
            if not np.isclose(stated, value, rtol=SAME, atol=0.0):
                message = f"is {stated:g}, but {value:g} in the settings; learn from one kind only"
                place = folder / "study" / "study.yaml"
                raise InputError([Problem(place, 1, None, f"cable.{name}", message)])
        cycles.append(cycle)
        folders[cycle.name] = folder
    if not cycles:
        why = NONE_MEASURED if product is None else f"{NONE_MEASURED} of product {product}"
        raise InputError([Problem(Path(runs[0]), 1, None, "", why)])
    return sorted(cycles, key=lambda c: c.name), left_out


def measured(runs: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """The folders without cycles that recorded no study; and a note on each omitted one.

    raises  InputError: none remains
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
