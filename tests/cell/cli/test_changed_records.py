"""Files of a cycle that were changed: every command names what is wrong, and none fails."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from cell.cli import app
from cell.records.folder import Record
from cell.records.result import AgreementCheck, Correction, Fault, Outcome
from cell.records.result import Result as CycleResult

NOON = datetime(2026, 11, 22, 12, tzinfo=UTC)
PARAMETER = {"name": "viscosity", "value": 1e-8, "low": 9e-9, "high": 2e-8, "unit": "N·m²·s"}
FULL = CycleResult(
    1,
    Outcome.INSERTED,
    "here",
    **{name: 0.01 for name in vars(CycleResult(1, Outcome.INSERTED, "")) if name.endswith("_m")},
    probability=0.9,
    wait_s=0.1,
    hold_saved_s=0.1,
    seconds={"grasp": 0.4},
    state_seconds={"execute": 2.0},
    fault=Fault("grasp", "a cause"),
    checks=(AgreementCheck("opening", 0.01, "m", 0.0, 0.02),),
    corrections=(Correction(0.1, 0.01, 0.2, 0.5, 0.9),),
)


def cell(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def recorded(runs: Path, cycle: int, result: CycleResult) -> Path:
    record = Record(runs, cycle, NOON)
    record.state(step="grasp", state="execute")
    record.model({"parameters": [PARAMETER]})
    record.close(result)
    return record.folder


def everywhere(data: Any, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Each place in plain data."""
    yield at
    for key, value in (
        ()
        if not isinstance(data, dict | list)
        else (data.items() if isinstance(data, dict) else enumerate(data))
    ):
        yield from everywhere(value, (*at, key))


def changed(data: Any, at: tuple[str | int, ...], value: Any) -> Any:
    """A copy with another value at a place; ... = without it."""
    if not at:
        return {} if value is ... else value
    copy = data.copy()
    if value is ... and len(at) == 1:
        del copy[at[0]]
    else:
        copy[at[0]] = changed(data[at[0]], at[1:], value)
    return copy


@pytest.mark.parametrize("value", ["x", [1], {"a": None}, True, float("nan"), 10**400])
@pytest.mark.parametrize("name", ["offset_m", "margin_m", "probability", "wait_s", "seconds"])
def test_a_result_with_a_wrong_type_hides_no_other_cycle(
    tmp_path: Path, name: str, value: object
) -> None:
    folder = recorded(tmp_path, 1, FULL)
    recorded(tmp_path, 2, replace(FULL, cycle=2))
    path = folder / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}, indent=2))
    listed = json.loads(cell("list", tmp_path, "--json").stdout)
    assert [c["outcome"] for c in listed] == ["unreadable", "inserted"]
    out = tmp_path / "r.html"
    for done in (
        cell("show", folder),
        cell("show", folder, "--json"),
        cell("report", folder, "-o", out),
    ):
        assert done.exit_code == 2
        for part in ("result.json:", f"{name}", "should be a", "give the file as it was written"):
            assert part in done.stderr


def test_a_state_with_a_number_that_json_lacks_is_shown(tmp_path: Path) -> None:
    folder = recorded(tmp_path, 1, FULL)
    path = folder / "state.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"of_mine": float("nan")}))
    assert json.loads(cell("show", folder, "--json").stdout)["state"]["of_mine"] is None


@pytest.mark.parametrize("model", [{}, {"parameters": None}, {"parameters": [{"name": "a"}]}])
def test_a_model_without_its_parameters_is_named(tmp_path: Path, model: object) -> None:
    folder = recorded(tmp_path, 1, FULL)
    (folder / "model.json").write_text(json.dumps(model))
    for command in ("show", "report"):
        done = cell(command, folder, *(("-o", tmp_path / "r") if command == "report" else ()))
        assert (done.exit_code, "model.json:1:" in done.stderr) == (2, True)
        assert "parameters" in done.stderr


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3)
    | st.sampled_from([10**400, 1e308, -1e308, 5e-324]),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)  # fmt: skip


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_no_change_of_a_file_ends_in_a_traceback(tmp_path: Path, data: st.DataObject) -> None:
    runs = tmp_path / "runs"
    shutil.rmtree(runs, ignore_errors=True)
    folder = recorded(runs, 1, FULL)
    for _ in range(data.draw(st.integers(1, 2))):
        path = folder / data.draw(st.sampled_from(["state.json", "result.json", "model.json"]))
        content = json.loads(path.read_text())
        at = data.draw(st.sampled_from([*everywhere(content)]))
        new = changed(content, at, data.draw(JSON | st.just(...)))
        path.write_text(json.dumps(new))
    out = tmp_path / "r.html"
    for command in (
        ("list", runs), ("list", runs, "--json"), ("show", folder), ("show", folder, "--json"),
        ("report", folder, "-o", out, "--force"),
    ):  # fmt: skip
        done = cell(*command)
        assert done.exit_code in (0, 2), (command, done.exception)
        assert done.exception is None or isinstance(done.exception, SystemExit)
        assert command[0] != "list" or done.exit_code == 0
