import os
from pathlib import Path

import numpy as np
import pytest

from cell.memory import give_back


def held_mib() -> float:
    pages = int(Path(f"/proc/{os.getpid()}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is counted otherwise")
def test_freed_arrays_are_given_back_although_others_lie_between_them() -> None:
    """Each too small for pages of its own, so that only the C library can return them."""
    arrays = [np.ones(10_000) for _ in range(2000)]
    kept = arrays[::50]
    before = held_mib()
    del arrays
    give_back()
    assert len(kept) == 40
    assert held_mib() < before - 100.0
