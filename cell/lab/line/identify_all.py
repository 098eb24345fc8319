"""All recordings of a folder identified again, by many workers, with bounded memory."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cell.lab.data.work import Progress, no_progress
from cell.lab.line.identified_again import IdentifiedAgain, identified_again
from cell.lab.line.identified_table import IdentifiedTable
from cell.lab.line.recordings import Packed
from cell.workers.executor import Executor

FORMAT = "cable-identified/1"
#: Recordings that are named in the summary of each kind; the table has all.
_NAMED = 10


@dataclass
class IdentifiedAll:
    """The results of all recordings, at a glance.

    recordings    in the folder
    known         of them, those that the table had already
    outcomes, compared   how many of each, see `IdentifiedAgain`
    moved         those that have moved most, the first the most
    unidentified  the first that were not identified
    """

    recordings: int
    known: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    compared: Counter[str] = field(default_factory=Counter)
    unidentified: list[IdentifiedAgain] = field(default_factory=list)
    _moved: list[tuple[float, str, IdentifiedAgain]] = field(default_factory=list)

    @property
    def done(self) -> int:
        """Recordings with a result."""
        return self.outcomes.total()

    @property
    def moved(self) -> list[IdentifiedAgain]:
        """Those that have moved most from what was identified then."""
        return [row for *_, row in sorted(self._moved, key=lambda m: (-m[0], m[1]))]

    def add(self, row: IdentifiedAgain) -> None:
        """Count one more."""
        row = replace(row, parameters=None)
        self.outcomes[row.outcome] += 1
        self.compared[row.compared] += 1
        if row.outcome != "identified" and len(self.unidentified) < _NAMED:
            self.unidentified.append(row)
        if row.moved_std is not None:
            heapq.heappush(self._moved, (row.moved_std, row.recording, row))
            if len(self._moved) > _NAMED:
                heapq.heappop(self._moved)

    def to_json(self) -> dict[str, Any]:
        """Plain data, format cable-identified/1."""
        return {
            "format": FORMAT,
            "recordings": self.recordings,
            "done": self.done,
            "known": self.known,
            "outcomes": dict(sorted(self.outcomes.items())),
            "compared": dict(sorted(self.compared.items())),
            "moved": [
                {"recording": r.recording, "parameter": r.moved, "std": r.moved_std}
                for r in self.moved
            ],
            "unidentified": [
                {"recording": r.recording, "outcome": r.outcome, "why": r.why}
                for r in self.unidentified
            ],
        }


def identify_all(
    recordings: Sequence[Path],
    pack: Callable[[Path], Packed],
    table: IdentifiedTable,
    executor: Executor,
    progress: Progress = no_progress,
    check: Callable[[], None] = lambda: None,
) -> Iterator[IdentifiedAll]:
    """The results so far, after every recording; each is in the table by then.

    What the table has of a recording is taken if all that it depends on is as it was.
    pack   of `recordings.packer`
    check  may raise while a result is waited for
    """
    found = IdentifiedAll(len(recordings))
    sent: list[str] = []

    def jobs() -> Iterator[Packed]:
        """Recordings of which nothing is known."""
        for recording in recordings:
            packed = pack(recording)
            row = table.known.get(packed.name)
            if row is not None and not packed.wrong and row.key == packed.key:
                found.known += 1
                found.add(row)
                continue
            sent.append(packed.name)
            yield packed

    progress("identifying", 0, len(recordings))
    with closing(executor.map(identified_again, jobs(), check)) as results:
        for result in results:
            if result.error is None:
                row = result.value
            else:
                row = IdentifiedAgain(sent[result.number], "", "failed", why=str(result.error))
            table.add(row)
            found.add(row)
            progress("identifying", found.done, len(recordings))
            yield found
    progress("identifying", found.done, len(recordings))
    yield found
