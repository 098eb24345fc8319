"""Commands are found by what they are for, and so is what the documentation says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from cell.cli import OLD_OPTIONS, PANELS, app
from cell.cli import settings as documentation


def test_every_command_is_in_one_panel_and_help_lists_them_in_that_order() -> None:
    listed = [name for names in PANELS.values() for name in names]
    assert sorted(listed) == sorted(get_command(app).commands)  # type: ignore[attr-defined]
    said = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "100"}).stdout
    places = [said.index(f"─ {panel} ─") for panel in PANELS]
    assert places == sorted(places)
    assert "─ Commands ─" not in said
    words = [line.split()[1] for line in said.splitlines() if line[:3] == "│ " + line[2:3]]
    assert [word for word in words if word in listed] == listed


def test_alone_it_says_what_can_be_done_first() -> None:
    done = CliRunner().invoke(app, [])
    assert done.exit_code == 0
    for word in ("cell init", "cell serve", "cell import", "cell diagnose", "cell help"):
        assert word in done.stdout


def test_topics_are_the_pages_of_the_documentation() -> None:
    done = CliRunner().invoke(app, ["help"])
    assert done.exit_code == 0
    for name, page in documentation.topics().items():
        title = page.read_text("utf-8").splitlines()[0].lstrip("# ")
        assert f"cell help {name} " in done.stdout
        assert title in done.stdout
    page = CliRunner().invoke(app, ["help", "Lab"])
    assert page.stdout.startswith("# The model lab\n")


def test_a_topic_that_is_not_there_is_refused() -> None:
    done = CliRunner().invoke(app, ["help", "labb"])
    assert done.exit_code == 2
    assert done.stderr == "labb: no topic; did you mean 'lab'? `cell help` lists them\n"
    assert CliRunner().invoke(app, ["help", "xyzzy"]).stderr.startswith("xyzzy: no topic; `cell")


def test_of_a_wheel_the_pages_are_where_it_was_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages = tmp_path / "share" / "doc" / "cable-cell"
    pages.mkdir(parents=True)
    (pages / "lab.md").write_text("# The model lab\n")
    monkeypatch.setattr(documentation, "__file__", str(tmp_path / "a" / "b" / "cell" / "help.py"))
    monkeypatch.setattr("sysconfig.get_path", lambda name: str(tmp_path))
    assert documentation.topics() == {"lab": pages / "lab.md"}


@pytest.mark.parametrize(
    ("command", "old", "new"),
    [(c, old, new) for c, names in OLD_OPTIONS.items() for old, new in names.items()],
)
def test_an_old_spelling_works_with_a_note(command: str, old: str, new: str) -> None:
    known = get_command(app).commands[command].params  # type: ignore[attr-defined]
    spellings = {option for p in known for option in p.opts}
    assert new in spellings and old not in spellings
    for words in ([old, "x"], [f"{old}=x"]):
        done = CliRunner().invoke(app, [command, *words, "--no-such"])
        assert f"note: {old} is called {new} now" in done.stderr
        assert "--no-such" in done.stderr and f"No such option: {old}" not in done.stderr


def test_an_old_spelling_means_what_it_meant(tmp_path) -> None:
    done = CliRunner().invoke(app, ["history", "--ledger", str(tmp_path / "nowhere")])
    assert done.exit_code == 2 and "nowhere.sqlite is missing" in done.stderr


def test_what_is_tried_anyway_is_no_effect_to_try(tmp_path) -> None:
    """The spelling of before made it part of the model."""
    said = [
        CliRunner().invoke(app, ["diagnose", str(tmp_path), option, "air_drag"]).stderr
        for option in ("--try", "--effect")
    ]
    assert (
        "air_drag: is tried anyway; --with air_drag, or `known`, makes it part of the model"
        in said[0]
    )
    assert "note: --effect is called --with now" in said[1] and "--try" not in said[1]


def test_every_command_says_what_its_exit_codes_mean() -> None:
    commands = get_command(app)
    said = {}
    for name in commands.list_commands(None):  # type: ignore[attr-defined]
        command = commands.get_command(None, name)  # type: ignore[attr-defined]
        for one in (command, *getattr(command, "commands", {}).values()):
            _, found, codes = one.help.partition("Exit codes:")
            said[f"{name} {one.name}"] = set(re.findall(r"(?:^|[;,.] (?:or )?)\s*(\d+)\b", codes))
            assert found, one.name
    assert all({"0", "2"} <= codes or name.endswith("check") for name, codes in said.items()), said
    assert set().union(*said.values()) == {"0", "1", "2", "3", "130"}
