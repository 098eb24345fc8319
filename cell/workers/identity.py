"""Versions that workers and this process must share, so that results are the same."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_SOURCES = ("calib", "cell", "drivers")
_PACKAGES = ("numpy", "scipy", "numba", "llvmlite")


@dataclass(frozen=True)
class WorkerIdentity:
    """Versions of a process.

    version    of this program
    code       first digits of the hash of all its sources
    python     major and minor version
    packages   name and version of numerical packages
    blas       threads of linear algebra: their number changes the last bits of sums
    processor  its type changes the last bits of linear algebra
    """

    version: str
    code: str
    python: str
    packages: tuple[tuple[str, str], ...]
    blas: str
    processor: str

    def differences(self, other: WorkerIdentity) -> list[str]:
        """Forbidden differences of another process, as `name theirs, here ours`."""
        names = ("version", "code", "python")
        each = [(name, getattr(self, name), getattr(other, name)) for name in names]
        for (name, ours), (_, theirs) in zip(self.packages, other.packages, strict=True):
            each.append((name, ours, theirs))
        return [f"{name} {theirs}, here {ours}" for name, ours, theirs in each if ours != theirs]


@cache
def identity() -> WorkerIdentity:
    """Identity of this process; computed once, from its code at that time."""
    from llvmlite.binding import get_host_cpu_name

    return WorkerIdentity(
        importlib.metadata.version("cable-cell"),
        code_hash(),
        ".".join(platform.python_version_tuple()[:2]),
        tuple((name, importlib.metadata.version(name)) for name in _PACKAGES),
        os.environ.get("OPENBLAS_NUM_THREADS", "not set"),
        str(get_host_cpu_name()),
    )


@cache
def code_hash() -> str:
    """First digits of SHA-256 over the sources of `cell`, `calib` and `drivers`."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[2]
    for package in _SOURCES:
        for file in sorted((root / package).rglob("*.py")):
            digest.update(f"{file.relative_to(root).as_posix()}\0".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
