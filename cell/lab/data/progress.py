"""Who is told how far a computation is."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Is told what is being done: `done` of `total` pieces lie behind; 0 of 0 = not counted.

    Any thread may tell it.
    """

    def __call__(self, text: str, done: int = 0, total: int = 0) -> None:
        """Must return at once."""


def no_progress(text: str, done: int = 0, total: int = 0) -> None:
    """A `Progress` that shows nothing."""
