"""Shows what a command is doing, for how long and until when: one line, or one every 10 s."""

from __future__ import annotations

import itertools
import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.status import Status

from cell.computer.watched import FIT_ERROR, PROGRESS_VARIABLE
from drivers.threads import GuardedThread, only_logged

if TYPE_CHECKING:
    from cell.lab.data.work import ModelError

#: Interval of lines off a terminal, s: enough to see progress, too little to fill a log.
EVERY_S = 10.0
#: An estimate that is exceeded by no more than this fraction is kept.
SLACK = 0.25
#: Number of pieces that make an estimate reliable: from then on it may grow, too.
MANY = 20
LONGER = "longer than thought"
#: Number of models whose errors are drawn as bars.
MOST_BARS = 24
_BARS = "▁▂▃▄▅▆▇█"
#: Steps of a cycle whose label is not their name.
_STEPS = {"warm_up": "warm up (on a new computer it compiles, once)"}


@dataclass(frozen=True)
class Stage:
    """Stage of a computation: `done` of `total` pieces since `started_s`; total 0 = not countable.

    first   pieces done before it began
    ends_s  estimated end; from few pieces it never grows; None = not known
    late    whether the few pieces so far take longer than estimated
    """

    text: str
    done: int
    total: int
    started_s: float
    first: int = 0
    ends_s: float | None = None
    late: bool = False

    def then(self, text: str, done: int, total: int, now_s: float) -> Stage:
        """Next stage: a further piece of this part, or a new part."""
        if not total or total != self.total or done < self.done:
            return Stage(text, done, total, now_s, done)
        if done in (self.done, self.first):
            return replace(self, text=text, done=done)
        each_s = (now_s - self.started_s) / (done - self.first)
        ends_s = now_s + each_s * (total - done)
        if done - self.first >= MANY:
            return replace(self, text=text, done=done, ends_s=ends_s, late=False)
        known_s = ends_s if self.ends_s is None else self.ends_s
        late = self.late or ends_s > known_s + SLACK * (known_s - self.started_s)
        return replace(self, text=text, done=done, ends_s=min(ends_s, known_s), late=late)

    def line(self, started_s: float, now_s: float) -> str:
        """Text for a person: activity, elapsed time, estimated time of this part."""
        words = [self.text]
        if self.total:
            words.append(f"{self.done} of {self.total}")
        words.append(f"{duration(now_s - started_s)} so far")
        if rest := self.remaining(now_s):
            words.append(f"{rest} of this part" if rest != LONGER else f"this part: {rest}")
        return ", ".join(words)

    def remaining(self, now_s: float) -> str:
        """Estimated remaining time of this part; empty = not known yet."""
        if self.ends_s is None or not self.done < self.total:
            return ""
        if self.late or now_s > self.ends_s:
            return LONGER
        return f"about {duration(self.ends_s - now_s)} left"


class Ticker:
    """Prints a line on the error stream periodically, in its own thread, until stopped.

    line     gives the text to print now; empty = nothing
    every_s  interval; None = the default
    wait     waits some seconds, returns whether it was closed; None = by the clock
    """

    def __init__(
        self,
        line: Callable[[], str],
        every_s: float | None = None,
        wait: Callable[[float], bool] | None = None,
    ) -> None:
        self._line = line
        self._every_s = _usual_s() if every_s is None else every_s
        self._closed = threading.Event()
        self._wait = self._closed.wait if wait is None else wait
        self._thread = GuardedThread("progress", self._tick, only_logged)
        self._thread.start()

    def stop(self) -> None:
        """Print no more."""
        self._closed.set()
        self._thread.join()

    def _tick(self) -> None:
        while not self._wait(self._every_s) and not self._closed.is_set():
            if text := self._line():
                print(text, file=sys.stderr, flush=True)


def _usual_s() -> float:
    """Time between two lines, s: as configured, but no less than 0.1 s."""
    try:
        return max(0.1, float(os.environ[PROGRESS_VARIABLE]))
    except (KeyError, ValueError):
        return EVERY_S


class ProgressLine:
    """Progress of a long computation, shown: call it as each piece begins; use it as a context.

    The remaining time is that of the current part, estimated from its pieces so far.  From few
    pieces it only falls.  Errors of fitted models follow as bars, or are sent to the page that
    began the command.
    """

    def __init__(
        self,
        command: str,
        console: Console | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._command = command
        self._console = Console(stderr=True) if console is None else console
        self._now_s = now_s
        self._started_s = now_s()
        self._stage = Stage("at work", 0, 0, self._started_s)
        self._drawn: Status | Progress | None = None
        self._ticker: Ticker | None = None
        self._errors: list[ModelError] = []

    def watch(self, error: ModelError) -> None:
        """Take the error of a model that was fitted.  A `Work` calls it."""
        self._errors.append(error)
        if isinstance(self._drawn, Status):
            self._drawn.update(self.line())
        elif PROGRESS_VARIABLE in os.environ:
            print(FIT_ERROR + json.dumps(asdict(error)), file=sys.stderr, flush=True)

    def __call__(self, text: str, done: int = 0, total: int = 0) -> None:
        """A piece begins: `done` of `total` are complete; 0 of 0 = they cannot be counted."""
        self._stage = self._stage.then(text, done, total, self._now_s())
        if isinstance(self._drawn, Status):
            self._drawn.update(self.line())

    def step(self, number: int, step: str) -> None:
        """A step of a cycle begins."""
        self(step.replace("_", " "))

    def line(self) -> str:
        """Text that would be shown now."""
        line = f"{self._command}: {self._stage.line(self._started_s, self._now_s())}"
        drawn = self._console.is_terminal and self._console.encoding.startswith("utf")
        return f"{line}  {error_sparkline(self._errors)}".rstrip() if drawn else line

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Hide the line while a person answers a prompt."""
        if self._drawn is not None:
            self._drawn.stop()
        yield
        if self._drawn is not None:
            self._drawn.start()

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._drawn = self._draw()
            self._drawn.start()
        else:
            self._ticker = Ticker(self.line)
        return self

    def __exit__(self, *_: object) -> None:
        for shown in (self._drawn, self._ticker):
            if shown is not None:
                shown.stop()

    def _draw(self) -> Status | Progress:
        """What moves at a terminal."""
        return Status(self.line(), console=self._console)


class RunProgress(ProgressLine):
    """A line that moves on with every step, on the error stream; off a terminal one every 10 s.

    The remaining time assumes that the remaining cycles take as long as those so far.

    steps  names of those of one cycle, in their order
    """

    def __init__(self, cycles: int, steps: Sequence[str]) -> None:
        super().__init__("run")
        self._cycles = cycles
        self._steps = steps
        self._stage = Stage("connect", 0, cycles, self._started_s)
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("cable {task.fields[number]} of {task.fields[cycles]}"),
            BarColumn(bar_width=16),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[hint]}"),
            console=self._console,
            transient=True,
        )
        in_all = cycles * len(steps)
        self._task = self._bar.add_task("", total=in_all, number=1, cycles=cycles, left="", hint="")

    def _draw(self) -> Progress:
        return self._bar

    def step(self, number: int, step: str) -> None:
        """A step of a cycle begins."""
        if step in self._steps:
            done = (number - 1) * len(self._steps) + self._steps.index(step)
            self._bar.update(self._task, completed=done)
        words = _STEPS.get(step, step.replace("_", " "))
        now_s = self._now_s()
        self._stage = self._stage.then(f"{words}, cables done", number - 1, self._cycles, now_s)
        remaining = self._stage.remaining(now_s)
        self._bar.update(self._task, description=words, number=number, left=remaining)

    def print_line(self, words: str) -> None:
        """Print a permanent line above the moving one."""
        self._console.print(words, markup=False, highlight=False, soft_wrap=True)

    def hint(self, words: str) -> None:
        """Show the function of the keys."""
        self._bar.update(self._task, hint=words)


def error_sparkline(errors: Sequence[ModelError]) -> str:
    """Bars of the least error after each model, from the noise to the first error, by logarithm."""
    if not errors:
        return ""
    least = list(itertools.accumulate((e.rms_m for e in errors), min))[-MOST_BARS:]
    low, high = math.log(min(errors[-1].noise_m, least[-1])), math.log(errors[0].rms_m)
    shares = [(math.log(m) - low) / max(high - low, 0.1) for m in least]
    return "".join(_BARS[max(0, min(len(_BARS) - 1, round(s * (len(_BARS) - 1))))] for s in shares)


def duration(seconds: float) -> str:
    """Whole seconds, or minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
