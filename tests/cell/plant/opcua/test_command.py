"""`cell opcua` as it is typed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.plant.opcua.commands import COMMANDS
from cell.plant.opcua.unit import tags_of
from cell.plant.users import Role, User, Users, all_users
from tests.cell.plant.opcua.conftest import CONFIG


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    said = (CONFIG / "fake.yaml").read_text()
    path.write_text(f"{said}\nplant:\n  opcua: {{folder: {tmp_path / 'opcua'}}}\n")
    return path


def typed(*words: object, password: str = "") -> str:
    done = CliRunner().invoke(app, [str(w) for w in words], f"{password}\n")
    assert done.exit_code == 0, done.output
    return done.stdout


def test_one_file_has_the_users_of_pages_and_opc_ua(config: Path, tmp_path: Path) -> None:
    file = tmp_path / "users.json"
    more = ("--users", file)
    said = typed("opcua", "user", "add", "ada", "--role", "operate", "--config", config, *more,
                 password="secret no 1")  # fmt: skip
    assert said == "ada: added, may operate\n"
    assert Users(file).authenticate("ada", "secret no 1") == User("ada", Role.operate)
    assert Users(file).authenticate("ada", "secret no 2") is None
    said = typed("serve", "user", "add", "ada", *more, password="secret no 2")
    assert said == "ada: changed, may watch\n"
    typed("user", "add", "eve", "--role", "engineer", *more, password="secret no 3")
    assert typed("user", "list", *more) == "ada: may watch\neve: may engineer\n"
    typed("user", "remove", "ada", *more)
    assert Users(file).all() == (User("eve", Role.engineer),)


def test_users_of_earlier_versions_hold_until_they_are_changed(
    config: Path, tmp_path: Path
) -> None:
    file, opcua = tmp_path / "users.json", tmp_path / "opcua" / "users.json"
    Users(tmp_path / "web-users.json").add("web", Role.engineer, "secret no 1")
    Users(opcua).add("plc", Role.watch, "secret no 2")
    rows = json.loads(opcua.read_text("utf-8"))["users"]
    opcua.write_text(json.dumps(rows), "utf-8")  # as `cell opcua` has written them
    assert typed("user", "list", "--users", file) == "plc: may watch\nweb: may engineer\n"
    typed("user", "remove", "plc", "--users", file, "--config", config)
    users = all_users(file)
    assert users.authenticate("plc", "secret no 2") is None
    assert users.authenticate("web", "secret no 1") == User("web", Role.engineer)
    users.add("plc", Role.operate, "secret no 4")
    assert users.authenticate("plc", "secret no 4") == User("plc", Role.operate)
    opcua.chmod(0o644)
    with pytest.raises(ValueError, match="chmod 600"):
        users.all()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["user", "add", "ada", "--role", "boss"],
            "--role boss: no role; give one of watch, operate, engineer",
        ),
        (["user", "remove", "eve"], "eve"),
        (["user", "add", "ada"], "password"),
    ],
)
def test_what_is_wrong_is_told(config: Path, words: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["opcua", *words, "--config", str(config)], "")
    assert done.exit_code == 2
    assert said in done.stderr


def test_without_the_section_the_remedy_is_told() -> None:
    done = CliRunner().invoke(app, ["opcua", "--config", str(CONFIG / "fake.yaml")])
    assert (done.exit_code, "plant.opcua; add one" in done.stderr) == (2, True)


PAGE = Path(__file__).parents[4] / "docs" / "howto" / "opcua.md"


def test_nodes_and_methods_of_the_page_are_there() -> None:
    text = PAGE.read_text(encoding="utf-8")
    tables = re.split(r"\n\| method ", text)
    nodes, methods = [re.findall(r"^\| `([\w.]+)` ", table, re.M) for table in tables]
    assert len(nodes) > 10
    assert set(nodes) <= {t.path for t in tags_of("line", None)}
    assert set(methods) <= {f"{c.path}.{c.name}" for c in COMMANDS}
