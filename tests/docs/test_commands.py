"""Every block of README and docs: commands run as printed, outputs compared, or it says why not.

A comment before a block says what it is.  `<!-- run -->`: commands, run in the page's own folder;
`<!-- run as: COMMAND -->`: that one instead; `<!-- slow: REASON -->` and
`<!-- slow run as: COMMAND -->`: only by `make docs`; `<!-- named: REASON -->`: not run, but all
commands, options and scripts that it names are there; `<!-- folder: PATTERN -->`: what that folder
holds; `<!-- file: NAME -->`: the content of a file; `<!-- replaces: TEXT in: NAME -->`: takes the
place of a text in a file; `<!-- output: 10 % -->`: what the last commands print, numbers within
that share (… stands for anything); `<!-- refused: COMMAND -->`: what that command says that ends
with 2; `<!-- not run: REASON -->`.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.core import TyperGroup
from typer.main import get_command

from cell.cli import app

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    *(p for p in sorted(DOCS.rglob("*.md")) if p.parent.name != "decisions"),
]
#: They begin with one command, which is run once.
OF_A_RUN = [ROOT / "README.md", DOCS / "start" / "simulated_cell.md"]
ALL = os.environ.get("CELL_DOCS") == "all"
_NUMBER = re.compile(r"[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_RUN = ("run as", "run", "slow", "slow run as")
_KINDS = (*_RUN, "named", "folder", "file", "replaces", "output", "refused", "not run")


@dataclass(frozen=True)
class Block:
    """Lines of code on a page, and what the comment before them says they are."""

    line: int
    kind: str
    given: str
    text: str


def blocks(page: str) -> list[Block]:
    """Fenced blocks and those indented by four spaces, outside lists' paragraphs too."""
    found, lines, i = [], page.splitlines(), 0
    while i < len(lines):
        fence = re.match(r"\s*```", lines[i])
        if fence:
            end = next(k for k in range(i + 1, len(lines)) if re.match(r"\s*```\s*$", lines[k]))
            body, start = lines[i + 1 : end], i
            i = end + 1
        elif re.match(r" {4,}\S", lines[i]) and not lines[i - 1].strip():
            start = i
            while i < len(lines) and (not lines[i].strip() or lines[i].startswith("    ")):
                i += 1
            body = lines[start:i]
        else:
            i += 1
            continue
        indent = min((len(x) - len(x.lstrip()) for x in body if x.strip()), default=0)
        text = "\n".join(x[indent:] for x in body).strip("\n")
        found.append(Block(start + 1, *_said(lines[:start]), text))
    return found


def _said(before: list[str]) -> tuple[str, str]:
    """Kind and details in the comment that is the last thing before a block."""
    words = [line for line in before if line.strip()]
    comment = re.fullmatch(r"\s*<!-- (.*?) -->", words[-1]) if words else None
    if comment is None:
        return "", ""
    kind, _, given = comment[1].partition(": ")
    return kind, given


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_block_says_what_it_is(page: Path) -> None:
    silent = [b.line for b in blocks(page.read_text()) if b.kind not in _KINDS]
    assert not silent, f"{page.name}: blocks at lines {silent} have no comment of {_KINDS}"


def tokens(text: str) -> list[str]:
    """Words, without the lines that tables are drawn with."""
    return [word for word in text.split() if not re.fullmatch(r"[─━═│┃|+-]+", word)]


def agrees(stated: str, printed: str, share: float) -> bool:
    """Whether two words are the same but for their numbers, and these within a share."""
    if _NUMBER.sub("#", stated) != _NUMBER.sub("#", printed):
        return False
    pairs = zip(_NUMBER.findall(stated), _NUMBER.findall(printed), strict=True)
    return all(
        math.isclose(float(a.replace("−", "-")), float(b.replace("−", "-")), rel_tol=share)
        for a, b in pairs
    )


def missing(stated: str, printed: str, share: float) -> str:
    """The first piece between two … that is not printed, in its order; empty = all is there."""
    rest = tokens(printed)
    for piece in stated.split("…"):
        wanted = tokens(piece)
        for at in range(len(rest) - len(wanted) + 1):
            if all(agrees(a, b, share) for a, b in zip(wanted, rest[at:], strict=False)):
                rest = rest[at + len(wanted) :]
                break
        else:
            return " ".join(wanted)
    return ""


def run(command: str, folder: Path, code: int = 0) -> str:
    """What a shell prints of a command, which must end with `code`; its errors if that is not 0."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=os.environ | {"PATH": path, "COLUMNS": "80"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stderr if code else done.stdout


def not_there(text: str) -> list[str]:
    """Commands, options, targets of make and scripts that a block names and that do not exist.

    A line that is indented goes on with the one before.
    """
    found: list[str] = []
    commands = get_command(app)
    assert isinstance(commands, TyperGroup)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for line in re.sub(r"\n +", " ", text).splitlines():
        match re.findall(r"[^\s\[\]|]+", line.partition("#")[0].removeprefix(".venv/bin/")):
            case ["cell", name, *words]:
                command = commands.commands.get(name)
                while isinstance(command, TyperGroup) and words and words[0] in command.commands:
                    command = command.commands[words.pop(0)]
                known = [] if command is None else [o for p in command.params for o in p.opts]
                options = [word for word in words if re.match(r"--?[a-z]", word)]
                found += [f"{name} {o}" for o in options if o not in known]
                found += [name] if command is None else []
            case ["make", *names]:
                found += [f"make {n}" for n in names if "=" not in n and n not in targets]
            case ["python", "-m", module, *_]:
                there = (ROOT / module.replace(".", "/")).with_suffix(".py").exists()
                found += [] if there else [module]
            case ["python", script, *_]:
                found += [] if (ROOT / script).exists() else [script]
    return found


def begins_with(page: Path) -> str:
    """The command that a page begins with; "" = another kind of block comes first, or none."""
    first = next((b for b in blocks(page.read_text()) if b.kind not in ("named", "not run")), None)
    return first.given if first is not None and first.kind == "run as" else ""


def follow(page: Path, folder: Path, before: tuple[Path, str] | None = None) -> list[str]:
    """Do what a page says, in a folder; returns the outputs that are not as stated.

    before  what the page's first command has left and printed, where another page began with it
    """
    for name in ("cell", "config", "docs", "tools"):
        (folder / name).symlink_to(ROOT / name)
    (folder / ".venv").mkdir()
    (folder / ".venv" / "bin").symlink_to(Path(sys.executable).parent)
    printed, wrong = "", []
    for block in blocks(page.read_text()):
        match block.kind:
            case "run" | "run as" | "slow" | "slow run as":
                as_given = block.kind.endswith("run as")
                commands = [block.given] if as_given else block.text.splitlines()
                do = ALL or not block.kind.startswith("slow")
                if before is not None and block.given == begins_with(page):
                    shutil.copytree(before[0] / "runs", folder / "runs")
                    printed, before = before[1], None
                    continue
                printed = "\n".join(run(command, folder) for command in commands if command and do)
            case "named":
                wrong += [f"{page.name}:{block.line}: {name}" for name in not_there(block.text)]
            case "folder":
                (shown,) = folder.glob(block.given)
                names = [line.split()[0] for line in block.text.splitlines()[1:]]
                wrong += [f"{page.name}: no {name}" for name in names if not list(shown.glob(name))]
            case "file":
                (folder / block.given).parent.mkdir(parents=True, exist_ok=True)
                (folder / block.given).write_text(block.text + "\n")
            case "refused":
                said = run(block.given, folder, 2)
                if piece := missing(block.text, said, 0.0):
                    wrong.append(f"{page.name}:{block.line}: not said: {piece}\n{said}")
            case "replaces":
                text, name = block.given.split(" in: ")
                content = (folder / name).read_text()
                assert content.count(text) == 1, f"{page.name}:{block.line}: {text!r} in {name}"
                (folder / name).write_text(content.replace(text, block.text))
            case "output" if printed:
                share = float(block.given.removesuffix("%").strip() or 0) / 100
                if piece := missing(block.text, printed, share):
                    wrong.append(f"{page.name}:{block.line}: not printed: {piece}\n{printed}")
    return wrong


@pytest.mark.parametrize(
    "page",
    [p for p in PAGES if p.name != "lab.md" and p not in OF_A_RUN],
    ids=lambda p: p.name,
)
def test_a_page_does_what_it_says(page: Path, tmp_path: Path) -> None:
    assert not follow(page, tmp_path)


def test_pages_that_begin_with_the_same_run_do_what_they_say(tmp_path: Path) -> None:
    (command,) = {begins_with(page) for page in OF_A_RUN}
    (begun := tmp_path / "begun").mkdir()
    (begun / "config").symlink_to(ROOT / "config")
    printed = run(command, begun)
    for page in OF_A_RUN:
        (folder := tmp_path / page.stem).mkdir()
        assert not follow(page, folder, (begun, printed))


def test_the_labs_first_session_prints_what_it_says_and_finds_what_was_hidden(
    tmp_path: Path,
) -> None:
    """One motion cannot tell, the suggested one decides: the loop of the lab in a cell."""
    assert not follow(ROOT / "docs" / "howto" / "lab.md", tmp_path)
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    assert found["verdict"] == "missing"
    assert [m["effect"] for m in found["missing"]] == ["added_mass"]
    value = found["missing"][0]["parameters"]["kg_per_m"]
    assert value["value"] == pytest.approx(8e-4, rel=0.06)
    model = json.loads((tmp_path / "after.json").read_text())
    assert "added_mass.kg_per_m" in [p["name"] for p in model["parameters"]]
    markers = (tmp_path / "study").glob("*/markers.csv")
    assert all("nan" not in m.read_text() for m in markers), "all of the cable was in every picture"


# --- the mechanism itself ------------------------------------------------------------------------


def test_numbers_agree_within_their_share_and_words_exactly() -> None:
    printed = "error 0.084 mm\n──── ───\n+ added_mass 0.0007987 (0.00078 … 0.00081) kg/m"
    assert not missing("error 0.083 mm … (0.00078", printed, 0.02)
    assert missing("error 0.083 mm", printed, 0.01) == "error 0.083 mm"
    assert missing("error 0.083 m", printed, 0.5)
    assert missing("kg/m … error", printed, 0.5) == "error"


def test_what_a_block_names_and_is_not_there_is_found() -> None:
    text = "cell fit STUDY [-o F] [--efect NAME|file.py]\n  [--prior F]\ncell fitt\nmake runn X=1\n"
    text += ".venv/bin/python -m tools.bench.none --seeds 3   # long\npython none.py\n"
    text += ".venv/bin/python -m tools.bench.bench\n.venv/bin/cell check --config F\n"
    wrong = ["fit --efect", "fitt", "make runn", "tools.bench.none", "none.py"]
    assert not_there(text) == wrong


def test_blocks_are_found_with_their_comments() -> None:
    page = (
        "Text\n\n<!-- run -->\n\n    cell a\n    cell b\n\nText\n\n1. x\n\n   <!-- file: y -->\n\n"
    )
    page += "       one\n         two\n\n```\nfenced\n```\n"
    assert blocks(page) == [
        Block(5, "run", "", "cell a\ncell b"),
        Block(14, "file", "y", "one\n  two"),
        Block(17, "", "", "fenced"),
    ]
