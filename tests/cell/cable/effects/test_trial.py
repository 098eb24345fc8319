"""A user's own effect is tried in a process of its own, whatever that may take."""

from __future__ import annotations

import resource

import pytest

from cell.cable.effects.trial import MEMORY_BYTES, limit_memory

GIB = 1024**3


@pytest.mark.parametrize(
    ("hard", "soft"),
    [(resource.RLIM_INFINITY, MEMORY_BYTES), (8 * GIB, MEMORY_BYTES), (4 * GIB, 4 * GIB)],
)
def test_a_limit_that_there_is_already_is_not_raised(
    hard: int, soft: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who is not root may not: the process ended, and the effect was blamed for it."""
    set_to: list[tuple[int, int]] = []

    def set_limit(which: int, limits: tuple[int, int]) -> None:
        if hard != resource.RLIM_INFINITY and not limits[0] <= limits[1] <= hard:
            raise ValueError("not allowed to raise maximum limit")
        set_to.append(limits)

    monkeypatch.setattr(resource, "getrlimit", lambda which: (hard, hard))
    monkeypatch.setattr(resource, "setrlimit", set_limit)
    limit_memory()
    assert set_to == [(soft, hard)]
