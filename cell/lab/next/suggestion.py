"""Motions that are suggested, as data and as a file for `cell run --motion`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.files.atomic import write_atomic
from cell.files.yaml_document import yaml_text
from cell.lab.next.strokes import FORMAT, HOLD_S, STILL_S, Stroke
from cell.settings.surroundings import Surroundings


@dataclass(frozen=True)
class Option:
    """A motion within all limits, and how well it distinguishes the candidates.

    separation  χ² that it puts between the likeliest candidate and the one hardest to tell from it
    hardest     that one
    power       probability that the motion decides against every other candidate, if the noise and
                the candidates are as they are taken to be
    """

    motion: Stroke
    separation: float
    hardest: str
    power: float


@dataclass(frozen=True)
class Suggestion:
    """Motions, the most informative first, and the candidates that they distinguish.

    refused  how many motions were left out, and for which limit
    """

    candidates: tuple[str, ...]
    options: tuple[Option, ...]
    surroundings: Surroundings
    refused: Mapping[str, int]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "format": "cable-suggestion/1",
            "candidates": list(self.candidates),
            "options": [
                {
                    **vars(o.motion),
                    "separation": o.separation,
                    "hardest": o.hardest,
                    "power": o.power,
                }
                for o in self.options
            ],
            "refused": dict(self.refused),
        }


def write_motion(suggestion: Suggestion, path: Path) -> None:
    """Write the best motion as YAML for `cell run --motion`: places from the cell's home."""
    best = suggestion.options[0].motion
    home_x, home_y, _ = suggestion.surroundings.home
    x_m, y_m = best.x_m - home_x, best.y_m - home_y
    first, *others = suggestion.candidates
    content = {
        "format": FORMAT,
        "purpose": f"tell {first} from {', '.join(others)}",
        "start": {"x_m": round(x_m, 6), "y_m": round(y_m, 6), "angle_rad": best.angle_rad},
        "still_s": STILL_S,
        "moves": [
            {
                "x_m": round(x_m + best.dx_m, 6),
                "y_m": round(y_m + best.dy_m, 6),
                "angle_rad": best.angle_rad,
                "duration_s": best.duration_s,
            }
        ],
        "hold_s": HOLD_S,
    }
    write_atomic(path, yaml_text(content))
