"""Cycles are recorded, and a recording is enough to decide the same again."""

from __future__ import annotations

import json
import logging
import zipfile
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cell.cli.cycle_tables import replayed_parts
from cell.cli.output import show
from cell.files.input_error import InputError
from cell.records.cycle_page import flight_of
from cell.records.folder import read_record
from cell.records.recording import form
from cell.records.recording.film import read_film
from cell.records.recording.reading import read_recording
from cell.records.recording.recover import recover_in_place
from cell.records.result import Outcome
from cell.settings import Settings, load_settings
from cell.settings.records import RecordingSettings
from cell.wiring.build import build_cell
from cell.wiring.replay import replay
from tools.faults.kill_study import kill_once

from .conftest import changed, run, unrecorded


def recorded_cycles(settings: Settings, runs: Path, count: int = 1, **changes):
    """Results of simulated cycles that were recorded."""
    wanted = RecordingSettings(**changes)
    settings = settings.model_copy(update={"recording": wanted})
    cell = build_cell(settings, runs, seed=1, cycles=count)
    try:
        return [cell.run_cycle(number) for number in range(1, count + 1)]
    finally:
        cell.close()


@pytest.fixture(scope="module")
def recorded(quick, tmp_path_factory) -> Path:
    """Folder of a cycle that was recorded."""
    logging.getLogger("cell").setLevel("INFO")  # as the commands do
    try:
        (result,) = recorded_cycles(quick, tmp_path_factory.mktemp("recorded"))
    finally:
        logging.getLogger("cell").setLevel("NOTSET")
    assert result.outcome is Outcome.INSERTED
    return Path(result.folder)


def test_its_model_goes_to_mujoco_and_comes_back(recorded, tmp_path):
    """From the folder, from the recording alone, and identified again from the folder."""
    xml, back, again = (tmp_path / name for name in ("cable.xml", "back.json", "again.json"))
    assert run("export", recorded, "--to", "mujoco", "-o", xml).returncode == 0
    assert run("fit", "--from", xml, "-o", back).returncode == 0
    assert run("identify", recorded, "-o", again).returncode == 0
    models = {}
    for model in (recorded / form.FILE, again):
        plain = tmp_path / "plain.json"
        assert run("export", model, "--to", "json", "-o", plain).returncode == 0
        models[model] = json.loads(plain.read_text())["bending"]
    of_recording, of_identify = models.values()
    assert of_identify["rigidity_n_m2"] == pytest.approx(of_recording["rigidity_n_m2"], rel=0.1)
    found = {p["name"]: p["value"] for p in json.loads(back.read_text())["parameters"]}
    for i, rigidity in enumerate(of_recording["rigidity_n_m2"]):
        assert found[f"rigidity_{i}"] == pytest.approx(rigidity, rel=1e-4)
    assert found["exponent"] == pytest.approx(of_recording["exponent"], abs=1e-4)
    assert found["viscosity"] == pytest.approx(of_recording["viscosity_n_m2_s"], rel=1e-6)


def test_everything_is_in_it(recorded):
    recording = read_recording(recorded)
    result = json.loads((recorded / "result.json").read_text())
    model = json.loads((recorded / "model.json").read_text())
    assert recording.complete
    assert recording.last(form.RESULT) == result
    assert recording.last(form.MODEL) == model
    assert recording.last(form.DECISION)["offset_m"] == result["offset_m"]
    flight = flight_of(read_record(recorded), recording)
    inside = (flight.t_s >= flight.inside_s[0]) & (flight.t_s <= flight.inside_s[1])
    largest_m = np.linalg.norm(flight.error_m[inside], axis=1).max()
    assert largest_m == pytest.approx(result["prediction_error_m"], rel=1e-12)
    corners_px = read_film(recorded / form.FILE).destination_px
    scale = recording.last(form.SETTINGS)["settings"]["camera"]["view"]["metres_per_pixel"]
    size_m = np.ptp(flight.destination_m, axis=0)
    assert np.ptp(corners_px, axis=0) == pytest.approx(size_m / scale)
    assert recording.count(form.IMAGE) == recording.count(form.SEEN) > 100
    steps = [s["step"] for s in recording.json(form.STATE) if s["step"]]
    assert steps == list(result["seconds"])
    seconds = recording.last(form.FILMING)["end_s"] - recording.last(form.FILMING)["begin_s"]
    assert recording.count(form.MEASURED) > 500 * seconds
    assert any("step lower took" in text for text in log_of(recording))


def test_of_an_inserted_cable_a_band_is_kept_unless_whole_frames_are_asked_for(
    recorded, quick_config, tmp_path
):
    """By `cell run --whole-frames`; both are replayed to the same end."""
    assert {p.name for p in recorded.glob("recording*")} == {form.FILE}
    said = list(read_recording(recorded).json(form.FRAME))
    assert sum("blank" not in frame for frame in said) <= 0.1 * len(said)
    text = "\n".join(
        line for line in quick_config.read_text("utf-8").splitlines() if line != "recording: null"
    )
    (tmp_path / "cell.yaml").write_text(text, "utf-8")
    command = "run", "--config", tmp_path / "cell.yaml", "--whole-frames", "--runs"
    done = run(*command, tmp_path / "runs")
    assert done.returncode == 0, done.stderr
    (whole,) = (tmp_path / "runs").glob(f"*/{form.FILE}")
    assert not any("blank" in frame for frame in read_recording(whole).json(form.FRAME))
    assert whole.stat().st_size > 5 * (recorded / form.FILE).stat().st_size
    unrecorded(tmp_path / "cell.yaml")
    done = run(*command, tmp_path / "none")
    assert done.returncode == 2
    assert "leave out --whole-frames" in done.stderr
    assert not (tmp_path / "none").exists()


def test_frames_of_a_cable_that_is_not_inserted_stay_whole_too(quick, tmp_path):
    out_of_reach = quick.destination.model_copy(update={"y_m": (0.5, 0.51)})
    settings = quick.model_copy(update={"destination": out_of_reach})
    (result,) = recorded_cycles(settings, tmp_path / "runs")
    assert result.outcome is Outcome.REJECTED
    folder = Path(result.folder)
    assert {p.name for p in folder.glob("recording*")} == {form.FILE, form.WHOLE}
    frames = read_recording(folder / form.WHOLE).json(form.FRAME)
    assert not any("blank" in frame for frame in frames)
    again = replay(read_recording(folder), None, tmp_path / "again")
    assert again.decided and again.differences == ()


def log_of(recording):
    from foxglove_schemas_protobuf.Log_pb2 import Log
    from mcap.reader import make_reader

    with recording.path.open("rb") as file:
        messages = make_reader(file).iter_messages(topics=[form.LOG])
        return [Log.FromString(m.data).message for _, _, m in messages]


def test_the_lab_takes_a_recording_in_place_of_its_folder(recorded, tmp_path):
    """From the file alone, wherever it lies, the same numbers."""
    moved = tmp_path / "elsewhere.mcap"
    moved.write_bytes((recorded / form.FILE).read_bytes())
    by_file, by_folder = (run("identify", place, "--json") for place in (moved, recorded))
    assert by_file.returncode == 0, by_file.stderr
    assert json.loads(by_file.stdout) == json.loads(by_folder.stdout)
    done = run("study", moved, "-o", tmp_path / "study")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "study" / "study.yaml").exists()
    done = run("identify", tmp_path / "none.mcap")
    assert done.returncode == 2
    assert "none.mcap:1: is missing" in done.stderr


def test_a_report_shows_film_decision_and_path(recorded, tmp_path):
    """From the recording alone; the folder adds its pictures."""
    moved = tmp_path / "elsewhere.mcap"
    moved.write_bytes((recorded / form.FILE).read_bytes())
    for given, pictures in ((moved, 10), (recorded, 14)):
        done = run("report", given, "-o", tmp_path / "report.html")
        assert done.returncode == 0, done.stderr
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert page.count("data:image/jpeg;base64,") == pictures
        for heading in ("Film", "Path of the tip", "Decision", "This cable", "Times"):
            assert f"<h2>{heading}</h2>" in page
        assert "taken</td>" in page


def test_the_same_software_decides_the_same(recorded, tmp_path):
    replayed = replay(read_recording(recorded), None, tmp_path)
    assert replayed.decided
    assert replayed.differences == ()
    assert replayed.software == {}
    (folder,) = tmp_path.iterdir()
    then = json.loads((recorded / "result.json").read_text())
    now = json.loads((folder / "result.json").read_text())
    same = set(then) - {"folder", "seconds", "state_seconds", "wait_s"}
    assert {k: now[k] for k in same} == {k: then[k] for k in same}


def test_other_settings_are_compared(recorded, quick_config, tmp_path, capsys):
    other = changed(
        quick_config, tmp_path / "other.yaml", [("[-0.111, -0.101]", "[-0.112, -0.109]")]
    )
    replayed = replay(read_recording(recorded), other, tmp_path)
    assert replayed.differences[0].name == "decision.offset_m"
    assert "no film of this motion" in replayed.result.fault.cause  # the execution was another
    show(*replayed_parts(replayed, most=3), console=Console(width=200))
    printed = capsys.readouterr().out
    assert "decision.offset_m" in printed
    assert f"and {len(replayed.differences) - 3} more" in printed


@pytest.mark.parametrize("name", [form.PART, form.FILE])
def test_what_a_torn_recording_holds_is_replayed(recorded, tmp_path, name):
    """By the commands, as a user does it."""
    data = (recorded / form.FILE).read_bytes()
    torn = tmp_path / name
    torn.write_bytes(data[: int(0.8 * len(data))])  # in the middle of the execution
    with pytest.raises(InputError, match="cell recover"):
        read_recording(tmp_path)
    done = run("recover", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "verified" in done.stdout
    done = run("replay", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    replayed = json.loads(done.stdout)
    assert replayed["decided"]  # from the same frames, the same
    assert replayed["identical"]
    assert not replayed["complete"]
    assert replayed["result"]["outcome"] == "failed"  # frames of the execution are missing


def test_a_replay_says_damage_first(recorded, tmp_path):
    """As `recover` does, which makes of it what can be replayed, and says what that lacks."""
    data = bytearray((recorded / form.FILE).read_bytes())
    data[len(data) // 2] ^= 0x10
    file = tmp_path / form.FILE
    file.write_bytes(data)
    with pytest.raises(InputError, match=f"damaged: .*; `cell recover {file}`"):
        replay(read_recording(tmp_path), None, tmp_path)
    recovered = recover_in_place(file)
    replayed = replay(read_recording(tmp_path), None, tmp_path)
    assert replayed.losses == (f"{recovered.damaged_bytes} damaged bytes could not be recovered",)


@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({"keep": ["inserted"]}, [True]),
        ({"keep": ["missed"], "keep_every": 2}, [False, True]),
    ],
)
def test_only_what_is_wanted_is_kept(quick, tmp_path, changes, kept):
    results = recorded_cycles(quick, tmp_path, len(kept), **changes)
    assert [r.outcome for r in results] == [Outcome.INSERTED] * len(kept)
    assert [(Path(r.folder) / form.FILE).exists() for r in results] == kept
    assert not list(tmp_path.rglob(form.PART))


def test_nothing_is_recorded_if_that_is_wanted(quick, tmp_path):
    settings = quick.model_copy(update={"recording": None})
    cell = build_cell(settings, tmp_path, seed=1, cycles=1)
    result = cell.run_cycle(1)
    cell.close()
    with pytest.raises(InputError, match="was not recorded"):
        read_recording(Path(result.folder))


@pytest.mark.real_time
@pytest.mark.parametrize("both", [False, True])
def test_a_killed_cell_leaves_all_but_the_last_instant(recorded_config, tmp_path, both):
    """The bar is 50 ms, measured by the study; a busy computer may stall a process for longer."""
    kill = kill_once(recorded_config, tmp_path, 0, after_s=2.0, both=both)
    assert kill.frames > 0
    assert kill.poses_lost_s < 0.5
    assert not kill.frames_lost_s > 0.5
    assert kill.finished_cycles == kill.results


def test_calibration_and_own_effects_are_in_it(quick, tmp_path):
    """A recording is enough, whatever becomes of the files that the settings named."""
    from cell.records.recording.unpack import restored_files
    from cell.settings.provenance import files_of

    own = tmp_path / "own.py"
    own.write_text("an effect")
    effect = {"effect": str(own)}
    model = quick.model.model_validate({"effects": [effect]})
    assert files_of(quick.model_copy(update={"model": model})) == {str(own): "an effect"}
    said = {
        "settings": {"calibration": {"folder": "gone"}, "model": {"effects": [dict(effect)]}},
        "files": {str(own): "an effect", "gone/time.yaml": "a: 1"},
    }

    class Recording:
        path = tmp_path

        def last(self, topic):
            return said

    restored = restored_files(Recording(), tmp_path / "restored")
    assert Path(restored["model"]["effects"][0]["effect"]).read_text() == "an effect"
    assert (Path(restored["calibration"]["folder"]) / "time.yaml").read_text() == "a: 1"


def test_the_shipped_settings_record(recorded_config):
    assert load_settings(recorded_config).recording == RecordingSettings()


def with_store(recorded_config: Path, tmp_path: Path) -> Path:
    """Settings with a store, a folder that is not there yet."""
    config = tmp_path / "stored.yaml"
    said = f"\nrecording: {{store: {tmp_path / 'nas'}}}\nledger: {{line: line 3}}\n"
    config.write_text(recorded_config.read_text() + said)
    return config


def test_recordings_go_to_a_store_between_cables(tmp_path, recorded_config):
    (tmp_path / "nas").mkdir()
    config = with_store(recorded_config, tmp_path)
    runs = tmp_path / "runs"
    done = run("run", "--config", config, "--cycles", "2", "--runs", runs)
    assert done.returncode == 0, done.stderr
    folders = sorted(f for f in runs.iterdir() if f.is_dir())
    assert len(folders) == 2
    assert not list(runs.glob(f"*/{form.FILE}"))
    there = sorted((tmp_path / "nas").rglob(form.FILE))
    assert [p.parent.name for p in there] == [f.name for f in folders]
    assert {p.parent.parent.name for p in there} == {"line 3"}
    assert "cell fetch" in run("replay", folders[0]).stderr
    assert run("fetch", folders[0]).returncode == 0
    assert run("replay", folders[0]).returncode == 0


def test_upload_brings_what_a_run_could_not(tmp_path, recorded_config):
    config = with_store(recorded_config, tmp_path)
    runs = tmp_path / "runs"
    done = run("run", "--config", config, "--runs", runs)
    assert done.returncode == 0  # the cable is in
    assert "not uploaded yet: 1" in done.stderr and "make it, or mount it" in done.stderr
    failed = run("upload", runs, "--config", config)
    assert failed.returncode == 1 and "make it, or mount it" in failed.stderr
    (tmp_path / "nas").mkdir()
    done = run("upload", runs, "--config", config).stdout
    assert done.endswith("uploaded and verified: 1; not uploaded: 0\n")
    assert list((tmp_path / "nas").rglob(form.FILE))
    assert run("upload", runs, "--config", recorded_config).returncode == 2
    (folder,) = (f for f in runs.iterdir() if f.is_dir())
    (folder / form.STORED).unlink()
    assert run("fetch", folder).returncode == 2


def test_a_bundle_is_what_a_maker_needs(recorded, quick_config, tmp_path):
    out = tmp_path / "bundle.zip"
    words = ("--runs", recorded.parent, "--config", quick_config, "-o", out)
    done = run("bundle", *words)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(out) as bundle:
        names = bundle.namelist()
        bundle.extractall(tmp_path / "there")
    assert {"versions.txt", f"settings/{quick_config.name}", "ledger/cycles.csv"} <= set(names)
    there = tmp_path / "there" / "cycles" / recorded.name
    assert run("replay", there).returncode == 0
    assert "numba==" in (tmp_path / "there" / "versions.txt").read_text()
    assert run("bundle", *words).returncode == 0  # one bundle replaces another
    again = run("bundle", *words, "--force", "--no-recordings", "--json")
    assert not any(name.endswith(".mcap") for name in json.loads(again.stdout)["files"])
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("cable: [")
    packed = run(
        "bundle", "--runs", recorded.parent, "-c", wrong, "-n", "0", "-o", tmp_path / "b.zip"
    )
    assert packed.returncode == 0, packed.stderr
    with zipfile.ZipFile(tmp_path / "b.zip") as bundle:
        assert "wrong.yaml" in bundle.read("settings/errors.txt").decode()
    assert run("bundle", tmp_path, "-o", tmp_path / "c.zip").returncode == 2
    assert run("bundle", "-c", tmp_path / "gone.yaml", "-o", tmp_path / "c.zip").returncode == 2
    assert not (tmp_path / "c.zip").exists()


def test_a_hold_that_ended_early_is_replayed(tmp_path, recorded_config):
    """With other settings that ask for more frames than were filmed, the replay says so."""
    hold = ("hold_s: 0.4", "start: {}\n  hold: {least_s: 0.4, most_s: 1.0}")
    config = changed(recorded_config, tmp_path / "hold.yaml", [hold])
    done = run("run", "--config", config, "--cycles", "1", "--runs", tmp_path / "runs", "--json")
    result = json.loads(done.stdout.splitlines()[0])
    assert result["outcome"] == "inserted" and result["hold_saved_s"] > 0.5
    again = run("replay", result["folder"], "--json")
    assert json.loads(again.stdout)["identical"], again.stdout
    longer = changed(recorded_config, tmp_path / "longer.yaml", [("hold_s: 0.4", "hold_s: 1.0")])
    again = run("replay", result["folder"], "--config", longer, "--json")
    fault = json.loads(again.stdout)["result"]["fault"]
    assert fault["cause"].startswith("this film was ended 36 frames earlier")
    assert "motion.hold" in fault["remedy"]


def test_an_insertion_that_begins_later_is_recorded_and_replayed(tmp_path, recorded_config):
    """A narrow opening: at once no offset passes."""
    config = changed(
        recorded_config,
        tmp_path / "narrow.yaml",
        [
            ("y_m: [-0.111, -0.101]", "y_m: [-0.107, -0.105]"),
            ("motion:\n", "motion:\n  start: {window_s: 0.25}\n"),
        ],
    )
    runs = tmp_path / "runs"
    done = run("run", "--config", config, "--runs", runs)
    (result,) = [json.loads(f.read_text()) for f in runs.glob("*/result.json")]
    assert result["outcome"] == "inserted", done.stderr
    assert result["delay_s"] > 0.0
    again = run("replay", result["folder"], "--json")
    assert json.loads(again.stdout)["identical"], again.stdout
