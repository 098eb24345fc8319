"""Every cycle is in the ledger, whatever became of it; what the ledger lists, the commands find."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime
from pathlib import Path

import pyarrow.parquet
import pytest

import cell
from cell.records.folder import UNFINISHED
from cell.records.ledger.entry import LedgerEntry, LedgerError
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.ledger.outbox import outbox_of
from cell.records.result import Fault, Outcome, Result
from cell.run.commands import InterruptedByCommandError
from cell.run.machine import MachineEvent
from cell.settings import Settings
from cell.wiring.build import build_cell
from tests.waiting import wait_until

from .conftest import run
from .forked import Forking


def is_begun(place: Path) -> bool:
    """Whether a run has listed a cycle: its ledger has tables then."""
    try:
        return place.with_suffix(".sqlite").exists() and bool(listed(place))
    except LedgerError:
        return False


def listed(place: Path, wanted: LedgerQuery | None = None):
    ledger = Ledger(place)
    found = ledger.listed(wanted or LedgerQuery(), estimates=True)
    ledger.close()
    return found


@pytest.fixture(scope="module")
def runs(quick_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cycles whose parts are counted on."""
    runs = tmp_path_factory.mktemp("listed") / "runs"
    words = ("--config", quick_config, "--cycles", 3, "--runs", runs, "--part-id", "A-09")
    done = run("run", *words)
    assert done.returncode == 0, done.stderr
    return runs


def test_a_run_is_listed_with_all_that_its_records_say(runs: Path) -> None:
    found = listed(runs)
    assert [c.part for c in found] == ["A-09", "A-10", "A-11"]
    assert sorted(c.folder.name for c in found) == sorted(f.name for f in runs.iterdir())
    assert not outbox_of(runs).exists()
    for cycle in found:
        result = json.loads((cycle.folder / "result.json").read_text())
        model = json.loads((cycle.folder / "model.json").read_text())
        assert cycle.outcome == result["outcome"]
        assert cycle.part == result["part"]
        assert dict(cycle.numbers) == {k: result[k] for k in cycle.numbers}
        estimates = {(e.name, e.value, e.low, e.high) for e in cycle.estimates}
        assert estimates == {
            (p["name"], p["value"], p["low"], p["high"]) for p in model["parameters"]
        }
        assert cycle.ended is not None
        assert cycle.ended > cycle.started


def test_history_lists_counts_and_exports(runs: Path, tmp_path: Path) -> None:
    table, parquet = tmp_path / "x.csv", tmp_path / "x.parquet"
    words = ("--runs", runs, "--since", "1h")
    done = run("history", *words, "--csv", table, "--parquet", parquet)
    assert done.returncode == 0, done.stderr
    assert "A-10" in done.stdout
    assert "3 cycles: 3 inserted" in done.stdout
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    first = listed(runs)[0]
    assert [row["part"] for row in rows] == ["A-09", "A-10", "A-11"]
    assert float(rows[0]["measured_miss_m"]) == first.numbers["measured_miss_m"]
    columns = pyarrow.parquet.read_table(parquet).to_pydict()
    assert columns["viscosity"][0] == next(
        e.value for e in first.estimates if e.name == "viscosity"
    )
    shown = json.loads(run("history", *words, "--json", "--part-id", "A-10").stdout)
    assert [row["part"] for row in shown] == ["A-10"]
    assert "100.0" in run("history", *words, "--oee").stdout
    assert "of inserted cables (3)" in run("history", *words, "--losses").stdout
    assert "no cycle was ended by a fault" in run("history", *words, "--faults").stdout


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--runs", "nowhere"], "nowhere.sqlite is missing"),
        (["--since", "yesterday"], "--since yesterday: no time"),
        (["--outcome", "lost"], "--outcome lost: no outcome"),
        (["--import", "nowhere"], "--import nowhere: is no folder"),
    ],
)
def test_what_is_wrong_is_named(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    given = words if "--runs" in words else ["--runs", str(runs), *words]
    monkeypatch.chdir(tmp_path)
    done = run("history", *given)
    assert done.returncode == 2
    assert said in done.stderr


def test_folders_of_before_are_taken_in(runs: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "other"
    for what in ("3 of 3", "0 of 3"):  # the second time nothing is new
        done = run("history", "--runs", elsewhere, "--import", runs)
        assert done.returncode == 0, done.stderr
        assert f"{what} cycles are new" in done.stdout
    then, now = listed(runs), listed(elsewhere)
    assert [c.estimates for c in now] == [c.estimates for c in then]
    assert [dict(c.numbers) for c in now] == [dict(c.numbers) for c in then]
    assert [c.part for c in now] == [c.part for c in then]


def test_a_killed_run_is_never_listed_as_finished(
    forking: Forking, quick_config: Path, tmp_path: Path
) -> None:
    text = quick_config.read_text(encoding="utf-8")
    paced = tmp_path / "paced.yaml"
    paced.write_text(text.replace("\nworld: ", "\nworld:\n  real_time_factor: 1.0\n#"), "utf-8")
    runs = tmp_path / "runs"
    process = forking.start("run", "--config", paced, "--cycles", 5, "--runs", runs)
    try:
        wait_until(lambda: any(runs.glob("*/state.json")) and is_begun(runs), 60.0)
    finally:
        process.kill()
        process.wait(30)
    (cycle,) = listed(runs)
    assert cycle.outcome == UNFINISHED
    assert not (cycle.folder / "result.json").exists()
    done = run("run", "--config", quick_config, "--runs", runs)  # the next one goes on
    assert done.returncode == 0, done.stderr
    assert [c.outcome for c in listed(runs)] == [UNFINISHED, "inserted"]


def test_a_fault_is_listed_with_its_code(quick: Settings, tmp_path: Path) -> None:
    def on_step(number: int, step: str) -> None:
        if step == "lower":
            cell.command(MachineEvent.STOP, "by a test")

    cell = build_cell(quick, tmp_path / "runs", seed=1, cycles=1, on_step=on_step)
    result = cell.run_cycle(1, part="P")
    cell.come_to_rest()
    cell.acknowledge("Ada", "was only tried")
    assert cell.prepare(2) is None
    cell.command(MachineEvent.STOP, "lunch")
    with pytest.raises(InterruptedByCommandError) as stopped:
        cell.check()
    cell.leave_idle(stopped.value)
    cell.come_to_rest()
    cell.acknowledge("Eve", "back from lunch")  # it is none of the cycle's
    cell.close()
    (cycle,) = listed(tmp_path / "runs")
    assert (cycle.acknowledged.by, cycle.acknowledged.note) == ("Ada", "was only tried")
    assert (cycle.outcome, cycle.part, cycle.fault) == ("failed", "P", result.fault)
    assert result.fault is not None
    assert (result.fault.code, result.fault.step) == ("stop", "lower")
    done = run("history", "--runs", tmp_path / "runs", "--faults")
    assert "by a test" in done.stdout


def test_a_run_goes_on_without_its_server(quick_config: Path, tmp_path: Path) -> None:
    """Nobody answers at its address: the cables are inserted, and the entries wait."""
    away = tmp_path / "away.yaml"
    text = quick_config.read_text(encoding="utf-8")
    away.write_text(f"{text}\nledger: {{url: 'postgresql://cell@127.0.0.1:9/plant'}}\n", "utf-8")
    runs = tmp_path / "runs"
    done = run("run", "--config", away, "--runs", runs)
    assert done.returncode == 0, done.stderr
    assert "2 entries for the ledger in" in done.stderr
    assert "whether anything has changed cannot be said" in done.stderr
    assert len(list(outbox_of(runs).iterdir())) == 2
    done = run("run", "--config", quick_config, "--runs", runs)  # another ledger, the same outbox
    assert done.returncode == 0, done.stderr
    assert [c.outcome for c in listed(runs)] == ["inserted", "inserted"]


def test_ids_are_scanned(quick_config: Path, tmp_path: Path) -> None:
    words = ("--config", quick_config, "--runs", tmp_path / "runs", "--cycles", 3, "--part-id", "-")
    done = run("run", *words, typed="X1\n \nY2\n")
    assert done.returncode == 1  # two of three
    assert "'' is no id" in done.stderr
    assert [c.part for c in listed(tmp_path / "runs")] == ["X1", "Y2"]


def test_an_id_that_is_none_is_refused(quick_config: Path, tmp_path: Path) -> None:
    done = run("run", "--config", quick_config, "--runs", tmp_path / "runs", "--part-id", "")
    assert done.returncode == 2
    assert "--part-id '' is no id" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_learning_finds_the_lines_cycles_in_the_ledger(
    quick_config: Path, runs: Path, tmp_path: Path
) -> None:
    words = ("learn", "--config", quick_config, "-o", tmp_path / "candidate.yaml")
    by_ledger = run(*words, "--runs", runs, "--since", "1h")
    by_folder = run(*words, runs)
    assert by_ledger.returncode == by_folder.returncode
    assert by_ledger.stdout == by_folder.stdout
    assert by_ledger.stdout.startswith("3 cables: ")
    by_function = cell.learn([runs], quick_config)
    assert by_folder.stdout.startswith(str(by_function.parts()[0]))
    assert "3 cables: " in by_function._repr_html_()
    assert not by_function.fit_for_line
    done = run(*words, "--runs", runs, "--since", "0h")
    assert done.returncode == 2
    assert "since 0h is listed whose folder is there" in done.stderr


def test_a_person_acknowledges_a_fault_afterwards(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "runs", create=True)
    fault = Fault("lower", "the arm was stopped", "arm", code="arm.stopped")
    at = datetime(2026, 11, 2, 6, 30, tzinfo=UTC)
    for number in (1, 2, 3):
        folder = tmp_path / "runs" / f"cycle-{number}"
        result = Result(number, Outcome.FAILED, str(folder), fault=fault)
        ledger.write(
            [LedgerEntry("line3", number, folder, at, "inserted", ended=at, result=result)]
        )
    ledger.close()
    (tmp_path / "runs" / "cycle-3").mkdir(parents=True)  # the other records are elsewhere
    place = ("--runs", tmp_path / "runs")
    assert run("history", *place).stdout.count("arm.stopped (open)") == 3
    done = run("acknowledge", *place, "--by", "Ada", "--note", "button released", "--json")
    (said,) = json.loads(done.stdout)
    assert (said["by"], said["note"], said["fault"]) == ("Ada", "button released", "arm.stopped")
    assert said["folder"].endswith("cycle-3")
    state = json.loads((tmp_path / "runs" / "cycle-3" / "state.json").read_text())
    assert state["acknowledged"] == {"by": "Ada", "note": "button released"}, "a service goes on"
    assert run("acknowledge", *place, tmp_path / "runs" / "cycle-1").returncode == 0
    opened = json.loads(run("history", *place, "--open", "--json").stdout)
    assert [Path(c["folder"]).name for c in opened] == ["cycle-2"]
    assert run("acknowledge", *place, "--all").stdout.count("acknowledged by") == 1
    nothing = run("acknowledge", *place)
    assert (nothing.returncode, "no fault is open" in nothing.stderr) == (2, True)
    other = run("acknowledge", *place, "cycle-9")
    assert (other.returncode, "cycle-9: no cycle of this name" in other.stderr) == (2, True)
    assert run("acknowledge", "--runs", tmp_path / "nowhere").returncode == 2
    assert not (tmp_path / "nowhere.sqlite").exists()
