"""Whether the trials of a study agree on what they say of the cable and its effects."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cable.effects import library
from cell.cli import app
from cell.lab.report.tables import agreement_table
from cell.lab.report.wording import agreement_sentence
from cell.lab.strength.trial_agreement import agreement
from cell.study.data import Markers
from cell.study.folder import write_study
from tests.cell.lab.conftest import LONG, fits_of

LATENCY = library()["camera_latency"]


def agreement_of(study):
    fits = fits_of(study, known=["camera_latency"])
    return agreement(fits.prepared, fits.base.fit)


@pytest.fixture(scope="module")
def study(make_study):
    return make_study([LATENCY.active(delay_s=0.004)], seed=31, **LONG)


def test_trials_of_one_cable_agree_each_about_the_truth(study):
    found = agreement_of(study)
    assert [a.parameter for a in found] == ["mean_rigidity", "viscosity", "camera_latency.delay_s"]
    assert all(a.agrees for a in found)
    latency = found[-1]
    assert [t.trial for t in latency.by_trial] == [t.name for t in study.trials]
    assert [t.value for t in latency.by_trial] == pytest.approx([0.004] * 4, abs=3e-4)
    assert sum(t.low < 0.004 < t.high for t in latency.by_trial) >= 3
    assert latency.spread < 1e-4
    assert agreement_sentence(found).startswith(
        "The 4 trials agree on mean rigidity, viscosity and"
    )


def test_a_trial_whose_pictures_are_later_than_those_of_others_is_told(study):
    late = study.trials[2]
    later = replace(late, markers=Markers(late.markers.t_s + 0.003, late.markers.xy_m))
    found = agreement_of(replace(study, trials=(*study.trials[:2], later, study.trials[3])))
    assert [a.agrees for a in found] == [True, True, False]
    latency = found[-1]
    assert latency.by_trial[2].value == pytest.approx(0.007, abs=4e-4)
    assert latency.spread == pytest.approx(0.0015, rel=0.2)
    said = agreement_sentence(found)
    assert said.startswith(
        "The 4 trials disagree on camera latency delay (s): estimates per trial 0.00"
    )
    assert said.endswith("They agree on mean rigidity and viscosity.")
    table = agreement_table(found)
    heads, rows = table.heads, table.rows
    assert heads[3] == "camera_latency.delay_s, s"
    assert rows[2][0] == "left"
    assert rows[2][3].startswith("0.00")
    assert rows[-1][3].startswith("no, p ")


def test_a_single_trial_agrees_with_nothing(study):
    alone = replace(study, trials=study.trials[:1])
    assert agreement_of(alone) == ()
    assert agreement_sentence(()) == ""


def test_where_the_model_errs_all_trials_together_say_what_the_fits_table_says(
    make_study, tmp_path
):
    """Asked with the camera's noise alone they said another EI than the fit, which weighs its own
    error: 4.94e-05 … 5.24e-05 below a table with 1.6e-05 … 2.2e-05.
    """
    late = make_study([LATENCY.active(delay_s=0.02)], seed=31)
    fitted = replace(late, trials=tuple(replace(t, role="fit") for t in late.trials[:2]))
    write_study(fitted, tmp_path / "late")
    found = CliRunner().invoke(app, ["fit", str(tmp_path / "late"), "--json"])
    said = json.loads(found.stdout)
    rigidity = [p["value"] for p in said["parameters"] if p["name"].startswith("rigidity_")]
    (mean,) = [a for a in said["agreement"] if a["parameter"] == "mean_rigidity"]
    assert mean["value"] == pytest.approx(np.exp(np.mean(np.log(rigidity))), rel=0.005)
