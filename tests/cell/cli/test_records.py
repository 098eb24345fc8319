"""Commands about records: where they are, what is written, and what is said of it."""

from __future__ import annotations

import json
import socket
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cell.cli import app
from cell.records.folder import Record
from cell.records.ledger.entry import LedgerEntry
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.recording import form
from cell.records.result import Fault, Outcome
from cell.records.result import Result as CycleResult

CONFIG = Path("config/fake.yaml").absolute()
NOON = datetime(2026, 11, 22, 12, tzinfo=UTC)


def cell(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder of records with one cycle, and its ledger."""
    runs = tmp_path / "runs"
    record = Record(runs, 1, NOON)
    result = CycleResult(1, Outcome.INSERTED, str(record.folder))
    record.close(result)
    ledger = Ledger(runs, create=True)
    ledger.write([LedgerEntry("l", 1, record.folder, NOON, "inserted", ended=NOON, result=result)])
    ledger.close()
    return runs


def test_the_folder_one_is_in_is_a_folder_of_records(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`.` has an empty name, and files stand beside the folder: it ended in a traceback."""
    monkeypatch.chdir(runs)
    for here in (".", "../runs/.", "../runs/../runs", ""):
        listed = cell("history", "--runs", here or ".", "--json")
        assert [c["outcome"] for c in json.loads(listed.stdout)] == ["inserted"]
        status = cell("status", "--runs", here)
        assert (status.exit_code, "no cell runs" in status.stderr) == (3, True)
    assert cell("acknowledge", "--runs", ".").stderr.startswith("no fault is open")
    assert cell("actions", "--runs", ".").exit_code == 0
    packed = runs.parent / "b.zip"
    assert cell("bundle", "--runs", ".", "-o", packed).exit_code == 0 and packed.exists()


@pytest.mark.parametrize(
    "command",
    [
        ("run", "--config", CONFIG, "--runs", "/"),
        ("status", "--runs", "/"),
        ("bundle", "--runs", "/"),
        ("serve", "--runs", "/"),
        ("history", "--runs", "/"),
        ("actions", "--runs", "/"),
    ],
    ids=lambda command: command[0],
)
def test_beside_the_root_there_is_no_place(command: tuple[object, ...]) -> None:
    done = cell(*command)
    assert done.exit_code == 2
    assert "has no name, and files are written next to it" in " ".join(
        done.stderr.replace("│", "").split()
    )


def test_the_settings_are_wrong_if_the_ledger_is_a_file_of_another_program(tmp_path: Path) -> None:
    foreign = sqlite3.connect(tmp_path / "runs.sqlite")
    foreign.execute("CREATE TABLE songs (name TEXT)")
    foreign.close()
    done = cell("check", "--config", CONFIG, "--runs", tmp_path / "runs")
    assert (done.exit_code, "is no ledger of this program" in done.stderr) == (2, True)


@pytest.mark.parametrize("command", ["status", "bundle", "serve"])
def test_a_file_is_no_folder_of_records(command: str, tmp_path: Path) -> None:
    """`cell status` said that no cell runs there."""
    file = tmp_path / "runs.sqlite"
    file.touch()
    done = cell(command, "--runs", file)
    assert done.exit_code == 2
    assert "is a file; give a folder" in " ".join(done.stderr.replace("│", "").split())


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_an_export_takes_the_place_of_the_last_one(runs: Path, tmp_path: Path, kind: str) -> None:
    table = tmp_path / f"week.{kind}"
    words = ("history", "--runs", runs, f"--{kind}", table)
    for _ in range(2):
        done = cell(*words)
        assert done.exit_code == 0, done.stderr
    none = cell(*words, "--until", "2000-01-01")
    assert none.exit_code == 0, none.stderr
    table.write_text("t_s,x_m\n")
    done = cell(*words)
    assert (done.exit_code, "not written by this program" in done.stderr) == (2, True)
    assert cell(*words, "--force").exit_code == 0


def test_a_recording_that_is_there_is_not_fetched(runs: Path) -> None:
    (folder,) = runs.iterdir()
    (folder / form.FILE).write_bytes(b"\x89MCAP0\r\n")
    done = cell("fetch", folder)
    assert (done.exit_code, "is here already; give another name with -o" in done.stderr) == (
        2,
        True,
    )
    other = cell("fetch", folder, "-o", folder / form.FILE)
    assert "is there and is a recording; give another name, or remove it" in other.stderr


@pytest.mark.parametrize("said", ["999999999d", "99999999999h", "0001-01-01"])
def test_a_time_before_the_calendar_is_none(runs: Path, said: str) -> None:
    for command in ("history", "actions"):
        done = cell(command, "--runs", runs, "--since", said)
        if said[-1] in "hd":
            assert (done.exit_code, "no time; give 2026-11-01" in done.stderr) == (2, True)
        assert not isinstance(done.exception, OverflowError)


def test_a_status_without_a_cell_is_json_too(tmp_path: Path) -> None:
    done = cell("status", "--runs", tmp_path, "--json")
    said = json.loads(done.stdout)
    assert (done.exit_code, said["state"]) == (3, None)
    assert "no cell runs" in said["cause"]


def test_one_cycle_is_one_cycle(runs: Path, tmp_path: Path) -> None:
    done = cell("history", "--runs", tmp_path / "new", "--import", runs)
    assert "1 of 1 cycle is new to the ledger" in done.stdout


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("history", "--since", "2999-01-01"), "2999-01-01: is to come"),
        (("actions", "--since", "2999-01-01"), "2999-01-01: is to come"),
        (("history", "--since", "1d", "--until", "2d"), "is not before --until 2d"),
        (("history", "--oee", "--faults"), "give one of them"),
        (("history", "--losses", "--product", "a"), "leave out --product"),
        (("history", "--candidate", "c.yaml", "--losses"), "add both"),
        (("history", "--json", "--csv", "-"), "--csv -: give the name of a file"),
        (("history", "--json", "--parquet", "-"), "--parquet -: give the name of a file"),
        (("history", "--runs", CONFIG), f"{CONFIG} is a file, and none named"),
    ],
)
def test_options_that_are_wrong_or_contradict_each_other_are_refused_with_a_remedy(
    runs: Path, words: tuple[object, ...], said: str
) -> None:
    done = cell(words[0], "--runs", runs, *words[1:])
    assert (done.exit_code, done.stdout) == (2, "")
    assert said in done.stderr


def test_lost_time_is_a_table_and_adds_up(runs: Path) -> None:
    words, ledger = ("history", "--runs", runs, "--losses"), Ledger(runs)
    folder, end = runs / "20261122T130000.000-2", NOON + timedelta(hours=1)
    result = CycleResult(2, Outcome.INSERTED, str(folder), state_seconds={"execute": 26.0})
    ledger.write([LedgerEntry("l", 2, folder, NOON, "inserted", ended=end, result=result)])
    ledger.close()
    (shift,) = json.loads(cell(*words, "--json").stdout)
    lost = sum(loss["minutes"] for loss in shift["losses"])
    assert lost + shift["inserted_minutes"] == pytest.approx(shift["planned_minutes"])
    shown = cell(*words).stdout
    assert "not running" in shown
    assert "480.0 min planned in 1 shift" in shown
    assert "shifts from 06:00, 14:00, 22:00 (default of `ledger.shifts`); these are" in shown


def test_a_page_is_said_to_be_written_once_it_is(
    runs: Path, tmp_path: Path, full_disk: None
) -> None:
    (folder,) = runs.iterdir()
    page = tmp_path / "page.html"
    done = cell("report", folder, "-o", page)
    assert done.exit_code == 1
    assert "written to" not in done.stdout
    assert f"{page}: cannot be written: " in done.stderr


NAME = "20261102T063000.000-1"


def test_a_cycle_of_the_same_name_on_another_line_stays_open(tmp_path: Path) -> None:
    """Two lines that a PLC starts at once share a ledger: nobody had looked at the other one."""
    ledger, at = Ledger(tmp_path / "plant", create=True), datetime(2026, 11, 2, 6, 30, tzinfo=UTC)
    fault = Fault("lower", "the arm was stopped", "arm", code="arm.stopped")
    for line in ("line3", "line4"):
        folder = tmp_path / line / NAME
        result = CycleResult(1, Outcome.FAILED, str(folder), fault=fault)
        ledger.write([LedgerEntry(line, 1, folder, at, "inserted", ended=at, result=result)])

    def acknowledge(folder: Path) -> str:
        words = ["acknowledge", str(folder), "--runs", str(tmp_path / "plant"), "--by", "Ada"]
        done = CliRunner().invoke(app, words)
        return f"{done.exit_code} {done.stderr}"

    said = acknowledge(tmp_path / NAME)  # where neither is
    assert said.startswith(f"2 {NAME}: is a cycle of line3 and of line4")
    assert acknowledge(tmp_path / "line4" / NAME) == "0 "
    assert [c.line for c in ledger.listed(LedgerQuery(fault="", acknowledged=False))] == ["line3"]
    ledger.close()


def test_serve_checks_its_files_and_address_before_it_prints(tmp_path: Path) -> None:
    pem, nix = tmp_path / "a.pem", tmp_path / "nix"
    pem.write_text("no certificate")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        for options, says in (
            (("--certificate", nix, "--key", nix), f"{nix}:1:1: cannot be read: No such file"),
            (("--certificate", pem, "--key", pem), f"--certificate {pem}, --key {pem}: "),
            (("--metrics-token", nix), f"--metrics-token: {nix} cannot be read: No such file"),
            ((), f"--port {port}: Address already in use; give another --port"),
            (("--host", "192.0.2.1"), "--host 192.0.2.1: beyond loopback TLS is needed"),
        ):
            served = cell("serve", "--config", CONFIG, "--runs", tmp_path, "--port", port, *options)
            assert (served.exit_code, served.stdout) == (2, "")
            assert says in served.stderr
            assert "Errno" not in served.stderr


def test_a_promotion_takes_a_candidate_or_goes_back(tmp_path: Path) -> None:
    for options, says in (((tmp_path, "--undo"), "--undo, not both\n"), ((), "--undo\n")):
        done = cell("promote", "--config", CONFIG, *options)
        assert (done.exit_code, done.stderr) == (2, f"give a candidate, or {says}")
