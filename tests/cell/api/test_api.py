"""From Python the same as by the commands; public names stay as they are."""

from __future__ import annotations

import csv
import errno
import inspect
import json
import os
import subprocess
import sys
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest

import cell
from cell.cable.effects import library
from cell.files.input_error import InputError
from tests.command import run_cell

#: Public functions as users call them: a change here is a change of version.
SIGNATURES = {
    "read_study": "(folder: 'Path | str') -> 'Study'",
    "write_study": "(study: 'Study', folder: 'Path | str', *, recorded: 'bool' = False) -> 'None'",
    "fit": "(study: 'StudyOrFolder', *, effects: 'Sequence[Path | str]' = (), "
    "prior: 'Path | str | None' = None, config: 'Path | str | None' = None, "
    "progress: 'Progress' = <function no_progress>) -> 'FitResult'",
    "compare": "(study: 'StudyOrFolder', "
    "models: 'Sequence[FitResult | Identified | Path | str]', *, "
    "names: 'Sequence[str] | None' = None) -> 'CompareResult'",
    "diagnose": "(study: 'StudyOrFolder', *, effects: 'Sequence[Path | str]' = (), "
    "candidates: 'Path | str | None' = None, known: 'Sequence[Path | str]' = (), "
    "checks: 'Sequence[Path | str]' = (), prior: 'Path | str | None' = None, "
    "config: 'Path | str | None' = None, progress: 'Progress' = <function no_progress>) "
    "-> 'DiagnoseResult'",
    "diagnose_together": "(studies: 'Sequence[StudyOrFolder]', *, "
    "effects: 'Sequence[Path | str]' = (), known: 'Sequence[Path | str]' = (), "
    "checks: 'Sequence[Path | str]' = (), config: 'Path | str | None' = None, "
    "progress: 'Progress' = <function no_progress>) -> 'TogetherResult'",
    "learn": "(runs: 'Sequence[Path | str]', config: 'Path | str', *, "
    "product: 'str | None' = None, effects: 'Sequence[Path | str]' = (), "
    "progress: 'Progress' = <function no_progress>) -> 'LearnResult'",
    "power": "(study: 'StudyOrFolder', effects: 'Sequence[str]', *, verify: 'int' = 0, "
    "motions: 'Sequence[Path | str]' = (), known: 'Sequence[Path | str]' = (), "
    "config: 'Path | str | None' = None, progress: 'Progress' = <function no_progress>) "
    "-> 'PowerResult'",
    "suggest": "(study: 'StudyOrFolder', *, effects: 'Sequence[Path | str]' = (), "
    "known: 'Sequence[Path | str]' = (), prior: 'Path | str | None' = None, "
    "config: 'Path | str | None' = None, progress: 'Progress' = <function no_progress>) "
    "-> 'SuggestResult'",
}
CLASSES = {
    "Cable": ("free_length_m", "line_density_kg_per_m", "width_m", "thickness_m"),
    "Motion": ("t_s", "x_m", "y_m", "angle_rad"),
    "Markers": ("t_s", "xy_m"),
    "Trial": ("name", "role", "start", "grip", "markers", "wrench"),
    "Wrench": ("t_s", "values"),
    "WrenchSensor": ("gauge", "force_std_n", "moment_std_nm", "gain_std"),
    "Study": ("name", "cable", "arc_length_m", "trials", "gravity_m_per_s2", "noise_std_m"),
    "FitResult": ("model", "candidate", "warnings", "agreement"),
    "CompareResult": ("comparisons",),
    "DiagnoseResult": ("diagnosis", "comparisons", "todo", "examination"),
    "PowerResult": ("power",),
    "SuggestResult": ("suggestion",),
    "TogetherResult": ("together",),
    "LearnResult": ("learned", "judgement", "settings", "left_out"),
}


def _signature(function: object) -> str:
    """Without the place in memory of a default."""
    text = str(inspect.signature(function))  # type: ignore[arg-type]
    return text if " at 0x" not in text else text[: text.index(" at 0x")] + text[text.index(">") :]


def test_public_names_are_listed_documented_and_stay_as_they_are() -> None:
    assert set(cell.__all__) == set(SIGNATURES) | set(CLASSES)
    assert set(cell.__all__) <= set(dir(cell))
    for name, signature in SIGNATURES.items():
        assert _signature(getattr(cell, name)) == signature, name
    for name, fields in CLASSES.items():
        assert set(fields) <= set(inspect.signature(getattr(cell, name)).parameters), name
    for name in cell.__all__:
        assert len(inspect.getdoc(getattr(cell, name)) or "") > 30, name
    with pytest.raises(AttributeError, match="no attribute 'diagnos'"):
        cell.diagnos  # noqa: B018


def test_what_is_not_used_is_not_imported() -> None:
    asked = "import cell, sys; print('numpy' in sys.modules, 'pandas' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout == "False False\n"


@pytest.fixture(scope="module")
def folder(make_study, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "made"
    cell.write_study(make_study([library()["tip_mass"].active(mass_kg=2.5e-5)], seed=11), path)
    return path


pytestmark = pytest.mark.usefixtures("few_effects")


@pytest.fixture(scope="module")
def diagnosed(folder: Path, few_effects: set[str]) -> cell.DiagnoseResult:
    return cell.diagnose(folder)


def test_a_diagnosis_is_that_of_the_command(
    folder: Path, diagnosed: cell.DiagnoseResult, tmp_path: Path
) -> None:
    out = tmp_path / "diagnosis.json"
    run_cell("diagnose", folder, "-o", out)
    assert diagnosed.to_json() == json.loads(out.read_text())
    assert "tip mass" in repr(diagnosed)
    assert "missing" in diagnosed._repr_html_()
    frame = diagnosed.to_frame()
    assert frame.effect[0] == "tip_mass"
    assert frame.answer[0] == "missing"
    assert diagnosed.todo[0].command.startswith(f"cell fit {folder}")
    diagnosed.write_report(tmp_path / "report.html")
    assert "tip_mass" in (tmp_path / "report.html").read_text()


def test_the_error_falls_from_fit_to_fit(
    folder: Path, diagnosed: cell.DiagnoseResult, tmp_path: Path
) -> None:
    study = cell.read_study(folder)
    before = cell.fit(study)
    before.write(tmp_path / "before.json")
    compared = cell.compare(study, [tmp_path / "before.json", diagnosed.model])
    assert [c.model for c in compared.comparisons] == ["before", "tip_mass"]
    frame = compared.to_frame()
    held = frame[frame.role == "validate"].groupby("model").rms_m.mean()
    assert held["tip_mass"] < 0.8 * held["before"]
    assert before.to_frame().set_index("parameter").unit["exponent"] == "1"
    assert "0 trials agree" not in before._repr_html_()
    with pytest.raises(FrozenInstanceError):
        before.model = diagnosed.model  # type: ignore[misc]
    with pytest.raises(ValueError, match="names: 1 for 2 models"):
        cell.compare(study, [before, diagnosed.model], names=["one"])
    with pytest.raises(ValueError, match="names: 'one' is given twice"):
        cell.compare(study, [before, diagnosed.model], names=["one", "one"])
    with pytest.raises(ValueError, match="models: there is none; give one or more"):
        cell.compare(study, [])
    # residuals of models of one name took each other's place
    twice = cell.compare(study, [before, before])
    assert [c.model for c in twice.comparisons] == ["baseline", "baseline (2)"]
    assert len(set(twice.write_residuals(tmp_path / "left"))) == 2 * len(study.trials)


def test_one_alone_is_one_of_several(folder: Path) -> None:
    """`effects="air_drag"` was taken for the effects a, i, r, _, d, …"""
    alone = cell.fit(folder, effects="air_drag")
    assert alone.to_json() == cell.fit(folder, effects=["air_drag"]).to_json()
    (shown,) = cell.compare(folder, alone, names="drag").comparisons  # type: ignore[arg-type]
    assert (shown.model, shown.effects) == ("drag", ("air_drag",))
    with pytest.raises(ValueError, match="did you mean 'air_drag'"):
        cell.power(folder, "air_darg")
    with pytest.raises(ValueError, match="effects: there is none; give one or more"):
        cell.power(folder, [])


def test_power_is_told_as_by_the_command(folder: Path) -> None:
    told = cell.power(folder, ["air_drag=0.3"], known=["tip_mass"])
    words = ["power", str(folder), "--try", "air_drag=0.3", "--with", "tip_mass", "--json"]
    done = run_cell(*words)
    assert told.to_json() == json.loads(done.stdout)
    frame = told.to_frame()
    assert (frame.effect[0], frame["size"][0], frame.unit[0]) == ("air_drag", 0.3, "1")
    assert 0.0 < frame.smallest[0] < 10.0
    assert "air_drag" in told._repr_html_()


def test_residuals_are_arrays_and_tables(folder: Path, tmp_path: Path) -> None:
    model = tmp_path / "model.json"
    cell.fit(folder).write(model)
    left = tmp_path / "left"
    asked = ["compare", str(folder), "--model", str(model), "--residuals", str(left)]
    run_cell(*asked)
    compared = cell.compare(folder, [model])
    residuals, predicted = compared.residuals_m(), compared.predicted_m()
    study = cell.read_study(folder)
    assert study.arc_length_m[0] == study.arc_length_m.max()
    for trial in study.trials:
        measured_m = predicted[trial.name] + residuals[trial.name]
        np.testing.assert_allclose(measured_m, trial.markers.xy_m, atol=1e-12)
    for name, left_m in residuals.items():
        with (left / "model" / f"{name}.csv").open() as file:
            heads, *rows = csv.reader(file)
        assert heads[:3] == ["t_s", "dx0_m", "dy0_m"]
        values = np.array([[float(v or "nan") for v in row[1:]] for row in rows])
        np.testing.assert_array_equal(values.reshape(left_m.shape), left_m)


def test_a_full_disk_costs_no_comparison_and_leaves_no_empty_folder(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    model, left = tmp_path / "model.json", tmp_path / "left"
    cell.fit(folder).write(model)
    monkeypatch.setattr("cell.api.results.write_atomic", full)
    asked = ["compare", str(folder), "--model", str(model), "--residuals", str(left)]
    done = run_cell(*asked, code=1)
    assert "mm" in done.stdout, "the comparison was lost"
    assert "left: cannot be written: No space left on device; make room there" in done.stderr
    assert not left.exists()


def test_without_pandas_it_says_how_to_get_it(
    diagnosed: cell.DiagnoseResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install -e .*\[notebook\]"):
        diagnosed.to_frame()


def test_bad_input_is_refused_as_by_the_command(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"study\.yaml"):
        cell.fit(tmp_path)
    with pytest.raises(ValueError, match="did you mean 'tip_mass'"):
        cell.fit(tmp_path, effects=["tip_mas"])


def test_a_study_made_in_python_is_checked_as_one_of_a_file(folder: Path) -> None:
    """A cable of 100 m, for millimetres, was fitted without a word."""
    study = cell.read_study(folder)
    long = replace(study, cable=replace(study.cable, free_length_m=100.0))
    twice = replace(study, trials=(study.trials[0], study.trials[0]))
    for wrong, said in ((long, "give metres, not millimetres"), (twice, "is also trial 1")):
        for work in (cell.fit, cell.diagnose, cell.suggest):
            with pytest.raises(ValueError, match=said):
                work(wrong)


def test_what_is_of_another_kind_is_named(folder: Path) -> None:
    with pytest.raises(TypeError, match=r"is a table; give a list.*'air_drag=2'"):
        cell.power(folder, {"air_drag": 2.0})  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"models: 3 is none; give a result of `cell\.fit`"):
        cell.compare(folder, [3])  # type: ignore[list-item]
    for work in (cell.fit, cell.diagnose, cell.suggest):
        with pytest.raises(TypeError, match="effects: None is no effect; give a name, or a file"):
            work(folder, effects=[None])  # type: ignore[list-item]
        with pytest.raises(TypeError, match="study: None is none; give its folder, or a Study"):
            work(None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="known: 3 is no effect"):
        cell.diagnose(folder, known=[3])  # type: ignore[list-item]
    with pytest.raises(FileNotFoundError, match=r"nowhere\.py: no such effect file"):
        cell.fit(folder, effects=[Path("nowhere.py")])
    with pytest.raises(TypeError, match="study: None is none"):
        cell.diagnose_together([folder, None])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="studies: there is none; give two or more"):
        cell.diagnose_together([])
    with pytest.raises(TypeError, match=r"cable\.free_length_m = '0\.1': must be a number"):
        cell.Cable("0.1", 0.0074, 0.016, 1e-4)  # type: ignore[arg-type]
