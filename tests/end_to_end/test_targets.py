"""Each target of the Makefile does what it is for, to its end, at a small size.

One table: a target without a row fails.  What CI itself runs, or a test elsewhere, is named.
"""

from __future__ import annotations

import ast
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.waiting import free_port

ROOT = Path(__file__).parents[2]
PRACTICE = ROOT.parent / "shared" / "data" / "practice"


@dataclass(frozen=True)
class Small:
    """A target that is made here.

    variables  of make; {out} is a folder for results
    says       what is printed
    writes     a file in {out} that is there then
    measures   it ends with an error where a bar is missed, as beside other tests
    """

    variables: str = ""
    says: str = ""
    writes: str = ""
    measures: bool = False


@dataclass(frozen=True)
class ByTest:
    """A target whose program a test runs: FILE::FUNCTION, from the folder of tests."""

    test: str


@dataclass(frozen=True)
class OfCI:
    """A part of `make test`."""


TABLE: dict[str, Small | ByTest | OfCI] = {
    "help": Small(says="list the targets"),
    "run": Small("CYCLES=1 ARGS='--out {out}/runs'", "inserted"),
    "serve": ByTest("end_to_end/test_targets.py::test_pages_are_served_until_they_are_interrupted"),
    **dict.fromkeys(("test", "lint", "types", "imports", "tests", "tests-real-time"), OfCI()),
    **dict.fromkeys(("tests-computing", "compiled", "compiled-cell", "compiled-arm"), OfCI()),
    **dict.fromkeys(("compiled-effects", "compiled-tests"), OfCI()),
    "quick": ByTest("tools/test_quick.py::"
                    "test_a_changed_module_leads_to_its_tests_and_to_those_of_its_importers"),
    "hardware": ByTest("end_to_end/test_hardware.py::"
                       "test_arm_camera_and_gripper_of_the_settings_are_tested"),
    "bench": Small("ARGS=plugin", "user's / project's", measures=True),
    "figures": Small("ARGS='--out {out} --only 02_still_shapes'", "png", "fig02_still_shapes.png"),
    "learn": ByTest("tools/studies/test_learn_steps.py::"
                    "test_the_time_left_is_corrected_by_the_time_taken"),
    "jaw-plate": Small("ARGS='-o {out}/plate.pdf'", writes="plate.pdf"),
    "picture": Small("ARGS='-o {out}/cycle.jpg'", writes="cycle.jpg"),
    "docs": ByTest("docs/test_commands.py::test_a_page_does_what_it_says"),
    "docs-site": Small("ARGS='-o {out}/site'", "index.html", "site/index.html"),
    "coverage": Small("ARGS='--cables 1'", "1"),
    "practice": Small("ARGS='{out}/p.csv --practice none_a --workers 1'", "complete", "p.csv"),
    "studies": ByTest("tools/studies/test_diagnosis_study.py::"
                      "test_a_study_is_made_diagnosed_and_counted_by_the_command"),
    "checks": Small("ARGS='{out}/c.csv --breadth complete=1 --workers 1'", "all checks", "c.csv"),
    "benchmark-effects": ByTest("tools/studies/test_benchmark_effects.py::"
                                "test_the_same_seed_gives_the_same_table"),
    "benchmark-rods": ByTest("tools/bench/test_benchmark_rods.py::"
                             "test_two_runs_choose_the_same_settings"),
    "discover": ByTest("tools/studies/test_discover_study.py::"
                       "test_the_target_asks_for_the_ten_laws_unless_some_are_named"),
    "fault-trials": ByTest("end_to_end/test_fault_trials.py::"
                           "test_the_cell_stops_names_the_fault_keeps_the_cable_and_works_again"),
    "handshake": Small("ARGS='--cycles 1 --carrier modbus'", "1"),
    "calibration-study": Small("ARGS='--setups 1 -o {out}/c.csv'", writes="c.csv"),
    "malformed": ByTest("end_to_end/test_malformed.py::"
                        "test_a_spoilt_file_is_refused_with_its_place_or_used"),
    "endurance": ByTest("end_to_end/test_emulated.py::test_a_cable_is_inserted_by_the_one_command"),
    "insertion": Small(
        "ARGS='{out}/i.csv --cables 1 --half-mm 2 --ways pace short_hold'", "complete", "i.csv"
    ),
    "plant": Small("ARGS='--only mqtt --steps lower execute --quick'", "2 of 2"),
    "pages": Small("ARGS='--hours 0.2 --speed 60'", "MiB"),
    "kills": Small("ARGS='{out}/k.csv --kills 1'", "1", "k.csv"),
    "clean": ByTest("end_to_end/test_targets.py::test_what_was_installed_is_removed"),
}  # fmt: skip
MADE = [name for name, row in TABLE.items() if isinstance(row, Small)]


def targets() -> list[str]:
    """All targets of the Makefile."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    return re.findall(r"^([a-z][a-z-]*):(?!=)", text, re.MULTILINE)


def make(target: str, *variables: str, folder: Path = ROOT) -> list[str]:
    """A command; what is installed stays as it is."""
    venv = Path(sys.executable).parents[1]
    kept = [word for stamp in (".dev", ".user", ".web") for word in ("-o", f"{venv}/{stamp}")]
    return ["make", "-C", str(folder), "-f", str(ROOT / "Makefile"), *kept, f"VENV={venv}",
            target, *variables]  # fmt: skip


def test_every_target_has_a_row() -> None:
    assert sorted(targets()) == sorted(TABLE)


@pytest.mark.parametrize("row", [r for r in TABLE.values() if isinstance(r, ByTest)])
def test_the_test_that_a_row_names_is_there(row: ByTest) -> None:
    file, _, name = row.test.partition("::")
    tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
    assert name in {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}


@pytest.mark.parametrize("target", MADE)
def test_a_target_is_made(target: str, tmp_path: Path) -> None:
    row = TABLE[target]
    assert isinstance(row, Small)
    if target == "practice" and not PRACTICE.exists():
        pytest.skip("no practice studies beside the project")
    variables = re.findall(r"(\w+=)(?:'([^']*)'|(\S+))", row.variables.format(out=tmp_path))
    done = subprocess.run(
        make(target, *(name + quoted + bare for name, quoted, bare in variables)),
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    missed = row.measures and "missed:" in done.stdout  # beside other tests a ratio is chance
    assert done.returncode == 0 or missed, done.stdout + done.stderr
    assert row.says in done.stdout
    assert not row.writes or (tmp_path / row.writes).stat().st_size > 0


def test_pages_are_served_until_they_are_interrupted() -> None:
    port = free_port()
    serving = subprocess.Popen(
        make("serve", f"ARGS=--port {port}"), stdout=subprocess.DEVNULL, start_new_session=True
    )
    try:
        end_s = time.monotonic() + 120.0
        while True:
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5.0) as page:
                    assert page.status == 200
                break
            except OSError:
                assert time.monotonic() < end_s
                assert serving.poll() is None
                time.sleep(0.2)
    finally:
        os.killpg(serving.pid, signal.SIGINT)
        serving.wait(60.0)


def test_what_was_installed_is_removed(tmp_path: Path) -> None:
    """Of a folder of its own: this one is in use."""
    for name in ("venv", ".mypy_cache", ".pytest_cache", ".ruff_cache", "kept"):
        (tmp_path / name).mkdir()
    command = ["make", "-C", str(tmp_path), "-f", str(ROOT / "Makefile"), "clean", "VENV=venv"]
    subprocess.run(command, check=True, capture_output=True)
    assert [p.name for p in tmp_path.iterdir()] == ["kept"]
