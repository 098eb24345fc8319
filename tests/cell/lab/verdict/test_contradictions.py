"""No sentence of a diagnosis may contradict the numbers beside it."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cell.cable.effects import library
from cell.cli.output import show
from cell.identify.gauss_newton import Options
from cell.lab.data.prepared import all_fitted
from cell.lab.data.results import RankedEffect, to_json
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.diagnosis import diagnose, with_agreement
from cell.lab.fit.fitting import fit_model
from cell.lab.next.advice import MEND, Paths, advice
from cell.lab.report.tables import diagnosis_parts
from cell.lab.search import partial
from cell.lab.search.fit_cache import with_lower_baseline
from cell.lab.search.fitted_model import model_of_fit
from cell.lab.strength.compare import compare_model
from tests.cell.lab.conftest import fits_of

from .contradictions import contradictions

KNOWN = library()


def as_printed(study, examination):
    """A diagnosis and its text, as the command ends with it."""
    examination = with_agreement(examination)
    ends = (examination.fits.base, examination.path[-1])
    comparisons = [compare_model(study, c.fit.model) for c in ends]
    todo = advice(examination.diagnosis, Paths(Path("STUDY")))
    return examination.diagnosis, printed(examination.diagnosis, comparisons, todo)


def printed(diagnosis, comparisons, todo):
    shown = io.StringIO()
    parts = diagnosis_parts(diagnosis, comparisons, todo)
    show(*parts, console=Console(file=shown, width=200))
    return shown.getvalue()


def wrong_in(diagnosis, text):
    return contradictions(json.loads(json.dumps(to_json(diagnosis), allow_nan=False)), text)


@pytest.fixture(scope="module")
def shaken(make_study):
    """Markers that follow the gripper, and of the swing only a third: no free end does that."""

    def following(trial):
        xy_m = trial.markers.xy_m
        return xy_m[:1] + 0.5 * (xy_m[:, -1:] - xy_m[:1, -1:])

    return make_study(seed=2).with_places(following)


def test_a_complete_study_is_described_without_contradiction(make_study):
    study = make_study(seed=12)
    diagnosis, text = as_printed(study, diagnose(fits_of(study, ("tip_mass", "air_drag"))))
    assert diagnosis.verdict == "complete"
    assert wrong_in(diagnosis, text) == []


def test_an_unexplained_study_is_described_without_contradiction(
    curved_and_loaded, partly_explained
):
    diagnosis, text = as_printed(curved_and_loaded, partly_explained)
    assert diagnosis.verdict == "unexplained"
    assert wrong_in(diagnosis, text) == []


def test_where_no_parameter_means_anything_no_effect_explains_and_nothing_is_to_be_fitted(shaken):
    """A cable held at both ends: "natural curvature explains most of it, and 116 mm stay" of 68,
    "the trials agree on rigidity", and commands to fit effects.
    """
    found, text = as_printed(shaken, diagnose(fits_of(shaken, ("natural_curvature", "tip_mass"))))
    assert found.codes & {"hopeless", "not_searched"}
    assert (found.verdict, found.partial, found.agreement) == ("unexplained", (), ())
    assert wrong_in(found, text) == []
    assert advice(found) == (MEND,)


def test_an_effect_explains_only_what_the_model_without_it_does_not(make_study, monkeypatch):
    """A magnet in a wrong minimum left 1.03 mm, and relaxation explained 100 % of it: it had only
    been fitted on from there.  From where that ended the magnet alone leaves as little.
    """
    study = all_fitted(make_study(seed=5))
    whole = fits_of(study, ("tip_mass", "air_drag"))
    base = whole.base
    initial_states = base.fit.q + 0.6 * np.eye(len(base.fit.q))[0]
    stuck = fit_model(
        whole.prepared, base.fit.space, initial_states, options=Options(max_iterations=1)
    )
    stuck = model_of_fit(whole.prepared, base.effects, stuck)
    assert stuck.fit.rms_m > 1.2 * base.fit.rms_m
    monkeypatch.setitem(whole._memory.models, base.names, stuck)
    whole, singles = partial._singles(whole)
    assert whole.base.fit.rms_m == pytest.approx(base.fit.rms_m, rel=0.01)
    assert partial.largest_step(whole, whole.base, singles) is None
    assert with_lower_baseline(whole, whole.base.fit.q, DEFAULT_RULES.tie_delta_chi2) is whole


@pytest.fixture(scope="module")
def found(make_study):
    """A load is found, and drag ruled out."""
    study = make_study([KNOWN["tip_mass"].active(mass_kg=3e-5)], seed=12)
    diagnosis, text = as_printed(study, diagnose(fits_of(study, ("tip_mass", "air_drag"))))
    assert [r.status for r in diagnosis.ranking] == ["present", "absent"]
    return diagnosis, text


def test_a_next_command_fits_no_effect_that_the_table_calls_absent(found):
    """Accepted on the way, and ruled out at the end: `fit` and `discover` had it all the same."""
    diagnosis, _ = found
    left = replace(
        diagnosis,
        verdict="unexplained",
        missing=(),
        ranking=(
            RankedEffect("tip_mass", 90.0, 1e-9, "inspect"),
            RankedEffect("air_drag", 0.0, 1.0, "absent"),
        ),
    )
    commands = " ".join(s.command for s in advice(left, accepted=("tip_mass", "air_drag")))
    assert "--with tip_mass" in commands
    assert "air_drag" not in commands
    commands = " ".join(s.command for s in advice(left, accepted=("air_drag",)))
    assert "cell discover STUDY -o" in commands


def held_out_rises(d, text):
    worse = replace(d.missing[0], errors=replace(d.missing[0].errors, heldout_rms_m=9e-4))
    return replace(d, missing=(worse,)), text


def one_explains_less_than_nothing(d, text):
    last = replace(d.ranking[-1], score=-3.0)
    return replace(d, ranking=(*d.ranking[:-1], last)), text


def listed_from_below(d, text):
    """The rows of the table of all effects, turned round."""
    rows = [
        line for line in text.splitlines() if re.match(r" +\S+ +[-\d.]+ .* (absent|pres)", line)
    ]
    assert len(rows) > 1
    head, tail = text.split(rows[0])[0], text.split(rows[-1])[-1]
    return d, head + "\n".join(reversed(rows)) + tail


def explained_in_part_and_absent(d, text):
    part = replace(d.missing[0], effect="air_drag", p_value=0.5)
    return replace(d, partial=(part,)), text


@pytest.mark.parametrize(
    ("change", "told_as"),
    [
        (lambda d, t: (d, t.replace("Verdict missing", "Verdict complete")), "is not said"),
        (lambda d, t: (d, t.replace("misses 0.", "misses 1.")), "“The model misses 1."),
        (
            lambda d, t: (d, t.replace("with tip mass in it 0.", "with tip mass in it 1.")),
            "in it 1.",
        ),
        (lambda d, t: (d, t + "of -0.0 mm"), "-0.0"),
        (lambda d, t: (d, t + "that is -0 %"), "-0"),
        (lambda d, t: (d, t + "(p = 0)"), "p = 0"),
        (lambda d, t: (d, t + "    cell fit S --with air_drag -o a.json"), "which is absent"),
        (lambda d, t: (replace(d, verdict="complete"), t), "complete, and effects are missing"),
        (lambda d, t: (replace(d, noise_m=2.0 * d.noise_m), t), "“camera noise ("),
        (lambda d, t: (replace(d, noise_m=0.5 * d.noise_m), t), "times it"),
        (held_out_rises, "tip_mass is missing, and held out"),
        (one_explains_less_than_nothing, "less than nothing"),
        (listed_from_below, "not listed by their χ²"),
        (explained_in_part_and_absent, "air_drag explains most, and is absent"),
        (explained_in_part_and_absent, "air_drag explains most, at p = 0.5"),
        (explained_in_part_and_absent, "was fitted to all trials, and one is held out"),
    ],
)
def test_what_contradicts_is_found(found, change, told_as):
    diagnosis, text = found
    assert wrong_in(diagnosis, text) == []
    assert any(told_as in w for w in wrong_in(*change(diagnosis, text)))
