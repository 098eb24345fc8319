"""Each command of `cell --help` does what it is for, to its end, on a small input.

One table: a command without a row fails.  Most rows are run here.  Where a command needs devices, a
broker or a person its row names the test that runs it.
"""

from __future__ import annotations

import ast
import shlex
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.core import TyperGroup
from typer.main import get_command

from cell.cable.effects import library
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.cli import app
from cell.files.yaml_document import yaml_text
from cell.lab.data import named_effects, prepared
from cell.plant.users import Role, Users
from cell.records.ledger.actions import take_over
from cell.settings import load_settings
from cell.settings.promotion import line_identity
from cell.settings.translate import model_hash
from cell.study.data import Study, Trial
from cell.study.folder import write_study
from cell.web.audit import Audit, audit_file
from tests.waiting import free_port, listens
from tools.worlds.made_studies import CABLE, filmed, moved

from .conftest import run
from .forked import Forking

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Run:
    """A command that is run here.

    words   after the command; {x} is a file of the `world`, {out} a folder for results
    says    what is printed
    writes  a file in {out} that is there then
    typed   at its standard input
    """

    words: str = ""
    says: str = ""
    writes: str = ""
    typed: str = ""


@dataclass(frozen=True)
class Served:
    """A command that serves at {port} until it is ended by SIGTERM, with 0."""

    words: str


@dataclass(frozen=True)
class ByTest:
    """A command that a test elsewhere runs: FILE::FUNCTION, from the folder of tests."""

    test: str


USERS = "--users {out}/users.json"
CALIBRATED = "cell/calibration/test_calibrate.py"
TABLE: dict[str, Run | Served | ByTest] = {
    "run": Run("-c {config} --runs {out}/runs", "robot waited"),
    "emulate": ByTest(
        "end_to_end/test_emulated.py::test_emulators_can_be_started_beforehand_and_end_with_ctrl_c"
    ),
    "status": ByTest(
        "end_to_end/test_service.py::test_two_starts_then_an_end_within_the_third_cycle"
    ),
    "send": ByTest(
        "end_to_end/test_service.py::test_two_starts_then_an_end_within_the_third_cycle"
    ),
    "service": Run("-c {config}", "ExecStart="),
    "init": Run("-y -o {out}/cell.yaml", "cell.yaml", "cell.yaml"),
    "doctor": ByTest(
        "cell/run/test_computer_check.py::test_the_command_ends_with_whether_all_are_met"
    ),
    "check": Run("-c {config}", "arm"),
    "schema": Run("", '"properties"'),
    "list": Run("{runs}", "inserted"),
    "show": Run("{cycle}", "viscosity"),
    "report": Run("{cycle} -o {out}/report.html", "report.html", "report.html"),
    "identify": Run("{cycle} -o {out}/model.json", "viscosity", "model.json"),
    "history": Run("--runs {runs}", "1 inserted"),
    "acknowledge": ByTest(
        "end_to_end/test_listed.py::test_a_person_acknowledges_a_fault_afterwards"
    ),
    "help": Run("recordings", "Recordings"),
    "actions": Run("--runs {runs}", "lab promote"),
    "bundle": Run("-c {config} --runs {runs} -o {out}/b.zip", "b.zip", "b.zip"),
    "replay": Run("{cycle}", "identical"),
    "recover": ByTest("end_to_end/test_recorded.py::test_what_a_torn_recording_holds_is_replayed"),
    "upload": ByTest("end_to_end/test_recorded.py::test_upload_brings_what_a_run_could_not"),
    "fetch": ByTest("end_to_end/test_recorded.py::test_recordings_go_to_a_store_between_cables"),
    "fit": Run("{study} -o {out}/model.json", "viscosity", "model.json"),
    "compare": Run("{study} --model {model} --report {out}/page.html", "mm", "page.html"),
    "diagnose": Run("{study} -o {out}/d.json --report {out}/page.html", "missing", "page.html"),
    "effects": Run("", "air_drag"),
    "discover": Run("{study} -o {out}/law.py", "With law the held-out error falls", "law.py"),
    "suggest": Run("{study} --try tip_mass -o {out}/motion.yaml", "tip_mass", "motion.yaml"),
    "power": Run("{study} --try tip_mass", "tip_mass"),
    "study": Run("{cycle} -o {out}/study", "study", "study/study.yaml"),
    "look": Run("{study} -o {out}/look.html", "pictures of every trial", "look.html"),
    "import": Run(
        "{table} --hand {hand} -o {out}/s --free-length 0.1 --line-density 0.0074 "
        "--width 0.016 --thickness 1e-4",
        "import.yaml",
        "s/import.yaml",
    ),
    "export": Run("{model} --to mujoco -o {out}/cable.xml --links 40", "cable.xml", "cable.xml"),
    "learn": Run("{runs} -c {config} -o {out}/c.yaml", "1 cable"),
    "promote": Run("{candidate} -c {config}", "has the model of"),
    "mqtt": ByTest(
        "cell/plant/mqtt/test_delivery.py::"
        "test_a_broker_that_is_killed_twice_gets_every_result_once_and_in_order"
    ),
    "handshake": ByTest(
        "cell/plant/handshake/test_command.py::test_the_command_serves_until_it_is_ended"
    ),
    "calibrate": ByTest(f"{CALIBRATED}::test_the_map_is_right_within_its_bound"),
    "calibrate camera": ByTest(f"{CALIBRATED}::test_recorded_folders_give_the_same_again"),
    "calibrate cell": ByTest(f"{CALIBRATED}::test_pictures_of_ones_own_give_the_same"),
    "calibrate time": ByTest(f"{CALIBRATED}::test_recorded_folders_give_the_same_again"),
    "calibrate grip": ByTest(f"{CALIBRATED}::test_recorded_folders_give_the_same_again"),
    "calibrate check": ByTest(f"{CALIBRATED}::test_check_says_what_changed"),
    "calibrate board": Run("-o {out}/board.pdf", "board.pdf", "board.pdf"),
    "serve": Served("-c {config} --runs {runs} --port {port}"),
    "serve user add": Run(
        f"ada --role operate {USERS}", "ada: added", "users.json", "correct horse"
    ),
    "serve user remove": Run("ivo --users {users}", "ivo: removed"),
    "serve user list": Run("--users {users}", "zoe: may engineer"),
    "opcua": Served("-c {plant} --runs {runs}"),
    "opcua user add": Run(
        f"ada --role operate -c {{plant}} {USERS}", "ada: added", "users.json", "correct horse"
    ),
    "opcua user remove": Run("eve -c {plant} --users {users}", "eve: removed"),
    "opcua user list": Run("-c {plant} --users {users}", "zoe: may engineer"),
    "user add": Run(f"ada --role watch {USERS}", "ada: added", "users.json", "correct horse"),
    "user remove": Run("ida --users {users}", "ida: removed"),
    "user list": Run("--users {users}", "zoe: may engineer"),
}


def commands(group: TyperGroup, before: str = "") -> Iterator[str]:
    """All commands, those of groups as `GROUP COMMAND`, and groups that do something themselves."""
    for name, command in group.commands.items():
        if not isinstance(command, TyperGroup):
            yield f"{before}{name}"
            continue
        if command.invoke_without_command:
            yield f"{before}{name}"
        yield from commands(command, f"{before}{name} ")


def test_every_command_has_a_row() -> None:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    assert sorted(commands(group)) == sorted(TABLE)


# --- rows that are run here ----------------------------------------------------------------------

ARCS = np.linspace(0.1, 0.0, 3)
NOISE_M = 1e-4
#: What a server does not reach after so long it never does, s.
LONGEST_S = 180.0
#: For a study that is soon computed.
COARSE = Solver(segments=16, step_s=2e-3)


def study() -> Study:
    """Three short motions of a cable with air drag; the last is held out."""
    drag = library()["air_drag"].active(drag_coefficient=4.0)
    model = CableModel.uniform(CABLE, 3e-5, viscosity_n_m2_s=1e-7, effects=(drag,))
    rng, t_s = np.random.default_rng(1), np.arange(0.0, 0.9, 0.01)
    trials = []
    for name, way_m in (("down", (0.0, -0.05)), ("aslant", (-0.04, -0.03)), ("deep", (0.0, -0.07))):
        grip = moved(t_s, way_m, 0.2)
        seen = filmed(rng, model, grip, t_s, ARCS, noise_m=NOISE_M, solver=COARSE)
        role = "validate" if name == "deep" else "fit"
        trials.append(Trial(name, role, "equilibrium", grip, seen))
    return Study("made", CABLE, ARCS, tuple(trials), noise_std_m=NOISE_M)


@pytest.fixture(scope="module")
def little_computing() -> Iterator[None]:
    """Few effects are tried, on a coarse mesh; `discover` tries all its laws."""
    few = {name: library()[name] for name in ("air_drag", "tip_mass", "grip_angle")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepared, "SOLVER", COARSE)
        patch.setattr(named_effects, "library", lambda: few)
        yield


@pytest.fixture(scope="module")
def world(
    recorded_config: Path, little_computing: None, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Files that rows are given, by the names that these have in the table."""
    folder = tmp_path_factory.mktemp("world")
    world = {name: folder / name for name in ("runs", "study", "model", "candidate", "users")}
    done = run("run", "-c", recorded_config, "--runs", world["runs"])
    assert done.returncode == 0, done.stderr
    (world["cycle"],) = (path for path in world["runs"].iterdir() if path.is_dir())
    log = Audit(audit_file(world["runs"]))
    log.write("ada", "lab promote", True)
    take_over(world["runs"], log.file, "line")
    write_study(study(), world["study"])
    world |= {
        n: world["study"] / "down" / f"{f}.csv" for n, f in (("table", "markers"), ("hand", "grip"))
    }
    done = run("fit", world["study"], "-o", world["model"])
    assert done.returncode == 0, done.stderr
    settings = load_settings(recorded_config)
    drag = {"effect": "air_drag", "parameters": {"drag_coefficient": {"fixed": 1.9}}}
    content = {
        "format": "cell-candidate/1",
        "beside": model_hash(settings.model),
        "lines": [line_identity(settings)],
        "model": {"effects": [drag]},
        "gates": [{"gate": "forecasts unseen cables better", "passed": True, "found": "so"}],
    }
    world["candidate"].write_text(yaml_text(content), encoding="utf-8")
    for name, role in (("eve", "watch"), ("ivo", "watch"), ("ida", "watch"), ("zoe", "engineer")):
        Users(world["users"]).add(name, Role[role], "correct horse")
    return world


def own_settings(config: Path, folder: Path, port: int) -> dict[str, Path]:
    """Settings of a row's own, so that none changes another's: the cell's, and with OPC UA."""
    text = config.read_text(encoding="utf-8")
    own = {"config": folder / "cell.yaml", "plant": folder / "plant.yaml"}
    own["config"].write_text(text, encoding="utf-8")
    opcua = f"\nplant: {{opcua: {{port: {port}, folder: {folder / 'opcua'}}}}}\n"
    own["plant"].write_text(text + opcua, encoding="utf-8")
    return own


@pytest.mark.parametrize("command", [name for name, row in TABLE.items() if isinstance(row, Run)])
def test_a_command_does_what_it_is_for(
    command: str, world: dict[str, Path], recorded_config: Path, tmp_path: Path
) -> None:
    row = TABLE[command]
    assert isinstance(row, Run)
    (out := tmp_path / "out").mkdir()
    own = own_settings(recorded_config, tmp_path, free_port())
    words = row.words.format(**world, **own, out=out)
    done = run(*command.split(), *shlex.split(words), typed=row.typed or None)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert row.says in f"{done.stdout} {out}"
    assert not row.writes or (out / row.writes).exists(), sorted(out.iterdir())


@pytest.mark.parametrize("command", [n for n, row in TABLE.items() if isinstance(row, Served)])
def test_a_command_serves_until_it_is_ended(
    command: str, forking: Forking, recorded_config: Path, tmp_path: Path
) -> None:
    row, port = TABLE[command], free_port()
    assert isinstance(row, Served)
    own = own_settings(recorded_config, tmp_path, port)
    words = row.words.format(**own, runs=tmp_path / "runs", port=port)
    process = forking.start(command, *shlex.split(words))
    try:
        until_s = time.monotonic() + LONGEST_S
        while not listens(port):
            assert process.poll() is None and time.monotonic() < until_s
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=LONGEST_S)
    finally:
        process.kill()
    assert process.returncode == 0, said.decode()


# --- rows that name a test -----------------------------------------------------------------------


def named(files: list[Path], function: str) -> list[ast.AST]:
    """A function of the first file, and of all files what it names, and what that names."""
    known: dict[str, ast.AST] = {}
    for file in reversed(files):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        known |= {n.name: n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    reached, waiting = list[ast.AST](), [function]
    while waiting:
        node = known.pop(waiting.pop(), None)
        if node is None:
            continue
        reached.append(node)
        for part in ast.walk(node):
            match part:
                case ast.Name(id=name) | ast.arg(arg=name):
                    waiting.append(name)
    return reached


@pytest.mark.parametrize("command", [n for n, row in TABLE.items() if isinstance(row, ByTest)])
def test_the_test_that_a_row_names_gives_the_command(command: str) -> None:
    row = TABLE[command]
    assert isinstance(row, ByTest)
    name, _, function = row.test.partition("::")
    file = ROOT / "tests" / name
    files = [file, *(p for p in [file.with_name("conftest.py")] if p.exists())]
    reached = named(files, function)
    assert reached, f"{row.test}: no such test"
    said = {part.value for n in reached for part in ast.walk(n) if isinstance(part, ast.Constant)}
    assert set(command.split()) <= said, f"{row.test} does not give {command}"
