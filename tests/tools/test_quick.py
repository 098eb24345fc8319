"""A change is followed to the tests that it touches."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tools import quick
from tools.quick import imported_by, touched

FILES = {
    "cell/__init__.py": "",
    "cell/a.py": "x = 1\n",
    "cell/b.py": "from cell.a import x\n",
    "cell/c.py": "from .b import x\n",
    "cell/d.py": "",
    "tests/cell/test_a.py": "from cell import a\n",
    "tests/cell/test_b.py": "import cell.b\n",
    "tests/cell/test_c.py": "from cell.c import x\n",
    "tests/cell/test_d.py": "import cell.d\n",
    "tests/end_to_end/test_a.py": "import cell.a\n",
}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "."], [*identity, "commit", "-q", "-m", "begin"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


def of(project: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    quick.main([], project)
    return capsys.readouterr().out.split()


def test_a_changed_module_leads_to_its_tests_and_to_those_of_its_importers(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert of(project, capsys) == []
    (project / "cell" / "a.py").write_text("x = 2\n")
    assert of(project, capsys) == ["tests/cell/test_a.py", "tests/cell/test_b.py"]
    (project / "cell" / "b.py").write_text("x = 3\n")
    assert of(project, capsys)[-1] == "tests/cell/test_c.py"


def test_rules_for_all_code_are_tested_whichever_code_has_changed() -> None:
    """Three functions grew too long after they had been tested last."""
    tests: dict[str, set[str]] = {
        "tests/cell/test_a.py": {"cell.a"},
        "tests/test_project.py": set(),
    }
    assert touched(["cell/a.py"], {}, tests) == ["tests/test_project.py", "tests/cell/test_a.py"]
    assert touched(["README.md"], {}, tests) == []


def test_changed_and_new_tests_come_first(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (project / "cell" / "a.py").write_text("x = 2\n")
    (project / "tests" / "cell" / "test_d.py").write_text("\n")
    (project / "tests" / "cell" / "test_e.py").write_text("\n")
    assert of(project, capsys)[:2] == ["tests/cell/test_d.py", "tests/cell/test_e.py"]


def test_a_commit_that_is_not_there_is_refused(project: Path) -> None:
    with pytest.raises(SystemExit, match=r"--since nowhere: .*nowhere"):
        quick.main(["--since", "nowhere"], project)


def test_relative_imports_are_resolved(tmp_path: Path) -> None:
    file = tmp_path / "m.py"
    file.write_text("from . import x\nfrom ..y import z\nimport u.v\n")
    assert set(imported_by(file, "p.q")) == {"p.q", "p.q.x", "p.y", "p.y.z", "u.v"}


def test_what_nobody_imports_touches_nothing() -> None:
    assert touched(["README.md", "cell/lonely.py"], {"cell.b": {"cell.a"}}, {"t": {"cell.b"}}) == []
