"""`cell export` and `cell fit --from`: files, tables, JSON, refusals."""

import json
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.exchange.from_mujoco import model_from_mujoco
from drivers.installing import install_extra

CELL = CliRunner().invoke


def cell(*words):
    return CELL(app, [str(word) for word in words])


@pytest.fixture
def model_file(flat_model, tmp_path):
    model = flat_model(3, 0.93, tip_mass={"mass_kg": 5e-5}, camera_latency={"delay_s": 0.005})
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model.to_dict()), encoding="utf-8")
    return path


def test_a_model_goes_to_mujoco_and_back(model_file, tmp_path):
    xml, back = tmp_path / "cable.xml", tmp_path / "back.json"
    done = cell("export", model_file, "--to", "mujoco", "-o", xml)
    assert done.exit_code == 0, done.output
    assert f"written to {xml}" in done.stdout
    assert "effects in it: tip_mass" in done.stdout
    assert "left out: camera_latency: belongs to the camera" in done.stdout
    assert "50 mm stroke" in done.stdout
    assert "exported from model.json" in xml.read_text(encoding="utf-8")

    done = cell("fit", "--from", xml, "-o", back)
    assert done.exit_code == 0, done.output
    assert "Nothing was measured" in done.stdout
    assert "beyond the chain" in done.stderr
    before, after = (
        {p["name"]: p["value"] for p in json.loads(path.read_text())["parameters"]}
        for path in (model_file, back)
    )
    assert after["exponent"] == pytest.approx(0.93, abs=1e-4)
    for name in ("rigidity_0", "rigidity_5", "viscosity"):
        assert after[name] == pytest.approx(before[name], rel=1e-4)


def test_samples_are_cables_of_the_distribution_with_the_same_links(flat_model, tmp_path):
    model, file = flat_model(3, 1.0), tmp_path / "model.json"
    file.write_text(json.dumps(model.to_dict()), encoding="utf-8")
    xml = tmp_path / "cable.xml"
    done = cell("export", file, "--to", "mujoco", "-o", xml, "--links", 14, "--samples", 3)
    assert done.exit_code == 0, done.output
    assert f"and 3 samples to {tmp_path / 'cable_001.xml'}" in done.stdout.replace("\n", " ")
    drawn = model.samples(3)
    for number, q in enumerate(drawn, 1):
        found = model_from_mujoco(tmp_path / f"cable_{number:03d}.xml").model
        assert found.values == pytest.approx(model.space.natural(q), rel=2e-4)
    assert np.ptp(drawn[:, 0]) > 0.0
    plain = tmp_path / "plain.json"
    done = cell("export", file, "--to", "json", "-o", plain, "--samples", 500)
    assert done.exit_code == 0, done.output
    samples = json.loads(plain.read_text())["samples"]
    assert samples["names"] == list(model.space.names)
    logs = np.log(np.array(samples["values"])[:, :6])
    assert np.cov(logs.T) == pytest.approx(
        model.covariance[:6, :6], abs=0.2 * model.covariance[0, 0]
    )


def test_json_is_printed_and_nothing_beside_it(model_file, tmp_path):
    given = ["export", model_file, "--to", "mujoco", "-o", tmp_path / "cable.xml", "--links", 4]
    done = cell(*given, "--json")
    assert done.exit_code == 1  # four links are too few
    printed = json.loads(done.stdout)
    assert printed["format"] == "cable-export/1"
    assert (printed["links"], printed["within_bar"]) == (4, False)
    assert [one["name"] for one in printed["left_out"]] == ["camera_latency"]
    assert (tmp_path / "cable.xml").exists()

    out = tmp_path / "model.txt"
    done = cell("export", model_file, "--to", "json", "-o", out, "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout) == json.loads(out.read_text())
    done = cell("fit", "--json", "--from", tmp_path / "cable.xml")
    assert json.loads(done.stdout)["method"] == "imported"
    older = tmp_path / "older.json"
    done = cell("fit", "--from", tmp_path / "cable.xml", "--json", older)
    assert json.loads(older.read_text())["method"] == "imported"


@pytest.mark.parametrize("to", ["mujoco", "json"])
def test_what_a_full_disk_refuses_is_not_said_to_be_written(model_file, tmp_path, full_disk, to):
    done = cell("export", model_file, "--to", to, "-o", tmp_path / "out")
    assert done.exit_code == 1
    assert "out: cannot be written: File too large" in done.stderr
    assert "written to" not in done.stdout
    assert not (tmp_path / "out").exists()


def test_a_cycles_folder_stands_for_its_model(model_file, tmp_path):
    done = cell("export", tmp_path, "--to", "json", "-o", tmp_path / "plain.json")
    assert done.exit_code == 0
    done = cell("export", tmp_path / "none", "--to", "json", "-o", tmp_path / "p.json")
    assert done.exit_code == 2
    assert not (tmp_path / "p.json").exists()


def test_what_another_wrote_is_overwritten_by_force_only(model_file, tmp_path):
    for name, to in (("cable.xml", "mujoco"), ("plain.json", "json")):
        out = tmp_path / name
        out.write_text("mine")
        given = ["export", model_file, "--to", to, "-o", out]
        refused = cell(*given)
        assert (refused.exit_code, out.read_text()) == (2, "mine")
        assert "--force" in refused.stderr
        assert cell(*given, "--force").exit_code == 0
        assert cell(*given).exit_code == 0  # its own


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "STUDY is missing"),
        (["study", "--from", "cable.xml"], "leave one out"),
        (["--from", "cable.xml", "--with", "air_drag"], "--with"),
        (["--from", "cable.xml", "--prior", "m.json", "--profile", "p.html"], "--prior, --profile"),
        (["--from", "none.xml"], "none.xml:1:1: cannot be read"),
    ],
)
def test_a_fit_is_to_a_study_or_a_chain(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = cell("fit", *words, "-o", "out.json")
    assert done.exit_code == 2
    assert said in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_without_mujoco_the_extra_is_named(model_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    xml = tmp_path / "cable.xml"
    done = cell("export", model_file, "--to", "mujoco", "-o", xml)
    assert (done.exit_code, xml.exists()) == (2, False)
    assert install_extra("mujoco") in done.stderr
    xml.write_text("<mujoco/>")
    done = cell("fit", "--from", xml, "-o", tmp_path / "back.json")
    assert (done.exit_code, (tmp_path / "back.json").exists()) == (2, False)
    assert install_extra("mujoco") in done.stderr
    plain = cell("export", model_file, "--to", "json", "-o", tmp_path / "plain.json")
    assert plain.exit_code == 0


def test_only_mujoco_takes_links_and_studies(model_file, tmp_path):
    done = cell("export", model_file, "--to", "json", "-o", tmp_path / "p.json", "--links", 20)
    assert done.exit_code == 2
    assert "--to mujoco" in done.stderr
