"""How far MuJoCo's tip is from the engine's for exported models, and what comes back of them.

    python -m tools.studies.export_study docs/measured/export.csv [FOLDER]

FOLDER holds the practice studies; by default `../shared/data/practice` beside the project.  Each is
fitted with the effects that are hidden in it.  Three more models are those of simulated cycles.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.api.fitted_study import fit_study
from cell.exchange.export import export_to_mujoco
from cell.exchange.from_mujoco import model_from_mujoco
from cell.exchange.peer import Difference, Trial, trials_of
from cell.identify.identified import Identified
from cell.lab.data.named_effects import select_effects
from cell.lab.data.opened_study import open_study
from cell.lab.search.setup import fit_cache_of
from cell.settings import load_settings
from tools.studies.cable_rows import CONFIG, written
from tools.studies.practice_table import DEFAULT
from tools.worlds.fast_cell import fast_cycle

PRACTICE = (
    *("none_a", "none_b", "air_drag", "stress_relaxation"),
    *("natural_curvature", "tip_mass", "bending_hysteresis"),
)
CYCLES = 3


@dataclass(frozen=True)
class Exported:
    """One model.

    stroke_mm    difference of the tips in the 50 mm stroke, root mean square
    most_mm      the largest there
    motions, own_mm   the study's own motions, and the root mean square of the worst of them
    left_out_mm  how far the tip is moved by the effects that are left out, in the worst motion
    rigidity_back_percent, exponent_back, viscosity_back_percent   largest change on the way back
    """

    model: str
    exponent: str
    effects: str
    left_out: str
    links: int
    step_ms: str
    stroke_mm: str
    most_mm: str
    motions: int
    own_mm: str
    left_out_mm: str
    rigidity_back_percent: str
    exponent_back: str
    viscosity_back_percent: str
    cpu_s: str


def models(folder: Path) -> Iterator[tuple[str, Identified, Sequence[Trial]]]:
    """Name, model and own motions: of practice studies, then of simulated cycles."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    for name in PRACTICE:
        study = open_study(folder / name)
        effects = [e for e in truth[name]["effects"] if e != "none"]
        model, _, _ = fit_study(fit_cache_of(study, select_effects(effects)))
        yield name, model, trials_of(study)[0]
    for number in range(1, CYCLES + 1):
        found = fast_cycle(load_settings(CONFIG), 7, number, only_chosen=True).identified
        if found is not None:
            yield f"cycle_{number}", found, ()


def exported(name: str, model: Identified, trials: Sequence[Trial]) -> Exported:
    """The row of a model."""
    begin_s = time.process_time()
    done = export_to_mujoco(model.model, f"{name}.json", trials=trials)
    cpu_s = time.process_time() - begin_s
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "cable.xml"
        path.write_text(done.xml, encoding="utf-8")
        back = model_from_mujoco(path).model.values
    k = model.space.knots
    changed = back[: k + 2] / model.values[: k + 2] - 1.0
    stroke, *own = done.differences
    return Exported(
        name,
        f"{model.values[k]:.3f}",
        " ".join(done.effects) or "–",
        " ".join(one.name for one in done.left_out) or "–",
        done.chain.links,
        f"{done.step_s * 1e3:g}",
        f"{stroke.rms_m * 1e3:.3f}",
        f"{stroke.most_m * 1e3:.3f}",
        len(own),
        _worst_mm(own),
        _worst_mm(done.missing),
        f"{100.0 * np.abs(changed[:k]).max():.4f}",
        f"{abs(back[k] - model.values[k]):.6f}",
        f"{100.0 * abs(changed[k + 1]):.4f}",
        f"{cpu_s:.1f}",
    )


def _worst_mm(differences: Sequence[Difference]) -> str:
    return f"{max(d.rms_m for d in differences) * 1e3:.3f}" if differences else "–"


def main() -> None:
    """Write the rows as they are known."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, help="CSV file to write")
    parser.add_argument("folder", nargs="?", type=Path, default=DEFAULT)
    given = parser.parse_args()
    with written(given.file, Exported) as write:
        for name, model, trials in models(given.folder):
            row = exported(name, model, trials)
            print(f"{name}: {row.stroke_mm} mm, own motions {row.own_mm} mm", flush=True)
            write([row])


if __name__ == "__main__":
    main()
