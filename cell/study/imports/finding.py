"""What was understood of a file, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Sure(Enum):
    """Where something that was understood comes from."""

    SAID = "said"
    """The file states it."""
    SEEN = "seen"
    """The data show it."""
    GUESSED = "guessed"
    """It is usual, or only indicated: somebody must check it."""
    WANTED = "wanted"
    """It cannot be known from the file: somebody must give it."""


@dataclass(frozen=True)
class Finding:
    """One sentence, and the entry of the mapping that it is about."""

    entry: str
    sentence: str
    sure: Sure

    def to_json(self) -> dict[str, str]:
        """Plain data."""
        return {"entry": self.entry, "sentence": self.sentence, "sure": self.sure.value}
