"""The table of checks of a study's data: every row is asked, and says what it measured."""

from __future__ import annotations

import string
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion
from cell.study.check import DataCheck, failures
from cell.study.data import Markers, Trial
from cell.study.facts import trial_facts
from cell.study.import_checks import (
    IMPORT_NOTES,
    IMPORT_REFUSALS,
    IMPORT_SHAPE,
    log_begins,
    log_ends,
    log_gap,
)
from cell.study.record_checks import RECORD_NOTES, STUDY_NOTES, TrialRecord
from cell.study.trial_checks import TRIAL_NOTES, TRIAL_REFUSALS, TrialEvidence
from cell.study.wrench import FORCE_NOTES, FORCE_REFUSALS
from tools.site.references import DATA_CHECKS

#: Where the rows' sentences are filled in by; of these every name must be one of the failure's.
GROUPS = (
    IMPORT_REFUSALS, IMPORT_SHAPE, TRIAL_REFUSALS, TRIAL_NOTES, IMPORT_NOTES, FORCE_REFUSALS,
    FORCE_NOTES, RECORD_NOTES, STUDY_NOTES,
)  # fmt: skip
ARCS_M = np.array([0.1, 0.07, 0.04])
CABLE = Cable(0.1, 0.0074, 0.016, 1e-4)
T_S = np.arange(0.0, 1.0, 0.01)


def evidence() -> TrialEvidence:
    """A straight cable that follows its gripper upwards, and droops a little when it is moved."""
    share = np.clip((T_S - 0.3) / 0.2, 0.0, 1.0)
    hand_m = np.column_stack([0.0 * T_S, 0.04 * share**2 * (3.0 - 2.0 * share)])
    droop_m = 0.002 * (1.0 + np.sin(40.0 * T_S) * (share > 0.0))
    bow_m = -droop_m[:, None] * (ARCS_M / 0.1) ** 2
    xy_m = hand_m[:, None] + np.stack([np.broadcast_to(-ARCS_M, bow_m.shape), bow_m], axis=2)
    grip = Motion(T_S, hand_m[:, 0], hand_m[:, 1], 0.0 * T_S)
    trial = Trial("made", "fit", "equilibrium", grip, Markers(T_S, xy_m))
    return TrialEvidence(trial, CABLE, ARCS_M, (0.0, -9.81))


def test_every_check_has_its_own_name_and_is_in_a_group() -> None:
    names = [check.name for check in DATA_CHECKS]
    assert len(set(names)) == len(names)
    assert {check.name for group in GROUPS for check in group} == set(names)


@pytest.mark.parametrize("check", DATA_CHECKS, ids=lambda check: check.name)
def test_a_row_says_what_is_asked_where_its_limit_is_and_what_to_do(check: DataCheck) -> None:
    assert check.question.endswith("?") and check.statistic and check.limit
    assert check.remedy or check.name in ("wide", "no_swing")
    names = {name for _, name, _, _ in string.Formatter().parse(check.says + check.remedy) if name}
    assert all(name.isidentifier() for name in names)


def test_nothing_is_said_of_a_cable_that_follows_its_hand() -> None:
    for group in (IMPORT_SHAPE, TRIAL_REFUSALS, TRIAL_NOTES, IMPORT_NOTES):
        assert not [sentence for _, sentence in failures(group, evidence())]


def with_places(change) -> TrialEvidence:
    given = evidence()
    xy_m = given.trial.markers.xy_m.copy()
    changed = change(xy_m)
    markers = Markers(T_S, xy_m if changed is None else changed)
    return replace(given, trial=replace(given.trial, markers=markers))


def shifted(xy_m: np.ndarray, late: int) -> np.ndarray:
    return np.concatenate([np.repeat(xy_m[:1], late, axis=0), xy_m[:-late]])


def lost(xy_m: np.ndarray) -> None:
    xy_m[32:45, 0] = xy_m[32, 0]


def swapped(xy_m: np.ndarray) -> None:
    xy_m[60:, [0, 2]] = xy_m[60:, [2, 0]]


#: Changes to that cable, and the first check that fails then.
CHANGES = {
    "cable_waits": partial(shifted, late=40),
    "out_of_reach": lambda xy_m: 5.0 * xy_m,
    "exchanged": swapped,
    "frozen_marker": lost,
    "reversed_arcs": lambda xy_m: xy_m[:, :1] + (xy_m - xy_m[:, :1]) * [-1.0, 1.0] + [0.1, 0.0],
    "too_far": lambda xy_m: xy_m - [0.0, 0.09],
    "beyond_arc": lambda xy_m: xy_m - [0.02, 0.0],
    "wrong_side": lambda xy_m: xy_m * [-1.0, 1.0],
    "rises": lambda xy_m: xy_m + (ARCS_M > 0.09)[:, None] * np.array([0.0, 0.014]),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_no_cable_does_fails_the_check_of_its_name(name: str) -> None:
    found = with_places(CHANGES[name])
    (check,) = [c for c in DATA_CHECKS if c.name == name]
    group = TRIAL_NOTES if check.outcome == "noted" else TRIAL_REFUSALS
    failed = [c.name for c in group if c.failure(found) is not None]
    assert failed and failed[0] == name
    failure, sentence = next(iter(failures(group, found)))
    assert "{" not in sentence and check.remedy.partition("{")[0] in sentence
    assert failure.row is None or 0 <= failure.row < len(T_S)


def test_a_swing_is_asked_for_once() -> None:
    """A record that shows no swing is told of that, not of what a swing would lack."""
    record = TrialRecord(trial_facts(evidence().trial, ARCS_M), 1e-4)
    short = replace(record, facts=replace(record.facts, spectrum=None))
    names = [c.name for c in RECORD_NOTES if c.failure(short) is not None]
    assert [n for n in names if n in ("no_swing", "few_swings", "few_per_swing")] == ["no_swing"]


def test_a_cut_off_log_is_not_told_of_one_with_a_gap() -> None:
    given = evidence()
    keep = (T_S < 0.31) | (T_S > 0.47)
    grip = given.trial.grip
    log = Motion(*(v[keep] for v in (grip.t_s, grip.x_m, grip.y_m, grip.angle_rad)))
    gapped = replace(given, trial=replace(given.trial, grip=log))
    assert log_gap.failure(gapped) is not None
    assert log_ends.failure(gapped) is None and log_begins.failure(gapped) is None
