"""Many recordings identified again: the table, going on with it, and what differs from then."""

from __future__ import annotations

import json
import os
import shutil
import signal
from itertools import islice
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.files.input_error import InputError
from cell.lab.line.identify_all import IdentifiedTable, identified_table, identify_all, rows_of
from cell.lab.line.recordings import (
    IdentifiedAgain,
    identified_again,
    identify_again,
    options_with,
    packer,
    recordings_in,
    study_to_identify,
)
from cell.study.folder import write_study
from cell.workers.here import LocalCores, OneAfterAnother
from tests.command import run_cell


@pytest.fixture(scope="module")
def runs(make_study, tmp_path_factory) -> Path:
    """Three cables, of which the second is recorded without a swing."""
    folder = tmp_path_factory.mktemp("year")
    for number in range(3):
        study = make_study(seed=30 + number)
        cycle = folder / f"20261125T10000{number}.000-{number + 1}"
        write_study(study, cycle / "study")
        (cycle / "state.json").write_text('{"format": "cable-cycle/1", "cycle": 1, "closed": true}')
    markers = next((folder / "20261125T100001.000-2").glob("study/*/markers.csv"))
    lines = markers.read_text().splitlines()
    markers.write_text("\n".join([*lines[:30], "spoilt", *lines[31:]]) + "\n")
    return folder


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return tmp_path / "identified.csv"


def all_of(runs: Path, table: Path, executor, effects=(), most: int | None = None):
    """The summary, after so many recordings at most."""
    pack = packer(runs, None, effects)
    with identified_table(table) as opened:
        results = identify_all(recordings_in(runs), pack, opened, executor)
        return list(islice(results, most))[-1]


@pytest.fixture(scope="module")
def expected(runs, tmp_path_factory) -> bytes:
    table = tmp_path_factory.mktemp("table") / "identified.csv"
    all_of(runs, table, OneAfterAnother())
    return table.read_bytes()


def test_a_full_disk_is_said_of_the_table(table: Path, full_disk: None) -> None:
    with pytest.raises(OSError, match="File too large") as failed, identified_table(table) as to:
        to.add(IdentifiedAgain("a", "k", "failed", why="x" * 2000))
    assert failed.value.filename == str(table)


def test_the_table_is_the_same_bit_for_bit_however_many_work(runs, table, expected):
    found = all_of(runs, table, LocalCores(2))
    assert table.read_bytes() == expected
    assert (found.recordings, found.done, found.known) == (3, 3, 0)
    assert found.outcomes == {"identified": 2, "failed": 1}


def test_values_are_those_of_a_single_identification(runs, table, expected):
    table.write_bytes(expected)
    first, second, _ = rows_of(table)
    folder = runs / first.recording
    found = identify_again(study_to_identify(folder), options_with(None, []))
    values = [value for value, _, _ in first.parameters.values()]
    assert values == pytest.approx(list(found.values), rel=1e-6)
    assert second.outcome == "failed"
    assert second.why.startswith(f"{second.recording}/study/")
    assert "markers.csv:31" in second.why


def test_an_interrupted_run_goes_on_and_a_torn_line_is_done_again(runs, table, expected):
    all_of(runs, table, OneAfterAnother(), most=2)
    whole = table.read_bytes()
    assert whole == b"".join(expected.splitlines(keepends=True)[:3])
    table.write_bytes(whole[:-20])
    found = all_of(runs, table, OneAfterAnother())
    assert (found.known, found.done) == (1, 3)
    assert table.read_bytes() == expected


def test_a_line_that_was_torn_within_a_letter_is_done_again(table: Path) -> None:
    """A killed run could not go on: "can't decode byte 0xe2"."""
    done = IdentifiedAgain("a", "k", "identified")
    with identified_table(table) as to:
        to.add(done)
        to.add(IdentifiedAgain("b", "k", "rejected", why="…"))
    table.write_bytes(table.read_bytes()[:-2])
    with identified_table(table) as to:
        assert to.known == {"a": done}
    assert list(rows_of(table)) == [done]
    table.write_bytes(table.read_bytes() + b"\xe2\n")
    with pytest.raises(InputError, match=r"identified\.csv:3.*is no text"):
        list(rows_of(table))


def test_what_a_result_depends_on_is_looked_at(runs, table, expected, tmp_path, monkeypatch):
    table.write_bytes(expected)
    assert all_of(runs, table, OneAfterAnother()).known == 3
    monkeypatch.setattr("cell.lab.line.recordings.code_hash", lambda: "another")
    moved = tmp_path / "runs"
    shutil.copytree(runs, moved)
    keys = {p.name: packer(runs, None, [])(p).key for p in recordings_in(runs)}
    assert all(keys[r.recording] != r.key for r in rows_of(table))
    assert packer(moved, None, [])(recordings_in(moved)[0]).key in keys.values()
    assert packer(runs, None, ["air_drag"])(recordings_in(runs)[0]).key not in keys.values()


def with_model(runs: Path, change) -> IdentifiedAgain:
    """The first recording beside a model of then."""
    packed = packer(runs, None, [])(recordings_in(runs)[0])
    row = identified_again(packed)
    model = {
        "parameters": [
            {"name": n, "value": v, "low": low, "high": high}
            for n, (v, low, high) in row.parameters.items()
        ]
    }
    change(model["parameters"])
    file = runs / packed.name / "model.json"
    file.write_text(json.dumps(model))
    try:
        return identified_again(packer(runs, None, [])(runs / packed.name))
    finally:
        file.unlink()


@pytest.mark.parametrize(
    ("deviations", "compared"), [(0.0, "same"), (0.5, "within"), (3.0, "outside")]
)
def test_it_is_said_how_far_values_are_from_those_of_then(runs, deviations, compared):
    def change(parameters):
        one = parameters[0]
        by = deviations * (one["high"] - one["low"]) / (2 * 1.959964)
        for key in ("value", "low", "high"):
            one[key] += by

    row = with_model(runs, change)
    assert row.compared == compared
    if deviations:
        assert row.moved == next(iter(row.parameters))
        assert row.moved_std == pytest.approx(deviations, rel=1e-3)


def test_another_model_is_not_compared(runs):
    assert with_model(runs, list.pop).compared == "other model"


def test_a_recording_that_was_identified_and_cannot_be_now_is_lost(runs):
    recording = recordings_in(runs)[1]
    (recording / "model.json").write_text('{"parameters": []}')
    try:
        row = identified_again(packer(runs, None, [])(recording))
    finally:
        (recording / "model.json").unlink()
    assert (row.outcome, row.compared) == ("failed", "lost")


def test_a_torn_recording_is_a_failed_row(runs, tmp_path):
    shutil.copytree(next(runs.iterdir()), tmp_path / "cycle")
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    table = tmp_path / "t.csv"
    all_of(tmp_path, table, OneAfterAnother())
    rows = {row.recording: row for row in rows_of(table)}
    assert list(rows) == ["cycle", "torn.mcap"]
    assert "`cell recover " in rows["torn.mcap"].why


def test_another_table_is_refused_and_kept(runs, table):
    table.write_text("t_s,x_m\n0,1\n")
    with pytest.raises(InputError, match=r"csv:1: is no table of `cell identify --all`; give"):
        all_of(runs, table, OneAfterAnother())
    assert table.read_text() == "t_s,x_m\n0,1\n"


def test_a_wrong_line_is_named(table, expected):
    lines = expected.decode().splitlines(keepends=True)
    table.write_text("".join([lines[0], lines[1].replace(",306,", ",many,"), "a,b\n"]))
    with pytest.raises(InputError, match=r"csv:[23]: "):
        list(rows_of(table))


def test_a_folder_without_recordings_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no recorded cycle, no recording"):
        recordings_in(tmp_path)


def test_the_command_tells_counts_and_ends_with_1_where_one_is_not_identified(
    runs, table, expected
):
    table.write_bytes(expected)
    command = ["identify", "--all", str(runs), "--csv", str(table)]
    done = run_cell(*command, code=1)
    assert "3 of 3 recordings (3 known from before): 1 failed, 2 identified" in done.output
    assert "Not identified" in done.output
    done = CliRunner().invoke(app, [*command, "--json"])
    assert json.loads(done.stdout)["outcomes"] == {"failed": 1, "identified": 2}
    assert table.read_bytes() == expected


def test_interrupted_the_command_says_how_to_go_on(runs, table, expected, monkeypatch):
    former = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    add = IdentifiedTable.add

    def interrupted(self, row):
        add(self, row)
        os.kill(os.getpid(), signal.SIGINT)

    command = ["identify", "--all", str(runs), "--csv", str(table), "--workers", "1"]
    with monkeypatch.context() as patched:
        patched.setattr(IdentifiedTable, "add", interrupted)
        done = CliRunner().invoke(app, command)
    for number, handler in former.items():
        signal.signal(number, handler)
    assert done.exit_code == 128 + signal.SIGINT
    assert f"recordings are left; the same command goes on with {table}" in done.output
    assert "1 of 3 recordings" in done.output
    run_cell(*command, code=1)
    assert table.read_bytes() == expected


def test_workers_that_are_none_are_refused(runs, table):
    command = ["identify", "--all", str(runs), "--csv", str(table), "--workers", "here"]
    done = run_cell(*command, code=2)
    assert "--workers here: is neither a number of cores" in done.output
    done = run_cell("identify", next(runs.iterdir()), "--workers", "2", code=2)
    assert "--workers is of --all" in done.output
