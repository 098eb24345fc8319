"""The lab's whole loop in a cell: measure, cannot tell, suggest, measure that, gather, know."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cable.effects import library
from cell.cli import app
from cell.identify.parameters import ParameterSpace
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.gather import gather
from cell.lab.prepared import PreparedStudy
from cell.lab.suggest import suggest_motion, write_motion
from cell.lab.surroundings import Surroundings
from cell.study.folder import read_study

FIRST = """\
format: cell-motion/1
start: {x_m: 0.0, y_m: 0.0, angle_rad: 0.0}
still_s: 0.2
moves:
- {x_m: 0.0, y_m: -0.05, angle_rad: 0.0, duration_s: 0.3}
hold_s: 0.7
"""


@pytest.fixture
def loaded(quick_config: Path, tmp_path: Path) -> Path:
    """A cell whose cables carry more inertia than the model knows, and may be tilted."""
    text = quick_config.read_text()
    hidden = text.replace("effects: {} ", "effects: {added_mass: {kg_per_m: 8.0e-4}} ")
    assert hidden != text
    path = tmp_path / "cell.yaml"
    path.write_text(hidden.replace("angle_rad: [-0.6, 1.1]", "angle_rad: [-0.6, 0.1]"))
    return path


def measure(config: Path, motion: Path, runs: Path) -> Path:
    before = set(runs.glob("*")) if runs.exists() else set()
    given = ["run", "-c", config, "--motion", motion, "--seed", "3", "--out", runs]
    done = CliRunner().invoke(app, [str(g) for g in given])
    assert done.exit_code == 0, done.output
    (run,) = set(runs.glob("*")) - before
    return run


def explorer(study):
    rivals = {n: library()[n] for n in ("added_mass", "natural_curvature", "tip_mass")}
    return Explorer(PreparedStudy.of(study), ParameterSpace.of(study.cable), rivals)


def test_a_suggested_motion_is_run_and_decides(loaded: Path, tmp_path: Path) -> None:
    first, second, runs = tmp_path / "first.yaml", tmp_path / "second.yaml", tmp_path / "runs"
    first.write_text(FIRST)
    run = measure(loaded, first, runs)
    alone = explorer(read_study(run / "study"))
    examination = diagnose(alone)
    assert examination.diagnosis.verdict == "cannot_tell"

    suggestion = suggest_motion(alone, examination, Surroundings.read(loaded))
    write_motion(suggestion, second)
    again = measure(loaded, second, runs)
    seen = read_study(again / "study").trials[0].markers.xy_m
    assert np.isfinite(seen).all()  # all of the cable was in every picture

    found = diagnose(explorer(gather([run, again], "both"))).diagnosis
    assert found.verdict == "missing"
    assert [f.effect for f in found.missing] == ["added_mass"]
    value = found.missing[0].parameters["kg_per_m"]
    assert value.value == pytest.approx(8e-4, rel=0.06)
