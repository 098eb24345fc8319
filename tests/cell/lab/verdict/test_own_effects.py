"""A user's own effect counts in every command, and a model is used with no other file of it."""

import hashlib
import json
import shutil

import pytest
from typer.testing import CliRunner

from cell.cable.effects import load_effect
from cell.cli import app
from cell.lab.data import named_effects
from cell.study.folder import write_study
from tests.command import run_cell

run = CliRunner().invoke

PULL = '''
from cell.cable.effects import Effect, Parameter


class SidePull(Effect):
    """Constant pull to the side, per metre."""

    name = "side_pull"
    parameters = (Parameter("pull_n_m", "N/m", -1.0, 1.0, 0.0, (5e-3,)),)

    def force(cable, at, p):
        return p.pull_n_m, 0.0
'''
STRENGTH_N_M = 0.012
NOISE_M = 1e-4


@pytest.fixture(scope="module")
def effect_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("effects") / "pull.py"
    path.write_text(PULL)
    return path


@pytest.fixture(scope="module")
def folder(make_study, effect_file, tmp_path_factory):
    """A recorded cycle's folder; the study is in it."""
    hidden = load_effect(effect_file).active(pull_n_m=STRENGTH_N_M)
    cycle = tmp_path_factory.mktemp("cycle")
    write_study(make_study([hidden], seed=21, noise_m=NOISE_M), cycle / "study")
    return cycle


def fit(folder, model, *options):
    run_cell("fit", folder, "-o", model, *options)
    return json.loads(model.read_text())


def compare(folder, model, out, *options):
    given = ["compare", str(folder), "--model", str(model), "--json", str(out)]
    return run(app, [*given, *map(str, options)])


def heldout_m(folder, model, tmp_path, *options):
    out = tmp_path / "comparison.json"
    done = compare(folder, model, out, *options)
    assert done.exit_code == 0, done.output
    return json.loads(out.read_text())["heldout_rms_m"]


@pytest.fixture(scope="module")
def model(folder, effect_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "with.json"
    fit(folder, path, "--with", effect_file)
    return path


@pytest.fixture(scope="module")
def without(folder, tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "without.json"
    fit(folder, path)
    return path


def test_an_own_effect_is_fitted_and_the_error_falls_to_the_noise(
    folder, effect_file, model, without, tmp_path
):
    assert json.loads(without.read_text())["effects"] == []
    assert heldout_m(folder, without, tmp_path) > 3.0 * NOISE_M
    data = json.loads(model.read_text())
    found = {p["name"]: p["value"] for p in data["parameters"]}
    assert found["side_pull.pull_n_m"] == pytest.approx(STRENGTH_N_M, rel=0.02)
    sha256 = hashlib.sha256(effect_file.read_bytes()).hexdigest()
    assert data["effect_files"]["side_pull"] == {"path": str(effect_file), "sha256": sha256}
    assert heldout_m(folder, model, tmp_path) < 1.03 * NOISE_M


def copied(model, effect_file, tmp_path):
    """The model with its effect in a place that a test may change."""
    mine, mine_model = tmp_path / "mine.py", tmp_path / "model.json"
    shutil.copy(effect_file, mine)
    data = json.loads(model.read_text())
    data["effect_files"]["side_pull"]["path"] = str(mine)
    mine_model.write_text(json.dumps(data))
    return mine, mine_model


def test_a_changed_file_of_a_models_effect_is_refused_with_both_hashes(
    folder, effect_file, model, tmp_path
):
    mine, mine_model = copied(model, effect_file, tmp_path)
    before = hashlib.sha256(mine.read_bytes()).hexdigest()
    mine.write_text(PULL.replace("return p.pull_n_m", "return 2.0 * p.pull_n_m"))
    after = hashlib.sha256(mine.read_bytes()).hexdigest()
    out = tmp_path / "out.json"
    for given in ((), ("--with", mine)):
        done = compare(folder, mine_model, out, *given)
        assert done.exit_code == 2
        for part in (str(mine_model), str(mine), before, after, "fit the model again"):
            assert part in done.output
    run_cell("fit", folder, "--prior", mine_model, "-o", out, code=2)
    assert not out.exists()


def test_a_missing_file_of_a_models_effect_is_named_and_may_be_given_elsewhere(
    folder, effect_file, model, tmp_path
):
    mine, mine_model = copied(model, effect_file, tmp_path)
    elsewhere = tmp_path / "elsewhere" / "renamed.py"
    elsewhere.parent.mkdir()
    mine.rename(elsewhere)
    done = compare(folder, mine_model, tmp_path / "out.json")
    assert done.exit_code == 2
    sha256 = json.loads(model.read_text())["effect_files"]["side_pull"]["sha256"]
    for part in (str(mine), sha256, "missing", "--with"):
        assert part in done.output
    assert heldout_m(folder, mine_model, tmp_path, "--with", elsewhere) < 1.03 * NOISE_M
    moved = elsewhere.parent / "model.json"
    shutil.copy(mine_model, moved)
    elsewhere.rename(elsewhere.with_name("mine.py"))
    assert heldout_m(folder, moved, tmp_path) < 1.03 * NOISE_M


def test_an_effect_that_no_model_has_is_refused(folder, effect_file, without, tmp_path):
    for name in (effect_file, "air_drag"):
        done = compare(folder, without, tmp_path / "out.json", "--with", name)
        assert done.exit_code == 2
        assert f"cell fit STUDY --with {name}" in done.output


@pytest.fixture
def few_rivals(monkeypatch):
    known = named_effects.library()
    rivals = {n: known[n] for n in ("tip_mass", "air_drag", "natural_curvature")}
    monkeypatch.setattr(named_effects, "library", lambda: rivals)
    return set(rivals)


def test_a_priors_own_effect_is_part_of_the_next_model(
    folder, effect_file, model, tmp_path, few_rivals
):
    for given in ((), ("--with", effect_file)):
        again = fit(folder, tmp_path / "again.json", "--prior", model, *given)
        assert again["effects"] == ["side_pull"]
        assert again["residual_rms_m"] < 1.03 * NOISE_M


def test_a_diagnosis_finds_an_own_effect_and_takes_a_known_one_as_given(
    folder, effect_file, tmp_path, few_rivals
):
    out = tmp_path / "d.json"
    given = ["diagnose", str(folder), "--json", str(out)]
    run_cell(*given, "--try", effect_file)
    found = json.loads(out.read_text())
    assert found["verdict"] == "missing"
    assert [f["effect"] for f in found["missing"]] == ["side_pull"]
    run_cell(*given, "--with", effect_file)
    found = json.loads(out.read_text())
    assert found["verdict"] == "complete"
    assert found["baseline"]["heldout_rms_m"] < 1.03 * NOISE_M
    assert {r["effect"] for r in found["ranking"]} == few_rivals


def test_a_cable_is_identified_again_with_an_own_effect(folder, effect_file):
    done = run_cell("identify", folder, "--json", "--with", effect_file)
    found = {p["name"]: p for p in json.loads(done.stdout)["parameters"]}
    pull = found["side_pull.pull_n_m"]
    assert pull["low"] < STRENGTH_N_M < pull["high"]


@pytest.mark.parametrize("command", ["fit", "diagnose", "suggest", "discover", "identify"])
def test_two_effects_of_one_name_are_refused(folder, effect_file, tmp_path, command):
    twin, shadow = tmp_path / "twin.py", tmp_path / "shadow.py"
    shutil.copy(effect_file, twin)
    shadow.write_text(PULL.replace('"side_pull"', '"air_drag"'))
    option = "--try" if command in ("diagnose", "suggest") else "--with"
    given = [
        command,
        str(folder),
        *(["-o", str(tmp_path / "x.py")] if command == "discover" else []),
    ]
    done = run_cell(*given, option, effect_file, option, twin, code=2)
    assert "side_pull" in done.output
    done = run_cell(*given, option, shadow, code=2)
    assert "air_drag" in done.output


def test_what_an_own_effect_prints_is_no_part_of_the_json(folder, tmp_path, capfd):
    """Neither what its law prints nor what its file does; a law that prints is not compiled."""
    path = tmp_path / "pull.py"
    in_law = PULL.replace("        return", "        print('hello')\n        return")
    in_file = f"{PULL}\nprint('hello')\n"
    for text, command in (
        (in_law, ["effects", "--try", path]),
        (in_file, ["diagnose", folder, "--try", path]),
    ):
        path.write_text(text)
        done = run_cell(*command, "--json")
        assert json.loads(done.stdout)
        assert "hello" in done.stderr + capfd.readouterr().err, command
