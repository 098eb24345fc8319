"""Whatever lacks an optional package names a command that installs it."""

from __future__ import annotations

import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest

from drivers import installing
from drivers.installing import install_extra

ROOT = Path(__file__).parents[2]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def test_every_extra_that_is_named_is_there() -> None:
    sources = [p for room in ("cell", "drivers") for p in (ROOT / room).rglob("*.py")]
    naming = re.compile(r"(?:install_extra|needing)\(['\"](\w+)")
    named = {n for p in sources for n in naming.findall(p.read_text())}
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    printed = {n for p in pages for n in re.findall(r"pip install -e '\.\[(\w+)\]'", p.read_text())}
    assert len(named) >= 10
    assert len(printed) >= 8
    assert named | printed <= set(EXTRAS)
    assert not [p.name for p in pages if "install 'cable-cell[" in p.read_text()]  # on no index


def test_in_a_clone_its_command_works() -> None:
    """Nothing is changed: pip only resolves what it would install."""
    command = shlex.split(install_extra("notebook"))
    done = subprocess.run(
        [*command, "--dry-run", "--no-deps", "--quiet"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


def test_of_a_wheel_the_name_is_enough(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(installing, "__file__", str(tmp_path / "drivers" / "installing.py"))
    assert install_extra("web").endswith("pip install 'cable-cell[web]'")
