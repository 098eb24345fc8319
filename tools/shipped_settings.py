"""The shipped settings, and their text with other entries."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cell.files.yaml_edit import edited

ROOT = Path(__file__).parents[1]
#: Settings of the simulated cell, and of the emulated one.
FAKE, EMULATED = ROOT / "config" / "fake.yaml", ROOT / "config" / "emulated.yaml"


def with_entries(settings: Path, changes: Mapping[str, Any]) -> str:
    """Text of a settings file with other values of entries: {"arm.host": …}; `UNSET` removes."""
    by_key = {tuple(name.split(".")): value for name, value in changes.items()}
    return edited(settings, settings.read_text(encoding="utf-8"), by_key)
