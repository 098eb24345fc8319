"""The lab of the pages: its commands, its checks of texts, what it shows, who may ask."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from cell.cable.effects.remote import is_confined
from cell.files.yaml_document import yaml_text
from cell.lab.verdict.checks import CHECKS
from cell.web.lab import Lab, named_files
from cell.web.lab_tasks import LabTasks, Subject
from cell.web.lab_views import (
    NOT_APPLICABLE,
    candidate_table,
    check_rows,
    error_steps,
    failing_places,
    fitted_lines,
    model_errors,
    parameter_lines,
    ranking_rows,
    read_result,
    trials_of,
)
from cell.web.pages.lab.line import former_models
from cell.web.pages.lab.own import TEMPLATE, free_name, named
from cell.web.workspace import Workspace

CONFIG = Path("cell.yaml")


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(Workspace.of_runs(tmp_path / "runs"))


@pytest.fixture
def tasks() -> LabTasks:
    return LabTasks(Workspace(Path("runs.lab")), CONFIG)


def test_the_template_is_right_and_what_could_do_more_than_compute_is_not_run(lab: Lab) -> None:
    checked = lab.check_effect(named(TEMPLATE), TEMPLATE)
    assert checked.good and "drag in proportion" in checked.law
    opening = TEMPLATE.replace("return -p", "open('x', 'w')\n        return -p", 1)
    refused = lab.save_effect("my_drag", opening)
    line = opening[: opening.index("open(")].count("\n") + 1
    assert f"my_drag.py:{line}: `open` is not allowed here" in refused
    assert not Path("x").exists()
    assert lab.save_effect("my_drag", TEMPLATE) == ""
    assert lab.workspace.names(lab.workspace.effects, ".py") == ["my_drag"]
    assert is_confined((lab.workspace.effects / "my_drag.py").resolve())


def test_a_busy_computer_is_not_blamed_on_the_law(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.web.lab.CHECK_S", 0.0)
    checked = lab.check_effect(named(TEMPLATE), TEMPLATE)
    (said,) = checked.output
    assert not checked.good and "too much to do" in said and "law" not in said


@pytest.mark.parametrize("name", ["../x", "a/b", "", "a.b", "-x"])
def test_an_effect_is_kept_nowhere_else(lab: Lab, name: str) -> None:
    assert "letters" in lab.save_effect(name, TEMPLATE)
    assert "characters" in lab.save_effect("long", "#" * 100_000)
    assert not lab.workspace.folder.exists()


def test_a_mapping_names_uploaded_files_only(lab: Lab, tmp_path: Path) -> None:
    mapping = lab.workspace.studies / "a" / "import.yaml"
    (tmp_path / "secret.csv").write_text("1")
    good = "trials: [{file: ../../uploads/a/x.csv, hand_file: ../../uploads/a/y.csv}]"
    assert lab.save_mapping(mapping, good) == ""
    assert mapping.read_text() == good
    for file in ("/etc/passwd", "../../../secret.csv", "../../../../etc/passwd"):
        assert "not in the lab" in lab.save_mapping(mapping, f"trials: [{{file: {file}}}]")
    assert "import.yaml:2" in lab.save_mapping(mapping, "trials:\n  - {file: [}")
    assert mapping.read_text() == good
    assert named_files(["x"]) == [] and named_files({"trials": "x"}) == []


def test_what_is_asked_for_is_a_command(tasks: LabTasks) -> None:
    study = Subject("made", Path("runs.lab/studies/made"))
    cycle = Subject("20261121T021043.800-3", Path("runs/20261121T021043.800-3"), True)
    assert tasks.diagnose(study, ["runs.lab/effects/a.py"], ["air_drag"], True).typed == (
        "cell diagnose runs.lab/studies/made --try runs.lab/effects/a.py --with air_drag "
        "--config cell.yaml -o runs.lab/results/made/diagnosis.json "
        "--report runs.lab/results/made/diagnosis.html"
    )
    assert tasks.fit(cycle, "baseline", [], False).typed == (
        "cell fit runs/20261121T021043.800-3 "
        "-o runs.lab/results/20261121T021043.800-3/models/baseline.json"
    )
    before, after, compared = tasks.fit_own(study, "a", ["air_drag"]).commands
    assert before[2:4] == ("--with", "air_drag") and "without_a.json" in before[-1]
    assert after[2:6] == ("--with", "air_drag", "--with", "runs.lab/effects/a.py")
    assert compared[2:6] == ("--model", before[-1], "--model", after[-1])
    before, after, _ = tasks.fit_own(study, "baseline", []).commands
    assert before[-1] != after[-1], "whatever an effect is called, two models are two files"
    stated = {"--free-length": 0.1, "--thickness": 1e-4}
    assert tasks.propose("x", ["a.csv"], ["h.csv"], stated).typed == (
        "cell import runs.lab/uploads/x/a.csv --hand runs.lab/uploads/x/h.csv "
        "-o runs.lab/studies/x --free-length 0.1 --thickness 0.0001 --force"
    )
    inferred = tasks.discover(study, free_name(["discovered"]), [])
    assert inferred.commands[0][-1] == "runs.lab/effects/discovered_2.py"
    learned = tasks.learn("c", [], "runs", [])
    assert learned.typed == (
        "cell learn --runs runs --config cell.yaml -o runs.lab/candidates/c.yaml"
    )
    assert tasks.promote("c") == (
        *("promote", "runs.lab/candidates/c.yaml", "--config", "cell.yaml"),
    )
    assert tasks.undo() == ("promote", "--undo", "--config", "cell.yaml")


CHECK = {"name": "ties", "question": "How many?", "unit": "effects", "statistic": 0.0}
CHECK |= {"passes": "<=", "limit": 3.0, "passed": True, "failed": "Tied."}
DIAGNOSIS = {
    "verdict": "missing",
    "noise_m": 1e-4,
    "baseline": {"fit_rms_m": 1e-3, "heldout_rms_m": None},
    "missing": [{"effect": "air_drag", "fit_rms_m": 2e-4, "heldout_rms_m": 3e-4}],
    "checks": [
        CHECK,
        {**CHECK, "unit": "p", "passes": ">=", "passed": False},
        {**CHECK, "statistic": None, "passed": None},
    ],
    "ranking": [{"effect": "air_drag", "score": 3247.25, "p_value": 0.0, "status": "present"}],
}


def test_the_error_falls_with_every_effect_added() -> None:
    chart = error_steps(DIAGNOSIS, str)
    assert chart["xAxis"]["data"] == ["Baseline", "+ air_drag"]
    fitted, held_out = chart["series"]
    assert (fitted["data"], held_out["data"]) == ([1.0, 0.2], [None, 0.3])
    assert fitted["markLine"]["data"][0]["yAxis"] == 0.1
    assert chart["yAxis"]["min"] <= 0.1


def test_checks_have_statistic_limit_and_result() -> None:
    rows = check_rows(DIAGNOSIS, str)
    shown = [(r["statistic"], r["limit"], r["result"], r["said"]) for r in rows]
    assert shown == [
        ("0", "effects ≤ 3", "passed", ""),
        ("< 1e-300", "p ≥ 3", "not passed", "Tied."),
        ("–", "effects ≤ 3", "–", "Not tested: no effect was added to the baseline."),
    ]
    assert ranking_rows(DIAGNOSIS)[0]["p"] == "< 1e-300"


def test_every_check_without_a_result_says_why() -> None:
    """Nine of 14 checks said "–"."""
    assert set(NOT_APPLICABLE) == {check.name for check in CHECKS}


def test_parameters_have_prefixes_and_an_own_effect_shows_what_was_fitted() -> None:
    """A rigidity of 21.7 µN·m² was 2.166e-05; the fitted value of an own effect was not shown."""
    found = {"name": "carried.kg_per_m", "unit": "kg/m", "value": 1.5e-3, "low": 1e-3, "high": 2e-3}
    other = {**found, "name": "rigidity_0"}
    shown = fitted_lines({"parameters": [other, found]}, "carried")
    assert shown == ["carried: kg_per_m 1.5 (1 … 2) g/m"]
    missing = [{"effect": "air_drag", "parameters": {"c": found}}]
    assert parameter_lines({"missing": missing}) == ["air_drag: c 1.5 (1 … 2) g/m"]


def trial(name: str, role: str) -> dict[str, object]:
    return {
        "name": name,
        "role": role,
        "by_time": {"t_s": [0.0, 0.1], "rms_m": [1e-3, None]},
        "by_arc_length": {"arc_length_m": [0.1], "rms_m": [2e-3]},
        "by_frequency": {
            "frequency_hz": [1.0, 2.0],
            "residual_m2_per_hz": [1e-9, 0.0],
            "noise_m2_per_hz": [1e-10, 1e-10],
        },
    }


def test_where_models_fail_is_shown_by_time_place_and_frequency() -> None:
    trials = [trial("a", "fit"), trial("b", "validate")]
    models = [
        {"name": n, "effects": e, "fit_rms_m": 1e-3, "heldout_rms_m": 1e-3, "trials": trials}
        for n, e in (("before", []), ("after", ["air_drag"]))
    ]
    comparison = {"noise_m": None, "trials": trials, "models": models}
    assert trials_of(comparison) == ["b", "a"]
    assert model_errors(comparison, str)["xAxis"]["data"] == ["before", "after\nair_drag"]
    lines = {
        place: [s["data"] for s in failing_places(comparison, place, "b", str)["series"]]
        for place in ("by_time", "by_arc_length", "by_frequency")
    }
    assert lines["by_time"] == [[[0.0, 1.0]]] * 2
    assert lines["by_arc_length"] == [[[100.0, 2.0]]] * 2
    assert lines["by_frequency"] == [[[1.0, 0.001]]] * 2 + [[[1.0, 1e-4], [2.0, 1e-4]]]


def test_candidates_stand_side_by_side_with_their_gates(tmp_path: Path) -> None:
    gates = [{"gate": "enough forecasts", "passed": True, "found": "5"}]
    refused = [*gates, {"gate": "identifiable", "passed": False, "found": "1.2"}]
    model = {"effects": [{"effect": "effects/drag.py"}]}
    content = {"a": {"model": model, "gates": gates, "verdict": "missing"}}
    content["b"] = {"model": model, "gates": refused}
    paths = {name: tmp_path / f"{name}.yaml" for name in (*content, "broken")}
    for name, data in content.items():
        paths[name].write_text(yaml_text(data))
    paths["broken"].write_text("format: x")
    columns, rows = candidate_table(paths, str)
    assert [c["name"] for c in columns] == ["gate", "a", "b", "broken"]
    assert rows[0]["a"] == "drag" and rows[0]["broken"].startswith("✗")
    assert rows[2] == {"gate": "enough forecasts", "a": "✓ 5", "b": "✓ 5"}
    assert rows[3] == {"gate": "identifiable", "b": "✗ 1.2"}


def test_a_failed_import_is_no_study(tmp_path: Path) -> None:
    """It was selected all the same, and the page showed that a file of it was not there."""
    made = Subject("a", tmp_path / "a")
    assert not made.is_there
    made.folder.mkdir()
    (made.folder / "import.txt").write_text("refused")
    assert not made.is_there
    (made.folder / "import.yaml").write_text("trials: []")
    assert made.is_there and made.to_import


def test_former_models_are_counted_without_those_undone(tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    assert former_models(config) == 0
    folder = tmp_path / "cell.models"
    folder.mkdir()
    for name in ("1.yaml", "2.undone.yaml"):
        (folder / name).touch()
    assert former_models(config) == 1


def test_a_result_that_is_none_is_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "diagnosis.json"
    assert read_result(path) is None
    path.write_text(json.dumps({"limit": math.pi}))
    assert read_result(path) == {"limit": math.pi}
    for text in ("[1]", "{"):
        path.write_text(text)
        assert read_result(path) is None
