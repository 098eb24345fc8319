"""References of the settings: files of a calibration, the user's effects, the line."""

from __future__ import annotations

import hashlib
import platform
from contextlib import suppress
from pathlib import Path

from cell.settings.calibrated import calibration_file
from cell.settings.model import Settings


def files_of(settings: Settings) -> dict[str, str]:
    """Text of every file, by its path in the settings; unreadable files are omitted.

    Grip calibrations of other products are not included.
    """
    paths = [Path(e.effect) for e in settings.model.effects if e.effect.endswith(".py")]
    if settings.calibration is not None and settings.calibration.folder.is_dir():
        grip = calibration_file(settings, "grip")
        calibrations = sorted(settings.calibration.folder.glob("*.yaml"))
        paths += [p for p in calibrations if p == grip or p.name.partition(".")[0] != "grip"]
    texts = {}
    for path in paths:
        with suppress(OSError, UnicodeDecodeError):
            texts[str(path)] = path.read_text(encoding="utf-8")
    return texts


def calibration_hash(settings: Settings) -> str | None:
    """Hash of the calibration's files; None = as typed."""
    folder = None if settings.calibration is None else settings.calibration.folder
    texts = {p: t for p, t in files_of(settings).items() if Path(p).parent == folder}
    if not texts:
        return None
    return hashlib.sha256("\0".join(texts.values()).encode()).hexdigest()[:16]


def line_name(settings: Settings | None) -> str:
    """Name of a cell's line in the ledger; the computer's name if the settings give none."""
    named = None if settings is None or settings.ledger is None else settings.ledger.line
    return named or platform.node() or "line"
