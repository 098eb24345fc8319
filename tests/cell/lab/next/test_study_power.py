"""Forecast and recovery: sizes, probabilities, and that diagnoses of copies bear them out."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from cell.lab.data.prepared import all_fitted
from cell.lab.data.results import Diagnosis, Errors, MissingEffect
from cell.lab.next import study_power
from cell.lab.next.effect_query import effect_queries
from cell.lab.next.study_power import (
    POWER,
    CopyOutcome,
    Recovery,
    copy_outcome,
    forecast,
    power_of,
    recover,
)
from cell.lab.report.model_tables import power_sentences, power_table, recovery_table
from tests.cell.lab.conftest import fits_of


def asked(given):
    return effect_queries([given], [])[0][0]


@pytest.fixture(scope="module")
def smallest(fitted, linear):
    found = forecast(fitted, asked("air_drag"), linear).smallest
    assert found is not None
    return found


def test_the_smallest_size_has_its_power_wherever_the_search_begins(fitted, linear, smallest):
    for begin in (0.2 * smallest, 5.0 * smallest):
        said = forecast(fitted, asked(f"air_drag={begin!r}"), linear)
        assert said.smallest == pytest.approx(smallest, rel=0.05)
    said = forecast(fitted, asked(f"air_drag={smallest!r}"), linear)
    assert said.chances.found == pytest.approx(POWER, abs=0.02)
    assert said.rivals[0].effect == "linear_air_drag"


def test_a_larger_effect_is_likelier_found_and_hardly_any_is_not(fitted, linear, smallest):
    sizes = [k * smallest for k in (0.05, 0.5, 0.8, 1.0, 4.0)]
    found = [forecast(fitted, asked(f"air_drag={s!r}"), linear).chances.found for s in sizes]
    assert found == sorted(found)
    assert found[0] < 0.01
    assert found[-1] > 0.99


def test_with_less_noise_a_smaller_one_is_found(fitted, linear, smallest, make_study):
    quiet = fits_of(make_study(seed=21, noise_m=3e-5), fitted.library)
    (effect,) = power_of(quiet, [asked("air_drag")]).effects
    assert effect.smallest == pytest.approx(0.3 * smallest, rel=0.25)


def test_copies_bear_out_what_is_surely_found_and_what_is_surely_missed(fitted, linear, smallest):
    drag = asked("air_drag")
    strong = recover(fitted, drag.at(2.0 * smallest), 3)
    assert strong.count("found") == 3
    weak = recover(fitted, drag.at(0.1 * smallest), 3)
    assert weak.count("missed", "undecided") == 3
    assert weak.share[:2] == (0.0, 0.0)


def test_of_a_copy_that_cannot_be_diagnosed_that_is_said(fitted, smallest, monkeypatch):

    def refused(*_):
        raise study_power.NoiseUnknownError("no frames")

    monkeypatch.setattr(study_power, "diagnose", refused)
    found = recover(fitted, asked("air_drag").at(smallest), 1)
    assert [o.said for o in found.outcomes] == ["failed"]


def said(verdict, *named):
    missing = tuple(MissingEffect(n[0], n[1:], 0.0, 1.0, {}, Errors(0.0, 0.0)) for n in named)
    return Diagnosis(1e-4, Errors(0.0, 0.0), verdict, missing=missing)


@pytest.mark.parametrize(
    ("diagnosis", "expected"),
    [
        (said("missing", ("air_drag",)), CopyOutcome("found", ("air_drag",))),
        (said("missing", ("draught", "air_drag")), CopyOutcome("found", ("draught or air_drag",))),
        (said("missing", ("draught",)), CopyOutcome("confused", ("draught",))),
        (
            said("missing", ("air_drag",), ("draught",)),
            CopyOutcome("confused", ("air_drag", "draught")),
        ),
        (said("cannot_tell", ("air_drag",)), CopyOutcome("undecided", ("air_drag",))),
        (said("complete"), CopyOutcome("missed")),
        (said("unexplained"), CopyOutcome("unexplained")),
    ],
)
def test_a_verdict_is_judged_beside_what_is_hidden(diagnosis, expected):
    assert copy_outcome(diagnosis, "air_drag") == expected


def test_the_result_is_json_and_tables_of_it_tell_the_same(fitted, smallest):
    found = power_of(fitted, [asked("air_drag"), asked(f"tip_mass={1e-5}")])
    copies = Recovery(4, (*[CopyOutcome("found")] * 3, CopyOutcome("confused", ("draught",))))
    tried = replace(found, effects=(replace(found.effects[0], recovery=copies), found.effects[1]))
    data = json.loads(json.dumps(tried.to_json(), allow_nan=False))
    assert data["format"] == "cable-power/1"
    first, second = data["effects"]
    assert first["smallest"] == pytest.approx(smallest)
    assert first["size"] == first["smallest"]
    total = first["forecast"]["found"] + first["forecast"]["missed"]
    total += math.fsum(first["forecast"]["confused"].values())
    assert total == pytest.approx(1.0)
    assert first["recovery"]["found"] == 3
    assert first["recovery"]["confused"] == {"draught": 1}
    assert first["recovery"]["low"] < 0.75 < first["recovery"]["high"]
    assert second["recovery"] is None
    assert power_table(tried).rows[0][0] == "air_drag"
    assert "3 of 4" in recovery_table(tried).rows[0][3]
    assert recovery_table(found) is None
    assert any("taken for draught (1)" in s for s in power_sentences(tried))


def test_without_a_held_out_trial_nothing_is_found_and_why_is_said(fitted):
    fits = fits_of(all_fitted(fitted.prepared.study), fitted.library)
    found = power_of(fits, [asked("air_drag=0.5")])
    assert found.effects[0].chances.found == 0.0
    assert found.effects[0].smallest is None
    assert [w.code for w in found.warnings] == ["confirmation"]
    assert "`role: validate`" in found.warnings[0].message


def test_the_interval_of_a_share_is_that_of_a_published_example() -> None:
    """Newcombe 1998, Stat. Med. 17, 857, table I: 81 of 263, Wilson's."""
    copies = (*[CopyOutcome("found")] * 81, *[CopyOutcome("missed")] * 182)
    assert Recovery(263, copies).share == pytest.approx((81 / 263, 0.2553, 0.3662), abs=5e-5)


def test_no_copy_diagnosed_tells_nothing_of_the_share() -> None:
    share, low, high = Recovery(4, ()).share
    assert math.isnan(share)
    assert (low, high) == (0.0, 1.0)
