"""State that all lab pages of a server share: the workspace, the jobs, and short commands."""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from cell.cable.effects.remote import MARK
from cell.files.atomic import write_atomic
from cell.files.input_error import InputError
from cell.files.yaml_document import read_yaml
from cell.web.jobs import OPEN, CompletedCommand, Jobs, run_command
from cell.web.workspace import Workspace, is_name

#: Time limit of an effect's check, s.  The check itself ends a law that is too slow, by processor
#: time: this limit is for an overloaded computer.
CHECK_S = 300.0
#: Time limit of a promotion, s.
PROMOTE_S = 60.0
#: Number of cached texts that have passed the check: a text that was checked while it was typed is
#: not checked again when it is saved.
_RIGHT = 20
#: A remedy of the command, and that of the page.
_OF_FILES = "in a file of --candidates; read the file, and give it as --try if you trust it"
_OF_PAGE = "here; on the cell's computer a file may have it, with --try"
#: Largest text of an effect or a mapping, characters.
LONGEST_TEXT = 60_000


@dataclass(frozen=True)
class CheckedFile:
    """Result of checking a typed effect.

    good    whether it can be fitted
    output  its errors, one a line, each with its line number
    law     its docstring
    """

    good: bool
    output: tuple[str, ...] = ()
    law: str = ""


class Lab:
    """Workspace and jobs."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace
        self.jobs = Jobs()
        self._right: deque[tuple[str, str, str]] = deque(maxlen=_RIGHT)
        self._promoting = threading.Lock()
        self._checking = threading.Lock()

    def check_effect(self, name: str, text: str) -> CheckedFile:
        """Check a typed effect as `cell effects --candidates` does, in a separate process.

        One at a time; temporary files are removed.
        """
        if refused := refused_text(name, text):
            return CheckedFile(False, (refused,))
        with self._checking, TemporaryDirectory() as folder:
            for known_name, known, law in self._right:
                if (known_name, known) == (name, text):
                    return CheckedFile(True, (), law)
            file = Path(folder) / f"{name}.py"
            file.write_text(text, encoding="utf-8")
            ran = run_command(("effects", "--candidates", folder, "--json"), CHECK_S)
            if ran.code == 0:
                law = _law(ran.printed, name)
                self._right.append((name, text, law))
                return CheckedFile(True, (), law)
        if ran.code is None:
            busy = f"the check had no answer in {CHECK_S:g} s: this computer has too much to do; "
            return CheckedFile(False, (f"{busy}check again when jobs have ended",))
        lines = ran.output.replace(f"{folder}/", "").replace(_OF_FILES, _OF_PAGE).splitlines()
        complaints = tuple(
            line.removeprefix("note: left out: ") for line in lines or ["the check failed"]
        )
        return CheckedFile(False, complaints)

    def save_effect(self, name: str, text: str) -> str:
        """Save a typed effect that has passed its check; reason of a refusal, or ""."""
        checked = self.check_effect(name, text)
        if not checked.good:
            return "\n".join(checked.output)
        try:
            write_atomic(self.workspace.effects / MARK, "Effects here run in sandboxes only.\n")
            write_atomic(self.workspace.effects / f"{name}.py", text)
        except OSError as error:
            return str(error)
        return ""

    def save_mapping(self, mapping: Path, text: str) -> str:
        """Save an edited mapping, with files of the workspace only; reason of a refusal, or ""."""
        if len(text) > LONGEST_TEXT:
            return f"the mapping has {len(text)} characters; at most {LONGEST_TEXT}"
        with TemporaryDirectory() as folder:
            draft = Path(folder) / mapping.name
            draft.write_text(text, encoding="utf-8")
            try:
                data = read_yaml(draft).data
            except InputError as error:
                return str(error).replace(str(draft), mapping.name)
        for path in named_files(data):
            if not self.workspace.inside(mapping.parent / path):
                return f"{path!r}: is not in the lab's workspace; name a file that was uploaded"
        try:
            write_atomic(mapping, text)
        except (OSError, ValueError) as error:
            return str(error)
        return ""

    def promoted(self, words: Sequence[str]) -> CompletedCommand:
        """Run `cell promote`, one at a time."""
        with self._promoting:
            return run_command(words, PROMOTE_S)

    def tidy(self) -> None:
        """Remove old files and those beyond the size limit, except files of jobs."""
        self.workspace.tidy({j.task.subject for j in self.jobs.listed() if j.state in OPEN})


def refused_text(name: str, text: str) -> str:
    """Why an effect of this name and text is refused before its check, or ""."""
    if not is_name(name) or "." in name or "-" in name:
        return "the name of an effect's file has letters, digits and _ only, a letter first"
    if len(text) > LONGEST_TEXT:
        return f"the text has {len(text)} characters; at most {LONGEST_TEXT}"
    return ""


def named_files(mapping: object) -> list[str]:
    """Files that a mapping names, even if it is wrong otherwise."""
    trials = mapping.get("trials") if isinstance(mapping, dict) else None
    entries = [t for t in trials if isinstance(t, dict)] if isinstance(trials, list) else []
    others = [name for t in entries for name in t.get("beside") or ()]
    return [str(t[k]) for t in entries for k in ("file", "hand_file") if t.get(k)] + [
        str(name) for name in others
    ]


def _law(printed: str, name: str) -> str:
    try:
        return str(json.loads(printed)["effects"][-1]["law"])
    except (ValueError, LookupError, TypeError):
        return name
