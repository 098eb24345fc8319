"""The lab's page in a real browser: upload, diagnosis, an effect of one's own, promotion, undo."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.geometry import node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.files.yaml_document import yaml_text
from cell.settings import load_settings
from cell.settings.promotion import line_identity
from cell.settings.translate import model_hash
from cell.study.data import Study, Trial
from cell.study.folder import write_study
from cell.web.audit import audit_file
from cell.web.workspace import Workspace
from tests.command import run_cell
from tests.waiting import free_port, listens, wait_until
from tools.worlds.made_studies import CABLE, filmed, moved

from . import test_web
from .conftest import CONFIG, WINDY, changed
from .test_web import Started

browser = test_web.browser
started = test_web.started

FEW = Path(__file__).with_name("few_effects")
_HIDDEN = 1.5e-3
#: Of `WINDY`.
WIND = {"draught.wind_x_m_per_s": 1.6, "draught.wind_y_m_per_s": 1.6}
#: The law of the effect that is hidden, as a person types it under another name.
_LAW = '''"""Air that the cable takes along."""

from cell.cable.effects import Effect, Parameter


class Carried(Effect):
    """Inertia of the air that moves with the cable."""

    name = "carried"
    parameters = (Parameter("kg_per_m", "kg/m", 0.0, 1e-2, default=0.0, starts=(5e-4,)),)

    def inertia(cable, p):
        return p.kg_per_m, p.kg_per_m
'''


def hidden_mass() -> Study:
    """Two strokes of a cable that carries more air than its model knows, with noise."""
    rng, arcs, trials = np.random.default_rng(0), node_arc_lengths(0.1), []
    effect = library()["added_mass"].active(kg_per_m=_HIDDEN)
    model = CableModel(CABLE, np.full(4, 2.3e-5), 1.05, 1e-7, effects=(effect,))
    for name, role, way_m in (("down", "fit", (0.0, -0.05)), ("left", "validate", (-0.05, 0.0))):
        hand = moved(np.arange(0.0, 0.75, 0.002), way_m, 0.25)
        seen = filmed(rng, model, hand, np.arange(0.002, hand.t_s[-1], 0.01), arcs, solver=Solver())
        trials.append(Trial(name, role, "equilibrium", hand, seen))
    return Study("hidden", CABLE, arcs, tuple(trials))


def write_candidate(path: Path, config: Path, *, passed: bool) -> None:
    settings = load_settings(config)
    drag = {"effect": "air_drag", "parameters": {"drag_coefficient": {"fixed": 1.9}}}
    content = {
        "format": "cell-candidate/1",
        "beside": model_hash(settings.model),
        "model": {"effects": [drag]},
        "gates": [{"gate": "identifiable", "passed": passed, "found": "so"}],
        "lines": [line_identity(settings)],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml_text(content), encoding="utf-8")


class LabPage:
    """The lab's page, as a person uses it."""

    def __init__(self, browser: Any) -> None:
        self._browser = browser

    def text(self, what: str) -> str:
        found = self._browser.find_elements("css selector", f"[data-test={what}]")
        try:
            return str(found[0].text) if found else ""
        except Exception as error:  # the page has just replaced it
            if type(error).__name__ != "StaleElementReferenceException":
                raise
            return ""

    def click(self, what: str) -> None:
        button = wait_until(lambda: self._shown(what))
        self._browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        wait_until(lambda: self._clicked(button))

    def upload(self, path: Path) -> None:
        kind = "folder" if path.is_dir() else "files"
        field = f"[data-test=drop][data-ready] [data-test=upload-{kind}]"
        wait_until(lambda: self._browser.find_elements("css selector", field))[0].send_keys(
            str(path)
        )

    def type_over_effect(self, text: str) -> None:
        from selenium.webdriver.common.keys import Keys

        content = wait_until(self._editor)  # which comes after its frame
        content.click()
        content.send_keys(Keys.CONTROL, "a")
        self._browser.execute_cdp_cmd("Input.insertText", {"text": text})

    def shows(self, what: str, text: str, within_s: float = 90.0) -> None:
        try:
            wait_until(lambda: text in self.text(what), within_s)
        except AssertionError:
            pytest.fail(f"{what}: {text!r} is not in {self.text(what)!r}")

    def ended(self, job: str, within_s: float = 300.0) -> None:
        self.shows("jobs", f"{job} · done", within_s)

    def _editor(self) -> Any:
        found = self._browser.find_elements("css selector", "[data-test=editor] .cm-content")
        return found[0] if found else None

    def _shown(self, what: str) -> Any:
        found = self._browser.find_elements("css selector", f"[data-test={what}]")
        return found[0] if found and found[0].is_displayed() and found[0].is_enabled() else None

    def _clicked(self, button: Any) -> bool:
        from selenium.common.exceptions import ElementClickInterceptedException

        try:
            button.click()
        except ElementClickInterceptedException:  # a message lies over it for some seconds
            return False
        return True


@pytest.fixture(autouse=True)
def no_giving_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs of the page give way to others: beside other tests they would wait for minutes."""
    nice = tmp_path / "bin" / "nice"
    nice.parent.mkdir()
    nice.write_text('#!/bin/sh\nshift 2\nexec "$@"\n', encoding="utf-8")
    nice.chmod(0o755)
    monkeypatch.setenv("PATH", str(nice.parent), prepend=os.pathsep)


@pytest.fixture
def few_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that are started try few effects; see there."""
    monkeypatch.setenv("PYTHONPATH", str(FEW), prepend=os.pathsep)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return Path(shutil.copy(CONFIG, tmp_path / "cell.yaml"))


@pytest.fixture(autouse=True)
def usual_priority(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no `nice` is found jobs have the usual priority: they starve with the low one."""
    monkeypatch.setenv("PATH", str(tmp_path))


def opened(browser: Any, started: Started, config: Path, runs: Path) -> LabPage:
    port = free_port()
    started("serve", "-c", config, "--runs", runs, "--port", port)
    wait_until(lambda: listens(port))
    browser.get(f"http://127.0.0.1:{port}/lab")
    return LabPage(browser)


def test_a_hidden_effect_is_found_typed_fitted_promoted_and_undone(
    few_effects: None, browser: Any, started: Started, config: Path, tmp_path: Path
) -> None:
    page = opened(browser, started, config, tmp_path / "runs")
    lab = Workspace.of_runs(tmp_path / "runs")
    page.click("way-example")
    page.ended("Example · example")
    page.shows("look-said", "Nothing is odd")
    write_study(hidden_mass(), tmp_path / "hidden")
    page.upload(Path(shutil.make_archive(str(tmp_path / "hidden"), "zip", tmp_path / "hidden")))
    page.ended("Look · hidden")

    page.click("tab-diagnose")
    page.click("diagnose")
    page.ended("Diagnose · hidden")
    page.shows("fit-errors", "Least so far")
    page.shows("verdict", "Missing")
    page.shows("parameters", "added_mass: kg_per_m 1.")
    diagnosis = json.loads((lab.results("hidden") / "diagnosis.json").read_text())
    found = diagnosis["missing"][0]["parameters"]["kg_per_m"]["value"]
    assert found == pytest.approx(_HIDDEN, rel=0.05)
    page.shows("checks", "Are the held-out trials sensitive to each named effect?")
    page.shows("checks", "error / noise ≤ 1.1")

    page.click("tab-own")
    page.type_over_effect(_LAW.replace("p.kg_per_m, p", "open('x'), p"))
    page.shows("checked", "carried.py:13: `open` is not allowed here")
    page.type_over_effect(_LAW)
    page.shows("checked", "Inertia of the air")
    page.click("fit-own")
    page.ended("Fit the effect · hidden")
    page.shows("shown-own", "falls from")
    page.shows("fitted-own", "carried: kg_per_m 1.")
    before, after = json.loads((lab.results("hidden") / "own.json").read_text())["models"]
    assert after["heldout_rms_m"] < 0.5 * before["heldout_rms_m"]

    damaged = tmp_path / "damaged"
    shutil.copytree(tmp_path / "hidden", damaged)
    rows = (damaged / "down" / "markers.csv").read_text().splitlines()
    (damaged / "down" / "markers.csv").write_text("\n".join([*rows[:4], "0.1,x,1", *rows[5:]]))
    page.click("tab-study")
    page.upload(damaged)
    page.ended("Look · damaged")
    page.shows("look-said", "down/markers.csv:5: has 3 cells")

    for name, passed in (("good", True), ("doubtful", False)):
        write_candidate(lab.candidates / f"{name}.yaml", config, passed=passed)
    text = config.read_text()
    page.click("tab-line")
    page.click("reload")
    page.shows("gates", "✗ so")
    page.click("promote-doubtful")
    page.click("promote-yes")
    page.shows("refused", "gate 'identifiable': not passed")
    assert config.read_text() == text
    page.click("promote-good")
    page.click("promote-yes")
    page.shows("line-model", "air_drag")
    assert load_settings(config).model.effects[0].effect == "air_drag"
    page.click("undo")
    page.click("undo-yes")
    page.shows("line-model", "0 former models")
    assert config.read_text() == text
    lines = audit_file(tmp_path / "runs").read_text("utf-8").splitlines()
    promotions = [(d["action"], d["done"]) for d in map(json.loads, lines)][-3:]
    assert promotions == [("lab promote", False), ("lab promote", True), ("lab promote", True)]
    assert started.end() == [0]  # not by the signal: what it has open, as jobs, is closed


def test_what_recorded_cycles_lack_is_learned_promoted_and_undone(
    few_effects: None, browser: Any, started: Started, quick_config: Path, tmp_path: Path
) -> None:
    config, runs = changed(quick_config, tmp_path / "windy.yaml", WINDY), tmp_path / "runs"
    words = ["run", "-c", str(config), "--cycles", "3", "--runs", str(runs)]
    run_cell(*words, code=1)
    page = opened(browser, started, config, runs)
    lab = Workspace.of_runs(runs)

    page.click("cycles-open")
    page.shows("cycles", "missed")
    boxes = browser.find_elements("css selector", "[data-test=cycles] tbody .q-checkbox")
    for box in boxes:
        box.click()
    page.click("gather")
    page.shows("jobs", "another individual, or gripped elsewhere; merge only cycles of one cable")
    for box in boxes[1:]:  # the newest stays
        box.click()
    page.click("use-cycle")
    newest = max(r.parent.name for r in runs.glob("*/result.json"))
    wait_until(lambda: browser.current_url.endswith(f"?study={newest}"))

    page.click("tab-compare")
    page.click("fit")
    page.ended(f"Fit · {newest}")
    page.click("compare")
    page.ended(f"Compare · {newest}")
    page.shows("shown-compare", "on motions not fitted to")

    page.click("tab-line")
    page.click("learn")
    page.shows("gates", "✓", within_s=600.0)
    (candidate,) = lab.candidates.glob("*.yaml")
    page.click(f"promote-{candidate.stem}")
    page.click("promote-yes")
    page.shows("line-model", "draught")
    prior = load_settings(config).model.prior
    assert prior is not None
    assert dict(zip(prior.names, prior.mean, strict=True)) == pytest.approx(WIND, rel=0.05)
    page.click("undo")
    page.click("undo-yes")
    page.shows("line-model", "0 former models")
