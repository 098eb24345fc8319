"""Writes the section `model` of a settings file, and nothing else in it; a history lies beside."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode

from cell.files.atomic import write_whole
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Document, document_of, read_yaml, validate, yaml_text
from cell.files.yaml_edit import last_line
from cell.settings.check import load_settings, settings_of
from cell.settings.line import differences, line_of
from cell.settings.model import Model, Settings
from cell.settings.translate import model_hash

FORMAT = "cell-candidate/1"
_KEY = "model"


@dataclass(frozen=True)
class CandidateModel:
    """A model that was learned, before the line uses it.

    model     the section, as it will be written
    beside    hash of the model that the line had when it was learned
    failed    gates that it did not pass: name → what was found
    lines     that it was learned from, as `line_of` has them; none = not known
    """

    path: Path
    model: Model
    beside: str
    failed: dict[str, str]
    lines: tuple[dict[str, Any], ...] = ()


def read_candidate(path: Path) -> CandidateModel:
    """A candidate's file.  Raises InputError: it is none, or was changed and is wrong now."""
    document = read_yaml(path)
    data = document.data
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        message = f"is no candidate: `format: {FORMAT}` is missing; `cell learn -o` writes one"
        raise InputError([document.problem((), message)])
    problems = [
        document.problem((key,), "is missing; learn it again")
        for key in ("model", "beside", "gates")
        if key not in data
    ]
    if problems:
        raise InputError(problems)
    problems = [
        document.problem(("gates", i), "needs gate, passed and found; learn it again")
        for i, gate in enumerate(data["gates"] if isinstance(data["gates"], list) else [None])
        if not isinstance(gate, dict) or not {"gate", "passed", "found"} <= set(gate)
    ]
    if problems:
        raise InputError(problems)
    lines = data.get("lines", [])
    if not isinstance(lines, list) or not all(isinstance(line, dict) for line in lines):
        message = "is no list of lines; learn it again"
        raise InputError([document.problem(("lines",), message)])
    nested = Document(
        path, data["model"], {k[1:]: v for k, v in document.places.items() if k[:1] == ("model",)}
    )
    failed = {str(g["gate"]): str(g["found"]) for g in data["gates"] if g["passed"] is not True}
    model = validate(nested, Model)
    return CandidateModel(path, model, str(data["beside"]), failed, tuple(lines))


def promote(candidate: CandidateModel, config: Path, *, from_another_line: bool = False) -> Path:
    """Make the candidate's model that of the settings.

    The settings as they were go to the history first; then the file is replaced whole, so that
    whenever this is killed, it holds the old settings or the new ones.
    from_another_line  the candidate may have been learned on another line
    returns  the file in the history
    raises   InputError: gates not passed, learned beside another model or on another line, settings
             that are wrong or whose outermost level is not one key a line
    """
    config = config.resolve()
    settings = load_settings(config)
    problems = [
        Problem(candidate.path, 1, None, f"gate {name!r}", f"not passed ({found}); learn from more")
        for name, found in candidate.failed.items()
    ]
    now = model_hash(settings.model)
    if candidate.beside != now:
        message = (
            f"was learned beside the model {candidate.beside}, the settings now have {now}: "
            "learn it again from cycles with this model"
        )
        problems.append(Problem(candidate.path, 1, None, "beside", message))
    if not from_another_line:
        problems += _of_another_line(candidate, settings)
    if problems:
        raise InputError(problems)
    text = read_exactly(config)
    section = yaml_text({_KEY: candidate.model.model_dump(mode="json", exclude_defaults=True)})
    changed = spliced(config, text, section)
    _check(config, changed, settings)
    entry = next_entry(history_of(config))
    write_whole(entry, text.encode())
    write_whole(config, changed.encode())
    return entry


def _of_another_line(candidate: CandidateModel, settings: Settings) -> Iterator[Problem]:
    """What says that a candidate was learned elsewhere."""
    remedy = "learn from cycles of this line, or promote it with --from-another-line"
    if not candidate.lines:
        message = f"is missing: nothing says on which line it was learned; {remedy}"
        yield Problem(candidate.path, 1, None, "lines", message)
    ours = line_of(settings)
    for line in candidate.lines:
        if apart := differences(line, ours):
            message = f"was learned on another line: {'; '.join(apart)}; {remedy}"
            yield Problem(candidate.path, 1, None, "lines", message)


def undo(config: Path) -> Path:
    """Give the settings the model that they had before the last promotion; the rest stays.

    returns  the file in the history that it was taken from, now marked as undone
    raises   InputError: there is none, or the settings are wrong
    """
    config = config.resolve()
    text = read_exactly(config)
    present = section_of(config, text)
    for entry in sorted(history_of(config).glob("*.yaml"), reverse=True):
        if entry.name.endswith(".undone.yaml"):
            continue
        former = section_of(entry, read_exactly(entry))
        if former != present:
            write_whole(config, spliced(config, text, former).encode())
        entry.rename(entry.with_name(entry.name.replace(".yaml", ".undone.yaml")))
        if former != present:
            load_settings(config)
            return entry
    raise InputError(
        [Problem(config, 1, None, _KEY, "nothing to undo: no model was promoted here")]
    )


def history_of(config: Path) -> Path:
    """Folder of the settings as they were before each promotion."""
    return config.with_name(f"{config.stem}.models")


def section_of(path: Path, text: str) -> str:
    """The lines of the section `model`; empty if there is none."""
    found = _lines(path, text)
    lines = text.splitlines(keepends=True)
    return "" if found is None else "".join(lines[found[0] : found[1]])


def spliced(path: Path, text: str, section: str) -> str:
    """The text with its section `model` replaced; all other lines are as they were."""
    ends = "\r\n" if "\r\n" in text else "\n"
    section = section.replace("\r\n", "\n").replace("\n", ends)
    lines = text.splitlines(keepends=True)
    found = _lines(path, text)
    if found is not None:
        before, after = lines[: found[0]], lines[found[1] :]
        if not section and not after and before and not before[-1].strip():
            before.pop()  # the blank line with which a section is added at the end
        return "".join([*before, section, *after])
    if not section:
        return text
    whole = text if text.endswith(("\n", "\r")) else text + ends
    return whole + ends + section


def _lines(path: Path, text: str) -> tuple[int, int] | None:
    """First line of the section, and the one after its last that is no comment."""
    root: Any = YAML(typ="safe", pure=True).compose(text.removeprefix("\ufeff"))
    if not isinstance(root, MappingNode) or root.flow_style:
        message = "is not one key a line at its outermost level; write it so to have it changed"
        raise InputError([Problem(path, 1, None, "", message)])
    for key, value in root.value:
        if key.value == _KEY:
            return key.start_mark.line, last_line(value) + 1
    return None


def _check(config: Path, changed: str, before: Settings) -> None:
    """Whether the changed text says what it said before, but for the model.  Raises InputError."""
    after = settings_of(document_of(changed.removeprefix("\ufeff"), config))
    assert after.model_copy(update={_KEY: before.model}) == before


def next_entry(folder: Path) -> Path:
    """Where the next file of a history goes; its folder is made.  Raises OSError."""
    folder.mkdir(exist_ok=True)
    numbers = [int(p.name[:4]) for p in folder.glob("[0-9][0-9][0-9][0-9]*.yaml")]
    return folder / f"{max(numbers, default=0) + 1:04d}.yaml"


def read_exactly(path: Path) -> str:
    """The text of a file with its ends of lines and its mark.  Raises OSError; ValueError."""
    with path.open(encoding="utf-8", newline="") as file:
        return file.read()
