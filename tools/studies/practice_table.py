"""Diagnoses every practice study and prints what was found beside what is hidden in it.

    python -m tools.studies.practice_table [FOLDER] [STUDY …] [--discover]

FOLDER holds studies and `truth.json`; by default `../shared/data/practice` beside the project.
Ends with 1 if a verdict is wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cell.lab.data.named_effects import select_effects
from cell.lab.data.opened_study import open_study
from cell.lab.data.results import Diagnosis
from cell.lab.next.discover import NothingFoundError, discover
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.diagnose import diagnose

DEFAULT = Path(__file__).resolve().parents[3] / "shared" / "data" / "practice"
#: What truth calls a parameter otherwise than our effects: name and conversion.
SAME = {("grip_compliance", "n_m_per_rad"): ("rad_per_n_m", lambda v: 1.0 / v)}


@dataclass(frozen=True)
class Row:
    study: str
    hidden: dict[str, dict[str, float]]
    found: Diagnosis
    seconds: float
    removed: float | None

    @property
    def right(self) -> bool:
        """Every hidden effect named or tied, nothing else; `unexplained` for what has no name."""
        named = [{f.effect, *f.tied_with} for f in self.found.missing]
        unknown = any(name.startswith("x_") for name in self.hidden)
        if unknown:
            return self.found.verdict == "unexplained" and (self.removed or 1.0) >= 0.8
        effects = {name for name in self.hidden if name != "none"}
        if not effects:
            return self.found.verdict == "complete"
        return (
            self.found.verdict == "missing"
            and len(named) == len(effects)
            and all(any(e in names and len(names) <= 3 for names in named) for e in effects)
        )

    def parameters(self) -> list[tuple[str, float, float, float, float]]:
        """Name, value, low, high, truth of every hidden parameter that was found."""
        rows = []
        for effect in self.found.missing:
            for name, true in self.hidden.get(effect.effect, {}).items():
                ours, convert = SAME.get((effect.effect, name), (name, float))
                if ours in effect.parameters:
                    p = effect.parameters[ours]
                    rows.append((ours, p.value, p.low, p.high, convert(true)))
        return rows


def examine(folder: Path, truth: dict[str, Any], with_discovery: bool) -> Row:
    began = time.monotonic()
    fits = fit_cache_of(open_study(folder), select_effects([]))
    found = diagnose(fits).diagnosis
    seconds = time.monotonic() - began
    removed = None
    if with_discovery and found.verdict == "unexplained":
        nothing = contextlib.suppress(NothingFoundError)
        with nothing, tempfile.TemporaryDirectory() as scratch:
            removed = discover(fits, Path(scratch) / "discovered.py").removed_share
    return Row(folder.name, truth["effects"], found, seconds, removed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=DEFAULT)
    parser.add_argument("studies", nargs="*")
    parser.add_argument("--discover", action="store_true")
    given = parser.parse_args()
    truth = json.loads((given.folder / "truth.json").read_text(encoding="utf-8"))
    rows = []
    for name in given.studies or truth:
        rows.append(examine(given.folder / name, truth[name], given.discover))
        print(f"{name}: {rows[-1].found.verdict}, {rows[-1].seconds:.1f} s", file=sys.stderr)
    Console(width=150).print(table(rows))
    intervals = [p for row in rows for p in row.parameters()]
    covered = sum(low <= true <= high for _, _, low, high, true in intervals)
    right = sum(row.right for row in rows)
    print(f"right: {right} of {len(rows)}; intervals that contain the truth: {covered} of "
          f"{len(intervals)}")  # fmt: skip
    return 0 if right == len(rows) else 1


def table(rows: list[Row]) -> Table:
    shown = Table(title="held-out error over noise")
    for column in ("study", "hidden", "verdict", "found", "before", "after", "true → found", "s"):
        shown.add_column(column)
    for row in rows:
        noise = row.found.noise_m
        after = row.found.missing[-1].errors if row.found.missing else row.found.baseline
        removed = "" if row.removed is None else f"; discovered law removes {row.removed:.0%}"
        shown.add_row(
            row.study,
            ", ".join(row.hidden),
            ("" if row.right else "[red]") + row.found.verdict,
            ", ".join(" or ".join((f.effect, *f.tied_with)) for f in row.found.missing) + removed,
            f"{row.found.baseline.heldout_rms_m / noise:.3f}",
            f"{after.heldout_rms_m / noise:.3f}",
            "\n".join(
                f"{n} {true:.4g} → {v:.4g} ({low:.4g} … {high:.4g})"
                for n, v, low, high, true in row.parameters()
            ),
            f"{row.seconds:.0f}",
        )
    return shown


if __name__ == "__main__":
    sys.exit(main())
