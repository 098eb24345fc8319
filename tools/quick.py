"""Lists the tests that a change affects, the nearest first, for a run before every commit.

    python -m tools.quick [--since HEAD]

Prints files of tests: changed ones, those that import a changed module directly or by one further
module, and those of the rules for all code.  Tests of complete cells and pages (`end_to_end`,
`docs`) are left to `make test`.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROOMS = ("cell", "drivers", "calib", "tools")
_SLOW = ("tests/end_to_end", "tests/docs")
#: Tests of rules for all code, such as the length of functions.
RULES = ("tests/test_project.py",)


def changed_files(root: Path, since: str) -> list[str]:
    """Files that differ from a commit, and new ones, relative to the project's root.

    raises  SystemExit: git knows no such commit, or no project
    """
    names = []
    for words in (("diff", "--name-only", since), ("ls-files", "--others", "--exclude-standard")):
        done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"--since {since}: {done.stderr.strip()}")
        names += done.stdout.split("\n")
    return [name for name in names if name]


def imported_by(file: Path, package: str = "") -> Iterator[str]:
    """Modules that a file imports, and the names that it imports from them.

    package  that relative imports begin at
    """
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: 1 - node.level or None] if node.level else []
            name = ".".join([*above, *([node.module] if node.module else [])])
            yield name
            yield from (f"{name}.{alias.name}" for alias in node.names)


def module_of(path: str) -> str:
    """Name of a module: cell/plan/choose.py → cell.plan.choose."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def touched(
    changed: Sequence[str], modules: Mapping[str, set[str]], tests: Mapping[str, set[str]]
) -> list[str]:
    """Affected files of tests, the nearest first.

    changed         files
    modules, tests  module → its imports; file of tests → its imports
    """
    near = {module_of(name) for name in changed if name.endswith(".py")}
    far = {name for name, imports in modules.items() if imports & near} - near
    ways = (
        (name for name in tests if name in RULES and near),
        (name for name in tests if name in changed),
        (name for name, imports in tests.items() if imports & near),
        (name for name, imports in tests.items() if imports & far),
    )
    return list(dict.fromkeys(name for way in ways for name in way))


def _imports(root: Path, files: Iterable[Path]) -> dict[str, set[str]]:
    imports = {}
    for file in sorted(files):
        name = file.relative_to(root).as_posix()
        package = (
            module_of(name) if file.name == "__init__.py" else module_of(name).rpartition(".")[0]
        )
        imports[name] = set(imported_by(file, package))
    return imports


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--since", default="HEAD", help="commit that a change begins after")
    since = parser.parse_args(arguments).since
    sources = (file for room in ROOMS for file in (root / room).rglob("*.py"))
    modules = {module_of(name): imported for name, imported in _imports(root, sources).items()}
    files = [
        file
        for file in (root / "tests").rglob("test_*.py")
        if not file.relative_to(root).as_posix().startswith(_SLOW)
    ]
    print("\n".join(touched(changed_files(root, since), modules, _imports(root, files))))


if __name__ == "__main__":
    main()
