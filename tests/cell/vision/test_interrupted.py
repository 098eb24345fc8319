"""A signal may fall into any moment of a look at a picture, and must not end the process by it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

#: Looks at pictures while a timer interrupts, as Ctrl-C does, 300 times at any moment.
INTERRUPTED = """
import random, signal, sys
from pathlib import Path
import numpy as np
from cell.wiring.build import cell_task
from cell.settings import load_settings
from cell.vision.detect import detect
from cell.vision.marks import find_jaw

task = cell_task(load_settings(Path(sys.argv[1])))
image = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)
def look():
    return {
        "detect": lambda: detect(image, 0.0, task.view, task.vision),
        "find_jaw": lambda: find_jaw(image, task.view, task.vision.marks),
    }[sys.argv[2]]()
def interrupt(number, frame):
    raise KeyboardInterrupt
look()
signal.signal(signal.SIGALRM, interrupt)
random.seed(0)
count = 0
while count < 300:
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-4, 5e-3))
        while True:
            look()
    except KeyboardInterrupt:
        count += 1
"""


@pytest.mark.parametrize("look", ["detect", "find_jaw"])
def test_an_interruption_while_a_picture_is_looked_at_is_only_that(look: str) -> None:
    """Numba runs Python to hand out a named tuple, and crashed if a signal was raised there."""
    config = Path(__file__).parents[3] / "config" / "fake.yaml"
    command = [sys.executable, "-c", INTERRUPTED, str(config), look]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
