"""Several studies give one answer, or say why they do not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import cell
from cell.api.lab import examined, set_up_opened
from cell.api.several import TogetherResult
from cell.cable.effects import ActiveEffect, library
from cell.cli import app
from cell.files.input_error import InputError
from cell.lab.data import named_effects
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.line.together import Hypothesis, StudyPart, joint_verdict, together
from cell.lab.verdict.conclusion import Examination
from cell.study.data import Markers, Study
from cell.study.folder import write_study
from tests.command import run_cell

GRAMS = library()["tip_mass"].active(mass_kg=2.5e-5)
#: What is hidden and one that is unlike it: what one study tells is tested elsewhere.
TRIED = {n: library()[n] for n in ("tip_mass", "air_drag")}


FEW = EffectSelection((), TRIED)


def alone(study: Study) -> Examination:
    """As `cell.diagnose_together` examines it first, with few effects tried."""
    found = examined(set_up_opened(study, FEW))
    found.fits.work.renew()
    return found


@pytest.fixture(scope="module")
def batch(make_study):
    def make(each: Sequence[Sequence[ActiveEffect]]) -> list[Study]:
        studies = [make_study(e, seed=40 + i) for i, e in enumerate(each)]
        return [replace(s, name=f"cable_{i}") for i, s in enumerate(studies)]

    return make


@pytest.fixture(scope="module")
def four(batch) -> list[Examination]:
    """Four cables, each diagnosed alone: two with a load, two without."""
    return [alone(study) for study in batch([[GRAMS], [], [GRAMS], []])]


def test_cables_that_are_alike_give_one_effect_and_its_mean(
    batch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(named_effects, "library", lambda: TRIED)
    studies = batch([[GRAMS]] * 2)
    folders = [tmp_path / s.name for s in studies]
    for folder, study in zip(folders, studies, strict=True):
        write_study(study, folder)
    out, page = tmp_path / "together.json", tmp_path / "together.html"
    asked = ["diagnose", *map(str, folders), "-o", str(out), "--report", str(page)]
    done = run_cell(*asked)
    found = json.loads(out.read_text())
    assert (found["format"], found["verdict"], found["effects"]) == (
        "cable-together/1",
        "missing",
        ["tip_mass"],
    )
    assert [p["says"] for p in found["studies"]] == ["shows"] * 2
    (mass,) = found["consistency"]
    assert mass["low"] < 2.5e-5 < mass["high"]
    assert mass["q_p_value"] > 0.01
    assert mass["without_low"] <= mass["value"] <= mass["without_high"]
    assert "2 of 2 studies show tip_mass" in done.output
    assert "tip_mass.mass_kg" in page.read_text()


def test_complete_cables_are_complete_together(four) -> None:
    found = TogetherResult(together(four[1::2]))
    assert found.together.verdict == "complete"
    assert found.together.effects == ()
    assert list(found.to_frame().says) == [""] * 2
    assert "the model leaves noise in all 2 studies" in repr(found)


def test_two_cables_of_four_that_have_an_effect_are_named(four) -> None:
    found = together(four)
    assert (found.verdict, found.effects) == ("missing", ("tip_mass",))
    assert [p.says for p in found.studies] == ["shows", "excludes", "shows", "excludes"]
    assert "missing in 2 of 4 studies, cable_0, cable_2" in found.why
    assert "cable_1, cable_3 exclude it at that size: the cables are not alike" in found.why
    (mass,) = found.consistency
    assert [v.study for v in mass.by_study] == ["cable_0", "cable_2"]


def test_what_one_study_leaves_unexplained_is_told(four, batch) -> None:
    """One cable is moved by what no effect does: a wave of 0.4 mm that runs along its middle."""
    _, odd = batch([[GRAMS], [GRAMS]])
    trials = []
    for trial in odd.trials:
        t_s, share = trial.markers.t_s, odd.arc_length_m / odd.arc_length_m.max()
        wave_m = np.sin(2 * np.pi * (3.3 * t_s[:, None] - 2.0 * share)) * np.sin(np.pi * share)
        wave_m *= 4e-4 * (t_s[:, None] > 0.25)  # not at rest: there it would be noise
        xy_m = trial.markers.xy_m + wave_m[:, :, None]
        trials.append(replace(trial, markers=Markers(t_s, xy_m)))
    found = together([four[0], alone(replace(odd, trials=tuple(trials)))])
    assert found.verdict == "unexplained"
    assert [p.explained for p in found.studies] == [True, False]
    assert found.why.startswith("the model with tip_mass leaves more than noise in cable_1")


@pytest.mark.parametrize(
    ("alone", "verdict"),
    [(("tip_mass",), "cannot_tell"), (("draught", "air_drag"), "missing")],
)
def test_an_effect_of_one_study_is_not_confirmed_by_what_another_lacks(
    alone: tuple[str, ...], verdict: str
) -> None:
    """A study that lacks a tip mass alone was taken for one that confirms air drag."""
    parts = [
        StudyPart("one", "missing", (alone,), 1.0, True, "cannot tell"),
        StudyPart("two", "cannot_tell", (), 50.0, True, "shows"),
    ]
    best = Hypothesis(("air_drag",), 20.0, 51.0)
    found, why = joint_verdict(best, (), parts, DEFAULT_RULES)
    assert found == verdict
    assert ("only two shows air_drag" in why) == (verdict == "cannot_tell")


def test_bad_input_is_refused(batch, tmp_path: Path) -> None:
    (study,) = batch([[]])
    write_study(study, tmp_path / "one")
    one = str(tmp_path / "one")
    done = CliRunner().invoke(app, ["diagnose", one, one])
    assert (done.exit_code, "is given twice; give each study once" in done.stderr) == (2, True)
    done = run_cell("diagnose", one, tmp_path / "none", code=2)
    done = CliRunner().invoke(app, ["diagnose", one, one, "--prior", "model.json"])
    assert "--prior is of one cable" in done.stderr
    with pytest.raises(ValueError, match="several studies of different names"):
        cell.diagnose_together([study])


def test_what_is_wrong_with_the_last_study_is_told_before_the_first_is_diagnosed(
    batch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for study in batch([[], []]):
        write_study(study, tmp_path / study.name)
    (tmp_path / "cable_1" / "study.yaml").write_text("format: cable-study/1\n")
    monkeypatch.setattr("cell.api.several.examined", lambda *_: pytest.fail("a study is diagnosed"))
    with pytest.raises(InputError, match=r"cable_1.study\.yaml:1"):
        cell.diagnose_together([tmp_path / "cable_0", tmp_path / "cable_1"])
