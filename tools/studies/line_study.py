"""How the line does in worlds whose physics the model lacks: inserted, and as surely as promised?

`python -m tools.studies.line_study [--sizes 1] [--cables 6] [--seed 100]
[--effects air_drag …] [--json F]`
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from cell.cable.effects import library
from cell.settings import load_settings
from cell.wiring.build import cell_task
from tools.worlds.fast_cell import fast_cycle, typical, with_world

#: A cable counts as one that a perfect model could insert if its best offset passes by this, m:
#: three times what arm and camera repeat to.
INSERTABLE_M = 3e-4
CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"


def rows(effects: list[str], sizes: list[float], cables: int, seed: int) -> list[dict[str, object]]:
    settings = load_settings(CONFIG)
    task = cell_task(settings)
    known = library()
    found: list[dict[str, object]] = []
    for name in effects:
        for size in sizes if name != "none" else [0.0]:
            hidden = {} if name == "none" else {name: typical(known[name], size)}
            world = with_world(settings, hidden)
            for number in range(1, cables + 1):
                begun_s = time.process_time()
                c = fast_cycle(world, seed, number, task=task)
                i = c.identified
                found.append(
                    {
                        "effect": name,
                        "size": size,
                        "number": number,
                        "outcome": c.outcome,
                        "reason": c.reason,
                        "insertable": c.best_margin_m > INSERTABLE_M,
                        "probability": c.choice.best.probability if c.choice else None,
                        "margin_std_m": c.choice.best.margin_std_m if c.choice else None,
                        "predicted_margin_m": c.choice.best.margin_m if c.choice else None,
                        "true_margin_m": c.true_margin_m,
                        "error_m": c.true_tip_error_m,
                        "residual_m": i.residual_rms_m if i else None,
                        "noise_m": i.noise.std_m if i else None,
                        "inflation": i.inflation if i else None,
                        "passes": i.passes if i else None,
                        "cpu_s": time.process_time() - begun_s,
                    }
                )
            print(summary(f"{name} × {size:g}", found[-cables:]), flush=True)
    return found


def summary(title: str, found: list[dict[str, object]]) -> str:
    could = [r for r in found if r["insertable"]]
    done = [r for r in could if r["outcome"] == "inserted"]
    missed = [r for r in found if r["outcome"] == "missed"]
    errors = np.array([r["error_m"] for r in found], dtype=float) * 1e3
    sure = [r for r in found if r["probability"] is not None and r["probability"] >= 0.9]
    passed = [r for r in sure if r["true_margin_m"] > 0]
    residual = [r["residual_m"] / r["noise_m"] for r in found if r["noise_m"]]
    std = np.array([r["margin_std_m"] or np.nan for r in found], dtype=float) * 1e3
    return (
        f"{title:28s} insertable {len(could):3d} inserted {len(done):3d} missed {len(missed):2d}  "
        f"promised {len(sure):3d} pass {len(passed):3d}  error median "
        f"{np.nanmedian(errors):.2f} max {np.nanmax(errors):.2f} mm  std {np.nanmedian(std):.2f} mm"
        f"  residual/noise {np.median(residual) if residual else np.nan:.1f}"
        f"  cpu {np.mean([r['cpu_s'] for r in found]):.2f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--effects", nargs="*", default=["none", *library()])
    parser.add_argument("--sizes", nargs="*", type=float, default=[1.0])
    parser.add_argument("--cables", type=int, default=6)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = rows(options.effects, options.sizes, options.cables, options.seed)
    print(summary("all", found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
