"""Physical effects that may be added to a cable: one file per family, and a user's own."""

from cell.cable.effects.base import (
    ActiveEffect,
    Bend,
    CableData,
    Effect,
    EffectError,
    EffectFile,
    HandMotion,
    Parameter,
    Place,
)
from cell.cable.effects.library import effect_path, file_sha256, library, load_effect, unscreened

__all__ = [
    "ActiveEffect",
    "Bend",
    "CableData",
    "Effect",
    "EffectError",
    "EffectFile",
    "HandMotion",
    "Parameter",
    "Place",
    "effect_path",
    "file_sha256",
    "library",
    "load_effect",
    "unscreened",
]
