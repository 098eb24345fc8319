"""The tables of the tutorial are what their program makes, and have the verdict that it shows."""

from pathlib import Path

import numpy as np
import pytest

from cell.cable.effects import load_effect
from cell.lab.diagnosis import diagnose
from cell.study.data import Study
from cell.study.folder import read_study
from tests.cell.lab.conftest import fits_of
from tests.command import run_cell

DATA = Path(__file__).parents[2] / "cell/examples"
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


@pytest.fixture(scope="module")
def second(tmp_path_factory: pytest.TempPathFactory) -> Study:
    study = tmp_path_factory.mktemp("own") / "b"
    tables = [str(DATA / "cable_b" / f"{m}.csv") for m in ("down", "left")]
    arguments = ["import", *tables, "-o", str(study), *SHEET.split()]
    run_cell(*arguments)
    mapping = study / "import.yaml"
    mapping.write_text(mapping.read_text().replace("constant_rad: 0.0097", "constant_rad: 0.0"))
    run_cell("import", mapping)
    return read_study(study)


def test_the_second_cable_is_not_explained_by_the_library(second: Study) -> None:
    assert diagnose(fits_of(second, RIVALS)).diagnosis.verdict == "unexplained"


def test_the_law_on_the_page_explains_the_second_cable(second: Study, tmp_path: Path) -> None:
    page = (DATA.parents[1] / "docs/start/own_measurements.md").read_text(encoding="utf-8")
    file = tmp_path / "magnet.py"
    file.write_text(page.partition("```python\n")[2].partition("```")[0])
    found = diagnose(fits_of(second, (load_effect(str(file)), "tip_mass"))).diagnosis
    assert found.verdict == "missing"
    (magnet,) = found.missing
    assert magnet.effect == "magnet"
    assert magnet.errors.heldout_rms_m == pytest.approx(5e-5, rel=0.05)
