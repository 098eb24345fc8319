"""The receiver of progress messages of a computation."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Receives what is being done: `done` of `total` pieces are finished; 0 of 0 = not counted.

    Any thread may tell it.
    """

    def __call__(self, text: str, done: int = 0, total: int = 0) -> None:
        """Must return at once."""


def no_progress(text: str, done: int = 0, total: int = 0) -> None:
    """A `Progress` that shows nothing."""
