"""Words that depend on a number."""

from __future__ import annotations


def counted(number: int, one: str, several: str | None = None) -> str:
    """`1 picture`, `2 pictures`: a number and what is counted.

    several  None = `one` with an s
    """
    return f"{number} {one if number == 1 else several or f'{one}s'}"
