"""Commands end to end: files written, tables printed, bad input refused with nothing written."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from cell.cable.effects import library
from cell.cli import app
from cell.files.input_error import InputError
from cell.lab.data.opened_study import open_study
from cell.study.folder import read_study, write_study
from tests.command import run_cell

run = CliRunner().invoke


@pytest.fixture(scope="module")
def folder(make_study, tmp_path_factory):
    study = make_study([library()["tip_mass"].active(mass_kg=2.5e-5)], seed=11)
    path = tmp_path_factory.mktemp("study") / "made"
    write_study(study, path)
    return path


def test_fit_with_an_effect_then_compare_and_report(folder, tmp_path):
    model, page, out = tmp_path / "model.json", tmp_path / "page.html", tmp_path / "c.json"
    run_cell("fit", folder, "--with", "tip_mass", "-o", model)
    found = {p["name"]: p for p in json.loads(model.read_text())["parameters"]}
    assert found["tip_mass.mass_kg"]["value"] == pytest.approx(2.5e-5, rel=0.05)

    given = ["compare", str(folder), "--model", str(model)]
    run_cell(*given, "--json", out, "--report", page)
    comparison = json.loads(out.read_text())
    assert comparison["heldout_rms_m"] == pytest.approx(1e-4, rel=0.05)
    text = page.read_text()
    assert "identify" in text
    assert 'src="http' not in text  # nothing is loaded from a network


def test_on_a_full_disk_a_fit_is_printed_and_leaves_nothing(folder, tmp_path, full_disk):
    files = ["-o", str(tmp_path / "model.json")]
    done = run_cell("fit", folder, *files, code=1)
    assert "viscosity" in done.stdout
    assert "model.json: cannot be written: File too large" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_results_that_would_replace_each_other_are_refused(folder, tmp_path):
    both = str(tmp_path / "a.json")
    done = run(app, ["fit", str(folder), "-o", both, "--profile", both])
    assert (done.exit_code, "is given for two results" in done.stderr) == (2, True)
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_no_file_can_have_is_wrong_input(tmp_path):
    done = run_cell("fit", "a" * 300, code=2)
    assert "File name too long; check the name" in done.stderr


def test_effects_are_listed_with_units(tmp_path):
    out = tmp_path / "effects.json"
    run_cell("effects", "--json", out)
    listed = {e["effect"]: e for e in json.loads(out.read_text())["effects"]}
    assert set(listed) == set(library())
    assert listed["tip_mass"]["parameters"][0]["unit"] == "kg"


def test_an_effect_to_check_is_shown_alone_with_its_checks(tmp_path):
    """Success was one row at the end of the table of all effects."""
    path = tmp_path / "lift.py"
    path.write_text(LIFT)
    printed = run_cell("effects", "--try", path).output
    said = "lift: 3 checks passed: force: finite at 5 sets of parameters; force: compiles; off at"
    assert printed.startswith(said)
    assert "Up on every piece" in printed and "air_drag" not in printed


LIFT = '''
from cell.cable.effects import Effect, Parameter


class Lift(Effect):
    """Up on every piece of the cable."""

    name = "lift"
    parameters = (Parameter("up_n_m", "N/m", 0.0, 1.0, default=0.0, starts=(0.01,)),)

    def force(cable, at, p):
        return 0.0, p.up_n_m
'''


def test_study_gathers_cycles_and_counts_a_recording_once(folder, tmp_path):
    cycle = tmp_path / "cycle"
    shutil.copytree(folder, cycle / "study")
    out = tmp_path / "gathered"
    done = run_cell("study", cycle, folder, "-o", out)
    trials = read_study(out).trials
    assert [t.role for t in trials] == [t.role for t in read_study(folder).trials]
    assert done.output.count("are one recording") == 3


def broken(folder, tmp_path, change):
    path = tmp_path / "broken"
    shutil.copytree(folder, path)
    change(path)
    return path


def edit_header(path, **cable):
    header = yaml.safe_load((path / "study.yaml").read_text())
    header["cable"].update(cable)
    (path / "study.yaml").write_text(yaml.safe_dump(header))


def change_lines(path, change, file="markers.csv"):
    table = path / "identify" / file
    table.write_text("\n".join(change(table.read_text().splitlines())) + "\n")


def in_millimetres(lines):
    rows = [[float(v) for v in line.split(",")] for line in lines[1:]]
    return [
        lines[0],
        *(",".join(str(v * (1e3 if i else 1)) for i, v in enumerate(r)) for r in rows),
    ]


@pytest.mark.parametrize("command", ["fit", "compare", "diagnose", "discover", "suggest"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: edit_header(p, free_length_m=100.0), "study.yaml:"),
        (lambda p: change_lines(p, in_millimetres), "markers.csv:2: x0_m"),
        (lambda p: change_lines(p, lambda t: [*t[:6], t[5], *t[6:]]), "markers.csv:7: t_s"),
        (lambda p: change_lines(p, lambda t: [*t[:6], t[7], t[6], *t[8:]]), "markers.csv:8: t_s"),
        (
            lambda p: change_lines(p, lambda t: [r.rsplit(",", 1)[0] for r in t]),
            "markers.csv:1: column y10_m is missing",
        ),
        (lambda p: change_lines(p, lambda t: t[:50]), "markers.csv:50: t_s: ends"),
        (lambda p: (p / "identify" / "grip.csv").unlink(), "grip.csv:1"),
    ],
)
def test_bad_studies_are_refused_and_nothing_is_written(folder, tmp_path, command, change, says):
    out = tmp_path / "out"
    out.mkdir()
    given = {"compare": ["--model", "none.json"], "discover": ["-o", str(out / "x.py")]}
    given |= {"suggest": ["-o", str(out / "x.yaml")]}
    study = str(broken(folder, tmp_path, change))
    done = run_cell(command, study, "--json", out / "x.json", *given.get(command, []), code=2)
    assert says in done.output
    assert list(out.iterdir()) == []


def test_wrong_values_of_a_hands_log_are_told_with_their_place_and_size(folder, tmp_path):
    """One of them in the first line made the model swing by millimetres before the gripper
    moved."""

    def jumps(lines):
        t, x, *rest = lines[1].split(",")
        return [lines[0], ",".join([t, str(float(x) + 1.2e-4), *rest]), *lines[2:]]

    path = broken(folder, tmp_path, lambda p: change_lines(p, jumps, "grip.csv"))
    (note,) = open_study(path).notes
    assert note.startswith(str(path / "identify" / "grip.csv"))
    assert "x_m jumps" in note and "line 2 by +0.12 mm; left out" in note


def test_markers_that_never_move_are_refused(folder, tmp_path):
    """A fit of them missed millimetres "of markers that move by 2.19e-14 mm"."""
    study = read_study(folder)
    trials = []
    for trial in study.trials:
        xy_m = np.repeat(trial.markers.xy_m[:1], len(trial.markers.t_s), axis=0)
        grip = replace(trial.grip, x_m=0.1 * trial.grip.x_m, y_m=0.1 * trial.grip.y_m)
        trials.append(replace(trial, grip=grip, markers=replace(trial.markers, xy_m=xy_m)))
    write_study(replace(study, trials=tuple(trials)), tmp_path / "stands")
    with pytest.raises(InputError, match=r"rows in which no marker moves by 0.001 mm: record a"):
        open_study(tmp_path / "stands")


def test_wrong_values_of_markers_are_told_with_their_place_and_size(folder, tmp_path):
    """30 mm in one of thousands of numbers made a complete model `unexplained`."""

    def jumps(lines):
        cells = lines[150].split(",")
        cells[7] = str(float(cells[7]) + 0.03)
        return [*lines[:150], ",".join(cells), *lines[151:]]

    path = broken(folder, tmp_path, lambda p: change_lines(p, jumps))
    (note,) = open_study(path).notes
    assert note.startswith(f"{path / 'identify' / 'markers.csv'}: 1 value lies apart")
    assert "line 151, x3_m by +30 mm; left out" in note


def test_a_prior_of_another_cable_is_refused(folder, tmp_path):
    model = tmp_path / "model.json"
    run_cell("fit", folder, "-o", model)
    other = broken(folder, tmp_path, lambda p: edit_header(p, line_density_kg_per_m=0.01))
    done = run_cell("diagnose", other, "--prior", model, code=2)
    assert "another cable" in done.output


def test_unknown_effects_are_refused_with_a_guess(folder):
    done = run_cell("fit", folder, "--with", "air_darg", code=2)
    assert "air_drag" in done.output


def test_all_nan_markers_are_refused(folder, tmp_path):
    def blind(path):
        file = path / "identify" / "markers.csv"
        head, *rows = file.read_text().splitlines()
        empty = [",".join([r.split(",")[0]] + ["nan"] * head.count(",")) for r in rows]
        file.write_text("\n".join([head, *empty]) + "\n")

    done = run_cell("fit", broken(folder, tmp_path, blind), code=2)
    assert "no marker is seen" in done.output


@pytest.mark.parametrize("option", ["-o", "--json"])
def test_a_place_that_cannot_be_written_is_refused_before_the_work(folder, tmp_path, option):
    (tmp_path / "file").write_text("")
    for place, says in ((tmp_path, "is a folder"), (tmp_path / "file" / "x.json", "no folder")):
        done = run_cell("fit", "/no/such/study", option, place, code=2)
        assert says in done.output


def test_a_config_or_effect_that_is_missing_is_named(folder, tmp_path):
    out = tmp_path / "motion.yaml"
    done = run_cell("suggest", folder, "--config", "nowhere.yaml", "-o", out, code=2)
    assert "nowhere.yaml:1" in done.output
    assert not out.exists()


def test_no_command_waits_for_statistics_that_it_does_not_use() -> None:
    """`scipy.stats` and `scipy.signal` take half a second of every start."""
    program = (
        "import sys, cell.lab.search.setup, cell.lab.strength.limits, cell.lab.next.suggest\n"
        "print(*sorted({'scipy.stats', 'scipy.signal'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "\n")
