"""Compiler of the engine's functions; its code on disk is valid for the same sources only."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from cell.computer.compiling import OPTIONS, WIDEST, compiler, hash_of, inline, widest_vectors

__all__ = ["OPTIONS", "WIDEST", "compiled", "fingerprint", "inline", "widest_vectors"]


@lru_cache(maxsize=1)
def fingerprint() -> str:
    """Hash of this package's sources: compiled code of other sources is never used."""
    here = Path(__file__).parent
    return hash_of([*here.glob("*.py"), here / "effects/base.py", here / "effects/pointer.py"])


compiled = compiler(fingerprint)
