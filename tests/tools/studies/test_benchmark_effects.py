"""The benchmark of hidden effects: scores, what entrants can see, two runs from one seed."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from math import log
from pathlib import Path

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.solver import Solver
from cell.study.folder import write_study
from tools.studies import benchmark_effects as benchmark
from tools.studies import sysid_entrant
from tools.studies.benchmark_effects import Entry, Truth
from tools.studies.entrants import ranked
from tools.studies.rows import added_rows, read_rows
from tools.worlds.made_studies import hidden, make_study, random_model

ROOT = Path(__file__).parents[3]
CLAIMS = 2 + 18 + 153
SMALL = {"trials": 2, "markers": 4, "rate_hz": 40.0, "rest_frames": 20, "noise": 2e-3,
         "length_m": 0.2, "droop": 2.0, "shift": 30.0, "held_out": False}  # fmt: skip
#: Looks for the truth in all that a process has, and says what it finds.
SPY = """
import json, os
found, word = [], "spinning_lift"
places = [secret / "truth.csv", "/proc/%d/environ" % os.getppid(), "/proc/self/environ",
          "/proc/%d/cmdline" % os.getppid(), "/proc/1/root" + str(secret / "truth.csv")]
for above in (study, *study.parents):
    try:
        places += [p for p in above.iterdir() if p.is_file()] + list(above.glob("*/truth.csv"))
    except OSError:
        pass
for place in places:
    try:
        if word.encode() in open(place, "rb").read(100_000):
            found.append(str(place))
    except OSError:
        pass
Path(result).write_text(json.dumps({"claims": {}, "failed": " ".join(found), "cpu_s": 0.0}))
"""


def truth(hidden: str, effects: str) -> Truth:
    return Truth("study_000", hidden, effects, "breadth", hidden, "0", 1, 1.0, "{}")


@pytest.mark.parametrize(
    ("hidden", "effects", "claim", "expected"),
    [
        ("complete", "", "complete", "right"),
        ("complete", "", "outside", "wrong"),
        ("complete", "", "air_drag", "wrong"),
        ("one", "robot_lag", "air_drag|camera_latency", "right"),
        ("one", "tip_mass", "tip_mass+air_drag", "wrong"),
        ("one", "tip_mass", "air_drag|draught|grip_slip|point_mass|tip_mass", "abstained"),
        ("one", "tip_mass", "complete", "wrong"),
        ("one", "tip_mass", "outside", "wrong"),
        ("pair", "tip_mass+air_drag", "air_drag", "in part"),
        ("pair", "tip_mass+air_drag", "air_drag+tip_mass|point_mass", "right"),
        ("pair", "tip_mass+air_drag", "air_drag+grip_slip", "wrong"),
        ("outside", "magnet", "outside", "right"),
        ("outside", "magnet", "draught", "wrong"),
        ("outside", "magnet", "complete", "wrong"),
    ],
)
def test_a_claim_is_judged_by_all_that_is_hidden(
    hidden: str, effects: str, claim: str, expected: str
) -> None:
    assert benchmark.judged(truth(hidden, effects), claim) == expected


def test_the_likeliest_claim_counts_from_a_threshold_on() -> None:
    claims = {"complete": 0.55, "tip_mass": 0.45}
    one = truth("one", "tip_mass")
    found = [benchmark.outcome(one, claims, threshold) for threshold in (0.0, 0.55, 0.56)]
    assert found == ["wrong", "wrong", "abstained"]
    assert benchmark.outcome(one, {}, 0.0) == "abstained"


@pytest.mark.parametrize(
    ("claims", "p"),
    [
        ({}, 1.0 / CLAIMS),
        ({"tip_mass": 1.0}, 1.0),
        ({"air_drag|tip_mass": 0.8}, 0.4 + 0.2 / CLAIMS),
        ({"complete": 0.7, "tip_mass": 0.3}, 0.3),
        ({"tip_mass": 1.0, "complete": 3.0}, 0.25),
        ({"complete": 1.0}, 0.0),
    ],
)
def test_the_score_is_the_logarithm_of_what_the_truth_was_given(
    claims: dict[str, float], p: float
) -> None:
    expected = log(0.999 * p + 0.001 / CLAIMS)
    assert benchmark.log_score(truth("one", "tip_mass"), claims) == pytest.approx(expected)


def test_sets_of_effects_are_claimed_by_their_weights_the_tied_together() -> None:
    costs = {(): 20.0, ("a",): 10.0, ("b",): 11.0, ("a", "c"): 10.0 + 2.0 * log(2.0)}
    found = ranked({frozenset(names): cost for names, cost in costs.items()})
    weights = np.exp(-0.5 * (np.array(list(costs.values())) - 10.0))
    assert found["a|b"] == pytest.approx(weights[1:3].sum() / weights.sum())
    assert found["a+c"] == pytest.approx(0.5 / weights.sum())
    assert sum(found.values()) == pytest.approx(1.0)
    assert ranked({frozenset(): 0.0, frozenset("a"): 30.0}) == {"complete": pytest.approx(1.0)}


@pytest.mark.parametrize("hides", [True, False])
def test_an_entrant_that_looks_for_the_truth_does_not_find_it(hides: bool, tmp_path: Path) -> None:
    study = tmp_path / "results" / "studies" / "study_000"
    study.mkdir(parents=True)
    (study / "study.yaml").write_text("name: study_000\n", encoding="utf-8")
    file = tmp_path / "results" / "truth.csv"
    list(added_rows(file, Truth, [truth("outside", "spinning_lift")]))
    looks = "study, secret = Path(study), Path(secret)" + SPY
    child = benchmark.CHILD.partition("from tools")[0] + looks
    child = child if hides else child.replace("hide(Path(secret))", "")
    found = benchmark.entered("abstains", study, file.parent, child).failed
    assert (found == "") is hides


def test_an_entrant_whose_package_is_missing_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(benchmark.ENTRANTS, "lasso", (lambda folder: {}, ["no-such-package"]))
    skipped = benchmark.run(tmp_path, [truth("complete", "")], ["lasso"])
    assert skipped == {"lasso": "no-such-package is not installed"}
    assert read_rows(tmp_path / "claims.csv", Entry) == []


def test_others_enter_with_a_file_of_claims(tmp_path: Path) -> None:
    file = tmp_path / "theirs.csv"
    lines = [
        "study,claim,probability",
        "study_000,tip_mass|point_mass,0.7",
        "study_000,outside,0.2",
    ]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    truths = [truth("one", "tip_mass"), replace(truth("complete", ""), study="study_001")]
    entries = benchmark.read_claims("theirs", file, truths)
    (found, *_) = (r for r in benchmark.scores(truths, entries) if r["threshold"] == 0.5)
    assert [found[c] for c in ("condition", "n", "right", "abstained")] == ["theirs", 2, 1, 1]
    file.write_text("\n".join([*lines, "study_001,tip_mas,0.5"]) + "\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"theirs.csv:4: 'tip_mas' 0.5: give .* 'tip_mass'"):
        benchmark.read_claims("theirs", file, truths)


@pytest.mark.parametrize("name", ["largest score", "lasso"])
def test_a_peer_names_a_strong_effect(name: str, tmp_path: Path) -> None:
    try:
        benchmark.versions(name)
    except PackageNotFoundError as error:
        pytest.skip(f"{error.name} is not installed")
    study = make_study(3, [hidden(library()["camera_roll"], 1.0)], noise_m=2e-4, colour=0.0)
    write_study(replace(study, trials=study.trials[:2]), tmp_path)
    claims = benchmark.ENTRANTS[name][0](tmp_path)
    assert benchmark.outcome(truth("one", "camera_roll"), claims) == "right", claims


def test_mujoco_moves_the_chain_of_a_model_as_the_engine_does() -> None:
    study = make_study(3, noise_m=1e-9)
    trial, model = study.trials[0], random_model(np.random.default_rng(3), study.cable, ())
    theirs = sysid_entrant.markers(model, trial, study.arc_length_m)
    ours = simulate(model, trial.grip, trial.markers.t_s, study.arc_length_m, solver=Solver())[0]
    assert np.sqrt(np.mean((theirs - ours) ** 2)) < 5e-5
    assert np.ptp(ours[:, 0, 1]) > 0.02


def test_the_same_seed_gives_the_same_table(tmp_path: Path) -> None:
    """By the command, and by its functions in another folder; CPU seconds differ."""
    command = [sys.executable, "-m", "tools.studies.benchmark_effects", tmp_path / "a",
               "--seed", "5", "--share", "0.01", "--changed", json.dumps(SMALL),
               "--entrants", "largest score", "abstains"]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "| abstains | all | 4 | 0 (0% … 60%) | 0 | 4 | 0 (0% … 60%) | -5.153 |" in done.stdout
    truths = read_rows(tmp_path / "a" / "truth.csv", Truth)
    assert {t.hidden for t in truths} == set(benchmark.FULL)
    assert benchmark.make_studies(tmp_path / "a", [next(benchmark.cases(5, 0.01, SMALL))]) == (
        [t for t in truths if t.study == "study_000"]
    )
    again = next(c for c in benchmark.cases(5, 0.01, SMALL) if c[1] == "one")
    (made,) = benchmark.make_studies(tmp_path / "b", [again])
    study = Path("studies", made.study)
    assert made == next(t for t in truths if t.hidden == "one")
    for file in sorted((tmp_path / "b" / study).rglob("*.*")):
        same = tmp_path / "a" / file.relative_to(tmp_path / "b")
        assert file.read_bytes() == same.read_bytes()
    benchmark.run(tmp_path / "b", [made], ["largest score"])
    (entry,) = read_rows(tmp_path / "b" / "claims.csv", Entry)
    before = read_rows(tmp_path / "a" / "claims.csv", Entry)
    assert entry.claims != "{}"
    assert replace(entry, cpu_s=0.0) in [replace(e, cpu_s=0.0) for e in before]
