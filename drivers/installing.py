"""Shell command that installs an extra (optional dependencies) of this project."""

from __future__ import annotations

import sys
from pathlib import Path


def install_extra(name: str) -> str:
    """The shell command that installs an extra of `pyproject.toml`, for a clone or a wheel."""
    root = Path(__file__).resolve().parents[1]
    pip = Path(sys.prefix, "Scripts" if sys.platform == "win32" else "bin", "pip")
    if (root / "pyproject.toml").exists():
        return f"{pip} install -e '{root}[{name}]'"
    return f"{pip} install 'cable-cell[{name}]'"
