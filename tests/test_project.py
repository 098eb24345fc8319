"""What is installed where: dependencies without a wheel for a machine are left out there."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]


def installed(python: str, machine: str, system: str = "linux") -> set[str]:
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "platform_machine": machine,
        "sys_platform": system,
    }
    needed = map(Requirement, PROJECT["dependencies"])
    return {r.name for r in needed if r.marker is None or r.marker.evaluate(environment)}


@pytest.mark.parametrize(
    ("python", "machine", "system", "has_wheel"),
    [
        ("3.11", "x86_64", "linux", True),
        ("3.12", "x86_64", "linux", True),
        ("3.13", "x86_64", "linux", False),
        ("3.12", "aarch64", "linux", False),
        ("3.12", "arm64", "darwin", False),
        ("3.12", "AMD64", "win32", False),
    ],
)
def test_ur_rtde_is_installed_where_there_is_a_wheel_and_the_rest_everywhere(
    python: str, machine: str, system: str, has_wheel: bool
) -> None:
    assert python in SpecifierSet(PROJECT["requires-python"])
    names = installed(python, machine, system)
    assert ("ur-rtde" in names) is has_wheel
    assert names | {"ur-rtde"} == {Requirement(r).name for r in PROJECT["dependencies"]}
