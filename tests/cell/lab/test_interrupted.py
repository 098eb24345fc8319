"""A diagnosis that a person stops says what it knows so far, and claims nothing."""

import json
import os
import signal

import pytest
from typer.testing import CliRunner

import cell.cli.lab
from cell.cable.effects import library
from cell.cli import app
from cell.cli.shared import INTERRUPTED
from cell.identify.parameters import ParameterSpace
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.limits import with_limits
from cell.lab.prepared import PreparedStudy, StoppedError
from cell.lab.tables import sentence
from cell.study.folder import write_study

KNOWN = library()
NAMES = ("air_drag", "tip_mass", "grip_angle", "natural_curvature")


@pytest.fixture(scope="module")
def study(make_study):
    return make_study([KNOWN["tip_mass"].active(mass_kg=3e-5)], seed=8)


def stopped_when(study, text, done=0):
    """An explorer that is stopped when it says so."""

    def progress(said, count=0, total=0):
        if text in said and count >= done:
            explorer.prepared.work.stop()

    space = ParameterSpace.of(study.cable)
    chosen = {n: KNOWN[n] for n in NAMES}
    explorer = Explorer(PreparedStudy.of(study), space, chosen, progress)
    return explorer


def test_what_was_fitted_until_then_is_told_and_nothing_claimed(study):
    explorer = stopped_when(study, "refitted with", 3)
    examination = with_limits(explorer, diagnose(explorer))
    found = examination.diagnosis
    assert found.verdict == "cannot_tell"
    assert found.missing == ()
    assert found.limits == ()
    assert found.warnings[0].code == "interrupted"
    assert 1 <= len(found.nearest) <= 3
    assert len(found.ranking) == len(NAMES)
    assert sentence(found).startswith("Interrupted. The model misses")
    assert "nothing confirmed" in sentence(found)


def test_before_the_baseline_there_is_nothing_to_tell(study):
    with pytest.raises(StoppedError):
        diagnose(stopped_when(study, "looking where to begin"))


def test_a_verdict_that_is_known_stays_when_its_limits_are_stopped(study):
    explorer = stopped_when(study, "how strong")
    found = with_limits(explorer, diagnose(explorer)).diagnosis
    assert found.verdict == "missing"
    assert found.limits == ()
    assert [w.code for w in found.warnings] == ["interrupted"]


class Interrupting:
    """A progress line during which Ctrl-C is pressed."""

    def __init__(self, command):
        self.pressed = False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def __call__(self, text, done=0, total=0):
        if "refitted with" in text and not self.pressed:
            self.pressed = True
            os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_gives_the_best_answer_so_far(study, tmp_path, monkeypatch):
    folder, out, page = tmp_path / "study", tmp_path / "found.json", tmp_path / "found.html"
    write_study(study, folder)
    monkeypatch.setattr(cell.cli.lab, "working", Interrupting)
    before = signal.getsignal(signal.SIGINT)
    try:
        given = ["diagnose", str(folder), "-o", str(out), "--report", str(page)]
        result = CliRunner().invoke(app, given)
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == INTERRUPTED
    assert "Interrupted." in result.output
    found = json.loads(out.read_text())
    assert (found["verdict"], found["missing"]) == ("cannot_tell", [])
    assert found["warnings"][0]["code"] == "interrupted"
    assert page.is_file()
