import gc
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cell.computer.memory import freeze_loaded_objects, release_free_memory


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
    release_free_memory()
    assert len(kept) == 40
    assert held_mib() < before - 100.0


def test_what_is_loaded_is_not_looked_at_again() -> None:
    """Looking at it after every cycle took 0.2 s, in which pictures were lost."""
    before = gc.get_freeze_count()
    loaded = [[[]] for _ in range(10_000)]
    try:
        freeze_loaded_objects()
        assert gc.get_freeze_count() >= before + len(loaded)
        assert len(gc.get_objects()) < len(loaded)
    finally:
        gc.unfreeze()


COUNT_ARENAS = """
import threading
from pathlib import Path
from cell.computer.memory import use_one_arena

def arenas():  # the C library lays each at a multiple of 64 MiB
    starts = (l.split("-")[0] for l in Path("/proc/self/maps").read_text().splitlines())
    return sum(int(start, 16) % 2**26 == 0 for start in starts)

if {one}:
    use_one_arena()
before, enough = arenas(), threading.Barrier(9)
def work():
    kept = bytes(2000), [None] * 1000
    enough.wait()
    enough.wait()
for _ in range(8):
    threading.Thread(target=work).start()
enough.wait()
print(arenas() - before)
enough.wait()
"""


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="memory is counted otherwise")
def test_threads_get_no_heap_of_their_own() -> None:
    def added(one: bool) -> int:
        script = COUNT_ARENAS.format(one=one)
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
        return int(done.stdout)

    if not added(one=False):
        pytest.skip("another C library")
    assert added(one=True) == 0


COUNT_PAGES = """
import resource
from cell.computer.memory import reuse_freed_memory

if {reused}:
    reuse_freed_memory()
def frames():
    return [bytearray(2_000_000) for _ in range(4)]
frames()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(50):
    frames()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="pages are counted otherwise")
def test_arrays_take_the_pages_of_freed_ones() -> None:
    def pages(reused: bool) -> int:
        script = COUNT_PAGES.format(reused=reused)
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
        return int(done.stdout)

    if pages(reused=False) < 10_000:
        pytest.skip("another C library")
    assert pages(reused=True) < 4_000  # of 97,000
