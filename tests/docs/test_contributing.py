"""The diffs in `CONTRIBUTING.md`: they apply, and do what the page says."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_DIFF = re.compile(r"^```diff\n(.*?)^```", re.DOTALL | re.MULTILINE)
_CHECK = """
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from cell.wiring.build import real_devices
from cell.cable.effects import library
from cell.run.findings import Findings
from cell.run.plans import INSERTING
from cell.settings import Settings, load_settings

settings = load_settings(Path("config/line3.yaml")).model_dump()
settings["wiper"] = {"kind": "serial", "port": "/dev/ttyUSB9"}
devices = real_devices(Settings.model_validate(settings))
assert devices.wiper is not None
(step,) = (s for s in INSERTING.steps if s.name == "wipe_window")
assert step.every == 100
wiped = []
wiper = SimpleNamespace(wipe=lambda: wiped.append(1))
step.act(SimpleNamespace(devices=replace(devices, wiper=wiper)), Findings())
assert wiped == [1]
assert library()["wind"].parameters[0].unit == "m/s"
print("all of it works")
"""


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the code with every diff applied."""
    tree = tmp_path_factory.mktemp("tree")
    for part in ("cell", "calib", "drivers", "config"):
        shutil.copytree(ROOT / part, tree / part, ignore=shutil.ignore_patterns("__pycache__"))
    diffs = _DIFF.findall((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    assert len(diffs) == 3
    for diff in diffs:
        subprocess.run(["git", "apply", "-"], input=diff, text=True, cwd=tree, check=True)
    return tree


def test_a_step_a_device_and_an_effect_work_as_the_page_shows_them(changed: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _CHECK], cwd=changed, capture_output=True, text=True, check=False
    )
    assert done.stdout == "all of it works\n", done.stderr


def test_a_step_costs_a_function_and_a_line(changed: Path) -> None:
    before, after = ((tree / "cell/run/plans.py").read_text() for tree in (ROOT, changed))
    assert len(after.splitlines()) == len(before.splitlines())
