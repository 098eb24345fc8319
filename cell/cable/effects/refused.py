"""The error with which an effect is refused: what is wrong, in which file and line."""

from __future__ import annotations

from pathlib import Path


class EffectError(ValueError):
    """An effect cannot be used.  Scenario: a hook returns one number where two are needed."""

    def __init__(self, path: str | Path, line: int, cause: str) -> None:
        super().__init__(f"{path}:{line}: {cause}")
        self.path = Path(path)
        self.line = line
        self.cause = cause
