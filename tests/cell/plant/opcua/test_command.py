"""`cell opcua` as it is typed."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.plant.opcua.users import Role, read_users, role_of
from tests.cell.plant.opcua.conftest import CONFIG


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    said = (CONFIG / "fake.yaml").read_text()
    path.write_text(f"{said}\nplant:\n  opcua: {{folder: {tmp_path / 'opcua'}}}\n")
    return path


def test_users_are_added_changed_and_removed(config: Path, tmp_path: Path) -> None:
    def typed(*words: str, password: str = "") -> str:
        done = CliRunner().invoke(app, ["opcua", "user", *words, "--config", str(config)], password)
        assert done.exit_code == 0, done.output
        return done.stdout

    assert typed("add", "ada", "--role", "operate", password="secret 1\n") == (
        "ada: added, may operate\n"
    )
    folder = tmp_path / "opcua"
    assert role_of(read_users(folder), "ada", "secret 1") is Role.OPERATE
    assert role_of(read_users(folder), "ada", "secret 2") is None
    assert typed("add", "ada", password="secret 2\n") == "ada: changed, may watch\n"
    assert role_of(read_users(folder), "ada", "secret 2") is Role.WATCH
    typed("remove", "ada")
    assert role_of(read_users(folder), "ada", "secret 2") is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["user", "add", "ada", "--role", "boss"], "--role boss: no role; give watch or operate"),
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
