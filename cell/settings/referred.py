"""Files that settings refer to: those of a calibration, and effects of one's own."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from cell.settings.model import Settings


def files_of(settings: Settings) -> dict[str, str]:
    """Text of every file, by its path as the settings name it; what cannot be read is left out."""
    paths = [Path(e.effect) for e in settings.model.effects if e.effect.endswith(".py")]
    if settings.calibration is not None and settings.calibration.folder.is_dir():
        paths += sorted(settings.calibration.folder.glob("*.yaml"))
    texts = {}
    for path in paths:
        with suppress(OSError, UnicodeDecodeError):
            texts[str(path)] = path.read_text(encoding="utf-8")
    return texts
