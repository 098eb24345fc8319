"""A hundred exports of thirty programs are one study, or are refused with a remedy that works."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.study.data import Study
from cell.study.imports.capture import Sure
from cell.study.imports.convert import read_captures, study_of
from cell.study.imports.mapping import FILE, read_mapping
from cell.study.imports.stated import Stated
from cell.study.imports.trial_files import read_trials
from cell.study.imports.understand import understand
from cell.study.imports.write import mapping_text

from .corpus.entries import CORPUS, Entry
from .corpus.swing import ARCS_M, LENGTH_M, Swing
from .made import ANGLE_RAD, check_same, filled

#: Of places beyond what a file's digits leave open, m.
PLACE_M = 1e-6
#: Arc lengths are proposed from shapes whose noise is 0.1 mm.
ARC_M = 2e-4
#: Exports that are not read rightly yet, and why.
NOT_YET: dict[str, str] = {}


def study_from(
    written: list[tuple[Path, Path | None]],
    out: Path,
    options: Mapping[str, float],
    edits: Mapping[str, Any],
) -> tuple[Study, str]:
    """The study as `cell import` makes it in two calls, and what the proposal doubts.

    raises  InputError: the files or the mapping are refused
    """
    files = read_trials([f for f, _ in written], [g for _, g in written], str)
    stated = Stated("s", LENGTH_M, 0.0074, 0.016, 0.0001, **options)
    understood = understand(files, stated)
    out.mkdir(exist_ok=True)
    proposal = out / FILE
    proposal.write_text(mapping_text(understood.mapping, understood.findings, "cell import"))
    if edits:
        filled(proposal, edits)
    read = read_mapping(proposal)
    doubts = [f for f in understood.findings if f.sure in (Sure.GUESSED, Sure.MISSING)]
    said = " ".join(f"{f.entry}: {f.sentence}" for f in doubts)
    return study_of(read, read_captures(read)).study, said


def assert_same(study: Study, truth: list[Swing], entry: Entry) -> None:
    """Arc lengths, and what `check_same` compares, are the truth."""
    np.testing.assert_allclose(study.arc_length_m, ARCS_M[::-1], atol=ARC_M)
    place_m, angle_rad = PLACE_M + entry.rounding_m, ANGLE_RAD + entry.rounding_rad
    check_same(study, *truth, place_m=place_m, angle_rad=angle_rad)


def pair(written: Path | tuple[Path, Path]) -> tuple[Path, Path | None]:
    return (written, None) if isinstance(written, Path) else written


def marked(entry: Entry) -> Any:
    reason = NOT_YET.get(entry.name)
    marks = [] if reason is None else [pytest.mark.xfail(reason=reason, strict=True)]
    return pytest.param(entry, id=entry.name, marks=marks)


@pytest.mark.parametrize("entry", [marked(e) for e in CORPUS])
def test_an_export_is_the_study_or_its_remedy_makes_it(entry: Entry, tmp_path: Path) -> None:
    truth = entry.trials()
    written = [pair(entry.write(s, tmp_path)) for s in truth]
    options = {} if entry.rate_hz is None else {"rate_hz": entry.rate_hz}
    remedy = entry.remedy
    try:
        study, said = study_from(written, tmp_path / "study", options, {})
        if remedy is None:
            assert_same(study, truth, entry)
            return
    except InputError as error:
        if remedy is None:
            raise
        said = str(error)
    assert remedy.says.lower() in said.lower()
    if remedy.mend is not None:
        written = [
            (remedy.mend(file, s), other) for (file, other), s in zip(written, truth, strict=True)
        ]
    study, _ = study_from(written, tmp_path / "study", options | dict(remedy.options), remedy.edits)
    assert_same(study, truth, entry)


def test_the_corpus_has_a_hundred_exports_of_thirty_programs() -> None:
    names = [entry.name for entry in CORPUS]
    assert len(set(names)) == len(names) >= 100
    assert len({entry.program for entry in CORPUS}) >= 30
    assert set(NOT_YET) <= set(names)
