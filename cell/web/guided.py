"""Runs a calibration command in a process of its own, and passes on its questions and answers."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivers.threads import GuardedThread, error_text

#: Number of the process's output lines that are kept.
_LINES = 40
#: Time limit of the process after a request to end, s; then it is killed.
_ENDS_S = 20.0


@dataclass(frozen=True)
class GuidedState:
    """State of a guided command: question, output, progress, exit code.

    ask              current instruction to a person; "" = none
    question_number  of that instruction, from 1; 0 = there is none
    output           its newest lines
    code             exit code; None = it runs
    """

    title: str = ""
    ask: str = ""
    question_number: int = 0
    output: tuple[str, ...] = ()
    done: int = 0
    total: int = 0
    started_s: float = 0.0
    code: int | None = 0

    @property
    def runs(self) -> bool:
        """Whether the command is running."""
        return self.code is None


class Guided:
    """At most one command at a time; safe to be used from several threads."""

    def __init__(self) -> None:
        self.state = GuidedState()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._following: threading.Thread | None = None
        self._errors: deque[str] = deque(maxlen=_LINES)
        self._questions = 0

    def start(self, title: str, command: Sequence[str]) -> str:
        """Start a command; reason of a refusal, or ""."""
        with self._lock:
            if self.state.runs:
                return f"{self.state.title} is under way"
            pipe = subprocess.PIPE
            try:
                self._process = subprocess.Popen(
                    command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, encoding="utf-8"
                )
            except OSError as error:
                return f"{command[0]}: {error.strerror}"
            self.state = GuidedState(title, started_s=time.time(), code=None)
            self._errors.clear()
        process = self._process
        follow = GuardedThread(
            "guided", partial(self._follow, process), partial(self._unread, process)
        )
        follow.start()
        self._following = follow
        return ""

    def answer(self, words: str, to: int) -> str:
        """Answer the question of the number `to`; reason of a refusal, or ""."""
        with self._lock:
            process = self._process
            if (
                not self.state.question_number
                or self.state.question_number != to
                or process is None
            ):
                return "this was answered already, or is asked no more"
            self.state = replace(self.state, ask="", question_number=0)
        assert process.stdin is not None
        try:
            process.stdin.write(words.replace("\n", " ") + "\n")
            process.stdin.flush()
        except (OSError, ValueError) as error:
            return f"it has ended: {error}"
        return ""

    def cancel(self) -> str:
        """End the command and its devices; reason of a refusal, or ""."""
        process = self._process
        if process is None or not self.state.runs:
            return "nothing is under way"
        process.terminate()
        GuardedThread("kill", partial(_killed_later, process), lambda _: process.kill()).start()
        return ""

    def close(self) -> None:
        """End a running command, and wait for it."""
        if self._process is not None and self.state.runs:
            self._process.terminate()
            _killed_later(self._process)
        if self._following is not None:
            self._following.join()

    def _follow(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        hear = GuardedThread(
            "guided errors", partial(self._read_output, process), partial(self._unheard, process)
        )
        hear.start()
        for line in process.stdout:
            message = _message(line)
            with self._lock:
                now = self.state
                if "ask" in message:
                    self._questions += 1
                    now = replace(now, ask=str(message["ask"]), question_number=self._questions)
                if text := str(message.get("say", "")).strip():
                    now = replace(now, output=(*now.output, text)[-_LINES:])
                if message.get("total"):
                    now = replace(now, done=int(message["done"]), total=int(message["total"]))
                self.state = now
        hear.join()
        self._ended(process, self._errors)

    def _unread(self, process: subprocess.Popen[str], error: BaseException) -> None:
        """End the command, which stops the arm: its output cannot be read any more."""
        process.terminate()
        self._ended(process, [error_text(error)], code=-1)

    def _ended(
        self, process: subprocess.Popen[str], lines: Iterable[str], code: int | None = None
    ) -> None:
        """Wait for its end; `code` replaces its own exit code."""
        with suppress(OSError), process:  # closes its pipes, and waits
            pass
        code = process.wait() if code is None else code
        with self._lock:
            last = (*self.state.output, *lines)[-_LINES:]
            self.state = replace(self.state, ask="", question_number=0, output=last, code=code)

    def _unheard(self, process: subprocess.Popen[str], error: BaseException) -> None:
        self._errors.append(error_text(error))
        process.terminate()

    def _read_output(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            self._errors.append(line.strip())


class OpenQuestion:
    """The question on an open page; it can be answered from the page's second refresh on.

    So a double click does not answer the next question before it was read.
    """

    def __init__(self, guided: Guided) -> None:
        self._guided = guided
        self._shown = self._read = 0

    def refresh(self) -> bool:
        """Show the current question; returns whether it can be answered."""
        number = self._guided.state.question_number
        self._read = number if number == self._shown else 0
        self._shown = number
        return self._read != 0

    def answer(self, words: str) -> str:
        """Answer the displayed question; reason of a refusal, or ""."""
        return self._guided.answer(words, self._read)


def calibrate_command(part: str, config: Path, product: str = "") -> list[str]:
    """The command that calibrates a part, or checks it, in a dialogue with this program.

    product  product of the grip; "" = the default product, or settings without products
    """
    words = [sys.executable, "-m", "cell", "calibrate", *([part] if part else [])]
    of = ["--product", product] if product else []
    return [*words, *of, "--config", str(config), "--dialogue"]


def _message(line: str) -> dict[str, Any]:
    """A line of JSON; other text is a message to a person."""
    with suppress(ValueError):
        message = json.loads(line)
        if isinstance(message, dict):
            return message
    return {"say": line}


def _killed_later(process: subprocess.Popen[str]) -> None:
    try:
        process.wait(_ENDS_S)
    except subprocess.TimeoutExpired:
        process.kill()
