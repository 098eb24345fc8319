"""The tables of the tutorial are what their program makes, and have the verdict that it shows."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cable.effects import library
from cell.cli import app
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.diagnosis import diagnose
from cell.lab.search.fit_cache import FitCache, SearchSetup
from cell.study.folder import read_study

DATA = Path(__file__).parents[2] / "docs/start/data"
SHEET = "--free-length 0.1 --line-density 0.0074 --width 0.016 --thickness 0.0001"
RIVALS = ("draught", "natural_curvature", "tip_mass")


def numbers(text: str) -> np.ndarray:
    lines = text.replace(",", ".").splitlines()[1:]
    return np.array([line.split(";") for line in lines], float)


def test_the_program_makes_a_table_again() -> None:
    pytest.importorskip("mujoco")
    from tools.worlds import tracker_tables  # needs mujoco

    (text,) = tracker_tables.tables("cable_b", ["down"]).values()
    stored = (DATA / "cable_b" / "down.csv").read_text(encoding="utf-8")
    assert np.allclose(numbers(text), numbers(stored), rtol=0.0, atol=0.0015)


def test_the_second_cable_is_not_explained_by_the_library(tmp_path: Path) -> None:
    study = tmp_path / "b"
    tables = [str(DATA / "cable_b" / f"{m}.csv") for m in ("down", "left")]
    arguments = ["import", *tables, "-o", str(study), *SHEET.split()]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    mapping = study / "import.yaml"
    mapping.write_text(mapping.read_text().replace("constant_rad: 0.0097", "constant_rad: 0.0"))
    assert CliRunner().invoke(app, ["import", str(mapping)]).exit_code == 0
    prepared = PreparedStudy.of(read_study(study))
    space = ParameterSpace.of(prepared.study.cable)
    tried = {name: library()[name] for name in RIVALS}
    found = diagnose(FitCache.of(SearchSetup(prepared, space, tried))).diagnosis
    assert found.verdict == "unexplained"
