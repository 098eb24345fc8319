"""The motion for the next cable that distinguishes tied effects of `cell learn`."""

from __future__ import annotations

from collections.abc import Sequence

from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.rival import Rival
from cell.lab.data.work import Progress, no_progress
from cell.lab.next.suggest import MOST_CANDIDATES, distinguishing_motions
from cell.lab.next.suggestion import Option, Suggestion
from cell.settings.surroundings import Surroundings

#: Motions that are asked for, one after another, at most.
MOST_ASKED = 2
#: A motion that decides less likely is not worth a cable.
WORTH_ASKING_POWER = 0.5


def distinguishing_motion(
    cable: PreparedStudy,
    open_to: Sequence[Rival],
    surroundings: Surroundings,
    progress: Progress = no_progress,
) -> Suggestion | None:
    """Motions that distinguish effects on a cable not seen yet; None = nothing is open.

    cable   one of those recorded: noise and markers of what will be measured
    raises  ValueError: no motion keeps the limits
    """
    if not open_to:
        return None
    return distinguishing_motions(cable, open_to[:MOST_CANDIDATES], surroundings, progress)


def worth_measuring(suggestion: Suggestion) -> Option | None:
    """The motion to be asked for, unless none is likely to decide."""
    best = suggestion.options[0]
    return best if best.power >= WORTH_ASKING_POWER else None
