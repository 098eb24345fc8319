"""Whole ways through the lab, by its commands as they are printed: the error's fall is seen."""

import json
import shlex
from pathlib import Path

import pytest

from cell.cable.effects import load_effect
from cell.lab.data import named_effects
from cell.lab.next import discover
from cell.lab.next.terms import admissible
from cell.study.folder import write_study
from tests.command import run_cell

NOISE_M = 1e-4
PULL_N_M = (0.012, 0.004)
PULL = '''
from cell.cable.effects import Effect, Parameter


class Fan(Effect):
    """Steady pull of a fan on the cable, per metre."""

    name = "fan"
    parameters = (
        Parameter("across_n_m", "N/m", -1.0, 1.0, 0.0, (5e-3,)),
        Parameter("up_n_m", "N/m", -1.0, 1.0, 0.0, (5e-3,)),
    )

    def force(cable, at, p):
        return p.across_n_m, p.up_n_m
'''


@pytest.fixture(scope="module")
def fan(tmp_path_factory):
    path = tmp_path_factory.mktemp("my effects") / "fan.py"  # a blank: commands must quote it
    path.write_text(PULL)
    return path


@pytest.fixture(scope="module")
def folder(make_study, fan, tmp_path_factory):
    hidden = load_effect(fan).active(across_n_m=PULL_N_M[0], up_n_m=PULL_N_M[1])
    path = tmp_path_factory.mktemp("studies") / "fan"
    write_study(make_study([hidden], seed=31, noise_m=NOISE_M), path)
    return path


@pytest.fixture(autouse=True)
def few_rivals(monkeypatch, tmp_path):
    """A library that lacks what is hidden, and few terms of a law: soon tried."""
    known = named_effects.library()
    rivals = {n: known[n] for n in ("tip_mass", "air_drag", "natural_curvature")}
    monkeypatch.setattr(named_effects, "library", lambda: rivals)
    terms = ("constant_field", "drag_along", "curved_stiffness", "power_viscosity")
    monkeypatch.setattr(
        discover, "admissible", lambda box_m: [t for t in admissible(box_m) if t.name in terms]
    )
    monkeypatch.chdir(tmp_path)


def cell(*arguments):
    done = run_cell(*[str(a) for a in arguments])
    return done.stdout


def printed_commands(output, name):
    """Arguments of the commands of a name that an output tells to type."""
    lines = [line.strip() for line in output.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith(f"cell {name} ")]


def follow_to_the_comparison(output):
    """Type the commands that an output prints; the comparison's two models."""
    for arguments in printed_commands(output, "fit"):
        cell(*arguments)
    (arguments,) = printed_commands(output, "compare")
    shown = cell(*arguments, "--json", "comparison.json")
    comparison = json.loads(Path("comparison.json").read_text())
    assert "comparison.html" in arguments
    return shown, comparison["models"]


def test_discover_fit_compare(folder, tmp_path):
    output = cell("discover", folder, "-o", "law.py", "--json", "law.json")
    found = json.loads((tmp_path / "law.json").read_text())
    assert found["complete"]
    assert 0.99 < found["removed_share"] <= 1.0
    shown, (before, after) = follow_to_the_comparison(output)
    assert (before["effects"], after["effects"]) == ([], ["law"])
    assert before["heldout_rms_m"] > 3.0 * NOISE_M
    assert after["heldout_rms_m"] < 1.05 * NOISE_M
    assert after["heldout_rms_m"] == pytest.approx(found["rms_m"], rel=0.02)
    assert "before" in shown
    page = (tmp_path / "comparison.html").read_text()
    assert "law" in page


def test_own_effect_diagnose_fit_compare(folder, fan):
    output = cell("diagnose", folder, "--try", fan, "--json", "d.json")
    found = json.loads(Path("d.json").read_text())
    assert found["verdict"] == "missing"
    assert [f["effect"] for f in found["missing"]] == ["fan"]
    _, (before, after) = follow_to_the_comparison(output)
    assert after["effects"] == ["fan"]
    assert before["heldout_rms_m"] > 3.0 * NOISE_M
    assert after["heldout_rms_m"] < 1.05 * NOISE_M
    for name, true in zip(("across_n_m", "up_n_m"), PULL_N_M, strict=True):
        parameter = found["missing"][0]["parameters"][name]
        assert parameter["low"] < true < parameter["high"]


def test_on_a_complete_model_discover_refuses_and_writes_nothing(make_study, tmp_path):
    write_study(make_study(seed=5), tmp_path / "complete")
    done = run_cell("discover", tmp_path / "complete", "-o", tmp_path / "law.py", code=2)
    assert "the model is complete" in done.output
    assert sorted(p.name for p in tmp_path.iterdir()) == ["complete"]


@pytest.mark.parametrize("name", ["air_drag.py", "a-law.py", "law.txt", "law"])
def test_a_law_that_could_not_be_used_under_its_name_is_refused_at_once(folder, tmp_path, name):
    done = run_cell("discover", folder, "-o", name, code=2)
    assert name in done.output
    assert list(tmp_path.iterdir()) == []
