"""A hundred exports of thirty programs are one study, or are refused with a remedy that works."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cell.files.input_error import InputError
from cell.study.data import Study
from cell.study.imports.capture import Sure
from cell.study.imports.convert import read_captures, study_of
from cell.study.imports.mapping import FILE, read_mapping
from cell.study.imports.read import read_capture
from cell.study.imports.trials import Files, trial_names
from cell.study.imports.understand import Stated, understand
from cell.study.imports.write import mapping_text

from .corpus.entries import CORPUS, Entry
from .corpus.swing import ARCS_M, LENGTH_M, Swing

#: Of places, angles and times beyond what a file's digits leave open: m, rad, s.
PLACE_M, ANGLE_RAD, TIME_S = 1e-6, 1e-5, 2e-5
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
    names = trial_names([file for file, _ in written])
    files = [
        Files(
            name,
            str(file),
            read_capture(file),
            None if gripper is None else str(gripper),
            None if gripper is None else read_capture(gripper),
        )
        for name, (file, gripper) in zip(names, written, strict=True)
    ]
    stated = Stated("s", LENGTH_M, 0.0074, 0.016, 0.0001, **options)
    understood = understand(files, stated)
    out.mkdir(exist_ok=True)
    proposal = out / FILE
    proposal.write_text(mapping_text(understood.mapping, understood.findings, "cell import"))
    if edits:
        content = yaml.safe_load(proposal.read_text())
        for path, value in edits.items():
            section: Any = content
            *keys, last = path.split(".")
            for key in keys:
                section = section[int(key) if key.isdigit() else key]
            section[last] = value
        proposal.write_text(yaml.safe_dump(content))
    read = read_mapping(proposal)
    doubts = [f for f in understood.findings if f.sure in (Sure.GUESSED, Sure.WANTED)]
    said = " ".join(f"{f.entry}: {f.sentence}" for f in doubts)
    return study_of(read, read_captures(read)).study, said


def assert_same(study: Study, truth: list[Swing], entry: Entry) -> None:
    """Places of markers and gripper from its first one on, clamp angles and times are the truth."""
    place_m, angle_rad = PLACE_M + entry.rounding_m, ANGLE_RAD + entry.rounding_rad
    np.testing.assert_allclose(study.arc_length_m, ARCS_M[::-1], atol=ARC_M)
    assert len(study.trials) == len(truth)
    for trial, s in zip(study.trials, truth, strict=True):
        grip, markers = trial.grip, trial.markers
        origin_m = np.array([grip.x_m[0], grip.y_m[0]]) - s.gripper_m[0]
        assert trial.start == "equilibrium"
        np.testing.assert_allclose(markers.t_s - markers.t_s[0], s.t_s, atol=TIME_S)
        np.testing.assert_allclose(
            markers.xy_m - origin_m, s.markers_m[:, ::-1], rtol=0.0, atol=place_m
        )
        at_s = grip.t_s - markers.t_s[0]
        if len(at_s) == len(s.t_s):
            np.testing.assert_allclose(at_s, s.t_s, atol=TIME_S)
            path = np.column_stack([grip.x_m, grip.y_m, grip.angle_rad])
        else:
            each = (grip.x_m, grip.y_m, grip.angle_rad)
            path = np.column_stack([np.interp(s.t_s, at_s, v) for v in each])
        np.testing.assert_allclose(path[:, :2] - origin_m, s.gripper_m, rtol=0.0, atol=place_m)
        np.testing.assert_allclose(path[:, 2], s.angle_rad, rtol=0.0, atol=angle_rad)


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
