"""One core where many computations go side by side, whichever thread asks."""

from __future__ import annotations

import threading

from cell.cable.solver import one_core, threads


def test_within_one_core_there_is_one_and_afterwards_as_many_as_before() -> None:
    before = threads()
    with one_core():
        assert threads() == 1
        with one_core():
            assert threads() == 1
        assert threads() == 1
    assert threads() == before


def test_other_threads_keep_theirs() -> None:
    found: list[int] = []
    with one_core():
        other = threading.Thread(target=lambda: found.append(threads()))
        other.start()
        other.join()
    assert found == [threads()]
