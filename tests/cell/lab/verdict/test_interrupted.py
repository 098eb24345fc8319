"""A diagnosis that a person stops says what it knows so far, and claims nothing."""

import json
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import cell.cli.fit
import cell.cli.lab
from cell.cable.effects import library
from cell.cli import app
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.work import Work, WorkStoppedError
from cell.lab.diagnosis import diagnose, with_limits
from cell.lab.fit.fitting import Rival
from cell.lab.next.motion_file import Option
from cell.lab.next.suggest import distinguishing_motions
from cell.lab.next.terms import admissible
from cell.lab.report.tables import sentence, verdict_line
from cell.lab.strength.compare import compare_model
from cell.settings.surroundings import Surroundings
from cell.study.folder import write_study
from tests.cell.lab.conftest import fits_of

KNOWN = library()
NAMES = ("air_drag", "tip_mass", "grip_angle", "natural_curvature")


@pytest.fixture(scope="module")
def study(make_study):
    return make_study([KNOWN["tip_mass"].active(mass_kg=3e-5)], seed=8)


def stopped_when(study, text, done=0):
    """The fits of a study, stopped when it says so."""
    work = Work()

    def progress(said, count=0, total=0):
        if text in said and count >= done:
            work.stop()

    return fits_of(study, NAMES, progress=progress, work=work)


def test_what_was_fitted_until_then_is_told_and_nothing_claimed(study):
    fits = stopped_when(study, "refitted with", 3)
    examination = with_limits(diagnose(fits))
    found = examination.diagnosis
    assert found.verdict == "cannot_tell"
    assert found.missing == ()
    assert found.limits == ()
    assert found.warnings[0].code == "interrupted"
    assert 1 <= len(found.nearest) <= 3
    assert len(found.ranking) == len(NAMES)
    assert sentence(found).startswith("Interrupted. The model misses")
    assert "lacks something" not in verdict_line(found)
    assert "nothing confirmed" in sentence(found)


def test_stopped_before_the_second_search_has_begun_the_first_is_told(study, monkeypatch):
    """After an effect is found, the mesh's error is that of another model: all is fitted again."""
    before = stopped_when(study, "never")
    before.screened(before.base)
    meshed = replace(before.prepared, mesh_m={study.trials[0].name: 0.0})

    def progress(said, count=0, total=0):
        if "looking where to begin" in said:
            before.work.stop()

    setup = replace(before.setup, progress=progress)
    fits = replace(before, prepared=meshed, setup=setup)
    fit_cache = "cell.lab.search.fit_cache"
    monkeypatch.setattr(f"{fit_cache}.corrected", lambda prepared, fit: prepared)
    monkeypatch.setattr(f"{fit_cache}.moves_parameters", lambda prepared, moved: True)
    found = diagnose(fits).diagnosis
    assert found.verdict == "cannot_tell"
    assert found.warnings[0].code == "interrupted"
    assert found.baseline.fit_rms_m == pytest.approx(before.base.fit.rms_m)


def test_before_the_baseline_there_is_nothing_to_tell(study):
    with pytest.raises(WorkStoppedError):
        stopped_when(study, "looking where to begin")


def test_a_verdict_that_is_known_stays_when_its_limits_are_stopped(study):
    fits = stopped_when(study, "how strong")
    found = with_limits(diagnose(fits)).diagnosis
    assert found.verdict == "missing"
    assert found.limits == ()
    assert [w.code for w in found.warnings] == ["interrupted"]


class Interrupting:
    """A progress line during which a signal comes."""

    def __init__(self, during, number):
        self.during, self.number, self.pressed = during, number, False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def watch(self, error):
        """Nobody looks at the errors of fits."""

    def __call__(self, text, done=0, total=0):
        if self.during in text and not self.pressed:
            self.pressed = True
            os.kill(os.getpid(), self.number)


def interrupted(monkeypatch, during, number, *given):
    """A command during whose work somebody wants it to end, when it says that it is doing that."""
    for module in (cell.cli.lab, cell.cli.fit):
        monkeypatch.setattr(module, "working", lambda command: Interrupting(during, number))
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        return CliRunner().invoke(app, [str(word) for word in given])
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)


@pytest.fixture
def folder(study, tmp_path):
    write_study(study, tmp_path / "study")
    return tmp_path / "study"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_before_a_model_is_fitted_the_noise_is_known(folder, tmp_path, monkeypatch, number):
    out = tmp_path / "found.json"
    given = ["diagnose", folder, "-o", out]
    result = interrupted(monkeypatch, "fitting the model", number, *given)
    assert result.exit_code == 128 + number
    assert "no model is fitted yet; noise of study" in result.stderr
    assert not out.exists()


def test_the_verdict_is_printed_before_the_models_are_compared(folder, tmp_path, monkeypatch):
    out, compared = tmp_path / "found.json", []

    def noted(study, model, name="model", work=None):
        print("COMPARED")
        compared.append(model)
        return compare_model(study, model, name, work)

    monkeypatch.setattr("cell.api.lab.compare_model", noted)
    given = ["diagnose", folder, "-o", out]
    result = interrupted(monkeypatch, "comparing the models", signal.SIGTERM, *given)
    assert result.exit_code == 128 + signal.SIGTERM
    assert result.stdout.count("Verdict ") == 1
    assert result.stdout.index("Verdict missing") < result.stdout.index("COMPARED")
    assert "tip_mass" in result.stdout
    assert len(compared) >= 2
    assert json.loads(out.read_text())["verdict"] == "missing"


@pytest.mark.parametrize("after", [3, 25, 80])
def test_at_any_moment_what_is_known_is_printed(folder, tmp_path, monkeypatch, after):
    """The signal comes with one of the batches of simulations, whatever that is for."""
    out, add, batches = tmp_path / "found.json", Work.add, []

    def counted(work, models, duration_s, solver):
        batches.append(models)
        if len(batches) == after:
            os.kill(os.getpid(), signal.SIGTERM)
        add(work, models, duration_s, solver)

    monkeypatch.setattr(Work, "add", counted)
    result = interrupted(monkeypatch, "never", signal.SIGTERM, "diagnose", folder, "-o", out)
    assert result.exit_code == 128 + signal.SIGTERM
    if not out.exists():
        assert "no model is fitted yet; noise of study" in result.stderr
        return
    found = json.loads(out.read_text())
    assert "interrupted" in [w["code"] for w in found["warnings"]]
    assert f"Verdict {found['verdict']}: " in result.stdout


def test_a_diagnosis_gives_the_best_answer_so_far(folder, tmp_path, monkeypatch):
    out, page = tmp_path / "found.json", tmp_path / "found.html"
    given = ["diagnose", folder, "-o", out, "--report", page]
    result = interrupted(monkeypatch, "refitted with", signal.SIGTERM, *given)
    assert result.exit_code == 128 + signal.SIGTERM
    assert "Interrupted." in result.output
    found = json.loads(out.read_text())
    assert (found["verdict"], found["missing"]) == ("cannot_tell", [])
    assert found["warnings"][0]["code"] == "interrupted"
    assert page.is_file()


def test_a_fit_is_told_without_what_would_have_followed(folder, tmp_path, monkeypatch):
    out, page = tmp_path / "model.json", tmp_path / "profiles.html"
    given = ["fit", folder, "-o", out, "--profile", page]
    result = interrupted(monkeypatch, "profile of ", signal.SIGINT, *given)
    assert result.exit_code == 128 + signal.SIGINT
    assert "viscosity" in result.stdout
    assert "computations after the fit are missing or incomplete" in result.stdout
    found = json.loads(out.read_text())
    assert found["warnings"][0]["code"] == "interrupted"
    assert found["agreement"]
    assert found["profiles"] == []
    assert not page.exists()


def test_a_fit_that_is_not_known_yet_writes_nothing(folder, tmp_path, monkeypatch):
    out = tmp_path / "model.json"
    result = interrupted(monkeypatch, "fitting", signal.SIGTERM, "fit", folder, "-o", out)
    assert result.exit_code == 128 + signal.SIGTERM
    assert "there are no results yet, and nothing was written" in result.stderr
    assert not out.exists()


def test_a_law_that_is_not_confirmed_yet_is_not_written(folder, tmp_path, monkeypatch):
    out = tmp_path / "law.py"
    monkeypatch.setattr("cell.lab.next.discover.admissible", lambda box_m: admissible(box_m)[:2])
    given = ["discover", folder, "-o", out]
    result = interrupted(monkeypatch, "refitted with", signal.SIGTERM, *given)
    assert result.exit_code == 128 + signal.SIGTERM
    assert "interrupted: no law is confirmed so far (it misses" in result.stdout
    assert "the nearest, " in result.stdout
    assert not out.exists()


def test_the_best_motion_so_far_is_suggested(study, monkeypatch):
    """Once some were looked at."""
    looked: list[float] = []

    def weighed(prepared, rivals, stroke, surroundings, low_m):
        looked.append(stroke.angle_rad)
        if len(looked) > 3:
            raise KeyboardInterrupt
        return "view" if len(looked) == 1 else Option(stroke, float(len(looked)), "b", 0.5)

    monkeypatch.setattr("cell.lab.next.suggest._evaluated", weighed)
    monkeypatch.setattr("cell.lab.next.suggest._rest_low_m", lambda *_: 0.0)
    space = ParameterSpace.of(study.cable)
    rivals = [Rival(n, space, space.mean, np.eye(len(space.mean))) for n in "ab"]
    prepared = PreparedStudy.of(study)
    found = distinguishing_motions(prepared, rivals, Surroundings.read(None))
    assert [o.separation for o in found.options] == [3.0, 2.0]
    assert found.refused == {"view": 1}
    looked.extend([0.0] * 3)
    with pytest.raises(KeyboardInterrupt):
        distinguishing_motions(prepared, rivals, Surroundings.read(None))
