"""What tests of the cell share."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No file may have more than a thousand bytes; Python would keep bytecode that is cut off."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    former = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, former[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, former)


_COMPILED = """
import sys
from numba.core.dispatcher import Dispatcher

def compiled():
    modules = [m for name, m in sys.modules.items() if name.startswith("cell.")]
    found = [v for m in modules for v in vars(m).values() if isinstance(v, Dispatcher)]
    return {f"{f.py_func.__module__}.{f.__name__} {s}" for f in found for s in f.signatures}
"""


@pytest.fixture
def knowing_what_is_compiled() -> Callable[..., list[str]]:
    """Runs a script, to which `compiled()` names the cell's functions compiled so far; its lines.

    In a process of its own, in which no other test has compiled anything yet.
    """

    def run(script: str, *arguments: object) -> list[str]:
        command = [sys.executable, "-c", _COMPILED + script, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, check=True, text=True)
        return done.stdout.splitlines()

    return run
