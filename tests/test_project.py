"""What is installed where, how long functions are, names of classes, which modules call devices."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from drivers.interfaces import Arm, Camera, Gripper

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

MOST_LINES, MOST_PARAMETERS = 80, 8
#: Loops that numba compiles: what they call costs time, and they take arrays, not objects.
KERNEL = ("njit", "compiled", "inline", "part")

#: The modules that call devices; everything else works with what these hand on.
CALLERS = {"steps", "measuring_steps", "dry_run", "endings", "filming", "waiting", "watch"}


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


def test_whoever_imports_the_packages_has_their_types() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    assert "py.typed" in settings["setuptools"]["package-data"]["*"]
    for package in settings["importlinter"]["root_packages"]:
        assert (ROOT / package / "py.typed").exists(), package


def sources(*folders: str) -> Iterator[tuple[Path, ast.Module]]:
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield path.relative_to(ROOT), ast.parse(path.read_text(encoding="utf-8"))


def test_functions_are_short_and_have_few_parameters() -> None:
    wrong = []
    for path, tree in sources("cell", "drivers", "calib", "tools"):
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            if any(ast.unparse(d).startswith(KERNEL) for d in node.decorator_list):
                continue
            given = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            parameters = [a for a in given if a.arg not in ("self", "cls")]
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > MOST_LINES or len(parameters) > MOST_PARAMETERS:
                where = f"{path}:{node.lineno} {node.name}"
                wrong.append(f"{where}: {lines} lines, {len(parameters)} parameters")
    assert not wrong, "\n".join(wrong)


def test_a_class_name_means_one_thing() -> None:
    places: dict[str, list[str]] = {}
    for path, tree in sources("cell", "drivers", "calib"):
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(str(path))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_only_a_few_modules_call_devices() -> None:
    """A call of a method of arm, camera or gripper, on something that is called like one."""
    methods = {
        name
        for kind in (Arm, Camera, Gripper)
        for name, value in vars(kind).items()
        if callable(value) and not name.startswith("_")
    }
    assert {"follow", "read", "grip"} <= methods
    calls = [
        (path, node.lineno)
        for path, tree in sources("cell")
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in methods
        and ast.unparse(node.func.value).rpartition(".")[2].lstrip("_")
        in ("arm", "camera", "gripper")
    ]
    found = {path for path, _ in calls if path.parts[1] != "wiring"}
    callers = {Path("cell", "run", f"{name}.py") for name in CALLERS}
    recorders = {Path("cell", "records", "recording", f"{n}.py") for n in ("devices", "recorder")}
    assert found == callers | recorders | {Path("cell", "calibration", "session.py")}, calls


def test_what_is_rounded_to_nothing_has_no_sign() -> None:
    """A number with a sign is "-0.00" otherwise: `z` in its format takes that off."""
    signed = re.compile(r"\+[0-9]*\.[0-9]f")
    found = [
        f"{path.name}:{spec.lineno}"
        for path, tree in sources("cell", "calib", "drivers")
        for spec in ast.walk(tree)
        if isinstance(spec, ast.Constant)
        and isinstance(spec.value, str)
        and signed.fullmatch(spec.value)
    ]
    assert not found
